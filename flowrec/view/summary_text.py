"""The text panel of the viewer: what the session wanted and how it ended, as Markdown."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

import numpy as np
import rerun as rr

from flowrec.core import (
    DOUBTS,
    FLOW_FIELDS,
    AxesVerdict,
    FlowField,
    Row,
    Tick,
    Value,
    body_lines,
    comparison_for_people,
    doubts_text,
    flow_text,
    goal_text,
    seconds,
    text_for_picture,
    verdict_lines,
    way_text,
)
from flowrec.physics import on_chip
from flowrec.stages import MotionOfRun, RunStatistics, TrackQuality, figures_of
from flowrec.view.scene import Scene, goal_of

_MARKDOWN = str.maketrans({character: f"\\{character}" for character in "\\`*_{}[]()<>#+!|~"})
_LETTERS, _LONGEST = 200, 600  # of a cell, and of a sentence: names and notes come from the file
# Figures of a run in the text panel, in this order. The panel has room for eleven rows.
FIGURES = (
    "outcome",
    "duration_s",
    "covered",  # of a replay or an import
    "axes_check",
    "assumed_flow_error",
    "refined_flow_error",
    "stated_flow_error",
    "navigation_s",
    "planned_s",
    "tracking_error_um",
    "contacts",
    "frames_dropped",
)
# Of them, what the sentences above the table state.
_IN_END = ("outcome", "duration_s")
_IN_WAY = ("navigation_s", "planned_s")
_IN_FLOW = ("assumed_flow_error", "refined_flow_error", "stated_flow_error")
_AT_ZERO = ("contacts",)  # counts that are shown also where they are 0
_USUAL = ("axes_check", AxesVerdict.AGREES)  # is not shown
_NEWS = ("mission", "route", "drops", "true_field", *FLOW_FIELDS)  # messages that bring another fact


def summary_document(
    columns: Sequence[str], rows: Iterable[Row], remarks: Iterable[str], verdict: Iterable[str] = ()
) -> rr.TextDocument:
    """Sentences below the first one as a heading, a table with one or two columns of values, then remarks; '' is none.

    Rows are key and values, as flowrec.core.summary reads them; of one column the second value is not shown.
    """
    cells = [[name, *values[: len(columns)]] for name, *values in comparison_for_people(rows)]
    lines = [[_cell(each) for each in row] for row in (["", *columns], *cells)]
    lines.insert(1, ["---"] + ["---:"] * len(columns))
    table = "\n".join("| " + " | ".join(line) + " |" for line in lines)
    return _document([*_sentences(verdict), table, *(_cell(remark, _LONGEST) for remark in remarks if remark)])


def _sentences(verdict: Iterable[str]) -> list[str]:
    return [f"{'' if number else '### '}{_cell(text, _LONGEST)}" for number, text in enumerate(verdict)]


def _document(paragraphs: Iterable[str]) -> rr.TextDocument:
    return rr.TextDocument("\n\n".join(paragraphs), media_type=rr.MediaType.MARKDOWN)


def rows_of_run(last: Tick, figures: Mapping[str, Value]) -> list[Row]:
    """Outcome, goal and figures of one run; those that are not known are left out."""
    goal: Row = ("goal", goal_text(goal_of(last.mission)), None)
    known = [key for key in FIGURES if figures.get(key) not in (None, "") and (key, figures[key]) != _USUAL]
    rows: list[Row] = [(key, figures[key], None) for key in known if figures[key] != 0 or key in _AT_ZERO]
    return [*rows[:1], goal, *rows[1:]] if "outcome" in known else [goal, *rows]


def document_of_run(title: str, last: Tick, figures: Mapping[str, Value]) -> rr.TextDocument:
    """The panel of one run, finished or not: its outcome, a line of figures that no sentence states, the sentences."""
    said = {*_IN_END, *(_IN_WAY if way_text(figures) else ()), *(_IN_FLOW if flow_text(figures) else ())}
    rows = comparison_for_people(row for row in rows_of_run(last, figures) if row[0] not in said)
    about = "; ".join([f"session {title}", *(f"{name} {value}" for name, value, _ in rows)])
    ended, *told = verdict_lines({"outcome": "its end is not known", **figures}, last.refined)
    others = body_lines(figures)
    return _document(_sentences(filter(None, [ended, about, *told, *others, registration_remark(last.refined)])))


def doubts_remark(figures: Mapping[str, Value], whose: str = "") -> str:
    """Reason why the result is doubtful; '' if it is not."""
    text = figures.get(DOUBTS)
    return f"{whose}Doubtful: {text}" if text else ""


def note_of(figures: Mapping[str, Value], whose: str = "") -> str:
    """The note on how a run ended, as a remark: in a row of the table it would be cut; '' if there is none."""
    note = figures.get("note")
    return f"{whose}{note}" if note else ""


class LiveSummary:
    """Summary panel of a run that is under way; at its end it states what the panel of its session states.

    Only the shortest way is missing, which is planned after the end.
    """

    def __init__(self, scene: Scene) -> None:
        self._scene = scene
        self._statistics = RunStatistics()
        shape = scene.camera_shape or scene.chip.mask.shape[:2]
        self._quality = TrackQuality(scene.calibration, (shape[0], shape[1]), scene.robot)
        self._motion = MotionOfRun(scene.robot)
        self._last = Tick()
        self._first_ns: int | None = None

    def add(self, tick: Tick) -> bool:
        """Take the next tick; whether the panel changes with it."""
        news = bool(tick.news(self._last, _NEWS))
        self._statistics.write(tick)
        self._quality.write(tick)
        self._motion.write(tick)
        self._last = tick.at_images(self._last)
        self._first_ns = tick.stamp_ns if self._first_ns is None else self._first_ns
        return news

    @property
    def doubtful(self) -> bool:
        """True if the run has ended and its result is doubtful."""
        mission = self._last.mission
        return mission is not None and mission.finished and bool(self._quality.doubts())

    def document(self) -> rr.TextDocument:
        """The panel at the last tick."""
        last, seen = self._last, self._statistics
        figures = figures_of(self._scene.chip, last, seen.true_field, seen.contacts, seen.navigating_ns)
        figures |= seen.others
        mission, timing = last.mission, last.timing
        if mission is not None and mission.finished:
            figures |= {"outcome": mission.outcome, "note": mission.note}
            figures[DOUBTS] = doubts_text([*self._quality.doubts(), *self._motion.doubts()])
            figures["duration_s"] = seconds(last.stamp_ns - (self._first_ns or 0))
            figures["tracking_error_um"] = seen.tracking_error_um or None  # a policy has no reference
        elif mission is not None:
            figures["outcome"] = f"under way: {mission.phase}"
        if timing is not None:
            figures["frames_dropped"] = timing.dropped_frames
        return document_of_run(self._scene.title, last, figures)


def registration_remark(refined: FlowField | None) -> str:
    """By how much the picture is moved in the middle of the chip; '' without a registration. Fits in one line."""
    if refined is None or refined.registration is None:
        return ""
    height, width = refined.pressure_pa.shape
    middle_um = 0.5 * refined.um_per_px * np.array([width - 1.0, height - 1.0])
    x_um, y_um = (on_chip(refined.registration, middle_um) - middle_um).round(1) + 0.0  # -0.0 becomes 0.0
    return f"Found registration: picture moved by ({x_um:.1f}, {y_um:.1f}) um"


def _cell(text: str, letters: int = _LETTERS) -> str:
    """Text as it is, without Markdown, HTML or control characters."""
    return text_for_picture(text, letters).translate(_MARKDOWN)
