"""`flowrec export`: convert a session to an .rrd for Rerun. The MCAP stays the archive; an .rrd can be made again."""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path

from flowrec.chip.chip import Chip
from flowrec.config import ResolvedConfig
from flowrec.errors import SessionError
from flowrec.pipeline import Pipeline, assemble
from flowrec.session import Session, files_behind, input_blamed
from flowrec.store.run_files import files_of
from flowrec.system.outputs import RRD, check_output
from flowrec.terminal import progress, say
from flowrec.view.rrd_file import is_made_from, write_rrd
from flowrec.view.scene import Scene


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


def export(session: Session | Path | str, out: Path | None = None, overwrite: bool = False) -> Path:
    """Write the .rrd of a session; a replay is shown beside its parent, if that is in the same folder.

    Parameters
    ----------
    out : the file; by default beside the session, with the suffix .rrd, where an earlier .rrd of the same session is
        replaced. Any other existing file is refused.
    overwrite : any existing file may be replaced, but none that is read.

    Raises
    ------
    SessionError : the session can not be read, or the file not be written; OutputError if it may not be.
    """
    session = Session.of(session)
    path, key = session.path, session.key
    target = out if out is not None else path.with_suffix(RRD[0])
    overwrite = overwrite or (out is None and is_made_from(target, key))
    inputs = files_behind(path)
    check_output(target, RRD, inputs=inputs, overwrite=overwrite)
    pipeline = assemble(session.config, session.chip)
    scene = replace(scene_of(session.config, session.chip, pipeline, path), key=key)
    parent = _parent_of(session)
    began = time.perf_counter()
    with progress(f"writing {target.name}", max(session.duration_s, 1e-3)) as done:
        if parent is not None:
            ticks, replayed = Session(parent).ticks(), session.ticks(with_frames=False)
        else:
            ticks, replayed = session.ticks(), None
        with input_blamed(session, session.config, "drawn"):
            write_rrd(target, scene, ticks, replayed, done, inputs=inputs, overwrite=overwrite)
    say(f"{target} written in {time.perf_counter() - began:.1f} s; open it with: rerun {target}")
    return target


def _parent_of(session: Session) -> Path | None:
    """The replayed session, if all of its files are in the same folder."""
    # A name only: a session from elsewhere does not say which files of this machine are opened.
    name = Path(session.header.parent.get("file", "")).name
    parent = session.path.parent / name
    try:
        return parent if name and all(file.is_file() for file in files_of(parent)) else None
    except SessionError:
        return None
