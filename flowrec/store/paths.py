"""How the files of a run are named.

X.mcap                           a run in one file
X.part001.mcap, X.part002.mcap   one that was split; all of them together are called X.mcap
X.snap001.mcap                   one of its snapshots
NAME.partial                     any of these while it is written, or what is left of it
"""

from __future__ import annotations

import re
from pathlib import Path

SUFFIX = ".mcap"
PARTIAL_SUFFIX = ".partial"
_PIECE = re.compile(r"(?P<stem>.+)\.(?P<kind>part|snap)(?P<number>\d{3,6})")


def part_path(path: Path, number: int) -> Path:
    """The file of part `number` (from 1) of the run X.mcap."""
    return _piece(path, "part", number)


def snapshot_path(path: Path, number: int) -> Path:
    """The file of snapshot `number` (from 1) of the run X.mcap."""
    return _piece(path, "snap", number)


def partial_path(path: Path) -> Path:
    """What a file is called until it is whole."""
    return path.with_name(path.name + PARTIAL_SUFFIX)


def run_path(path: Path) -> Path:
    """X.mcap for any of its pieces, finished or not."""
    whole = path.with_name(path.name.removesuffix(PARTIAL_SUFFIX))
    match = _PIECE.fullmatch(whole.stem)
    return whole if match is None else whole.with_name(match["stem"] + whole.suffix)


def pieces(path: Path) -> list[Path]:
    """Everything that is there of the run X.mcap in order of name, finished or not, itself included."""
    if not path.parent.is_dir():
        return []
    return sorted(other for other in path.parent.iterdir() if other.is_file() and run_path(other) == path)


def taken(folder: Path) -> set[Path]:
    """Every X.mcap in a folder of which any piece is there."""
    return {run_path(path) for path in folder.iterdir()} if folder.is_dir() else set()


def is_snapshot(path: Path) -> bool:
    """Whether a file is a snapshot by its name."""
    match = _PIECE.fullmatch(path.stem)
    return match is not None and match["kind"] == "snap"


def parts(path: Path) -> list[Path]:
    """The finished parts of the run X.mcap, in order."""
    return sorted(
        (other for other in pieces(path) if part_number(other) and other.suffix == path.suffix), key=part_number
    )


def part_number(path: Path) -> int:
    """The number of a part of a run, finished or not, as its name tells; 0 for any other file."""
    match = _PIECE.fullmatch(path.with_name(path.name.removesuffix(PARTIAL_SUFFIX)).stem)
    return int(match["number"]) if match is not None and match["kind"] == "part" else 0


def _piece(path: Path, kind: str, number: int) -> Path:
    return path.with_name(f"{path.stem}.{kind}{number:03d}{path.suffix}")
