"""Figure: what happened when: sight of the robot, alarms, the operator, warnings, losses."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from flowrec.core import ALARM_WORDS, Action, Level
from flowrec.exports.report import style
from flowrec.exports.report.curves import Span
from flowrec.exports.report.history import History, Remark
from flowrec.exports.report.report_data import ReportData
from flowrec.exports.report.time_axis import panels

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_LANE_MM = 5.0
_BAR_HEIGHT = 0.55  # of a span, of its lane
_LEAST_WIDTH = 0.004  # of the time axis: shorter spans are drawn this long
_LABEL_MM = 6.0  # width of a number: moments that are nearer to each other share a label


@dataclass(frozen=True, slots=True)
class Lane:
    """One line of the figure: spans of time, and moments with their numbers in the table of events ('': none)."""

    name: str
    colour: str
    spans: Sequence[Span] = ()
    moments: Sequence[tuple[float, str]] = ()


class TimelineFigure:
    """Marks, alarms and losses on the time axis."""

    name = "timeline"
    title = "What happened when"

    def __init__(self, gaps: Sequence[Span] = ()) -> None:
        self._gaps = gaps

    def why_not(self, data: ReportData) -> str:
        history = data.history
        return "" if history.phases.spans or self._lanes(history) else "the session holds no phase, event or alarm"

    def caption(self, data: ReportData) -> str:
        drawn = {lane.name for lane in self._lanes(data.history)}
        parts = []
        if numbered_actions(data.history.remarks):
            parts.append("Numbers: actions of the operator in the table below.")
        absent = [
            words
            for words, names in (
                ("no alarm", ALARM_WORDS.values()),
                ("no mark or other action of the operator", ("operator",)),
                ("no warning", ("warnings",)),
                ("no time without the robot in view", ("robot not in view",)),
                ("no gap in the images", ("no image",)),
            )
            if not drawn & set(names)
        ]
        if absent:
            parts.append(f"There was {', '.join(absent)}.")
        return " ".join(parts)

    def alt(self, data: ReportData) -> str:
        phases = ", ".join(span.name for span in data.history.phases.spans) or "none recorded"
        lanes = ", ".join(lane.name for lane in self._lanes(data.history)) or "nothing else"
        return f"Time line. Phases: {phases}. Beside them: {lanes}."

    def draw(self, data: ReportData, width_mm: float) -> Figure:
        history = data.history
        lanes = self._lanes(history)
        figure, (ax,) = panels(history, width_mm, [_LANE_MM * max(len(lanes), 1)])
        least_s = _LEAST_WIDTH * (history.last_s - history.first_s)
        for y, lane in enumerate(lanes):
            bars = [(span.from_s, max(span.to_s - span.from_s, least_s)) for span in lane.spans]
            ax.broken_barh(bars, (y - 0.5 * _BAR_HEIGHT, _BAR_HEIGHT), facecolors=lane.colour, lw=0.0)
            times_s = [time_s for time_s, _ in lane.moments]
            ax.plot(times_s, [y] * len(times_s), ls="none", marker="|", ms=7, mew=1.2, color=lane.colour)
            apart_s = _LABEL_MM / width_mm * (history.last_s - history.first_s)
            for time_s, name in _labels([moment for moment in lane.moments if moment[1]], apart_s):
                ax.annotate(name, (time_s, y), (2.0, 0.0), textcoords="offset points", va="center")
        ax.set_yticks(range(len(lanes)), [lane.name for lane in lanes])
        ax.set_ylim(max(len(lanes), 1) - 0.5, -0.5)
        ax.tick_params(axis="y", length=0)
        ax.spines["left"].set_visible(False)
        return figure

    def _lanes(self, history: History) -> list[Lane]:
        warnings = [(each.time_s, "") for each in history.remarks if each.level in (Level.WARNING, Level.ERROR)]
        actions = [(each.time_s, number) for number, each in numbered_actions(history.remarks)]
        lanes = [
            Lane("robot not in view", style.VERMILLION, history.unseen.spans),
            Lane("held by the operator", style.BLUE, history.held.spans),
            *(
                Lane(ALARM_WORDS.get(name, name), style.ORANGE, each.spans)
                for name, each in sorted(history.alarms.items())
            ),
            Lane("warnings", style.ORANGE, moments=warnings),
            Lane("operator", style.BLUE, moments=actions),
            Lane("no image", style.INK, self._gaps),
        ]
        return [lane for lane in lanes if lane.spans or lane.moments]


def numbered_actions(remarks: Sequence[Remark]) -> list[tuple[str, Remark]]:
    """The actions of the operator with their numbers; the end of a movie is not counted."""
    actions = [remark for remark in remarks if remark.action and remark.action != Action.END]
    return [(str(number), remark) for number, remark in enumerate(actions, 1)]


def _labels(moments: Sequence[tuple[float, str]], apart_s: float) -> list[tuple[float, str]]:
    """Numbers and where to put them; those of moments that are near to each other are one label, as in 2-4."""
    groups: list[list[tuple[float, str]]] = []
    for moment in moments:
        if groups and moment[0] - groups[-1][-1][0] < apart_s:
            groups[-1].append(moment)
        else:
            groups.append([moment])
    return [(group[-1][0], group[0][1] if len(group) == 1 else f"{group[0][1]}-{group[-1][1]}") for group in groups]
