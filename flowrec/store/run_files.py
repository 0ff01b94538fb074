"""The files of a run: their names, and whether the parts of a run follow each other without a gap.

X.mcap                           a run in one file
X.part001.mcap, X.part002.mcap   the parts of a run that was split; all of them together are called X.mcap
X.snap001.mcap                   one of its snapshots
NAME.partial                     any of these while it is written, or what a killed run has left of it
"""

from __future__ import annotations

import contextlib
import hashlib
import itertools
import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Self

from flowrec.core import MCAP, Outcome, Output, SessionError, is_growing, name_taken, seconds, shell_word
from flowrec.store.byte_source import is_there, open_bytes
from flowrec.store.mcap_format import Summary, UnfinishedError
from flowrec.store.session_metadata import Part, SessionMetadata, is_count
from flowrec.store.session_path import UrlPath, session_path

SESSION_SUFFIX = ".mcap"
PARTIAL_SUFFIX = ".partial"
_ASKED, _PROBED, _OPENED = 8, 1000, 64  # parts at a URL: asked for at a time, by number at most, opened at a time
_HASHED_BYTES = 4 << 20
_NUMBERED = re.compile(r"(?P<stem>.+)\.(?P<kind>part|snap)(?P<number>\d{3,6})")


def part_path(path: Path, number: int) -> Path:
    """The file of part `number` (from 1) of the run X.mcap."""
    return path.with_name(f"{path.stem}.part{number:03d}{path.suffix}")


def snapshot_path(path: Path, number: int) -> Path:
    """The file of snapshot `number` (from 1) of the run X.mcap."""
    return path.with_name(f"{path.stem}.snap{number:03d}{path.suffix}")


def partial_path(path: Path) -> Path:
    """The name of a file until it is complete."""
    return path.with_name(path.name + PARTIAL_SUFFIX)


def is_partial(path: Path) -> bool:
    """True for the name of a file that is not complete."""
    return path.name.endswith(PARTIAL_SUFFIX)


def complete_path(path: Path) -> Path:
    """The name of a file when it is complete."""
    return path.with_name(path.name.removesuffix(PARTIAL_SUFFIX))


def run_path(path: Path) -> Path:
    """X.mcap for any of its files, finished or not."""
    complete = complete_path(path)
    match = _NUMBERED.fullmatch(complete.stem)
    return complete if match is None else complete.with_name(match["stem"] + complete.suffix)


def run_files(path: Path) -> list[Path]:
    """Every existing file of the run X.mcap in order of name, finished or not, itself included; at a URL its parts."""
    if isinstance(path, UrlPath):
        return _parts_at(path)
    if not path.parent.is_dir():
        return []
    return sorted(other for other in path.parent.iterdir() if other.is_file() and run_path(other) == path)


def existing_session(named: Path | str) -> Path:
    """The path as of `session_path`; SessionError if it is local, and neither it nor a part of its run is there."""
    path = session_path(named)
    if not isinstance(path, UrlPath) and not path.exists() and not run_files(path):
        open_bytes(path)  # which says so
    return path


def _parts_at(path: UrlPath) -> list[Path]:
    """The parts of a run at a URL: those that the server lists, else those that follow each other."""
    from flowrec.store.remote_file import are_there, is_listed, objects_in
    from flowrec.store.traffic import MissingError

    folder = path.parent
    assert isinstance(folder, UrlPath)
    if is_listed(path):
        with contextlib.suppress(MissingError):  # who may read may not always list
            listed: list[Path] = [file for file, _ in objects_in(folder, f"{path.stem}.part") if run_path(file) == path]
            are_there(listed[:_OPENED])  # together: each is read next
            return listed
    found: list[Path] = []
    there = [True]
    while all(there) and len(found) < _PROBED:
        asked = [part_path(path, len(found) + more) for more in range(1, _ASKED if found else 2)]
        there = are_there(asked)
        found += itertools.takewhile(dict(zip(asked, there, strict=True)).get, asked)
    return found


def runs_in(folder: Path) -> set[Path]:
    """Every X.mcap in a folder of which any file exists."""
    return {run_path(path) for path in folder.iterdir()} if folder.is_dir() else set()


def is_snapshot(path: Path) -> bool:
    """True if a finished file is a snapshot by its name."""
    match = _NUMBERED.fullmatch(path.stem)
    return match is not None and match["kind"] == "snap"


def parts(path: Path) -> list[Path]:
    """The finished parts of the run X.mcap, in order."""
    return _parts_among(run_files(path))


