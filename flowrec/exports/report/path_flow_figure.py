"""Figure: the flow along the robot's way, before and after the refinement, with error bars."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from flowrec.exports.report import style
from flowrec.exports.report.history import std_at
from flowrec.exports.report.motion_figure import speed_of
from flowrec.exports.report.report_data import ReportData
from flowrec.exports.report.time_axis import line, observation_points, panels, shown_observations
from flowrec.physics import sample

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Floats = NDArray[np.float64]


class PathFlowFigure:
    """Flow along the robot's path: the assumed map, the refined map, and the observations."""

    name = "before_after"
    title = "Flow at the places of the robot"

    def why_not(self, data: ReportData) -> str:
        return data.no_map or data.no_position

    def caption(self, data: ReportData) -> str:
        parts = ["Speed of the flow at the place where the robot was at each time, by the last map of each kind."]
        if data.refined is None:
            parts.append("The flow was not refined in this session.")
        elif data.refined.std_um_s is None:
            parts.append(f"The method {data.refined.method} states no standard deviation, so there is no band.")
        else:
            parts.append("Band: one standard deviation that the refined map states for itself.")
        shown, words = shown_observations(data)
        parts.append(words)
        if shown is not None:
            parts.append(
                "An observation is the robot's motion over ground less the motion that it was driven to; so it holds "
                "the robot's own errors, too, which a refinement tells from the flow."
            )
        return " ".join(parts)

    def alt(self, data: ReportData) -> str:
        kinds = [name for name, field in (("assumed", data.assumed), ("refined", data.refined)) if field is not None]
        return f"Curves over time: speed of the flow at the robot by the {' and the '.join(kinds)} map."

    def draw(self, data: ReportData, width_mm: float) -> Figure:
        history = data.history
        figure, (ax,) = panels(history, width_mm, [44.0])
        path_um, time_s = data.path_um, history.curve("x_um").time_s
        line(ax, speed_of(data, "true"), style.INK, "true (simulated)", lw=0.7)
        if data.assumed is not None:
            speed = _speed(sample(data.assumed, path_um), path_um)
            ax.plot(time_s, speed, color=style.QUIET, ls=(0, (4, 2)), label="assumed")
        top = 0.0
        if data.refined is not None:
            speed, std = _speed(sample(data.refined, path_um), path_um), std_at(data.refined, path_um)
            ax.fill_between(time_s, np.maximum(speed - std, 0.0), speed + std, color=style.ORANGE, alpha=0.3, lw=0.0)
            ax.plot(time_s, speed, color=style.ORANGE, lw=1.3, label="refined")
            top = float(np.nanmax(speed, initial=0.0))
        observations, _ = shown_observations(data)
        if observations is not None:
            observed = np.hypot(*observations.flow_um_s.T)
            observation_points(ax, observations, observed, 2.0)
            top = max(top, float(observed.max()))
        _, high = ax.get_ylim()
        ax.set_ylim(0.0, min(high, 1.6 * top) if top else high)
        ax.set_ylabel("speed of the flow (µm/s)")
        style.legend_above(ax, 2 if width_mm <= style.NARROW_MM else 4)
        return figure


def _speed(velocity: Floats, at_um: Floats) -> Floats:
    speed: Floats = np.where(np.isfinite(at_um[:, 0]), np.hypot(velocity[:, 0], velocity[:, 1]), np.nan)
    return speed
