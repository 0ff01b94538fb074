"""Which files make a run, and whether they fit together."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Self

from flowrec.errors import SessionError
from flowrec.store.mcap_reader import UnfinishedError
from flowrec.store.metadata import Part, SessionHeader
from flowrec.store.paths import PARTIAL_SUFFIX, part_number, part_path, partial_path, parts, pieces
from flowrec.store.session_metadata import Head
from flowrec.system.locks import is_growing
from flowrec.units import seconds

_COUNTS = ("ticks", "dropped_frames", "frames_missing_from_camera")  # of an outcome: each part tells its own


@dataclass(frozen=True, slots=True)
class Piece:
    """What must be known of a file to read it with others."""

    path: Path
    part: Part | None
    first_ns: int
    last_ns: int
    counts: Mapping[str, int]
    outcome: Mapping[str, str]
    flowrec_version: str

    @classmethod
    def of(cls, head: Head) -> Self:
        """Of an open file."""
        statistics = head.statistics
        first_ns, last_ns = statistics.message_start_time, statistics.message_end_time
        return cls(head.source.path, head.part, first_ns, last_ns, head.counts, head.outcome, head.flowrec_version)


@dataclass(frozen=True, slots=True)
class Run:
    """A session as its files tell of it, one or the parts of a run in order."""

    path: Path
    pieces: Sequence[Piece]

    @classmethod
    def at(cls, path: Path) -> Self:
        """What `path` names; SessionError as `files_of` and `check_joints`."""
        found = []
        for file in files_of(path):
            with Head(file) as head:
                found.append(Piece.of(head))
        run = cls(path, found)
        if run.in_parts:
            check_joints(path, found)
        return run

    @property
    def in_parts(self) -> bool:
        """Whether it is a run of parts, rather than the file that was named."""
        return self.pieces[0].path != self.path

    @property
    def part(self) -> Part | None:
        """Which piece of a run it is; None for a whole run."""
        return None if self.in_parts else self.pieces[0].part

    @property
    def first_ns(self) -> int:
        """Stamp of the first tick, 0 where there is none."""
        return self.pieces[0].first_ns

    @property
    def last_ns(self) -> int:
        """Stamp of the last tick, 0 where there is none."""
        return self.pieces[-1].last_ns

    @property
    def outcome(self) -> dict[str, str]:
        """How it ended, and the sums of what each part counts."""
        outcome = dict(self.pieces[-1].outcome)
        if self.in_parts:
            outcome.pop("frames_windows", None)  # of the last part alone
            for key in _COUNTS:
                said = [piece.outcome[key] for piece in self.pieces if key in piece.outcome]
                if said and all(text.isdecimal() and len(text) < 20 for text in said):
                    outcome[key] = str(sum(map(int, said)))
        return outcome

    def counts(self) -> dict[str, int]:
        """Number of messages by topic; what parts repeat is counted once, for which their first chunks are read."""
        total = Counter(self.pieces[0].counts)
        for piece in self.pieces[1:]:
            total.update(piece.counts)
            with Head(piece.path) as head:
                total.subtract(head.counts_until(piece.first_ns))
        return {topic: count for topic, count in total.items() if count > 0}


def files_of(path: Path) -> list[Path]:
    """What `path` names: itself or, where there is no such file, the parts of the run in order.

    Raises
    ------
    SessionError : the run has no end yet, or a part of it is missing.
    """
    if path.exists():
        return [path]
    found = parts(path)
    _refuse_unfinished(path, found)
    numbers = {part_number(file) for file in found}
    missing = next((number for number in range(1, max(numbers, default=0)) if number not in numbers), None)
    if missing is not None:
        raise SessionError(
            f"{part_path(path, missing)}: is missing from its run, of which there are {len(found)} parts;"
            " put it back, or name another part to read that alone"
        )
    return found or [path]


def unfinished_of(path: Path) -> list[Path]:
    """What was begun of the run X.mcap and not finished: its file, parts and snapshots."""
    return [file for file in pieces(path) if file.name.endswith(PARTIAL_SUFFIX)]


def _refuse_unfinished(path: Path, found: Sequence[Path]) -> None:
    """Nobody is to take the first parts for all of them. An unfinished snapshot is no part."""
    open_ones = [file for file in unfinished_of(path) if part_number(file) or file == partial_path(path)]
    if not open_ones:
        return
    others = f", or name one of its {len(found)} finished parts" if found else ""
    if any(is_growing(file) for file in open_ones):
        raise UnfinishedError(f"{path}: is being recorded just now; stop that run with Ctrl-C{others}")
    raise UnfinishedError(
        f"{path}: was not finished (the run was killed; {open_ones[-1].name} is left of it);"
        f" `flowrec recover {path}` makes a whole session of it{others}"
    )


def check_joints(path: Path, run: Sequence[Piece]) -> None:
    """See that files are the parts of one run, and that each begins where the one before ends.

    Raises
    ------
    SessionError : they do not; one line about the first that does not fit.
    """
    for number, piece in enumerate(run, 1):
        if (fault := fault_of(piece, number, run[number - 2] if number > 1 else None)) is not None:
            raise SessionError(
                f"{piece.path}: {fault}; `flowrec check {path}` says more, a part that is named is read alone"
            )
    last = run[-1]
    if goes_on(last.outcome):
        following = part_path(path, len(run) + 1)
        raise UnfinishedError(
            f"{following}: is missing, though {last.path.name} says that the run goes on in it; put it back,"
            f" or let `flowrec recover {path}` end the run with what is there"
        )


def fault_of(piece: Piece, number: int, before: Piece | None) -> str | None:
    """Why a file is not part `number` of a run behind `before`; None where it is."""
    part = piece.part
    if part is None or part.kind != "part":
        return "is no part of a run, whatever its name says"
    if part.number != number:
        return f"is part {part.number} of a run by what it says, and {number} by its name"
    if before is None:
        return "is called the first part and goes on from another" if part.carried_ns is not None else None
    if before.part is not None and part.run != before.part.run:
        return f"is of another run than {before.path.name}"
    if part.carried_ns is None:
        return f"does not say where {before.path.name} ended"
    if part.carried_ns != before.last_ns:
        gap_s = seconds(part.carried_ns - before.last_ns)
        return f"goes on {abs(gap_s):.3f} s {'after' if gap_s > 0 else 'before'} the end of {before.path.name}"
    if piece.first_ns != part.carried_ns:
        return "does not begin with the tick that it says to repeat"
    return None


def goes_on(outcome: Mapping[str, str]) -> bool:
    """Whether a part says that the run goes on in another."""
    return "continued" in (outcome.get("outcome"), outcome.get("ended_as"))


def without_part(header: SessionHeader) -> SessionHeader:
    """What is the same in all parts of a run."""
    return replace(header, part=None)
