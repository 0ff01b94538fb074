"""Records -> rows of plain values, for tables: a fifth of the time that messages with their arrays take.

A row has one value for each field of the message type, in order: int, float, bool, str, a tuple for a vector, an array
for an array, or None.
"""

from __future__ import annotations

import operator
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flowrec.core import MessageField, SessionError, array_shapes, message_fields, shape_fault
from flowrec.store.channels import SessionContents
from flowrec.store.codec import array_of
from flowrec.store.mcap_format import Record

Row = tuple[Any, ...]
_SMALL_BYTES = 1 << 14  # of a payload that is parsed as a whole


def row_decoder(contents: SessionContents, channel: int) -> Callable[[Record], Row]:
    """Function from a record of a channel, not of images, to its row; it raises SessionError for a damaged record."""
    kind: type = contents.topics.by_field[contents.fields[channel]].type
    codec = contents.codecs[channel]
    names = [each.name for each in message_fields(kind)]

    def whole(record: Record) -> Row:
        message = contents.decode(record)
        fault = shape_fault(kind, lambda name: None if (array := getattr(message, name)) is None else array.shape)
        if fault:
            raise SessionError(fault)
        return tuple(getattr(message, name) for name in names)

    if codec.has_unix_time:
        return whole
    parse = codec.schema.wire.FromString
    unpackers = [_unpacker(each) for each in message_fields(kind)]
    arrays = {name: names.index(name) for name, _ in array_shapes(kind)}

    def small(record: Record) -> Row:
        payload = record.payload
        if len(payload) > _SMALL_BYTES:  # type: ignore[arg-type]  # a memoryview here
            return whole(record)
        try:
            parsed = parse(payload)
            row = tuple([unpack(parsed) for unpack in unpackers])
        except Exception:  # noqa: BLE001 - the careful decoder says what is wrong with it, as for every reader
            return whole(record)
        if arrays:
            fault = shape_fault(kind, lambda name: _shape(row[arrays[name]]))
            if fault:
                raise SessionError(fault)
        return row

    return small


def _shape(value: tuple[float, ...] | NDArray[Any] | None) -> tuple[int, ...] | None:
    if value is None:
        return None
    return (len(value),) if isinstance(value, tuple) else value.shape


def _unpacker(form: MessageField) -> Callable[[Any], Any]:
    name, dtype = form.name, form.dtype
    present: Callable[[Any], Any] = operator.attrgetter(name)
    if form.kind == "vector":

        def present(parsed: Any) -> Any:
            return tuple(getattr(parsed, name))  # not a list, which the garbage collector visits again and again

    elif form.kind == "array":
        assert dtype is not None
        empty = np.empty(0, dtype)

        def present(parsed: Any) -> Any:
            field = getattr(parsed, name)
            return array_of(field, field.data, empty.dtype)

    if not form.optional:
        return present
    return lambda parsed: present(parsed) if parsed.HasField(name) else None
