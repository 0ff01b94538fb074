"""The export format rrd: a recording for Rerun, which shows a replay beside the session that it replays."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Self

import numpy as np

from flowrec.core import DOUBTS, RRD, Outcome, SessionError, Tick, end_text, verdict_lines
from flowrec.exports.formats import TimeProgress
from flowrec.physics import Chip
from flowrec.stages import ResolvedConfig, calibration_of
from flowrec.store import Session, files_of
from flowrec.view import (
    FIGURES,
    PAIR,
    REPLAY,
    Scene,
    document_of_run,
    doubts_remark,
    note_of,
    registration_remark,
    rows_of_run,
    summary_document,
    write_rrd,
)

if TYPE_CHECKING:
    import rerun as rr


# What the table of a replay tells of its commands and the panel leaves out: it has room for eleven rows.
_OF_COMMANDS = ("commands_compared", "commands_difference_rms_um_s")


class RrdExport:
    """Implements flowrec.exports.formats.Exporter.

    `second`: a session that is shown beside the exported one; None: a replay is shown beside its parent.
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

    def write(self, session: Session, part: Path, progress: TimeProgress) -> None:
        scene = replace(
            scene_of(session.config, session.chip, session.path),
            key=session.key,
            doubts=str(session.outcome.get(DOUBTS, "")),
        )
        shown = {"": session}
        parent = _parent_of(session)
        if self._second is not None:
            shown = dict(zip(PAIR, (session, self._second), strict=True))
            summary = _pair(session, self._second)
        elif parent is not None:
            shown = dict(zip(REPLAY, (Session(parent), session), strict=True))
            summary = _comparison(*shown.values())
        else:
            summary = document_of_run(session.path.stem, session.last, session.outcome)
        first = next(iter(shown.values()))
        ticks = {prefix: _with_end(each, each.ticks(with_frames=each is first)) for prefix, each in shown.items()}
        write_rrd(part, scene, ticks, progress, summary)


def _with_end(session: Session, ticks: Iterable[Tick]) -> Iterator[Tick]:
    """The ticks; of a run that was stopped the last mission states the outcome, as the file does."""
    outcome, last = str(session.outcome.get("outcome") or ""), None
    for tick in ticks:
        if last is not None:
            yield last
        last = tick
    if last is None:
        return
    mission = last.mission
    if mission is not None and not mission.finished and outcome not in ("", Outcome.REPLAYED):
        mission = replace(mission, finished=True, outcome=outcome, stamp_ns=last.stamp_ns, since_ns=last.stamp_ns)
    yield replace(last, mission=mission)


def _comparison(recorded: Session, replayed: Session) -> rr.TextDocument:
    from flowrec.run import ReplayFiles, before_after  # late: they import all stages

    pair = ReplayFiles.of(recorded, replayed)
    rows = before_after(pair)
    told = [row for row in rows if row[0] not in _OF_COMMANDS]
    shown = [(key, was, now) for key, was, now in told if key != "planner" or was != now]
    ended = end_text({key: recorded.outcome.get(key) for key in ("outcome", "duration_s")}) or "its end is not known"
    verdict = [f"Replay of {recorded.path.name}: {ended}", *verdict_lines({}, pair.replayed.refined)]
    remarks = [doubts_remark(replayed.outcome), registration_remark(pair.replayed.refined)]
    return summary_document(["recorded", "replayed"], shown, remarks, verdict)


def _pair(first: Session, second: Session) -> rr.TextDocument:
    was, now = ({key: value for key, value, _ in rows_of_run(each.last, each.outcome)} for each in (first, second))
    named = list(zip(PAIR, (first, second), strict=True))
    notes = [remark(each.outcome, f"{name}: ") for remark in (doubts_remark, note_of) for name, each in named]
    rows = [
        (key, was.get(key), now.get(key)) for key in (*FIGURES[:1], "goal", *FIGURES[1:]) if key in was or key in now
    ]
    return summary_document([f"A: {first.path.stem}", f"B: {second.path.stem}"], rows, notes)


def scene_of(config: ResolvedConfig, chip: Chip, path: Path) -> Scene:
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
    return Scene(
        chip,
        calibration_of(config, chip),
        config.robot,
        path.stem,
        properties,
        windows=windows,
        camera_shape=config.camera.shape,
    )


def _parent_of(session: Session) -> Path | None:
    """The replayed session, if all of its files are in the same folder."""
    # A name only: a session from elsewhere must not choose which files of this machine are opened.
    name = Path(session.header.parent.get("file", "")).name
    parent = session.path.parent / name
    try:
        return parent if name and all(file.is_file() for file in files_of(parent)) else None
    except SessionError:
        return None
