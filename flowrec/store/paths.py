"""The names of the files of a run.

X.mcap                           a run in one file
X.part001.mcap, X.part002.mcap   the parts of a run that was split; all of them together are called X.mcap
X.snap001.mcap                   one of its snapshots
NAME.partial                     any of these while it is written, or what a killed run has left of it
"""

from __future__ import annotations

import re
from pathlib import Path

SUFFIX = ".mcap"
PARTIAL_SUFFIX = ".partial"
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


def run_path(path: Path) -> Path:
    """X.mcap for any of its files, finished or not."""
    complete, match = _matched(path)
    return complete if match is None else complete.with_name(match["stem"] + complete.suffix)


def run_files(path: Path) -> list[Path]:
    """Every existing file of the run X.mcap in order of name, finished or not, itself included."""
    if not path.parent.is_dir():
        return []
    return sorted(other for other in path.parent.iterdir() if other.is_file() and run_path(other) == path)


def runs_in(folder: Path) -> set[Path]:
    """Every X.mcap in a folder of which any file exists."""
    return {run_path(path) for path in folder.iterdir()} if folder.is_dir() else set()


def is_snapshot(path: Path) -> bool:
    """Whether a finished file is a snapshot by its name."""
    match = _NUMBERED.fullmatch(path.stem)
    return match is not None and match["kind"] == "snap"


def parts(path: Path) -> list[Path]:
    """The finished parts of the run X.mcap, in order."""
    return sorted(
        (other for other in run_files(path) if part_number(other) and other.suffix == path.suffix), key=part_number
    )


def part_number(path: Path) -> int:
    """The number of a part of a run, finished or not, by its name; 0 for any other file."""
    match = _matched(path)[1]
    return int(match["number"]) if match is not None and match["kind"] == "part" else 0


def _matched(path: Path) -> tuple[Path, re.Match[str] | None]:
    """The file under its final name, and the parts of that name where it has a number."""
    complete = path.with_name(path.name.removesuffix(PARTIAL_SUFFIX))
    return complete, _NUMBERED.fullmatch(complete.stem)
