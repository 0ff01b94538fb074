"""Power cuts under every writer, with the shipped settings: what was acknowledged is whole, and nothing older is lost.

`Disk` is a model of a disk under real writers. It notes every fsync and every change of names in a folder, by standing
between `os` and the writers. At each of these moments it makes the states that a power cut may leave, and has them
checked:

- a name that was given or taken away since the last fsync of its folder has, or has not, changed; what was asked of the
  disk earlier comes first, as in the journal of a file system;
- of a file, what was there at its last fsync is kept. What was written behind it is there, is missing, is there up to
  a byte, or is zeros; where a file was written anew or shortened, any of both contents is possible.
"""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest

from flowrec.archive.catalog import catalog_file
from flowrec.archive.catalog.format import About
from flowrec.archive.sweep.results import Results, read_rows
from flowrec.core import JSON, PREFIX, Output, OutputFolder, nanoseconds, remove_leftovers, seconds
from flowrec.stages.config import Recording
from flowrec.store import SLOTS, SessionReader, SessionWriter, WriterOptions, digest_faults, recover
from flowrec.store.mcap_reader import McapReader
from flowrec.store.notes import append_note, read_notes
from flowrec.store.scan import scan
from tests.archive.sweep.rows import row_of
from tests.store.made_up import HEADER, ticks_of

Names = dict[tuple[int, str], int]  # number of a file or folder, by that of its folder and its name
State = dict[str, bytes | None]  # content by path below the root; None: a folder


