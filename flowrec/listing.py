"""What `flowrec info` and `flowrec ls` tell of sessions: from heads and indexes only, at once however large they are.

The configuration is read as the text that it is, and topics by what the file calls them: the stages and the messages
behind them take long to import.
"""

from __future__ import annotations

import struct
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from flowrec.errors import SessionError
from flowrec.store.head import Head
from flowrec.store.header import Part, SessionHeader
from flowrec.store.joints import Run
from flowrec.store.mcap_file import is_growing
from flowrec.store.names import PARTIAL_SUFFIX, SUFFIX, part_number, run_path
from flowrec.units import seconds

_NAMES = (SUFFIX, SUFFIX + PARTIAL_SUFFIX)
_PNG_SIZE = struct.Struct(">II")  # width and height follow the signature and the head of the first part
_PNG_SIZE_AT = 16


def describe(path: Path) -> tuple[dict[str, str], dict[str, int]]:
    """Facts about a session for people, and its message counts by topic.

    Reads no message, but for those that the parts of a run repeat.
    """
    run = Run.at(path)
    header = _header(run)
    outcome = run.outcome
    config = _table(header.config_toml, f"{path}: config.toml inside")
    said = header.provenance
    facts = {
        "outcome": outcome.get("outcome", "unknown") + _bracketed(_why(outcome)),
        "duration": f"{_duration_s(run):.1f} s",
        "size": f"{_size(run) / 1e6:.1f} MB" + (f" in {len(run.pieces)} parts" if run.in_parts else ""),
        "chip": _chip(_table(header.chip_toml, f"{path}: chip.toml inside"), header.chip_png),
        "rig": _at(config, "rig"),
        "phases": " -> ".join(map(str, _listed_at(config, "mission", "phases"))) or "?",
        "stages": ", ".join(_at(config, stage, "method") for stage in ("observer", "refine", "plan", "control")),
        "recorded": said.get("wall_time", "unknown"),
        "by": f"flowrec {said.get('flowrec', '?')}" + _bracketed(said.get("git_commit", "")[:10]),
    }
    if run.part is not None:
        facts["piece"] = _piece(run.part, path)
    for key, code in said.items():
        if key.startswith("weights."):
            facts["weights"] = f"{key.removeprefix('weights.')} {code[:16]}"
    if _at(config, "recording", "region") == "robot" and "frames_windows" not in outcome:
        facts["frames windows"] = "most images hold what the tracker read, and are black elsewhere"
    if header.parent:
        facts["replay of"] = header.parent.get("file", "?")
    hidden = ("outcome", "note", "duration", "wall_ns", "monotonic_ns")
    facts |= {key.replace("_", " "): value for key, value in outcome.items() if key not in hidden}
    return facts, run.counts()


@dataclass(frozen=True, slots=True)
class Listed:
    """One session of a directory, the parts of a run together; what is not known of it is None or empty."""

    name: str
    outcome: str  # or: recording, unfinished, unreadable
    note: str  # why
    size_bytes: int
    duration_s: float | None = None
    chip: str = ""
    recorded: str = ""
    parts: int = 0  # of a run that was split; finished or not


def list_sessions(directory: Path) -> list[Listed]:
    """The sessions in a directory by name, with those that were not finished or can not be read.

    Reads heads and indexes only. Raises SessionError when there is no such directory.
    """
    if not directory.is_dir():
        raise SessionError(f"{directory}: no such directory; flowrec ls lists the sessions in one")
    try:
        paths = [path for path in directory.iterdir() if path.is_file() and path.name.endswith(_NAMES)]
    except OSError as error:
        raise SessionError(f"{directory}: can not be listed ({error.strerror}); check its permissions") from error
    rows: dict[Path, list[Path]] = {}
    for path in sorted(paths):
        run = run_path(path)
        # Beside a file of that name the parts are not what opens under it: each is a session of its own.
        rows.setdefault(run if part_number(path) and run not in paths else path, []).append(path)
    return [_listed(path, files) for path, files in sorted(rows.items())]


def _listed(path: Path, files: list[Path]) -> Listed:
    size = sum(file.stat().st_size for file in files)
    parts = len(files) if files != [path] else 0
    try:
        run = Run.at(path)
        head = _header(run)
        outcome = run.outcome.get("outcome", "unknown"), _why(run.outcome)
        chip = str(_table(head.chip_toml, f"{path}: chip.toml inside").get("name", ""))
        recorded = head.provenance.get("wall_time", "")
        return Listed(path.name, *outcome, size, _duration_s(run), chip, recorded, parts)
    except SessionError as error:
        unfinished = any(file.name.endswith(PARTIAL_SUFFIX) for file in files)
        what = "recording" if any(map(is_growing, files)) else "unfinished" if unfinished else "unreadable"
        return Listed(path.name, what, str(error).removeprefix(f"{path}: "), size, parts=parts)


def _header(run: Run) -> SessionHeader:
    with Head(run.pieces[0].path) as head:
        return head.header


def _duration_s(run: Run) -> float:
    return seconds(run.last_ns - run.first_ns)


def _size(run: Run) -> int:
    return sum(piece.path.stat().st_size for piece in run.pieces)


def _piece(part: Part, path: Path) -> str:
    said = f"{part.kind} {part.number} of the run {run_path(path).stem}" + _bracketed(part.why)
    return said if part.carried_ns is None else f"{said}, goes on from {seconds(part.carried_ns):.2f} s"


def _table(text: str, where: str) -> dict[str, Any]:
    try:
        return tomllib.loads(text)
    except (ValueError, RecursionError) as error:  # besides bad TOML, numbers and nesting beyond all measure
        raise SessionError(f"{where}: is not valid TOML ({error}); the file is damaged or was edited") from error


def _chip(said: Mapping[str, Any], png: bytes) -> str:
    parts = [str(said.get("name", "?"))]
    scale_um = said.get("um_per_px")
    if isinstance(scale_um, float) and len(png) >= _PNG_SIZE_AT + _PNG_SIZE.size:
        width_px, height_px = _PNG_SIZE.unpack_from(png, _PNG_SIZE_AT)
        parts.append(f"{width_px * scale_um / 1000:.2f} x {height_px * scale_um / 1000:.2f} mm")
    openings = said.get("opening")
    parts.append(f"{len(openings) if isinstance(openings, list) else 0} openings")
    return ", ".join(parts)


def _at(tree: object, *keys: str) -> str:
    for key in keys:
        tree = tree.get(key) if isinstance(tree, dict) else None
    return str(tree) if tree is not None else "?"


def _listed_at(tree: object, *keys: str) -> list[Any]:
    for key in keys:
        tree = tree.get(key) if isinstance(tree, dict) else None
    return tree if isinstance(tree, list) else []


def _bracketed(text: str) -> str:
    return f" ({text})" if text else ""


def _why(outcome: Mapping[str, str]) -> str:
    """The note of a run that ended by itself, the reason of one that failed."""
    return outcome.get("note") or outcome.get("reason", "")
