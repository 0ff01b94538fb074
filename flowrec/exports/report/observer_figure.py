"""Figure: the flow at the robot, as the observer estimates it and as the map of that time states it."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from flowrec.exports.report import style
from flowrec.exports.report.curves import Curve
from flowrec.exports.report.report_data import ReportData
from flowrec.exports.report.time_axis import line, observation_points, panels, shown_observations

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_EXPECTED_NIS = 2.0  # of a two-dimensional measurement


class ObserverFigure:
    """Consistency of the robot's motion with the map: the observer's health checks over time."""

    name = "observer"
    title = "Observer against map"

    def why_not(self, data: ReportData) -> str:
        if data.no_position or data.history.curve("flow_x_um_s"):
            return data.no_position
        return "the session holds no estimate of the flow at the robot"

    def caption(self, data: ReportData) -> str:
        parts = [
            "Flow at the robot along the chip's x axis (right) and y axis (down). Observer: estimated from the robot's "
            "motion; the band is one standard deviation."
        ]
        if data.history.curve("map_x_um_s"):
            parts.append("Map: the best flow map known at that time, at the same place; it jumps when a map is new.")
        else:
            parts.append("No map of the flow was known in this session.")
        parts.append(shown_observations(data)[1])
        if data.history.curve("nis"):
            parts.append(
                "Below: consistency of the observer (normalised innovation squared, mean); 2 is expected, and much "
                "more means that the robot moves in a way that the observer does not know."
            )
        return " ".join(parts)

    def alt(self, data: ReportData) -> str:
        observed, on_map = (
            np.hypot(*(data.history.curve(f"{name}_{axis}_um_s").mean for axis in "xy")) for name in ("flow", "map")
        )
        text = f"Flow at the robot over time: observer up to {_largest(observed):.0f} µm/s"
        return text + (f", map up to {_largest(on_map):.0f} µm/s." if len(on_map) else "; no map.")

    def draw(self, data: ReportData, width_mm: float) -> Figure:
        history, (observations, _) = data.history, shown_observations(data)
        nis = history.curve("nis")
        narrow = width_mm <= style.NARROW_MM
        figure, axes = panels(history, width_mm, [28.0, 28.0, 16.0] if nis else [28.0, 28.0])
        std = history.curve("flow_std_um_s")
        for column, (ax, axis) in enumerate(zip(axes, "xy", strict=False)):
            flow = history.curve(f"flow_{axis}_um_s")
            width = std.mean if len(std.mean) == len(flow.mean) else np.full_like(flow.mean, np.nan)
            ax.fill_between(flow.time_s, flow.mean - width, flow.mean + width, color=style.SKY, alpha=0.35, lw=0.0)
            line(ax, history.curve(f"true_{axis}_um_s"), style.INK, "true (simulated)", lw=0.7)
            ax.plot(flow.time_s, flow.mean, color=style.BLUE, label="observer")
            line(ax, history.curve(f"map_{axis}_um_s"), style.ORANGE, "map", lw=1.3)
            if observations is not None:
                # Behind the curves.
                observation_points(ax, observations, observations.flow_um_s[:, column], 1.8, 1.5)
            _limit(ax, [flow, history.curve(f"map_{axis}_um_s"), history.curve(f"true_{axis}_um_s")])
            ax.axhline(0.0, color=style.FAINT, lw=0.6, zorder=0)
            ax.set_ylabel(f"flow along {axis} (µm/s)")
        style.legend_above(axes[0], 2 if narrow else 4)
        if nis:
            line(axes[2], nis, style.QUIET, "")
            axes[2].axhline(_EXPECTED_NIS, color=style.INK, lw=0.6, ls=(0, (3, 2)))
            axes[2].set_ylim(0.0, max(2.0 * _EXPECTED_NIS, 1.05 * nis.largest))
            axes[2].set_ylabel("consistency")
        return figure


def _limit(ax: Axes, curves: list[Curve]) -> None:
    """Limits by the curves: the first standard deviations of an observer are as wide as can be."""
    known = np.concatenate([curve.known for curve in curves])
    if len(known):
        low, high = min(float(known.min()), 0.0), max(float(known.max()), 0.0)
        margin = 0.15 * max(high - low, 1.0)
        ax.set_ylim(low - margin, high + margin)


def _largest(values: np.ndarray) -> float:
    return float(np.nanmax(values)) if np.isfinite(values).any() else 0.0
