"""Messages, samples, flow fields and observations -> Arrow tables: typed columns whose metadata state unit and meaning.

The rows come from `SessionReader.rows`. A batch has at most some thousand rows and some 8 MB, so a session of
any length is streamed. https://arrow.apache.org/docs/python/data.html#record-batches
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flowrec.core import (
    FIXED,
    NS_PER_S,
    SAMPLES,
    VALUES,
    Bools,
    FlowField,
    Ints,
    Observations,
    SessionError,
    TopicTable,
    message_fields,
    needs,
    unit_of,
    values_of,
)
from flowrec.store.reader import SessionReader
from flowrec.store.table_columns import OBSERVED, STAMP, TIME, WALL, Column, columns_of

with needs("a table", "export"):
    import pyarrow as pa

_ROWS = 4096
_SAMPLES = 1 << 16  # of a batch
_BATCH_BYTES = 8 << 20  # an export holds some five times as much: columns, copies, and the pages of its writer


class Tables:
    """The tables of a session.

    Parameters
    ----------
    start_unix_ns : Unix time of stamp 0; 0: not known, and no row has a time of day.
    topics : those of the session.
    coils : their number in the session.
    """

    def __init__(self, start_unix_ns: int, topics: TopicTable = FIXED, coils: int = 3) -> None:
        self._start_unix_ns, self._topics, self._coils = start_unix_ns, topics, coils

    def schema(self, topic: str) -> pa.Schema:
        """The Arrow schema of a topic's table; each field's metadata has `unit` and `meaning`, the table's `topic`."""
        fields = [
            _field(column.name, _type_of(column), column.unit, column.meaning)
            for column in columns_of(topic, self._topics, self._coils)
        ]
        return pa.schema(fields, metadata={"topic": self._topics.by_field[topic].path})

    def table(self, topic: str, rows: Iterable[tuple[str, tuple[Any, ...]]]) -> pa.Table:
        """The rows of one topic as a table."""
        return pa.Table.from_batches([batch for _, batch in self.batches(rows)], self.schema(topic))

    def batches(self, rows: Iterable[tuple[str, tuple[Any, ...]]]) -> Iterator[tuple[str, pa.RecordBatch]]:
        """The rows of several topics as record batches of each, in order.

        `rows`: topic, by its field of `Tick`, and row. Raises SessionError: a message has another number of coils.
        """
        waiting: dict[str, list[tuple[Any, ...]]] = {}
        nbytes: dict[str, int] = {}
        for topic, row in rows:
            held = waiting.setdefault(topic, [])
            held.append(row)
            nbytes[topic] = nbytes.get(topic, 0) + sum([cell.nbytes for cell in row if isinstance(cell, np.ndarray)])
            if len(held) == _ROWS or nbytes[topic] > _BATCH_BYTES:
                yield topic, self._batch(topic, waiting.pop(topic))
                nbytes[topic] = 0
        for topic, held in waiting.items():
            yield topic, self._batch(topic, held)

    def _batch(self, topic: str, rows: Collection[tuple[Any, ...]]) -> pa.RecordBatch:
        declared, columns = self._topics.by_field[topic], columns_of(topic, self._topics, self._coils)
        names = [each.name for each in message_fields(declared.type)]
        cells = dict(zip(names, zip(*rows, strict=True), strict=True))
        stamps = np.fromiter(cells[STAMP], np.int64, len(rows))
        arrays = []
        for column in columns:
            if column.name == STAMP:
                array = pa.array(stamps)
            elif column.name == TIME:
                array = pa.array(stamps / NS_PER_S)
            elif column.name == WALL:
                none = np.full(len(rows), not self._start_unix_ns)
                array = pa.array((stamps + self._start_unix_ns).view("datetime64[ns]"), _type_of(column), mask=none)
            elif column.component is not None:
                width = sum(other.field == column.field for other in columns)
                if set(map(len, cells[column.field])) != {width}:
                    what = f"{declared.path}: {column.field}"
                    raise SessionError(f"{what} has not {width} numbers in each message, one a coil")
                array = pa.array([cell[column.component] for cell in cells[column.field]], _type_of(column))
            elif column.shape:
                array = _lists(column, cells[column.field])
            else:
                array = pa.array(cells[column.field], _type_of(column))
            arrays.append(array)
        return pa.RecordBatch.from_arrays(arrays, schema=self.schema(topic))


def _field(name: str, kind: pa.DataType, unit: str, meaning: str) -> pa.Field:
    return pa.field(name, kind, metadata={"unit": unit, "meaning": meaning})


