"""The recorded images of a session as a sequence: any one of them is read from the chunk that holds it."""

from __future__ import annotations

import operator
from collections.abc import Iterator, Sequence
from typing import overload

import numpy as np
from numpy.typing import NDArray

from flowrec.core import Frame
from flowrec.store.reader import SessionReader


class Frames(Sequence[Frame]):
    """The images in order. `frames[-1]` reads one image, a loop reads each chunk once; a slice is a sequence again.

    Attributes
    ----------
    stamps_ns : (n,) stamps on the session clock; no image is read for them.
    wall_times : (n,) the same as time of day, UTC; NaT where the file does not state when its clock was 0.
    """

    def __init__(self, reader: SessionReader, which: range | None = None) -> None:
        self._reader = reader
        self._which = which if which is not None else range(len(reader.frame_stamps))

    @property
    def stamps_ns(self) -> NDArray[np.int64]:
        return np.array(self._reader.frame_stamps, np.int64)[list(self._which)]

    @property
    def wall_times(self) -> NDArray[np.datetime64]:
        start_unix_ns = self._reader.header.start_unix_ns
        times = (self.stamps_ns + start_unix_ns).view("datetime64[ns]")
        return times if start_unix_ns else np.full(len(times), np.datetime64("NaT", "ns"))

    def __len__(self) -> int:
        return len(self._which)

    @overload
    def __getitem__(self, place: int) -> Frame: ...
    @overload
    def __getitem__(self, place: slice) -> Frames: ...
    def __getitem__(self, place: int | slice) -> Frame | Frames:
        if isinstance(place, slice):
            return Frames(self._reader, self._which[place])
        try:
            number = self._which[operator.index(place)]
        except IndexError:
            raise IndexError(f"frame {place} of {len(self)} in {self._reader.path}") from None
        return self._reader.frame_at(self._reader.frame_stamps[number])

    def __iter__(self) -> Iterator[Frame]:
        if len(self._which) == len(self._reader.frame_stamps) and self._which.step == 1:
            yield from self._reader.messages("frame")
        else:
            for number in self._which:
                yield self._reader.frame_at(self._reader.frame_stamps[number])

    def __repr__(self) -> str:
        return f"<{len(self)} images of {self._reader.path}>"
