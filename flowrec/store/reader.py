"""Reads a session, one file or a run in parts, as ticks, messages and images."""

from __future__ import annotations

import difflib
import functools
import itertools
import operator
from collections import deque
from collections.abc import Collection, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple, overload

import numpy as np
from numpy.typing import NDArray

from flowrec.core import (
    COILS,
    NS_PER_S,
    SAMPLES,
    STREAMS,
    Closing,
    Floats,
    Frame,
    Ints,
    SessionError,
    Tick,
    array_shapes,
    seconds,
)
from flowrec.store.channels import Row
from flowrec.store.file_reader import Cache, FileReader
from flowrec.store.run_files import Run
from flowrec.store.session_metadata import SessionHeader
from flowrec.store.session_path import session_path

_OPEN_FILES = 4  # of a run in parts, at a time


class Channel(NamedTuple):
    """The samples of a channel of a stream.

    Attributes
    ----------
    time_s : (n,) when each was taken, on the session clock.
    value : (n,) in `unit`.
    unit : as the sender or the settings state it, '' where nobody does.
    """

    time_s: Floats
    value: Floats
    unit: str


class SessionReader(Closing):
    """A finished session, open for reading; several iterations may run at a time.

    X.mcap is that file or, where there is none, the run whose parts are X.part001.mcap and so on; a part or a snapshot
    that is named is opened alone. The parts of a run are read as if it had never been split. Raises SessionError: there
    is no such file, it is no session that this flowrec can read, or its parts do not make a whole run; on reading,
    damage.

    Parameters
    ----------
    path : the session.
    run : its files, where they are known already.

    Attributes
    ----------
    path : as it was named.
    files : its files, in order.
    topics : those that this flowrec knows, and those that the session declares.
    region : window of most images that was recorded, the rest being black (roi.py); None: the images are not cut.
    frame_bits : depth of the images.
    recorded_fields : names of the message fields that the file has, by field of Tick, for the topics that it declares.
    part : which file of a run it is; None for all parts of a run together.
    keyframe_ns : stamp of the first tick where that is a keyframe, the state before this file began, from which a
        replay starts. None where the session begins with the run.
    outcome : how the run ended: `outcome`, `reason`, `ticks`, `dropped_frames`, ...; all text, may be empty.
    first_ns, last_ns : stamps of the first and the last tick; both 0 in an empty session.
    """

    def __init__(self, path: Path | str, run: Run | None = None) -> None:
        self.path = session_path(path)
        self._run = run or Run.at(self.path)
        self._cache: Cache = {}
        self._closed = False
        self._open: dict[int, FileReader] = {}  # the one that was used longest ago first
        self.files = [file.path for file in self._run.files]
        self.part = self._run.part
        self.keyframe_ns = self.part.keyframe_ns if self.part is not None else None
        self.first_ns, self.last_ns = self._run.first_ns, self._run.last_ns
        self.outcome = self._run.outcome
        first = self.file(0)
        self.topics, self.recorded_fields = first.topics, first.recorded_fields
        self.region, self.frame_bits = first.region, first.frame_bits

    @functools.cached_property
    def _fields(self) -> list[set[str]]:
        """For each file the fields of Tick of which it has messages."""
        return [{topic.field for topic in self.topics.topics if topic.path in file.counts} for file in self._run.files]

    @functools.cached_property
    def header(self) -> SessionHeader:
        """Configuration, chip, provenance and weights."""
        return self.file(0).header

    @functools.cached_property
    def counts(self) -> dict[str, int]:
        """Number of messages by field of Tick, for the topics that have any; of an extra topic by its path."""
        known = self.topics.by_path
        return {known[path].field: count for path, count in self._run.counts().items() if path in known}

    def coils_of(self, fields: Iterable[str]) -> int:
        """Number of coils by the first message about them, if a table of these topics has columns by coil; else 3."""
        kinds: list[Any] = [self.topics.by_field[field].type for field in fields]
        return self._coils if any(COILS in lengths for kind in kinds for _, lengths in array_shapes(kind)) else 3

    @functools.cached_property
    def _coils(self) -> int:
        first = next(itertools.chain(self.messages("applied"), self.messages("currents")), None)
        return 3 if first is None else len(first.currents_a)

    @property
    def duration_s(self) -> float:
        """From the first tick to the last, in s."""
        return seconds(self.last_ns - self.first_ns)

    def ticks(
        self, start_ns: int | None = None, end_ns: int | None = None, *, with_frames: bool = True
    ) -> Iterator[Tick]:
        """All ticks, or those at and after `start_ns` and before `end_ns`, each with everything known by then.

        A message is new in a tick if it is another object than in the tick before. Where the recording had to
        drop an image, the tick still holds the previous one, so its frame is not new.

        Parameters
        ----------
        start_ns : the state before it is restored from the few chunks that hold it, so that starting late in a
            session gives exactly the tail of all ticks.
        end_ns : at a URL, what is before it is asked for at once.
        with_frames : without, no image is read and `frame` is None; ticks in which nothing but a frame
            was new are left out.
        """
        wanted, tick = self._choose_fields(with_frames=with_frames), Tick()
        if start_ns is not None:
            self.file(max(self._numbers_until(start_ns), default=0)).announce(start_ns, wanted, end_ns)
            tick = self.tick_before(start_ns - 1, with_frames=with_frames)
        for number, file in enumerate(self._run.files):
            if start_ns is not None and file.last_ns < start_ns:
                continue
            if end_ns is not None and file.first_ns >= end_ns:
                break
            # A file that is read from its beginning is compared with the counts in its index.
            late_ns = start_ns if start_ns is not None and (start_ns > file.first_ns or not number) else None
            for stamp_ns, new in self.file(number).new_messages(late_ns, wanted, end_ns):
                if not number or stamp_ns > file.first_ns:
                    tick = self.topics.with_messages(tick, stamp_ns, new)
                    yield tick

    def tick_before(self, stamp_ns: int, *, with_frames: bool = True) -> Tick:
        """The tick at or before a stamp; an empty `Tick()` before the first one.

        `tick_before(start_ns - 1)` holds the same objects as the state from which `ticks(start_ns)` starts, so that a
        message of its first tick is new if and only if it is another object.
        """
        begun = self._numbers_until(stamp_ns)
        wanted = self._choose_fields(with_frames=with_frames)
        found_ns, known = -1, dict[str, Any]()
        # The keyframe of a part has the state; what is missing there is searched for in the parts before.
        for number in reversed(begun):
            missing = (wanted - known.keys()) & self._fields[number]
            if missing:
                latest_ns, state = self.file(number).state_at(stamp_ns, missing)
                found_ns, known = max(found_ns, latest_ns), known | state
        return self.topics.with_messages(Tick(), found_ns, known)

    def _numbers_until(self, stamp_ns: int) -> list[int]:
        """Numbers of the files that begin at or before a stamp."""
        return [number for number, file in enumerate(self._run.files) if file.first_ns <= stamp_ns]

    def _choose_fields(self, *, with_frames: bool) -> set[str]:
        return {field for field in self.topics.by_field if with_frames or field != "frame"}

    def messages(self, field: str) -> Iterator[Any]:
        """All messages of one topic, named by its field of Tick or by its path.

        Raises SessionError: no such field, or damage in the file.
        """
        field = self.field_of(field)
        for file, keyframe_ns in self._files_with({field}):
            for stamp_ns, message in file.messages(field):
                if stamp_ns > keyframe_ns:
                    yield message

    @functools.cached_property
    def stream_units(self) -> dict[str, str]:
        """Unit of each channel of a stream, by its name stream/channel."""
        last = deque(self.messages(STREAMS) if STREAMS in self.topics.by_path else (), maxlen=1)
        if not last or not last[0].channels:
            return {}
        return dict(zip(last[0].channels.split("\n"), last[0].units.split("\n"), strict=True))

    def channel(self, name: str) -> Channel:
        """The samples of a channel of a stream. Raises SessionError: there is none of that name; it tells which are."""
        names = list(self.stream_units)
        if name not in names:
            there = ", ".join(names[:12]) or "none: it was recorded without [streams.NAME]"
            raise SessionError(f"{self.path}: no channel {name!r} of a stream; there are {there}")
        times, values = [np.zeros(0, np.int64)], [np.zeros(0)]
        for message in self.messages(SAMPLES):
            mine = message.channel == names.index(name)
            times.append(message.sample_ns[mine])
            values.append(message.value[mine])
        return Channel(np.concatenate(times) / NS_PER_S, np.concatenate(values), self.stream_units[name])

    def field_of(self, name: str) -> str:
        """The field of Tick of a topic, named by its field or by its path; SessionError if there is none."""
        topic = self.topics.by_field.get(name) or self.topics.by_path.get(name)
        if topic is None:
            known = [*self.topics.by_field, *self.topics.by_path]
            near = difflib.get_close_matches(name, known, 1)
            hint = f"did you mean {near[0]!r}?" if near else f"the topics are {', '.join(self.topics.by_field)}"
            raise SessionError(f"{self.path}: there is no topic {name!r}; {hint}")
        return topic.field

    def rows(self, fields: Collection[str]) -> Iterator[tuple[str, Row]]:
        """Field of Tick and row of plain values (channels.py) of each message of some topics, in order of time.

        The rows of "frame" come last. They are made from the file's index, without numbers and images, which are None.
        """
        small = set(fields) - {"frame"}
        for file, keyframe_ns in self._files_with(small):
            for stamp_ns, field, row in file.rows(small):
                if stamp_ns > keyframe_ns:
                    yield field, row
        if "frame" in fields:
            for stamp_ns in self.frame_stamps:
                yield "frame", (stamp_ns, None, None, self.frame_bits)

    @functools.cached_property
    def frame_stamps(self) -> list[int]:
        """The stamps of the recorded images, in order; no image is read for them."""
        return self.stamps("frame")

    def stamps(self, field: str) -> list[int]:
        """The stamps of the ticks with a new message of a topic, in order; from the index, no message is read."""
        return [
            stamp_ns
            for file, keyframe_ns in self._files_with({field})
            for stamp_ns in file.stamps(field)
            if stamp_ns > keyframe_ns
        ]

    def frame(self, number: int) -> Frame:
        """A recorded image by its number, from 0."""
        frame = self.file(0).frame(number) if len(self._run.files) == 1 else None
        return self.frame_at(self.frame_stamps[number]) if frame is None else frame

    @property
    def frame_count(self) -> int:
        """Number of recorded images."""
        return self.counts.get("frame", 0) if len(self._run.files) == 1 else len(self.frame_stamps)

    def frame_at(self, stamp_ns: int) -> Frame:
        """The image of the tick with this stamp, one of `frame_stamps`; SessionError if it is damaged."""
        for number, file in enumerate(self._run.files):
            # A later part may begin with a copy of the last image of the part before: the same pixels.
            if file.first_ns <= stamp_ns <= file.last_ns and "frame" in self._fields[number]:
                found_ns, state = self.file(number).state_at(stamp_ns, {"frame"})
                if found_ns == stamp_ns:
                    return state["frame"]
        raise SessionError(f"{self.path}: has no image at {stamp_ns} ns")

    def close(self) -> None:
        """Close the files that are kept open; one that is kept no longer is closed when it is collected."""
        self._closed = True
        for file in self._open.values():
            file.close()

    def _files_with(self, fields: set[str]) -> Iterator[tuple[FileReader, int]]:
        """The files with messages of some topics, each with the stamp of its keyframe, which is skipped; else -1."""
        for number, file in enumerate(self._run.files):
            if self._fields[number] & fields:
                yield self.file(number), file.first_ns if number else -1

    def file(self, number: int) -> FileReader:
        """One of its files, from 0; SessionError if it is not of the same run as the first."""
        file = self._open.pop(number, None)
        if file is None:
            if self._closed:
                raise SessionError(f"{self.path}: has been closed; open the session again")
            file = FileReader(self.files[number], self._cache, None if number else self._run.first_index)
            if number and not file.header.is_same_run(self.header):
                raise SessionError(
                    f"{file.source.path}: has another head than {self.files[0].name}, so it is not of the same run;"
                    " move it away, or name it alone"
                )
        self._open[number] = file
        if len(self._open) > _OPEN_FILES:
            # Not closed here, because an iteration may still read it; it is closed when it is collected.
            del self._open[next(iter(self._open))]
        return file


class Frames(Sequence[Frame]):
    """The images in order. `frames[-1]` reads one image, a loop reads each chunk once; a slice is a sequence again.

    Attributes
    ----------
    stamps_ns : (n,) stamps on the session clock; no image is read for them.
    wall_times : (n,) the same as time of day, UTC; NaT where the file does not state it, see SessionHeader.
    """

    def __init__(self, reader: SessionReader, which: range | None = None) -> None:
        self._reader = reader
        self._which = which if which is not None else range(reader.frame_count)

    @property
    def stamps_ns(self) -> Ints:
        return np.array(self._reader.frame_stamps, np.int64)[list(self._which)]

    @property
    def wall_times(self) -> NDArray[np.datetime64]:
        start_unix_ns = self._reader.header.taken_unix_ns
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
        return self._reader.frame(number)

    def __iter__(self) -> Iterator[Frame]:
        if len(self._which) == self._reader.frame_count and self._which.step == 1:
            yield from self._reader.messages("frame")
        else:
            for number in self._which:
                yield self._reader.frame(number)

    def __repr__(self) -> str:
        return f"<{len(self)} images of {self._reader.path}>"