def _type_of(column: Column) -> pa.DataType:
    kind = pa.timestamp("ns", "UTC") if column.kind == "timestamp" else pa.type_for_alias(column.kind)
    for length in reversed(column.shape):
        kind = pa.list_(kind, length) if isinstance(length, int) else pa.list_(kind)
    return kind


def _lists(column: Column, cells: tuple[Any, ...]) -> pa.Array:
    """Arrays of one number of dimensions and of any shape, None among them, as nested lists without a copy a number."""
    there = [cell for cell in cells if cell is not None]
    shapes = np.array([np.shape(cell) for cell in there], np.int64)
    axes = len(column.shape)
    shapes = shapes.reshape(len(there), axes)  # also where there is none
    values = pa.array(np.concatenate([np.zeros(0, column.kind), *map(np.ravel, there)]))
    for axis in reversed(range(1, axes)):  # from the innermost lists to those of which a row has one
        length = column.shape[axis]
        if isinstance(length, int):
            values = pa.FixedSizeListArray.from_arrays(values, length)
        else:
            counts = np.prod(shapes[:, :axis], axis=1)  # how many lists each row has on this level
            lengths = np.repeat(shapes[:, axis], counts)
            values = pa.ListArray.from_arrays(_offsets(lengths), values)
    missing = np.array([cell is None for cell in cells])
    outer = column.shape[0]
    if isinstance(outer, int):
        assert not missing.any()  # see table_columns.py
        return pa.FixedSizeListArray.from_arrays(values, outer)
    lengths = np.zeros(len(cells), np.int64)
    lengths[~missing] = shapes[:, 0]
    mask = pa.array(missing) if missing.any() else None
    return pa.ListArray.from_arrays(_offsets(lengths), values, mask=mask)


def _offsets(lengths: Ints) -> pa.Array:
    return pa.array(np.concatenate(([0], np.cumsum(lengths))).astype(np.int32))


def sample_schema() -> pa.Schema:
    """The schema of `sample_batches`."""
    return pa.schema(
        [
            _field("channel", pa.string(), "", "stream/channel"),
            _field("unit", pa.string(), "", "of the value"),
            _field("time_s", pa.float64(), "s", "when it was taken, on the session clock"),
            _field("value", pa.float64(), "", "in that unit"),
            _field("stamp_ns", pa.int64(), "ns", "stamp of the tick that took it"),
        ]
    )


def sample_batches(reader: SessionReader) -> Iterator[pa.RecordBatch]:
    """All samples of the streams of other programs, a row each, in order of arrival."""
    names, units = (np.array(list(each), object) for each in (reader.stream_units, reader.stream_units.values()))
    held: list[Any] = []
    rows = 0

    def batch() -> pa.RecordBatch:
        channel = np.concatenate([each.channel for each in held])
        stamps = np.repeat([each.stamp_ns for each in held], [len(each.value) for each in held])
        columns = (
            names[channel],
            units[channel],
            np.concatenate([each.sample_ns for each in held]) / NS_PER_S,
            np.concatenate([each.value for each in held]),
            stamps.astype(np.int64),
        )
        return pa.RecordBatch.from_arrays(list(map(pa.array, columns)), schema=sample_schema())

    for message in reader.messages(SAMPLES):
        held.append(message)
        rows += len(message.value)
        if rows >= _SAMPLES:
            yield batch()
            held.clear()
            rows = 0
    if held:
        yield batch()


def observed_flow(observations: Observations) -> pa.Table:
    """Observations with a row each, in the columns OBSERVED; what is not stated is empty."""
    rolled = (None, None) if observations.rolled_um_s is None else observations.rolled_um_s.T
    place, flow = observations.position_um.T, observations.flow_um_s.T
    return _table(OBSERVED, (*place, *flow, observations.std_um_s, *rolled, observations.time_s, observations.tracer))


def field_values(field: FlowField, fluid: Bools) -> pa.Table:
    """A flow field with a row for each pixel of fluid. `fluid`: (h, w), where the chip holds fluid."""
    columns = zip(VALUES, values_of(field, fluid).T, strict=True)
    return _table(VALUES, [None if field.std_um_s is None and "std" in name else values for name, values in columns])


def _table(meanings: Mapping[str, str], columns: Sequence[NDArray[Any] | None]) -> pa.Table:
    """A table of numbers; a column that is None is empty."""
    fields = [_field(name, pa.float64(), unit_of(name), text) for name, text in meanings.items()]
    missing = [None] * next(len(each) for each in columns if each is not None)
    arrays = [pa.array(missing if each is None else np.ascontiguousarray(each), pa.float64()) for each in columns]
    return pa.Table.from_arrays(arrays, schema=pa.schema(fields))
