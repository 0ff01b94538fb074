"""From a session to other files: the .rrd for Rerun. The MCAP stays the archive, these are caches for looking."""

from __future__ import annotations

import time
from pathlib import Path

from flowrec.chip.chip import Chip
from flowrec.config import Config
from flowrec.errors import SessionError
from flowrec.pipeline import Pipeline, assemble
from flowrec.session import open_session
from flowrec.status import progress, say
from flowrec.store import SessionReader, files_of
from flowrec.view import Scene, write_rrd


def scene_of(config: Config, chip: Chip, pipeline: Pipeline, path: Path) -> Scene:
    """What the viewer needs to know besides the ticks."""
    properties = {
        "chip": chip.name,
        "session": path.name,
        "observer": config.observer.method,
        "refine": config.refine.method,
        "planner": config.plan.method,
        "controller": config.control.method,
    }
    windows = config.recording.region != "whole"
    return Scene(chip, pipeline.calibration, pipeline.robot, path.stem, properties, windows=windows)


def write_rrd_of(path: Path, out: Path | None = None) -> Path:
    """Write the .rrd of a session beside it; a replay is shown beside its parent, where that is still there."""
    reader, config, chip = open_session(path)
    scene = scene_of(config, chip, assemble(config, chip), path)
    target = out if out is not None else path.with_suffix(".rrd")
    parent = _parent_of(path, reader)
    began = time.perf_counter()
    with progress(f"writing {target.name}", max(reader.duration_s, 1e-3)) as done:
        if parent is not None:
            write_rrd(target, scene, SessionReader(parent).ticks(), reader.ticks(with_frames=False), progress=done)
        else:
            write_rrd(target, scene, reader.ticks(), progress=done)
    say(f"{target} written in {time.perf_counter() - began:.1f} s; open it with: rerun {target}")
    return target


def _parent_of(path: Path, reader: SessionReader) -> Path | None:
    """The session that was replayed, where it is there, all of it."""
    # A name only: a session from elsewhere does not say which files of this machine are opened.
    name = Path(reader.header.parent.get("file", "")).name
    parent = path.parent / name
    try:
        return parent if name and all(file.is_file() for file in files_of(parent)) else None
    except SessionError:
        return None
