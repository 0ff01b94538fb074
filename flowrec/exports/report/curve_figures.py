"""Figures of curves over time: the robot's motion, the flow at it by observer and maps, and how the recording went."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from flowrec.core import Floats, FlowField
from flowrec.exports.report import style
from flowrec.exports.report.curves import Curve
from flowrec.exports.report.report_data import ReportData
from flowrec.exports.report.time_axis import line, observation_points, panels, shown_observations
from flowrec.physics import on_chip, sample
from flowrec.stages import EXPECTED_NIS

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_RECORDING_PANEL_MM = 20.0


class _Recorded(NamedTuple):
    """A curve of the figure about the recording: label of its axis, what it is, and its largest value in words."""

    label: str
    caption: str
    largest: str


_RECORDED = {
    "tick_ms": _Recorded(
        "time per\ntick (ms)",
        "Time per tick: computing time of one image (logarithmic); dashed: the time between images.",
        "time per tick up to {:.1f} ms",
    ),
    "late_ms": _Recorded(
        "delay of\nimages (ms)",
        "Delay of images: arrival at the computer after the moment that the fit of the camera's clock predicts; mean "
        "and largest of each second.",
        "mean delay of images up to {:.1f} ms",
    ),
    "lost": _Recorded(
        "lost\nimages",
        "Lost images: images so far that the camera counted and that did not reach the loop.",
        "{:.0f} images lost",
    ),
    "dropped": _Recorded(
        "dropped\nimages",
        "Dropped images: images so far that reached the loop and were not written.",
        "{:.0f} images dropped",
    ),
    "queue_mb": _Recorded(
        "queue\n(MB)", "Queue: data that waits for the disk.", "up to {:.1f} MB waiting for the disk"
    ),
}


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
            "estimates it."
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
        figure, axes = panels(history, width_mm, [34.0, 26.0] if below else [38.0])
        line(axes[0], history.curve("speed_um_s"), style.VERMILLION, "robot over ground", zorder=3)
        if _has_demand(data):
            line(axes[0], history.curve("demand_um_s"), style.QUIET, "demanded through fluid", lw=0.8)
        line(axes[0], _speed_of(data, "flow"), style.BLUE, "flow at the robot")
        _finish(axes[0], "speed (µm/s)", columns=3)
        if below:
            line(axes[1], errors["error_um"], style.VERMILLION, "distance to the route")
            line(axes[1], errors["estimate_error_um"], style.SKY, "error of the estimate")
            _finish(axes[1], "distance (µm)", columns=2)
        return figure


class TrackFigure:
    """Position and speed of the robot over time, where there is no flow to tell of."""

    name = "motion"
    title = "Position and speed over time"

    def why_not(self, data: ReportData) -> str:
        return data.no_position

    def caption(self, data: ReportData) -> str:
        return "Estimated position of the robot, from the first pixel of the mask, and its speed over ground."

    def alt(self, data: ReportData) -> str:
        x, y = data.history.curve("x_um").known, data.history.curve("y_um").known
        return f"Curves over time: x from {x.min():.0f} to {x.max():.0f} µm, y from {y.min():.0f} to {y.max():.0f} µm."

    def draw(self, data: ReportData, width_mm: float) -> Figure:
        history = data.history
        shown = [(name, history.curve(name)) for name in ("x_um", "y_um", "speed_um_s")]
        shown = [(name, curve) for name, curve in shown if curve]  # a short session has no speed
        figure, axes = panels(history, width_mm, [26.0] * len(shown))
        for ax, (name, curve) in zip(axes, shown, strict=True):
            line(ax, curve, style.VERMILLION, name)
            ax.set_ylabel({"x_um": "x (µm)", "y_um": "y (µm)"}.get(name, "speed (µm/s)"))
        return figure


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
        observed, on_map = _speed_of(data, "flow"), _speed_of(data, "map")
        text = f"Flow at the robot over time: observer up to {observed.largest:.0f} µm/s"
        return text + (f", map up to {on_map.largest:.0f} µm/s." if on_map else "; no map.")

    def draw(self, data: ReportData, width_mm: float) -> Figure:
        history, (observations, _) = data.history, shown_observations(data)
        nis = history.curve("nis")
        figure, axes = panels(history, width_mm, [28.0, 28.0, 16.0] if nis else [28.0, 28.0])
        std = history.curve("flow_std_um_s")
        for column, (ax, axis) in enumerate(zip(axes, "xy", strict=False)):
            flow, on_map, true = (history.curve(f"{name}_{axis}_um_s") for name in ("flow", "map", "true"))
            width = std.mean if len(std.mean) == len(flow.mean) else np.full_like(flow.mean, np.nan)
            ax.fill_between(flow.time_s, flow.mean - width, flow.mean + width, color=style.SKY, alpha=0.35, lw=0.0)
            line(ax, true, style.GREEN, "true (simulated)", lw=0.7)
            ax.plot(flow.time_s, flow.mean, color=style.BLUE, label="observer")
            line(ax, on_map, style.ORANGE, "map", lw=1.3)
            if observations is not None:
                # Behind the curves.
                observation_points(ax, observations, observations.flow_um_s[:, column], 1.8, 1.5)
            _limit(ax, [flow, on_map, true])
            ax.axhline(0.0, color=style.FAINT, lw=0.6, zorder=0)
            ax.set_ylabel(f"flow along {axis} (µm/s)")
        style.legend_above(axes[0])
        if nis:
            line(axes[2], nis, style.QUIET, "")
            axes[2].axhline(EXPECTED_NIS, color=style.INK, lw=0.6, ls=(0, (3, 2)))
            axes[2].set_ylim(0.0, max(2.0 * EXPECTED_NIS, 1.05 * nis.largest))
            axes[2].set_ylabel("consistency")
        return figure


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
        line(ax, _speed_of(data, "true"), style.GREEN, "true (simulated)", lw=0.7)
        if data.assumed is not None:
            speed = _speed(data.assumed, path_um)
            ax.plot(time_s, speed, color=style.QUIET, ls=(0, (4, 2)), label="assumed")
        top = 0.0
        if data.refined is not None:
            place_um = on_chip(data.refined.registration, path_um)
            speed, std = _speed(data.refined, place_um), _std(data.refined, place_um)
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
        style.legend_above(ax)
        return figure


class RecordingFigure:
    """Timing of the run: periods of the loop, the write queue, and lost frames."""

    name = "recording"
    title = "Losses and clocks"

    def why_not(self, data: ReportData) -> str:
        return "" if self._panels(data) else "the session holds neither the times of its ticks nor its clocks"

    def caption(self, data: ReportData) -> str:
        shown = [_RECORDED[name].caption for name in self._panels(data)]
        absent = []
        if not data.history.curve("late_ms"):
            absent.append("The session holds no clock of a camera.")
        if not data.history.curve("lost"):
            absent.append("The camera did not count its images, or the session is not from a camera that does.")
        return " ".join([*shown, *absent])

    def alt(self, data: ReportData) -> str:
        curves = {name: data.history.curve(name) for name in self._panels(data)}
        words = [_RECORDED[name].largest.format(curve.largest) for name, curve in curves.items()]
        return f"Curves over time: {', '.join(words)}."

    def draw(self, data: ReportData, width_mm: float) -> Figure:
        history, names = data.history, self._panels(data)
        figure, axes = panels(history, width_mm, [_RECORDING_PANEL_MM] * len(names))
        rate_hz = data.session.config.camera.rate_hz
        for ax, name in zip(axes, names, strict=True):
            line(ax, history.curve(name), style.BLUE, "mean")
            if name == "late_ms":
                line(ax, history.curve("latest_ms"), style.VERMILLION, "largest", lw=0.8)
                style.legend_above(ax, 2)
            ax.set_ylabel(_RECORDED[name].label)
            if name != "tick_ms":
                few = name in ("lost", "dropped") and ax.get_ylim()[1] < 1.0
                ax.set_ylim(bottom=0.0, top=1.0 if few else None)
                continue
            if rate_hz:
                ax.axhline(1e3 / rate_hz, color=style.INK, lw=0.6, ls=(0, (3, 2)))
            ax.set_yscale("log")
            ax.yaxis.set_major_formatter("{x:g}")
        return figure

    def _panels(self, data: ReportData) -> list[str]:
        """The curves to draw; of the queue and of dropped images only where there were any."""
        history = data.history
        always = [name for name in ("tick_ms", "late_ms", "lost") if history.curve(name)]
        if not history.curve("tick_ms"):
            return always
        return always + [name for name in ("dropped", "queue_mb") if history.curve(name).largest > 0.0]


def _finish(ax: Axes, label: str, columns: int) -> None:
    """Name a vertical axis that begins at 0, and its curves."""
    ax.set_ylabel(label)
    ax.set_ylim(bottom=0.0)
    style.legend_above(ax, columns)


def _has_demand(data: ReportData) -> bool:
    """True if the controller ever demanded a motion: not in a movie."""
    return data.history.curve("demand_um_s").largest > 0.0


def _speed_of(data: ReportData, name: str) -> Curve:
    """Speed of a flow at the robot, from its two components: `flow`, `map` or `true`."""
    x, y = (data.history.curve(f"{name}_{axis}_um_s") for axis in "xy")
    if not x:
        return x
    speed = np.hypot(x.mean, y.mean)
    return Curve(x.time_s, speed, speed, speed)


def _limit(ax: Axes, curves: list[Curve]) -> None:
    """Limits by the curves: the first standard deviations of an observer are as wide as can be."""
    known = np.concatenate([curve.known for curve in curves])
    low, high = known.min(initial=0.0), known.max(initial=0.0)
    margin = 0.15 * max(high - low, 1.0)
    ax.set_ylim(low - margin, high + margin)


def _speed(field: FlowField, at_um: Floats) -> Floats:
    """Speed (n,) of a map at points (n, 2), um/s; NaN where a point is not known."""
    speed: Floats = np.where(np.isfinite(at_um[:, 0]), np.hypot(*sample(field, at_um).T), np.nan)
    return speed


def _std(field: FlowField, at_um: Floats) -> Floats:
    """One standard deviation (n,) of the velocity vector of a map at points (n, 2), um/s: of the nearest pixel.

    NaN where the map states none, and outside of the mask's image.
    """
    if field.std_um_s is None:
        return np.full(len(at_um), np.nan)
    std = np.hypot(*np.moveaxis(field.std_um_s, -1, 0))
    pixels = np.rint(at_um / field.um_per_px)
    inside = (pixels >= 0.0).all(axis=1) & (pixels < std.shape[::-1]).all(axis=1)
    column, row = np.where(inside[:, None], pixels, 0.0).astype(np.intp).T
    return np.where(inside, std[row, column], np.nan)
