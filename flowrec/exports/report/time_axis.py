"""The time axis that all figures over time share: the phases of the mission above it, the same limits below."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from flowrec.core import Floats, Observations
from flowrec.exports.report import style
from flowrec.exports.report.curves import Curve
from flowrec.exports.report.history import History
from flowrec.exports.report.report_data import ReportData
from flowrec.view import OF_PHASE

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_MOST_POINTS = 80  # observations in a figure: more would hide the curves
_ORDINALS = {2: "2nd", 3: "3rd"}
_MOST_LINES = 60  # begins of phases: more are in the strip only
_TINT = 0.45  # strength of a phase's colour on paper
_STRIP_MM = 4.0
_LETTER_MM = 1.35  # width of a letter at the size of all figures
_AXIS_MM = 14.0  # of the width, beside the panels: labels and numbers


def panels(history: History, width_mm: float, heights_mm: list[float]) -> tuple[Figure, list[Axes]]:
    """A figure with a strip of phases and, below it, panels that share the time axis."""
    figure = style.new_figure(width_mm, _STRIP_MM + sum(heights_mm) + 9.0 + 4.0 * len(heights_mm))
    heights = [_STRIP_MM, *heights_mm]
    strip, *axes = figure.subplots(len(heights), 1, sharex=True, squeeze=False, height_ratios=heights)[:, 0]
    _draw_phases(strip, history, width_mm)
    begins = [span.from_s for span in history.phases.spans[1:]]
    for ax in axes:
        for at_s in begins if len(begins) <= _MOST_LINES else ():
            ax.axvline(at_s, color=style.FAINT, lw=0.6, zorder=0)
    axes[-1].set_xlabel("session time (s)")
    axes[-1].set_xlim(history.first_s, history.last_s)
    for ax in axes:
        ax.tick_params(labelbottom=ax is axes[-1])
    figure.align_ylabels(axes)
    return figure, list(axes)


def _draw_phases(ax: Axes, history: History, width_mm: float) -> None:
    """A coloured span for each phase, with its name where there is room for it."""
    ax.set_yticks([])
    ax.spines[:].set_visible(False)
    ax.tick_params(bottom=False, labelbottom=False)
    ax.set_ylim(0.0, 1.0)
    per_s = (width_mm - _AXIS_MM) / (history.last_s - history.first_s)
    for span in history.phases.spans:
        length_s = span.to_s - span.from_s
        ax.axvspan(span.from_s, span.to_s, color=_tint(span.name), lw=0.0)
        if per_s * length_s > _LETTER_MM * (len(span.name) + 1):
            ax.text(span.from_s + 0.5 * length_s, 0.45, span.name, ha="center", va="center")
    if not history.phases.spans:
        ax.text(0.0, 0.45, "no phases recorded", transform=ax.transAxes, va="center", color=style.QUIET)


def _tint(phase: str) -> str | tuple[float, ...]:
    """The colour that a phase has in all pictures, on white paper: light enough for its name."""
    if phase not in OF_PHASE:
        return style.FAINT
    return tuple(1.0 - _TINT * (1.0 - level / 255.0) for level in OF_PHASE[phase])


def line(ax: Axes, curve: Curve, colour: str, label: str, **how: object) -> None:
    """A curve with the range of its values where it was thinned; nothing for an empty one."""
    if not curve:
        return
    if not np.array_equal(curve.low, curve.high, equal_nan=True):
        ax.fill_between(curve.time_s, curve.low, curve.high, color=colour, alpha=0.25, lw=0.0)
    ax.plot(curve.time_s, curve.mean, color=colour, label=label, **how)  # type: ignore[arg-type]


def shown_observations(data: ReportData) -> tuple[Observations | None, str]:
    """The observations that curves over time show, at most _MOST_POINTS of them, and what they are in words.

    None where there are none, or where they do not state their times.
    """
    found = data.observations
    if found is None:
        return None, "No observation of the flow was taken."
    count = len(found.position_um)
    if found.time_s is None:
        return None, f"The {count} observations do not state their times and are not drawn."
    step = -(-count // _MOST_POINTS)
    which = f"{count} observations" if count > 1 else "one observation"
    if step > 1:
        which = f"every {_ORDINALS.get(step, f'{step}th')} of {count} observations"
    return found.only(slice(None, None, step)), f"Points: {which}, with one standard deviation."


def observation_points(
    ax: Axes, observations: Observations, observed: Floats, ms: float, zorder: float | None = None
) -> None:
    """Observations of `shown_observations` as points with one standard deviation."""
    assert observations.time_s is not None, "those without times are not shown"
    ax.errorbar(
        observations.time_s,
        observed,
        observations.std_um_s,
        fmt="o",
        ms=ms,
        lw=0.6,
        color=style.PURPLE,
        label="observations",
        zorder=zorder,
    )
