"""A session as the verbs handle it: what is written before the first frame, and what is read back to go on with it."""

from __future__ import annotations

import hashlib
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from flowrec.chip import chip_files, chip_from_files
from flowrec.chip.chip import Chip
from flowrec.config import Config, config_from_toml, to_toml
from flowrec.errors import SessionError
from flowrec.messages import Route
from flowrec.provenance import provenance
from flowrec.store import SessionHeader, SessionReader, SessionWriter, encoding_for, is_growing
from flowrec.topics import BY_FIELD

SESSION_NAMES = (".mcap", ".mcap.partial")


def session_writer(
    path: Path,
    config: Config,
    chip: Chip,
    *,
    parent: Path | None = None,
    live: bool = False,
    overwrite: bool = False,
) -> SessionWriter:
    """A new session file with its head written. `parent` is the session that it replays, named by content.

    A `live` run drops images rather than wait for the disk.
    """
    named = {"file": parent.name, "sha256": file_sha256(parent)} if parent is not None else None
    return SessionWriter(
        path,
        session_header(config, chip, named),
        frames=frames_of(config),
        flush_s=config.recording.flush_s,
        sync_s=config.recording.sync_s,
        queue_limit_bytes=int(config.recording.queue_mb * 1e6),
        block=not live,
        overwrite=overwrite,
    )


def frames_of(config: Config) -> str:
    """How the images of a run travel, a name of store/frames.py."""
    camera, chosen = config.camera, config.recording.frames
    if chosen != "auto":
        return chosen
    return encoding_for(camera.width_px, camera.height_px, camera.rate_hz or 0.0)


def session_header(config: Config, chip: Chip, parent: Mapping[str, str] | None = None) -> SessionHeader:
    """Everything that must be in a file before its first frame."""
    png, toml = chip_files(chip)
    facts = provenance(config.recording.anonymous) | {
        "operator": config.recording.operator,
        "sample": config.recording.sample,
        "notes": config.recording.notes,
        "seed": str(config.simulated.seed),
    }
    if config.refine.weights_sha256:
        facts[f"weights.{config.refine.method}"] = config.refine.weights_sha256
    return SessionHeader(to_toml(config), png, toml, facts, dict(parent or {}))


def open_session(path: Path) -> tuple[SessionReader, Config, Chip]:
    """A session with the configuration and the chip that it carries."""
    reader = SessionReader(path)
    config = config_from_toml(reader.header.config_toml, f"{path}: config.toml inside")
    return reader, config, chip_from_files(reader.header.chip_png, reader.header.chip_toml)


def file_sha256(path: Path) -> str:
    """Hash of a file's content, by which a replay names its parent."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def length_mm(route: Route) -> float:
    """Length of a route in mm."""
    return float(np.linalg.norm(np.diff(route.waypoints_um, axis=0), axis=1).sum()) / 1000.0


def describe(path: Path) -> tuple[dict[str, str], dict[str, int]]:
    """Facts about a session for people, and its message counts by topic."""
    reader, config, chip = open_session(path)
    said = reader.header.provenance
    width_um, height_um = chip.size_um
    facts = {
        "outcome": reader.outcome.get("outcome", "unknown") + _bracketed(_why(reader.outcome)),
        "duration": f"{reader.duration_s:.1f} s",
        "size": f"{path.stat().st_size / 1e6:.1f} MB",
        "chip": f"{chip.name}, {width_um / 1000:.2f} x {height_um / 1000:.2f} mm, {len(chip.openings)} openings",
        "rig": config.rig,
        "phases": " -> ".join(config.mission.phases),
        "stages": f"{config.observer.method}, {config.refine.method}, {config.plan.method}, {config.control.method}",
        "recorded": said.get("wall_time", "unknown"),
        "by": f"flowrec {said.get('flowrec', '?')}" + _bracketed(said.get("git_commit", "")[:10]),
    }
    for key, code in said.items():
        if key.startswith("weights."):
            facts["weights"] = f"{key.removeprefix('weights.')} {code[:16]}"
    if reader.header.parent:
        facts["replay of"] = reader.header.parent.get("file", "?")
    facts |= {
        key.replace("_", " "): value
        for key, value in reader.outcome.items()
        if key not in ("outcome", "note", "duration")
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
            chip = str(tomllib.loads(head.chip_toml).get("name", ""))
            return Listed(path.name, *outcome, size, reader.duration_s, chip, head.provenance.get("wall_time", ""))
    except (SessionError, tomllib.TOMLDecodeError) as error:
        what = "recording" if is_growing(path) else "unfinished" if path.suffix == ".partial" else "unreadable"
        return Listed(path.name, what, str(error).removeprefix(f"{path}: "), size)


def _bracketed(text: str) -> str:
    return f" ({text})" if text else ""


def _why(outcome: Mapping[str, str]) -> str:
    """The note of a run that ended by itself, the reason of one that failed."""
    return outcome.get("note") or outcome.get("reason", "")
