"""Message <-> bytes, one codec per message type, bit for bit.

Frames (frames.py) and events (standard.py) travel in standard schemas, all others field by field (schemas.py).
"""

from __future__ import annotations

import math
import operator
from collections.abc import Callable
from dataclasses import replace
from typing import Any, TypeVar

import numpy as np
from google.protobuf.message import DecodeError
from numpy.typing import NDArray

from flowrec.declarations import Message, MessageField, message_fields
from flowrec.errors import SessionError
from flowrec.messages import Event, Frame, OperatorEvent
from flowrec.store import standard
from flowrec.store.encoder import encoder_of
from flowrec.store.form import Codec, Payload
from flowrec.store.frame_encodings import FRAME_CODECS, RAW_IMAGE
from flowrec.store.schema import ARRAY_DATA, array_schema, schema_of
from flowrec.store.wire import LARGE_BYTES, cut_out, own

_M = TypeVar("_M", bound=Message)
# Up to here a loop over the wire's values is quicker than numpy's general conversion.
_SHORT_VECTOR = 64
_LONG_VECTOR = 1 << 16


_codecs: dict[type[Any], Codec] = {
    Frame: FRAME_CODECS[RAW_IMAGE],
    Event: standard.event_codec(),
    OperatorEvent: standard.operator_codec(),
}


def codec_of(message_type: type[Any], schema: str = "") -> Codec:
    """The codec of a message type, of that schema where it may travel in several; made once."""
    if message_type is Frame and schema in FRAME_CODECS:
        return FRAME_CODECS[schema]
    codec = _codecs.get(message_type)
    if codec is None:
        derived = schema_of(message_type)
        codec = Codec(derived, encoder_of(message_type), _decoder(message_type, derived.wire))
        _codecs[message_type] = codec
    return codec


def encode(message: Message) -> bytes:
    """One message as bytes; errors as `encode_record`."""
    return b"".join(encode_record(message)[1])


def encode_record(message: Message, codec: Codec | None = None, start_unix_ns: int = 0) -> tuple[int | None, Payload]:
    """The MCAP sequence that a message must have, if any, and its payload in parts, large arrays uncopied.

    `codec` is the one of its type where nothing else is said. `start_unix_ns` is that of the session: foxglove's
    schemas say Unix time, flowrec's own the session clock.

    Raises
    ------
    SessionError : a value that does not fit the message's declaration, such as an int beyond 64 bit.
    """
    codec = codec or codec_of(type(message))
    if start_unix_ns and codec.says_unix_time:
        message = replace(message, stamp_ns=message_stamp(message) + start_unix_ns)  # type: ignore[type-var]
    try:
        try:
            return codec.sequence(message), codec.encode(message)
        except UnicodeEncodeError:
            # Half a character from a terminal must not end a run: it is kept in spelled-out form.
            return codec.sequence(message), codec.encode(_without_surrogates(message))
    except (TypeError, ValueError, OverflowError) as error:
        kind, stamp_ns = type(message).__name__, message_stamp(message)
        raise SessionError(f"a {kind} at {stamp_ns} ns can not be stored: {error}") from error


def decode(
    message_type: type[_M],
    payload: bytes | memoryview,
    sequence: int = 0,
    schema: str = "",
    start_unix_ns: int = 0,
) -> _M:
    """One message from its bytes; `sequence` is MCAP's, where a Frame keeps its index; `schema` as in `codec_of`.

    `start_unix_ns` as in `encode_record`.

    Raises
    ------
    SessionError : bytes that are no such message.
    """
    try:
        codec = codec_of(message_type, schema)
        message: _M = codec.decode(payload, sequence)
        if start_unix_ns and codec.says_unix_time:
            message = replace(message, stamp_ns=message_stamp(message) - start_unix_ns)  # type: ignore[type-var]
    except (DecodeError, ValueError, TypeError, OverflowError) as error:
        raise SessionError(f"damaged {message_type.__name__}: {error}") from error
    return message


def message_stamp(message: Message) -> int:
    """The stamp that every message type has, in ns."""
    stamp: int = message.stamp_ns  # type: ignore[attr-defined]
    return stamp


def _without_surrogates(message: _M) -> _M:
    changes = {}
    for form in message_fields(type(message)):
        value = getattr(message, form.name)
        changes[form.name] = value.encode("utf-8", "backslashreplace").decode() if isinstance(value, str) else value
    return type(message)(**changes)


def _decoder(message_type: type[Any], wire: Any) -> Callable[[bytes | memoryview, int], Any]:
    parse = wire.FromString
    unpackers = [_unpacker(form) for form in message_fields(message_type)]
    arrays = {number: form for number, form in enumerate(message_fields(message_type), 1) if form.kind == "array"}

    def decode(payload: bytes | memoryview, sequence: int) -> Any:
        if len(payload) < LARGE_BYTES or not arrays:
            parsed = parse(payload)
            return message_type(*[unpack(parsed) for unpack in unpackers])
        rest, found = cut_out(memoryview(payload), arrays)
        parsed, found = parse(rest), own(memoryview(payload), found)
        return message_type(
            *[
                _cut_array(found[number], arrays[number].dtype) if number in found else unpack(parsed)
                for number, unpack in enumerate(unpackers, 1)
            ]
        )

    return decode


def _unpacker(form: MessageField) -> Callable[[Any], Any]:
    name, dtype = form.name, form.dtype
    present: Callable[[Any], Any]
    if form.kind == "vector":

        def present(parsed: Any) -> Any:
            values = getattr(parsed, name)
            count = len(values)
            # numpy's general conversion makes a list first, which is not to be a large one.
            short_or_huge = count < _SHORT_VECTOR or count > _LONG_VECTOR
            return np.fromiter(values, np.float64, count) if short_or_huge else np.array(values, np.float64)

    elif form.kind == "array":
        assert dtype is not None

        def present(parsed: Any) -> Any:
            return _unpacked_array(getattr(parsed, name), dtype)

    else:
        present = operator.attrgetter(name)
    if not form.optional:
        return present
    return lambda parsed: present(parsed) if parsed.HasField(name) else None


def _cut_array(field: memoryview, dtype: np.dtype[Any] | None) -> NDArray[Any]:
    assert dtype is not None
    rest, found = cut_out(field, (ARRAY_DATA,))
    parsed = array_schema().wire.FromString(rest)
    return _unpacked_array(parsed, dtype, found.get(ARRAY_DATA))


def _unpacked_array(parsed: Any, dtype: np.dtype[Any], cut: memoryview | None = None) -> NDArray[Any]:
    if parsed.dtype != dtype.str:
        raise ValueError(f"an array of {parsed.dtype!r} where {dtype.str!r} belongs")
    shape, data = tuple(parsed.shape), cut if cut is not None else parsed.data
    if math.prod(shape) * dtype.itemsize != len(data):
        raise ValueError(f"an array of shape {shape} in {len(data)} bytes")
    return np.frombuffer(data, dtype).reshape(shape)
