"""Streams of samples: the protocol of the rows of STREAM_KINDS, and what passes between a stream and its reader.

A stream finds its sender and hands on what comes. It neither queues, nor counts, nor looks for a sender again:
`run.stream_reader.StreamReader` does that for every kind alike.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, ClassVar, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from flowrec.core import Floats, Ints, RigError
from flowrec.stages import StreamSettings


class NoStreamError(RigError):
    """There is no such stream now, or the one that there was has ended; there may be one later."""


@dataclass(frozen=True, slots=True)
class StreamHead:
    """Properties that a sender states."""

    channels: tuple[str, ...]  # names of the channels
    units: tuple[str, ...]  # of each channel, '' where it is not stated
    rate_hz: float = 0.0  # of a regular stream; 0: samples come when they come
    sender: str = ""  # who sends, for people: program, machine


@dataclass(frozen=True, slots=True)
class Chunk:
    """Samples that came together."""

    # (n,) when each was taken, on the host's monotonic clock; of a simulated stream on the session clock
    times_ns: Ints
    values: Floats  # (n, c) all channels of each sample; or (n,) one value each, of the channels in `channel`
    arrival_ns: int  # when they had come, on the same clock
    channel: NDArray[np.int32] | None = None  # (n,) places in `StreamHead.channels`, where `values` is (n,)
    head: StreamHead | None = None  # the head, if it has changed


class SampleStream(Protocol):
    """One stream. All methods are called in one thread at a time; `open` again after `close` looks for it anew.

    `of(name, settings)` of a row's class in STREAM_KINDS makes one of a section [streams.NAME]; nothing is touched
    before `open`. Settings of a kind of another package are its `Settings`, section [streams.NAME.device]. `polled`:
    the loop's own thread calls `read`, which never waits; else a thread of the stream does.
    """

    polled: ClassVar[bool] = False

    def open(self) -> StreamHead:
        """Find the sender and connect; takes two seconds at most.

        Raises
        ------
        NoStreamError : it is not there.
        RigError : it can not be used, or two fit; one line.
        """

    def read(self, timeout_s: float) -> Chunk | None:
        """The samples that have come since the last call; None if there is none within the timeout.

        Raises NoStreamError: the sender has ended.
        """

    def correction_s(self) -> float:
        """Correction added to the stamps of the sender, in s, to have them on this machine's clock; NaN: unknown."""
        return math.nan

    def close(self) -> None:
        """Disconnect; never raises."""


@runtime_checkable
class SettableStream(Protocol):
    """A stream of what an operator or a program can set: a lamp, a generator. Its samples are the values as set."""

    def set(self, place: int, value: float) -> None:
        """Set a channel, by its place in the head, soon; called in any thread, it never waits.

        Raises
        ------
        UsageError : a value that the channel must not have; one line.
        """


def named_channels(settings: StreamSettings, stated: list[str], count: int) -> tuple[str, ...]:
    """Names of the channels of a stream: those of the settings, else as the sender states them, else numbers.

    Raises RigError: the settings name another number of channels.
    """
    given = settings.channels or tuple(name.strip() for name in stated)
    if settings.channels and len(given) != count:
        raise RigError(f"has {count} channels, where `channels` names {len(given)}; name each, or none")
    usable = len(given) == count and all(given) and len(set(given)) == count
    return tuple(" ".join(name.split()) for name in given) if usable else tuple(str(n + 1) for n in range(count))


def settings_of_device(kind: Any, given: dict[str, Any], where: str) -> Any:
    """The settings of a kind of another package, from the table of a configuration.

    Raises UsageError: a key or a value that they do not have; one line.
    """
    from pydantic import TypeAdapter, ValidationError

    from flowrec.core import Origin, UsageError, check_ranges, refuse_unknown

    refuse_unknown(given, kind, Origin(where))
    try:
        made = TypeAdapter(kind).validate_python(given)
    except ValidationError as error:
        first = error.errors()[0]
        raise UsageError(f"{where}.{'.'.join(map(str, first['loc']))}: {first['msg'].lower()}") from error
    check_ranges(made, where)
    return made
