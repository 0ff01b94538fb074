"""Session -> ticks, whether it is one file or a run in parts."""

from __future__ import annotations

import functools
import itertools
from collections.abc import Callable, Collection, Iterable, Iterator
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from flowrec.core import COILS, Frame, SessionError, Tick, TopicTable, array_shapes, seconds
from flowrec.store.byte_source import is_there
from flowrec.store.channels import SessionContents
from flowrec.store.file_reader import Cache, FileReader
from flowrec.store.roi import Region
from flowrec.store.rows import Row
from flowrec.store.run_files import Run, RunFile
from flowrec.store.session_metadata import SessionHeader
from flowrec.store.session_path import session_path

_OPEN_FILES = 4


class SessionReader:
    """A finished session, open for reading; several iterations may run at a time.

    X.mcap is that file or, where there is none, the run whose parts are X.part001.mcap and so on; a part or a
    snapshot that is named is opened alone. The parts of a run are read as if it had never been split.

    Parameters
    ----------
    path : the session.
    contents, skip : of a single file, as in file_reader.py.

    Attributes
    ----------
    path : as it was named.
    files : its files, in order.
    part : which file of a run it is; None for all parts of a run together.
    keyframe_ns : stamp of the first tick where that is a keyframe, the state before this file began, from which a
        replay starts. None where the session begins with the run.
    outcome : how the run ended: `outcome`, `reason`, `ticks`, `dropped_frames`, ...; all text, may be empty.
    first_ns, last_ns : stamps of the first and the last tick; both 0 in an empty session.
    flowrec_version : of the program that wrote it.

    Raises
    ------
    SessionError : there is no such file, it is no session that this flowrec can read, or its parts do not make a
        whole run; on reading, damage.
    """

    def __init__(
        self, path: Path | str, contents: SessionContents | None = None, skip: Callable[[str], None] | None = None
    ) -> None:
        self.path = session_path(path)
        self._cache: Cache = {}
        self._closed = False
        self._open: dict[int, FileReader] = {}  # the one that was used longest ago first
        if contents is not None or is_there(self.path):
            self._open[0] = first = FileReader(self.path, contents, skip, self._cache)
            self._run = Run(self.path, [RunFile.of(first.contents)])
        else:
            self._run = Run.at(self.path)
        self.files = [file.path for file in self._run.files]
        self.part = self._run.part
        self.keyframe_ns = self.part.keyframe_ns if self.part is not None else None
        self.first_ns, self.last_ns = self._run.first_ns, self._run.last_ns
        self.outcome = self._run.outcome
        self.flowrec_version = self._run.files[0].flowrec_version

    @functools.cached_property
    def topics(self) -> TopicTable:
        """The topics that this flowrec knows, and those that the session declares."""
        return self._file(0).contents.topics

    @functools.cached_property
    def _fields(self) -> list[set[str]]:
        """The topics of each file by field."""
        return [{topic.field for topic in self.topics.topics if topic.path in file.counts} for file in self._run.files]

    @functools.cached_property
    def header(self) -> SessionHeader:
        """Configuration, chip, provenance and weights."""
        return self._file(0).contents.header

    @functools.cached_property
    def region(self) -> Region | None:
        """Window of most images that was recorded, the rest being black (roi.py); None: the images are not cut."""
        return self._file(0).contents.region

    @functools.cached_property
    def frame_bits(self) -> int:
        """Depth of the images."""
        return self._file(0).contents.frame_bits

    @functools.cached_property
    def counts(self) -> dict[str, int]:
        """Number of messages by field of Tick, for the topics that have any; of an extra topic by its path."""
        known = self.topics.by_path
        return {known[path].field: count for path, count in self._run.counts().items() if path in known}

    def coils_of(self, fields: Iterable[str]) -> int:
        """Number of coils, as the first message about them has it, if the tables of some topics need it; else 3."""
        kinds: list[Any] = [self.topics.by_field[field].type for field in fields]
        return self._coils if any(COILS in lengths for kind in kinds for _, lengths in array_shapes(kind)) else 3

    @functools.cached_property
    def _coils(self) -> int:
        first = next(itertools.chain(self.messages("applied"), self.messages("currents")), None)
        return 3 if first is None else len(first.currents_a)

    @property
    def recorded_fields(self) -> dict[str, frozenset[str]]:
        """Names of the message fields that the file has, by field of Tick, for the topics that it declares."""
        return self._file(0).contents.recorded_fields

    @property
    def duration_s(self) -> float:
        """From the first tick to the last, in s."""
        return seconds(self.last_ns - self.first_ns)

    def ticks(self, start_ns: int | None = None, *, with_frames: bool = True) -> Iterator[Tick]:
        """All ticks, or those at and after `start_ns`, each with everything known by then.

        A message is new in a tick if it is another object than in the tick before. Where the recording had to
        drop an image, the tick still holds the previous one, so its frame is not new.

        Parameters
        ----------
        start_ns : the state before it is restored from the few chunks that hold it, so that starting late in a
            session gives exactly the tail of all ticks.
        with_frames : without, no image is read and `frame` is None; ticks in which nothing but a frame
            was new are left out.
        """
        tick = Tick() if start_ns is None else self.tick_before(start_ns - 1, with_frames=with_frames)
        for number, file in enumerate(self._run.files):
            if start_ns is not None and file.last_ns < start_ns:
                continue
            # A file that is read from its beginning is compared with the counts in its index.
            late_ns = start_ns if start_ns is not None and (start_ns > file.first_ns or not number) else None
            for stamp_ns, new in self._file(number).new_messages(late_ns, with_frames=with_frames):
                if not number or stamp_ns > file.first_ns:
                    tick = self.topics.with_messages(tick, stamp_ns, new)
                    yield tick

    def tick_before(self, stamp_ns: int, *, with_frames: bool = True) -> Tick:
        """The tick at or before a stamp; an empty `Tick()` before the first one.

        `tick_before(start_ns - 1)` holds the same objects as the state from which `ticks(start_ns)` starts, so that a
        message of its first tick is new if and only if it is another object.
        """
        begun = [number for number, file in enumerate(self._run.files) if file.first_ns <= stamp_ns]
        wanted = {field for field in self.topics.by_field if with_frames or field != "frame"}
        found_ns, known = -1, dict[str, Any]()
        # The keyframe of a part has the state; what is missing there is searched for in the parts before.
        for number in reversed(begun):
            missing = (wanted - known.keys()) & self._fields[number]
            if missing:
                latest_ns, state = self._file(number).state_at(stamp_ns, missing)
                found_ns, known = max(found_ns, latest_ns), known | state
        return self.topics.with_messages(Tick(), found_ns, known)

    def messages(self, field: str) -> Iterator[Any]:
        """All messages of one topic, named by its field of Tick or by its path.

        Raises
        ------
        SessionError : no such field, or damage in the file.
        """
        field = self.field_of(field)
        for number, file in enumerate(self._run.files):
            if field in self._fields[number]:
                for stamp_ns, message in self._file(number).messages(field):
                    if not number or stamp_ns > file.first_ns:
                        yield message

    def field_of(self, name: str) -> str:
        """The field of Tick of a topic, named by its field or by its path; SessionError if there is none."""
        topic = self.topics.by_field.get(name) or self.topics.by_path.get(name)
        if topic is None:
            known = ", ".join(self.topics.by_field)
            raise SessionError(f"{self.path}: there is no topic {name!r}; the topics are {known}")
        return topic.field

    def rows(self, fields: Collection[str]) -> Iterator[tuple[str, Row]]:
        """Field of Tick and row of plain values (see rows.py) of each message of some topics, in order of time.

        The rows of "frame" come last. They are made from the file's index, without numbers and images, which are None.
        """
        small = set(fields) - {"frame"}
        for number, file in enumerate(self._run.files):
            if self._fields[number] & small:
                for stamp_ns, field, row in self._file(number).rows(small):
                    if not number or stamp_ns > file.first_ns:
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
        found: list[int] = []
        for number, file in enumerate(self._run.files):
            if field in self._fields[number]:
                stamps = self._file(number).stamps(field)
                found += [stamp_ns for stamp_ns in stamps if not number or stamp_ns > file.first_ns]
        return found

    def frame_at(self, stamp_ns: int) -> Frame:
        """The image of the tick with this stamp, one of `frame_stamps`; SessionError if it is damaged."""
        for number, file in enumerate(self._run.files):
            # A later part may begin with a copy of the last image of the part before: the same pixels.
            if file.first_ns <= stamp_ns <= file.last_ns and "frame" in self._fields[number]:
                found_ns, state = self._file(number).state_at(stamp_ns, {"frame"})
                if found_ns == stamp_ns:
                    frame: Frame = state["frame"]
                    return frame
        raise SessionError(f"{self.path}: has no image at {stamp_ns} ns")

    def close(self) -> None:
        """Close the session; forgotten readers close theirs when they are collected."""
        self._closed = True
        for file in self._open.values():
            file.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _file(self, number: int) -> FileReader:
        file = self._open.pop(number, None)
        if file is None:
            if self._closed:
                raise SessionError(f"{self.path}: has been closed; open the session again")
            file = FileReader(self.files[number], cache=self._cache)
            if number and not file.contents.header.is_same_run(self.header):
                raise SessionError(
                    f"{file.path}: has another head than {self.files[0].name}, so it is not of the same run;"
                    " move it away, or name it alone"
                )
        self._open[number] = file
        if len(self._open) > _OPEN_FILES:
            # Not closed here, because an iteration may still read it; it is closed when it is collected.
            del self._open[next(iter(self._open))]
        return file