def _parts_among(files: Iterable[Path]) -> list[Path]:
    finished = (file for file in files if part_number(file) and not is_partial(file))
    return sorted(finished, key=part_number)


def part_number(path: Path) -> int:
    """The number of a part of a run, finished or not, by its name; 0 for any other file."""
    match = _NUMBERED.fullmatch(complete_path(path).stem)
    return int(match["number"]) if match is not None and match["kind"] == "part" else 0


def refuse_if_taken(path: Path, *, overwrite: bool, inputs: Iterable[Path] = ()) -> None:
    """Refuse the output X.mcap as `Output.check` does, and any file of that run, finished or not, in the same way.

    Raises OutputError: as `Output.check`; SessionError: the unfinished file of a killed run is there, which `overwrite`
    would remove.
    """
    there = run_files(path)
    Output(path, MCAP, tuple(inputs), overwrite).check((*there, partial_path(path)))
    if overwrite:
        return
    for file in there:
        if not is_partial(file):
            raise name_taken(file)
        raise SessionError(
            f"{file}: is left from a run that did not finish; `flowrec recover {shell_word(file)}`"
            " saves it, another --out or --overwrite records without it"
        )


_COUNTS = ("ticks", "dropped_frames", "frames_missing_from_camera")  # of an outcome: each part has its own


@dataclass(frozen=True, slots=True)
class RunFile:
    """The properties of a file that decide whether it continues another one."""

    path: Path
    part: Part | None
    first_ns: int
    last_ns: int
    counts: Mapping[str, int]
    outcome: Mapping[str, str]
    size_bytes: int
    digest: Mapping[str, str] | None

    @classmethod
    def of(cls, file: SessionMetadata) -> Self:
        """Description of an open file."""
        times_ns = file.statistics.message_start_time, file.statistics.message_end_time
        return cls(file.source.path, file.part, *times_ns, file.counts, file.outcome, file.source.size, file.digest)


@dataclass(frozen=True, slots=True)
class Run:
    """A session as its files describe it: one, or the parts of a run in order.

    Attributes
    ----------
    first_index : summary of the first file, for who reads it next.
    first_ns, last_ns : stamps of the first and the last tick, 0 where there is none.
    """

    path: Path
    files: Sequence[RunFile]
    first_index: Summary | None = None

    @classmethod
    def at(cls, path: Path) -> Self:
        """Run of the files that `path` names; SessionError as `files_of` and `check_continuity`."""
        found: list[RunFile] = []
        first_index: Summary | None = None
        for path_of_file in files_of(path):
            with SessionMetadata(path_of_file) as file:
                found.append(RunFile.of(file))
                first_index = first_index or file.index
        run = cls(path, found, first_index)
        if run.in_parts:
            check_continuity(path, found)
        return run

    @property
    def in_parts(self) -> bool:
        """True if it is a run of parts, rather than the file that was named."""
        return self.files[0].path != self.path

    @property
    def part(self) -> Part | None:
        """Number and kind of this file in its run; None for all parts of a run together."""
        return None if self.in_parts else self.files[0].part

    @property
    def first_ns(self) -> int:
        return self.files[0].first_ns

    @property
    def last_ns(self) -> int:
        return self.files[-1].last_ns

    @property
    def outcome(self) -> dict[str, str]:
        """The outcome of the last file, with the counts summed over the parts."""
        outcome = dict(self.files[-1].outcome)
        if self.in_parts:
            outcome.pop("frames_windows", None)  # of the last part alone
            for key in _COUNTS:
                counts = [file.outcome[key] for file in self.files if key in file.outcome]
                if counts and all(map(is_count, counts)):
                    outcome[key] = str(sum(map(int, counts)))
        return outcome

    def counts(self) -> dict[str, int]:
        """Number of messages by topic. Keyframes are not counted, for which the first chunks of parts are read."""
        total = Counter(self.files[0].counts)
        for file in self.files[1:]:
            total.update(file.counts)
            with SessionMetadata(file.path) as metadata:
                total.subtract(metadata.counts_until(file.first_ns))
        return {topic: count for topic, count in total.items() if count > 0}


