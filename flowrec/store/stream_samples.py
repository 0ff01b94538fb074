"""Samples of the streams of a session by channel: as arrays, and as a table with a row a sample."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from flowrec.core import NS_PER_S, SAMPLES, STREAMS, Floats, SessionError
from flowrec.store.reader import SessionReader

if TYPE_CHECKING:
    import pyarrow as pa

_ROWS = 1 << 16  # of a batch


class Channel(NamedTuple):
    """The samples of a channel.

    Attributes
    ----------
    time_s : (n,) when each was taken, on the session clock.
    value : (n,) in `unit`.
    unit : as the sender or the settings state it, '' where nobody does.
    """

    time_s: Floats
    value: Floats
    unit: str


def has_streams(reader: SessionReader) -> bool:
    """True if the session was recorded with streams."""
    return SAMPLES in reader.topics.by_path


def units_of(reader: SessionReader) -> dict[str, str]:
    """Unit of each channel, by its name stream/channel."""
    states = deque(reader.messages(STREAMS) if has_streams(reader) else (), maxlen=1)
    if not states or not states[0].channels:
        return {}
    last = states[0]
    return dict(zip(last.channels.split("\n"), last.units.split("\n"), strict=True))


def channel_of(reader: SessionReader, name: str) -> Channel:
    """The samples of a channel. Raises SessionError: there is no such channel; those that there are are named."""
    units = units_of(reader)
    if name not in units:
        there = ", ".join(list(units)[:12]) or "none: it was recorded without [streams.NAME]"
        raise SessionError(f"{reader.path}: no channel {name!r} of a stream; there are {there}")
    place = list(units).index(name)
    times, values = [np.zeros(0, np.int64)], [np.zeros(0)]
    for message in reader.messages(SAMPLES):
        mine = message.channel == place
        times.append(message.sample_ns[mine])
        values.append(message.value[mine])
    return Channel(np.concatenate(times) / NS_PER_S, np.concatenate(values), units[name])


def sample_schema() -> pa.Schema:
    """The schema of `sample_batches`."""
    import pyarrow as pa

    meanings = {
        "channel": (pa.string(), "", "stream/channel"),
        "unit": (pa.string(), "", "of the value"),
        "time_s": (pa.float64(), "s", "when it was taken, on the session clock"),
        "value": (pa.float64(), "", "in that unit"),
        "stamp_ns": (pa.int64(), "ns", "stamp of the tick that took it"),
    }
    fields = [
        pa.field(name, kind, metadata={"unit": unit, "meaning": text}) for name, (kind, unit, text) in meanings.items()
    ]
    return pa.schema(fields)


def sample_batches(reader: SessionReader) -> Iterator[pa.RecordBatch]:
    """All samples, a row each, in order of arrival."""
    import pyarrow as pa

    units = units_of(reader)
    names, of_unit = np.array(list(units), object), np.array(list(units.values()), object)
    held: list[Any] = []
    rows = 0

    def batch() -> pa.RecordBatch:
        channel = np.concatenate([each.channel for each in held])
        stamps = np.repeat([each.stamp_ns for each in held], [len(each.value) for each in held])
        columns = (
            names[channel],
            of_unit[channel],
            np.concatenate([each.sample_ns for each in held]) / NS_PER_S,
            np.concatenate([each.value for each in held]),
            stamps.astype(np.int64),
        )
        return pa.RecordBatch.from_arrays(list(map(pa.array, columns)), schema=sample_schema())

    for message in reader.messages(SAMPLES):
        held.append(message)
        rows += len(message.value)
        if rows >= _ROWS:
            yield batch()
            held.clear()
            rows = 0
    if held:
        yield batch()