@dataclass(slots=True)
class Disk:
    """The disk below a folder; make it with `recorded`."""

    root: Path  # the folder; what is in it when recording begins is on the disk
    scratch: Path
    # is called with each state that a power cut may leave, written to a folder of its own
    check: Callable[[Path], None]
    states: int = 0
    _lock: Any = field(default_factory=threading.RLock)
    _top: int = 0  # number of the root
    _folders: set[int] = field(default_factory=set)
    _held: dict[int, int] = field(default_factory=dict)  # descriptors, so that no number is given again
    _flushed: dict[int, bytes] = field(default_factory=dict)  # content at the last fsync, by number
    _names: Names = field(default_factory=dict)  # on the disk
    _current: Names = field(default_factory=dict)  # at the last look
    _changes: list[tuple[int, Names]] = field(default_factory=list)  # folder, names afterwards; not on the disk yet
    _seen: set[object] = field(default_factory=set)

    def moment(self) -> None:
        """Check what a power cut would leave now."""
        with self._lock:
            self._look()
            possible = list(self._possible())
        for state in possible:
            place = self.scratch / f"cut{self.states}"
            place.mkdir()
            for path, content in sorted(state.items()):
                if content is None:
                    (place / path).mkdir()
                else:
                    (place / path).write_bytes(content)
            self.states += 1
            _owners_end(place)
            self.check(place)
            shutil.rmtree(place)

    def done(self) -> None:
        """Check what a power cut would leave now that something more was acknowledged."""
        self._seen.clear()
        self.moment()

    def flushed(self, name: str) -> bytes:
        """What the disk is sure to hold of a file of the folder; nothing where it may have lost the name."""
        with self._lock:
            self._look()
            return self._flushed.get(self._names.get((self._top, name), 0), b"")

    def fsync(self, descriptor: int) -> None:
        """What a file or folder holds now stays."""
        with self._lock:
            self._look()
            number = os.fstat(descriptor).st_ino
            if number in self._folders:
                for folder, names in self._changes:
                    if folder == number:
                        self._names = _of_folder(self._names, names, folder)
                self._changes = [change for change in self._changes if change[0] != number]
            else:
                self._flushed[number] = _content(self._held[number])

    def begin(self) -> None:
        """What is there now is on the disk."""
        self._top = self.root.stat().st_ino
        self._names = self._current = self._now()
        self._flushed = {n: _content(self._held[n]) for n in self._names.values() if n not in self._folders}

    def is_meant(self, named: Any) -> bool:
        """Whether a call of the system, by path or descriptor, is about this disk and not about that of a check."""
        path = Path(f"/proc/self/fd/{named}").readlink() if isinstance(named, int) else Path(named)
        return path.is_relative_to(self.root)

    def close(self) -> None:
        """Release the files."""
        for descriptor in self._held.values():
            os.close(descriptor)

    def _now(self) -> Names:
        names: Names = {}
        waiting = [(self.root, self._top)]
        self._folders.add(self._top)
        while waiting:
            folder, number = waiting.pop()
            for entry in os.scandir(folder):
                inside = names[number, entry.name] = entry.inode()
                if inside not in self._held:
                    self._held[inside] = os.open(entry.path, os.O_RDONLY)
                if entry.is_dir():
                    self._folders.add(inside)
                    waiting.append((Path(entry.path), inside))
        return names

    def _look(self) -> None:
        """Note which folders have other names in them than before."""
        now = self._now()
        for folder in sorted({folder for folder, _ in {*now, *self._current}}):
            after = _of_folder(self._current, now, folder)
            if after != self._current:
                self._changes.append((folder, after))
                self._current = after

    def _possible(self) -> Iterator[State]:
        steps = [self._names]
        for folder, names in self._changes:
            steps.append(_of_folder(steps[-1], names, folder))
        for names in steps:
            for choice in ("flushed", "written", "half", "zeros"):
                state = dict(self._below(names, self._top, "", choice))
                told = tuple(sorted((path, content or b"") for path, content in state.items()))
                if told not in self._seen:
                    self._seen.add(told)
                    yield state

    def _below(self, names: Names, folder: int, at: str, choice: str) -> Iterator[tuple[str, bytes | None]]:
        """Paths and contents of what is in a folder."""
        for (parent, name), number in names.items():
            if parent == folder and number in self._folders:
                yield at + name, None
                yield from self._below(names, number, f"{at}{name}/", choice)
            elif parent == folder:
                yield at + name, self._content(number, choice)

    def _content(self, number: int, choice: str) -> bytes:
        flushed, written = self._flushed.get(number, b""), _content(self._held[number])
        grown = len(written) - len(flushed) if written.startswith(flushed) else 0
        if choice == "flushed" or written == flushed:
            return flushed
        if choice == "written":
            return written
        if not grown:
            return written[: len(written) // 2] if choice == "half" else bytes(len(written))
        return flushed + (written[len(flushed) :][: grown // 2] if choice == "half" else bytes(grown))


def _of_folder(names: Names, other: Names, folder: int) -> Names:
    """Names, with those in one folder taken from others."""
    elsewhere = {key: number for key, number in names.items() if key[0] != folder}
    return elsewhere | {key: number for key, number in other.items() if key[0] == folder}


def _owners_end(folder: Path) -> None:
    """Temporary files are those of a process that has ended: its number was given to another one."""
    for path in sorted(folder.rglob(f"{PREFIX}*")):
        if path.name.count("-") > 3:
            host, pid, start, rest = path.name.removeprefix(PREFIX).split("-", 3)
            path.rename(path.with_name(f"{PREFIX}{host}-{pid}-{int(start) - 1}-{rest}"))


def _content(descriptor: int) -> bytes:
    return os.pread(descriptor, os.fstat(descriptor).st_size, 0)


@contextlib.contextmanager
def recorded(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, check: Callable[[Path], None], *, always: bool = True
) -> Iterator[Disk]:
    """Record what is done below tmp_path / "disk", and check each state that a power cut may leave on the way.

    `always`: at each change of the disk; else only where the test says so.
    """
    (tmp_path / "disk").mkdir(exist_ok=True)
    (tmp_path / "cuts").mkdir()
    disk = Disk(tmp_path / "disk", tmp_path / "cuts", check)

    def noted(name: str) -> Callable[..., Any]:
        real = getattr(os, name)

        def call(*words: Any, **named: Any) -> Any:
            if not disk.is_meant(words[0]):
                return real(*words, **named)
            if always:
                disk.moment()
            done = real(*words, **named)
            if name == "fsync":
                disk.fsync(words[0])
            if always:
                disk.moment()
            return done

        return call

    disk.begin()
    with monkeypatch.context() as patched:
        for name in ("fsync", "rename", "replace", "link", "unlink", "mkdir", "rmdir", "ftruncate"):
            patched.setattr(os, name, noted(name))
        try:
            yield disk
        finally:
            disk.close()


def test_a_note_that_was_taken_is_there_after_a_power_cut(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    taken: list[str] = []

    def check(place: Path) -> None:
        found = [note.text for note in read_notes(place / "a.mcap", "key")]
        assert found[: len(taken)] == taken and set(found[len(taken) :]) <= {f"note {len(taken)}"}

    with recorded(monkeypatch, tmp_path, check) as disk:
        for number in range(3):
            append_note(disk.root / "a.mcap", "key", f"note {number}", [], "Zoë")
            taken.append(f"note {number}")
            disk.done()
    assert disk.states > 5


def test_a_row_of_a_sweep_that_is_done_is_there_after_a_power_cut(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    done: set[str] = set()

    def check(place: Path) -> None:
        out = place / "out.parquet"
        rows = read_rows(out) if out.exists() else []
        rows += [json.loads(file.read_text()) for file in place.glob("out.parquet.tasks/[!.]*.json")]
        assert done <= {row["key"] for row in rows}

    with recorded(monkeypatch, tmp_path, check) as disk:
        for sweep in range(2):
            with Results.open_locked(disk.root / "out.parquet", [], ["a"]) as results:
                row = row_of("a", refine=f"{sweep}")
                results.put(row)
                done.add(row["key"])
                disk.done()
            disk.done()
    assert disk.states > 20 and len(done) == 2


def test_a_catalog_is_the_former_or_the_new_one_after_a_power_cut(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    written = [0]

    def check(place: Path) -> None:
        known = catalog_file.read(place / "flowrec-catalog.parquet")
        assert not known.remark and len(known.sessions) in (written[-1], written[-1] + 1)

    with recorded(monkeypatch, tmp_path, check) as disk:
        path = disk.root / "flowrec-catalog.parquet"
        for number in range(1, 3):
            rows = catalog_file.table_of([{"path": f"{each}.mcap"} for each in range(number)])
            replays = catalog_file.pa.array([[]] * number, catalog_file.pa.list_(catalog_file.pa.string()))
            with catalog_file.lock_catalog(path):
                catalog_file.write(path, rows, replays, [None] * number, About(["."], number, "", ""))
            written.append(number)
            disk.done()
    assert disk.states > 10


def test_an_export_is_the_former_or_the_new_one_after_a_power_cut(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    written = {"tables": 0, "a.json": 0}

    def check(place: Path) -> None:
        remove_leftovers(place)
        for name, number in written.items():
            files = sorted((place / name).glob("*.csv")) if name == "tables" else [place / name]
            found = {int(file.read_text()) for file in files if number or file.exists()}
            assert found <= {number, number + 1} and len(found) in ({1} if number else {0, 1}), (name, found)
            assert len(files) in (0, 1 if name == "a.json" else 2)

    with recorded(monkeypatch, tmp_path, check) as disk:
        for number in range(1, 3):
            with OutputFolder(disk.root / "tables", {}).new_folder() as part:
                (part / "a.csv").write_text(f"{number}")
                (part / "b.csv").write_text(f"{number}")
            written["tables"] = number
            disk.done()
            with Output(disk.root / "a.json", JSON, overwrite=True).new_file() as file:
                file.write_text(f"{number}")
            written["a.json"] = number
            disk.done()
    assert disk.states > 20


def test_with_the_shipped_settings_a_power_cut_costs_a_second_of_a_session_at_most(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The time is that of the test: it goes on when the writer has nothing left to do."""
    shipped, now_s = Recording(), [0.0]
    options = WriterOptions(flush_s=shipped.flush_s, sync_s=shipped.sync_s)
    monkeypatch.setattr(time, "monotonic", lambda: now_s[0])
    recovered: list[int] = []

    def check(place: Path) -> None:
        recovered.append(recover(place / "s.mcap.partial").ticks)

    with recorded(monkeypatch, tmp_path, check, always=False) as disk:
        writer = SessionWriter(disk.root / "s.mcap", HEADER, options)
        first_ns = None
        for number, tick in enumerate(ticks_of(180, shape=(8, 8))):
            first_ns = tick.stamp_ns if first_ns is None else first_ns
            now_s[0] = seconds(tick.stamp_ns - first_ns)
            writer.write(tick)
            if number >= 60 and (number % 12 == 0 or number == 179):  # the last, too: then the power is cut
                wanted_ns = tick.stamp_ns - nanoseconds(1.0)
                _until(lambda wanted_ns=wanted_ns: _last_ns(disk, tmp_path) >= wanted_ns)
        disk.done()
        writer.close()
        disk.check = lambda place: recovered.append(_whole(place / "s.mcap"))
        disk.done()
    assert recovered.pop() == 180
    assert min(recovered) >= 120  # 1 s of 3 s at 60 Hz


def _whole(session: Path) -> int:
    """Number of ticks of a session; SessionError if it is not whole."""
    assert digest_faults(session) == {session: []}
    with SessionReader(session) as reader:
        return sum(1 for _ in reader.ticks())


def _last_ns(disk: Disk, folder: Path) -> int:
    """Stamp of the last tick that the disk is sure to have."""
    (folder / "flushed.mcap").write_bytes(disk.flushed("s.mcap.partial"))
    with contextlib.closing(McapReader(folder / "flushed.mcap")) as source:
        return scan(source).last.get(SLOTS["/robot/track"].channel, (0,))[0]


def _until(happened: Callable[[], bool]) -> None:
    """Wait for the threads of the writer, which on a busy machine takes a while."""
    for _ in range(1000):
        if happened():
            return
        threading.Event().wait(0.01)
    pytest.fail("what is older than a second is not on the disk")
