"""What `flowrec info` and `flowrec ls` tell of sessions: from heads and indexes only, at once however large they are.

The configuration is read as the text that it is: the stages behind it take seconds to import.
"""

from __future__ import annotations

import struct
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from flowrec.errors import SessionError
from flowrec.store import SessionReader, is_growing
from flowrec.topics import BY_FIELD

SESSION_NAMES = (".mcap", ".mcap.partial")
_PNG_SIZE = struct.Struct(">II")  # width and height follow the signature and the head of the first part
_PNG_SIZE_AT = 16


def describe(path: Path) -> tuple[dict[str, str], dict[str, int]]:
    """Facts about a session for people, and its message counts by topic. Reads no message."""
    with SessionReader(path) as reader:
        header = reader.header
        config = _table(header.config_toml, f"{path}: config.toml inside")
        said = header.provenance
        facts = {
            "outcome": reader.outcome.get("outcome", "unknown") + _bracketed(_why(reader.outcome)),
            "duration": f"{reader.duration_s:.1f} s",
            "size": f"{path.stat().st_size / 1e6:.1f} MB",
            "chip": _chip(_table(header.chip_toml, f"{path}: chip.toml inside"), header.chip_png),
            "rig": _at(config, "rig"),
            "phases": " -> ".join(map(str, _listed_at(config, "mission", "phases"))) or "?",
            "stages": ", ".join(_at(config, stage, "method") for stage in ("observer", "refine", "plan", "control")),
            "recorded": said.get("wall_time", "unknown"),
            "by": f"flowrec {said.get('flowrec', '?')}" + _bracketed(said.get("git_commit", "")[:10]),
        }
        for key, code in said.items():
            if key.startswith("weights."):
                facts["weights"] = f"{key.removeprefix('weights.')} {code[:16]}"
        if reader.region is not None and "frames_windows" not in reader.outcome:
            facts["frames windows"] = "most images hold what the tracker read, and are black elsewhere"
        if header.parent:
            facts["replay of"] = header.parent.get("file", "?")
        facts |= {
            key.replace("_", " "): value
            for key, value in reader.outcome.items()
            if key not in ("outcome", "note", "duration", "wall_ns", "monotonic_ns")
        }
        return facts, {BY_FIELD[name].path: count for name, count in reader.counts.items()}


@dataclass(frozen=True, slots=True)
class Listed:
    """One session file of a directory; what is not known of it is None or empty."""

    name: str
    outcome: str  # or: recording, unfinished, unreadable
    note: str  # why
    size_bytes: int
    duration_s: float | None = None
    chip: str = ""
    recorded: str = ""


def list_sessions(directory: Path) -> list[Listed]:
    """The sessions in a directory by name, with those that were not finished or can not be read.

    Reads heads and indexes only. Raises SessionError when there is no such directory.
    """
    if not directory.is_dir():
        raise SessionError(f"{directory}: no such directory; flowrec ls lists the sessions in one")
    try:
        paths = [path for path in directory.iterdir() if path.is_file() and path.name.endswith(SESSION_NAMES)]
    except OSError as error:
        raise SessionError(f"{directory}: can not be listed ({error.strerror}); check its permissions") from error
    return [_listed(path) for path in sorted(paths)]


def _listed(path: Path) -> Listed:
    size = path.stat().st_size
    try:
        with SessionReader(path) as reader:
            head = reader.header
            outcome = reader.outcome.get("outcome", "unknown"), _why(reader.outcome)
            chip = str(_table(head.chip_toml, f"{path}: chip.toml inside").get("name", ""))
            return Listed(path.name, *outcome, size, reader.duration_s, chip, head.provenance.get("wall_time", ""))
    except SessionError as error:
        what = "recording" if is_growing(path) else "unfinished" if path.suffix == ".partial" else "unreadable"
        return Listed(path.name, what, str(error).removeprefix(f"{path}: "), size)


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
