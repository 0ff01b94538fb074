"""The export format rrd: a recording for Rerun, which shows a replay beside the session that it replays."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Self

import numpy as np

from flowrec.chip.chip import Chip
from flowrec.config import ResolvedConfig
from flowrec.errors import SessionError
from flowrec.pipeline import Pipeline, assemble
from flowrec.replay_figures import ReplayFiles, before_after
from flowrec.session import Session
from flowrec.store.run_files import files_of
from flowrec.summary import Row
from flowrec.system.outputs import RRD, Output
from flowrec.topics import Tick
from flowrec.view.entities import PAIR, REPLAY
from flowrec.view.rrd_file import is_made_from, write_rrd
from flowrec.view.scene import Scene
from flowrec.view.summary_text import registration_remark, summary_document

if TYPE_CHECKING:
    import rerun as rr

# Figures of the end of a run in the text panel, in this order.
_FIGURES = (
    "outcome",
    "note",
    "duration_s",
    "assumed_flow_error",
    "refined_flow_error",
    "planned_s",
    "navigation_s",
    "tracking_error_um",
    "contacts",
    "frames_dropped",
)


class RrdExport:
    """Implements flowrec.exports.formats.Exporter.

    Parameters
    ----------
    second : a session that is shown beside the exported one; None: a replay is shown beside its parent.
    """

    suffixes: tuple[str, ...] = RRD
    folder = False
    advice = "open it with: rerun"

    def __init__(self, second: Session | None = None) -> None:
        self._second = second

    @classmethod
    def of_pair(cls, first: Session, second: Session) -> Self:
        """The exporter of two sessions in one view; SessionError if they can not lie on each other."""
        (a, b) = first.chip, second.chip
        same = a.um_per_px == b.um_per_px and np.array_equal(a.mask, b.mask) and first.calibration == second.calibration
        if not same:
            raise SessionError(f"{second.path}: has another chip or camera than {first.path}; view them one by one")
        return cls(second)

    def is_export_of(self, path: Path, session: Session) -> bool:
        return is_made_from(path, session.key)

    def write(self, session: Session, part: Path, progress: Callable[[float], None]) -> None:
        config, path = session.config, session.path
        scene = replace(scene_of(config, session.chip, assemble(config, session.chip), path), key=session.key)
        parent = _parent_of(session)
        prefixes = REPLAY
        if self._second is not None:
            prefixes = PAIR
            ticks, replayed = session.ticks(), self._second.ticks(with_frames=False)
            summary = _pair(session, self._second)
        elif parent is not None:
            recorded = Session(parent)
            ticks, replayed = recorded.ticks(), session.ticks(with_frames=False)
            summary = _comparison(ReplayFiles.of(recorded, session))
        else:
            ticks, replayed, summary = session.ticks(), None, _summary(session)
        write_rrd(Output(part, RRD, overwrite=True), scene, ticks, replayed, progress, prefixes, summary)


def _summary(session: Session) -> rr.TextDocument:
    return summary_document([session.path.stem], _rows(session), _remarks(session.last))


def _rows(session: Session) -> list[Row]:
    figures = session.outcome
    start_goal: list[Row] = [("goal", _place(session.last), None)]
    return start_goal + [(key, figures[key], None) for key in _FIGURES if figures.get(key) not in (None, "")]


def _comparison(pair: ReplayFiles) -> rr.TextDocument:
    return summary_document(["recorded", "replayed"], before_after(pair), _remarks(pair.replayed))


def _pair(first: Session, second: Session) -> rr.TextDocument:
    was, now = ({key: value for key, value, _ in _rows(each)} for each in (first, second))
    rows = [(key, was.get(key), now.get(key)) for key in ("goal", *_FIGURES) if key in was or key in now]
    return summary_document([f"A: {first.path.stem}", f"B: {second.path.stem}"], rows, [])


def _place(last: Tick) -> str:
    goal = last.mission.goal_um if last.mission is not None else None
    if goal is None or not np.isfinite(goal).all():
        return "none"
    return f"({goal[0]:.0f}, {goal[1]:.0f}) um"


def _remarks(last: Tick) -> list[str]:
    remark = registration_remark(last.refined)
    return [remark] if remark else []


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
