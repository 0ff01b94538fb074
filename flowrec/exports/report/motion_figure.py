"""Figure: speed of the robot, of the flow at it, and its distance to where it should be, over time."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from flowrec.exports.report import style
from flowrec.exports.report.curves import Curve
from flowrec.exports.report.report_data import ReportData
from flowrec.exports.report.time_axis import line, panels

if TYPE_CHECKING:
    from matplotlib.figure import Figure


class MotionFigure:
    """Speed of the robot, and its distance from the route, over time."""

    name = "motion"
    title = "Speed and error over time"

    def why_not(self, data: ReportData) -> str:
        if data.history.curve("speed_um_s") or data.history.curve("error_um"):
            return ""
        return data.no_position or "the session is too short for a speed"

    def caption(self, data: ReportData) -> str:
        demanded = "the speed through the fluid that the controller demands, " if _has_demand(data) else ""
        parts = [
            f"Above: speed of the robot over ground, {demanded}and the speed of the flow at the robot, as the observer "
            "estimates it.",
        ]
        if data.history.curve("error_um"):
            parts.append("Below: distance of the robot to the point of its route where it should be at that time.")
        else:
            parts.append("There was no route to follow, so there is no distance to it.")
        if data.history.curve("estimate_error_um"):
            parts.append("Error of the estimate: its distance to the simulated robot's true position.")
        return " ".join(parts)

    def alt(self, data: ReportData) -> str:
        speed, error = data.history.curve("speed_um_s"), data.history.curve("error_um")
        text = "Curves over time."
        if len(speed.known):
            text += f" Speed over ground: up to {speed.largest:.0f} µm/s."
        if len(error.known):
            text += f" Distance to the route: median {np.median(error.known):.0f} µm, up to {error.largest:.0f} µm."
        return text

    def draw(self, data: ReportData, width_mm: float) -> Figure:
        history = data.history
        errors = {name: history.curve(name) for name in ("error_um", "estimate_error_um")}
        below = any(errors.values())
        narrow = width_mm <= style.NARROW_MM
        figure, axes = panels(history, width_mm, [34.0, 26.0] if below else [38.0])
        line(axes[0], history.curve("speed_um_s"), style.VERMILLION, "robot over ground", zorder=3)
        if _has_demand(data):
            line(axes[0], history.curve("demand_um_s"), style.QUIET, "demanded through fluid", lw=0.8)
        line(axes[0], speed_of(data, "flow"), style.BLUE, "flow at the robot")
        axes[0].set_ylabel("speed (µm/s)")
        axes[0].set_ylim(bottom=0.0)
        style.legend_above(axes[0], 2 if narrow else 3)
        if below:
            line(axes[1], errors["error_um"], style.VERMILLION, "distance to the route")
            line(axes[1], errors["estimate_error_um"], style.SKY, "error of the estimate")
            axes[1].set_ylabel("distance (µm)")
            axes[1].set_ylim(bottom=0.0)
            style.legend_above(axes[1], 2)
        return figure


def _has_demand(data: ReportData) -> bool:
    """True if the controller ever demanded a motion: not in a movie."""
    return data.history.curve("demand_um_s").largest > 0.0


def speed_of(data: ReportData, name: str) -> Curve:
    """Speed of a flow at the robot, from its two components: `flow`, `map` or `true`."""
    x, y = (data.history.curve(f"{name}_{axis}_um_s") for axis in "xy")
    if not x:
        return x
    speed = np.hypot(x.mean, y.mean)
    return Curve(x.time_s, speed, speed, speed)
