"""What a codec is, so that each family of codecs can live in a file of its own."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from flowrec.store.schema import Schema

Payload = tuple[bytes | memoryview, ...]


def _unnumbered(_message: Any) -> None:
    return None


@dataclass(frozen=True, slots=True)
class Codec:
    """How one message type travels.

    Attributes
    ----------
    encode : message -> parts that follow each other in the file; large arrays are not copied.
    decode : payload, MCAP sequence -> message.
    sequence : message -> the MCAP sequence it must have, or None where the writer may count.
    """

    schema: Schema
    encode: Callable[[Any], Payload]
    decode: Callable[[bytes | memoryview, int], Any]
    sequence: Callable[[Any], int | None] = _unnumbered

    @property
    def says_unix_time(self) -> bool:
        """Whether it is one of foxglove's schemas, whose `timestamp` every viewer reads as Unix time."""
        return self.schema.name.startswith("foxglove.")
