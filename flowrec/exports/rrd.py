"""The export format rrd: a recording for Rerun, which shows a replay beside the session that it replays."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from flowrec.chip.chip import Chip
from flowrec.config import ResolvedConfig
from flowrec.errors import SessionError
from flowrec.pipeline import Pipeline, assemble
from flowrec.session import Session
from flowrec.store.run_files import files_of
from flowrec.system.outputs import RRD, Output
from flowrec.view.rrd_file import is_made_from, write_rrd
from flowrec.view.scene import Scene


class RrdExport:
    """Implements flowrec.exports.formats.Exporter."""

    suffixes = RRD
    folder = False
    advice = "open it with: rerun"

    def is_export_of(self, path: Path, session: Session) -> bool:
        return is_made_from(path, session.key)

    def write(self, session: Session, part: Path, progress: Callable[[float], None]) -> None:
        config, path = session.config, session.path
        scene = replace(scene_of(config, session.chip, assemble(config, session.chip), path), key=session.key)
        parent = _parent_of(session)
        if parent is not None:
            ticks, replayed = Session(parent).ticks(), session.ticks(with_frames=False)
        else:
            ticks, replayed = session.ticks(), None
        write_rrd(Output(part, RRD, overwrite=True), scene, ticks, replayed, progress)


def scene_of(config: ResolvedConfig, chip: Chip, pipeline: Pipeline, path: Path) -> Scene:
    """Static data of a session for the viewer."""
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


def _parent_of(session: Session) -> Path | None:
    """The replayed session, if all of its files are in the same folder."""
    # A name only: a session from elsewhere must not choose which files of this machine are opened.
    name = Path(session.header.parent.get("file", "")).name
    parent = session.path.parent / name
    try:
        return parent if name and all(file.is_file() for file in files_of(parent)) else None
    except SessionError:
        return None
