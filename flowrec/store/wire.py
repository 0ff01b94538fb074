"""Large byte fields of a protobuf message, taken out and put in without the three copies that protobuf makes of them.

https://protobuf.dev/programming-guides/encoding
"""

from __future__ import annotations

import functools
from collections.abc import Container, Iterator, Mapping

LARGE_BYTES = 1 << 16  # from here on it pays
_FIELDS_LIMIT = 64  # of a message that is looked at here; one with more is left to protobuf
VARINT, FIXED64, BYTES, FIXED32 = 0, 1, 2, 5  # kinds of fields


def cut_out(payload: memoryview, numbers: Container[int]) -> tuple[bytes | memoryview, dict[int, memoryview]]:
    """What is left of a message without some of its byte fields, and those by number, where they lie.

    Raises
    ------
    ValueError : it is no message, or one of the fields is in it twice.
    """
    rest: list[memoryview] = []
    found: dict[int, memoryview] = {}
    for count, (number, kind, begin, value, end) in enumerate(_fields(payload)):
        if count == _FIELDS_LIMIT:
            return payload, {}
        if kind == BYTES and number in numbers:
            if number in found:
                raise ValueError(f"field {number} is in it twice")
            found[number] = payload[value:end]
        else:
            rest.append(payload[begin:end])
    return b"".join(rest), found


def own(payload: memoryview, found: Mapping[int, memoryview]) -> dict[int, memoryview]:
    """The fields as they are or, where they would keep much more in memory than themselves, copied."""
    whole = payload.obj
    much = not isinstance(whole, bytes | bytearray) or len(whole) > 2 * sum(map(len, found.values()))
    return {number: memoryview(bytes(view)) if much else view for number, view in found.items()}


def tag(number: int, kind: int) -> bytes:
    """What stands before the value of field `number`."""
    return varint(number << 3 | kind)


def head_of(number: int, nbytes: int) -> bytes:
    """What stands before a byte field of that length."""
    return tag(number, BYTES) + varint(nbytes)


@functools.lru_cache(maxsize=1024)  # lengths and the stamp of a tick come again and again
def varint(number: int) -> bytes:
    """Protobuf's variable-length form of a size."""
    out = bytearray()
    while number > 0x7F:
        out.append(number & 0x7F | 0x80)
        number >>= 7
    out.append(number)
    return bytes(out)


def _fields(payload: memoryview) -> Iterator[tuple[int, int, int, int, int]]:
    """Number, kind, begin, begin of the value and end of each field."""
    at, size = 0, len(payload)
    while at < size:
        begin = at
        tag, at = _number_at(payload, at)
        kind = tag & 7
        if kind == BYTES:
            length, at = _number_at(payload, at)
            end = at + length
        elif kind == VARINT:
            end = _number_at(payload, at)[1]
        elif kind in (FIXED64, FIXED32):
            end = at + (8 if kind == FIXED64 else 4)
        else:
            raise ValueError(f"a field of the kind {kind}")
        if end > size:
            raise ValueError("a field that reaches beyond its message")
        yield tag >> 3, kind, begin, at, end
        at = end


def _number_at(payload: memoryview, at: int) -> tuple[int, int]:
    number = shift = 0
    while shift < 64 and at < len(payload):
        byte = payload[at]
        at += 1
        number |= (byte & 0x7F) << shift
        if byte < 0x80:
            return number, at
        shift += 7
    raise ValueError("a number without an end")