def files_of(path: Path) -> list[Path]:
    """Files that `path` names: itself or, where there is no such file, the parts of the run in order.

    Raises SessionError: the run has no end yet, or a part of it is missing.
    """
    if is_there(path):
        return [path]
    files = run_files(path)
    found = _parts_among(files)
    _refuse_unfinished(path, found, list(filter(is_partial, files)))
    numbers = set(map(part_number, found))
    missing = min(set(range(1, max(numbers, default=0))) - numbers, default=None)
    if missing is not None:
        raise SessionError(
            f"{part_path(path, missing)}: is missing from its run, of which there are {len(found)} parts;"
            " put it back, or name another part to read that alone"
        )
    return found or [path]


def unfinished_of(path: Path) -> list[Path]:
    """The unfinished files of the run X.mcap: its single file, parts and snapshots."""
    return list(filter(is_partial, run_files(path)))


def _refuse_unfinished(path: Path, found: Sequence[Path], partial: Sequence[Path]) -> None:
    """Raise UnfinishedError if a part is unfinished: the finished parts are not the complete run."""
    unfinished = [file for file in partial if part_number(file) or file == partial_path(path)]
    if not unfinished:
        return
    others = f", or name one of its {len(found)} finished parts" if found else ""
    if any(is_growing(file) for file in unfinished):
        raise UnfinishedError(f"{path}: is being recorded just now; stop that run with Ctrl-C{others}")
    raise UnfinishedError(
        f"{path}: was not finished (the run was killed; {unfinished[-1].name} is left of it);"
        f" `flowrec recover {shell_word(path)}` makes a complete session of it{others}"
    )


def check_continuity(path: Path, run: Sequence[RunFile]) -> None:
    """Check that files are the parts of one run, and that each begins where the one before ends.

    Raises SessionError: they do not; one line about the first that does not fit.
    """
    for number, file in enumerate(run, 1):
        if (fault := continuity_fault(file, number, run[number - 2] if number > 1 else None)) is not None:
            raise SessionError(
                f"{file.path}: {fault}; "
                f"`flowrec check {shell_word(path)}` says more, a part that is named is read alone"
            )
    last = run[-1]
    if is_continued(last.outcome):
        following = part_path(path, len(run) + 1)
        raise UnfinishedError(
            f"{following}: is missing, though {last.path.name} says that the run is continued in it; put it back,"
            f" or let `flowrec recover {shell_word(path)}` end the run with what is there"
        )


def continuity_fault(file: RunFile, number: int, before: RunFile | None) -> str | None:
    """Reason that a file is not part `number` of a run after `before`; None where it is."""
    part = file.part
    if part is None or part.kind != "part":
        return "is named like a part of a run and is none"
    if part.number != number:
        return f"is part {part.number} of a run by what it says, and {number} by its name"
    if before is None:
        return "is named as the first part and continues another one" if part.keyframe_ns is not None else None
    if before.part is not None and part.run != before.part.run:
        return f"is of another run than {before.path.name}"
    if part.keyframe_ns is None:
        return f"does not say where {before.path.name} ended"
    if part.keyframe_ns != before.last_ns:
        gap_s = seconds(part.keyframe_ns - before.last_ns)
        return f"begins {abs(gap_s):.3f} s {'after' if gap_s > 0 else 'before'} the end of {before.path.name}"
    if file.first_ns != part.keyframe_ns:
        return "does not begin with the keyframe that it announces"
    return None


def is_continued(outcome: Mapping[str, str]) -> bool:
    """True if the outcome of a part says that the run is continued in another part."""
    return Outcome.CONTINUED in (outcome.get("outcome"), outcome.get("ended_as"))


def files_behind(path: Path) -> list[Path]:
    """All files of a session and, if they are in the same folder, of the sessions that it replays.

    An output that is made from the session must not replace any of them.
    """
    files: list[Path] = []
    path = session_path(path)
    while path not in files and not isinstance(path, UrlPath):  # no output of this machine is at a URL
        files += [path, *run_files(path)]
        # Errors in a file are reported by the code that reads it.
        with contextlib.suppress(SessionError), SessionMetadata(files_of(path)[0]) as file:
            path = path.with_name(Path(file.header.parent.get("file", "")).name or path.name)
    return files


def session_sha256(files: Sequence[Path]) -> str:
    """SHA-256 of a session, by which a replay names its parent: of its file, or of its parts in order."""
    digest = hashlib.sha256()
    for path in files:
        with open_bytes(path) as source:
            for offset in range(0, source.size, _HASHED_BYTES):
                source.prefetch((at, _HASHED_BYTES) for at in range(offset, offset + 4 * _HASHED_BYTES, _HASHED_BYTES))
                digest.update(source.read(offset, min(_HASHED_BYTES, source.size - offset)))
    return digest.hexdigest()
