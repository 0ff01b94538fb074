"""A run that is being recorded, read from its files while they grow, without a word to the run.

Who may read the file may watch: the run is neither asked nor delayed. What is seen is as old as the last flush of the
recorder (`recording.flush_s`). A run that keeps only the time around events has no file between them.
"""

from __future__ import annotations

import getpass
import time
from collections.abc import Iterator, Mapping
from functools import cached_property
from pathlib import Path
from typing import NamedTuple

from flowrec.core import NS_PER_S, SessionError, Tick, is_growing, shell_word
from flowrec.store.file_reader import FileReader
from flowrec.store.mcap_format import MAGIC
from flowrec.store.mcap_reader import McapReader
from flowrec.store.recorder_process import MODULE
from flowrec.store.run_files import (
    complete_path,
    part_number,
    part_path,
    partial_path,
    run_files,
    run_path,
    unfinished_of,
)
from flowrec.store.scan import Scan, extent_of
from flowrec.store.session_metadata import SessionHeader

_IMAGE_LATE_NS = 2 * NS_PER_S  # longer than this a tick does not wait for its image
_POLL_S = 0.1


class LiveRun(NamedTuple):
    """A run that is being recorded on this machine by this user."""

    path: Path
    process: int  # its recorder
    since_unix_s: float


def live_runs() -> list[LiveRun]:
    """The runs that are recorded by a process of their own just now, the latest last; hidden files are trials."""
    import psutil  # type: ignore[import-untyped]

    me = getpass.getuser()
    found = []
    for process in psutil.process_iter(["cmdline", "username", "create_time", "status"]):
        words = process.info["cmdline"] or []
        own = str(process.info["username"]).rpartition("\\")[2] == me
        if own and MODULE in words[:-1] and process.info["status"] != psutil.STATUS_ZOMBIE:
            path = Path(words[-1])
            if not path.name.startswith(".") and run_files(path):
                found.append(LiveRun(path, process.pid, process.info["create_time"]))
    return sorted(found, key=lambda run: run.since_unix_s)


class GrowingRun:
    """The ticks of a run as they reach its files.

    `path`: X.mcap, or any file of that run. Raises SessionError: it is not being recorded, or keeps only the time
    around events and none has come.
    """

    def __init__(self, path: Path) -> None:
        self.path = run_path(path)
        under_way = list(filter(is_growing, unfinished_of(self.path)))
        if not under_way:
            raise SessionError(f"{self.path}: is not being recorded; `flowrec ls --live` lists the runs that are")
        self._file = _GrowingFile(complete_path(under_way[-1]))
        self._file.look()
        self._tick = Tick()

    @cached_property
    def header(self) -> SessionHeader:
        """Configuration, chip and provenance."""
        with self._file.reader() as reader:
            return reader.header

    @property
    def outcome(self) -> Mapping[str, str]:
        """The outcome of the run, and its figures; empty before its end."""
        with self._file.reader() as reader:
            return reader.outcome

    def ticks(self) -> Iterator[Tick]:
        """The ticks as they come, from the beginning of the present file to the end of the run.

        Raises SessionError: the file is damaged, or was not completed: its recorder was killed.
        """
        while True:
            self._file.look()
            yield from self._news()
            if self._file.ended:
                following = part_path(self.path, part_number(self._file.path) + 1)
                # The next part is there, or will be: a part is completed beside it.
                if not part_number(self._file.path) or not (following.exists() or partial_path(following).exists()):
                    return
                self._file = _GrowingFile(following)
            elif (partial := partial_path(self._file.path)).exists() and not is_growing(partial):
                raise SessionError(
                    f"{partial}: its recorder has ended without completing it; "
                    f"`flowrec recover {shell_word(partial)}` does"
                )
            else:
                time.sleep(_POLL_S)

    def _news(self) -> Iterator[Tick]:
        with self._file.reader() as reader:
            fields = set(reader.fields.values())
            until_ns = self._file.until_ns(reader)
            for stamp_ns, new in reader.new_messages(self._tick.stamp_ns + 1, fields):
                if stamp_ns > until_ns:
                    break
                self._tick = reader.topics.with_messages(self._tick, stamp_ns, new)
                yield self._tick


class _GrowingFile:
    """One file of the run, indexed as far as it has grown.

    `path`: the name that it gets when it is complete. `ended`: all of it was seen.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.ended = False
        self._scan: Scan | None = None
        self._at = len(MAGIC)
        self._start_unix_ns = 0

    def look(self) -> None:
        """Index what has come since the last look."""
        source = McapReader(self._present())
        try:
            source.set_start(self._start_unix_ns)
            if self._scan is None:
                self._scan = Scan(source)
            self._scan.source = source
            while not self._scan.ended:
                opcode, end = extent_of(source, self._at)
                if not end:
                    break
                if not self._scan.add(opcode, self._at, end - self._at):
                    raise source.damage_error(self._at, "a record that can not be read")
                self._at = end
            self._scan.close()
            self._start_unix_ns = source.start_unix_ns
            self.ended = self._scan.ended
        finally:
            source.close()

    def reader(self) -> FileReader:
        """The indexed part, open for reading."""
        assert self._scan is not None
        return FileReader(self._present(), summary=self._scan.summary)

    def until_ns(self, reader: FileReader) -> int:
        """Stamp up to which state and images have come; images are written at a lower priority."""
        assert self._scan is not None
        seen = reader.fields.keys() & self._scan.last.keys()
        last = {reader.fields[channel]: self._scan.last[channel][0] for channel in seen}
        last_ns = max(last.values(), default=-1)
        image_ns = last.get("frame", last_ns)
        return last_ns if self.ended or last_ns - image_ns > _IMAGE_LATE_NS else image_ns

    def _present(self) -> Path:
        partial = partial_path(self.path)
        return partial if partial.exists() else self.path
