"""From ticks to Rerun entities. What is new in a tick is logged, what is not is not."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

import cv2
import numpy as np
import rerun as rr
from numpy.typing import NDArray

from flowrec.flow import sample
from flowrec.messages import (
    Currents,
    Demand,
    Estimate,
    Event,
    FlowField,
    Frame,
    Mission,
    OperatorEvent,
    Route,
    Tick,
    Timing,
    Track,
    Truth,
)
from flowrec.units import NS_PER_S
from flowrec.view import entities as e
from flowrec.view import maps, palette
from flowrec.view.arrows import arrow_grid, flow_arrows
from flowrec.view.scene import Scene

_JPEG_QUALITY = 85
_TRAIL_S = 4.0
_TRAIL_STEP_PX = 1.0  # likewise
_COMMAND_PX = 60.0  # length of the arrow of the fastest command, in an image of 640 pixels
_LEVELS = {"info": "INFO", "warning": "WARN", "error": "ERROR"}
_PHASES = {
    "start": palette.GREY,
    "survey": palette.PURPLE,
    "refine": palette.BLUE,
    "plan": palette.YELLOW,
    "navigate": palette.ORANGE,
    "done": palette.GREEN,
}


@dataclass(frozen=True, slots=True)
class _Style:
    """How one of up to two sessions in one view is told from the other."""

    word: str
    path: palette.Rgb
    robot: palette.Rgb
    width: float  # the recorded one is broad and below, so that both are seen where they coincide
    label_at: float  # share of the path


_STYLES = {
    "": _Style("", palette.CYAN, palette.ORANGE, 1.4, 0.06),
    "recorded": _Style("recorded ", palette.ORANGE, palette.ORANGE, 2.6, 0.06),
    "replayed": _Style("replayed ", palette.CYAN, palette.CYAN, 1.2, 0.25),
}


class TickLogger:
    """Logs the ticks of one session into a recording stream, below `prefix` ('', 'recorded' or 'replayed').

    Loggers that share `speeds` paint their maps on one scale. Of a preview, `image_step` says that only each
    so-manieth row and column of the camera's image is there. `present` collects what was ever seen, for the blueprint.
    """

    def __init__(
        self,
        stream: rr.RecordingStream,
        scene: Scene,
        prefix: str = "",
        *,
        images: bool = True,
        speeds: maps.SpeedScale | None = None,
    ) -> None:
        self.present: set[str] = set()
        self._stream = stream
        self._scene = scene
        self._prefix = prefix
        self._style = _STYLES[prefix]
        self._images = images
        self.image_step = 1
        self._placed_step = 0
        self._speeds = maps.SpeedScale() if speeds is None else speeds
        self._painted = 0  # version of the scale the maps were painted on
        self._last = Tick()
        self._trail: deque[tuple[int, NDArray[np.float64]]] = deque()
        self._grid = arrow_grid(scene)
        self._bar = maps.ColourBar.beside(scene)
        self._names: dict[str, str] = {}
        left, _, right, _ = scene.image_bounds()
        self._unit_px = (right - left) / 640.0  # sizes that suit a 640 pixel image, whatever the camera
        self._robot_px = scene.length_px(scene.robot.radius)
        turn = np.linspace(0.0, 2.0 * np.pi, 33)
        self._ring = np.stack([np.cos(turn), np.sin(turn)], 1)
        self._log_static()

    def log(self, tick: Tick, frame_index: int | None = None) -> None:
        """Log what is new since the previous tick; the index is for a tick that comes without its frame."""
        last, self._last = self._last, tick
        self._set_time(tick, frame_index)
        if tick.frame is not None and tick.frame is not last.frame:
            self._log_image(tick.frame)
        self._log_not_yet(tick.refined, last)
        self._log_fields(tick, last)
        if tick.route is not None and tick.route is not last.route:
            self._log_route(tick.route)
        if tick.mission is not None and tick.mission is not last.mission:
            self._log_mission(tick.mission, last.mission)
        if tick.track is not None and tick.track is not last.track:
            self._log_sight(tick.track, last.track)
        if tick.estimate is not None and tick.estimate is not last.estimate:
            self._log_estimate(tick.estimate, tick.field, tick.truth)
        if tick.demand is not None and tick.demand is not last.demand:
            self._log_demand(tick.demand, tick.estimate)
        if tick.currents is not None and tick.currents is not last.currents:
            self._log_currents(tick.currents)
        if tick.timing is not None and tick.timing is not last.timing:
            self._log_timing(tick.timing)
        if tick.event is not None and tick.event is not last.event:
            self._log_event(tick.event)
        if tick.operator is not None and tick.operator is not last.operator:
            self._log_operator(tick.operator)

    # ---- time and names

    def _set_time(self, tick: Tick, frame_index: int | None) -> None:
        self._stream.set_time(e.SESSION_TIME, duration=np.timedelta64(tick.stamp_ns, "ns"))
        index = tick.frame.index if tick.frame is not None else frame_index
        if index is not None:
            self._stream.set_time(e.FRAME, sequence=index)
        else:
            self._stream.disable_timeline(e.FRAME)

    def _log(self, entity: str, *what: rr.AsComponents, static: bool = False) -> None:
        path = self._names.get(entity)
        if path is None:
            path = self._names[entity] = e.under(self._prefix, entity)
        self._stream.log(path, what[0], *what[1:], static=static)

    def _log_static(self) -> None:
        placement = self._scene.mask_placement(self._scene.chip.um_per_px)
        mask = self._scene.chip.mask.astype(np.uint8)
        contours, _ = cv2.findContours(mask, cv2.RETR_CCOMP, cv2.CHAIN_APPROX_SIMPLE)
        strips = [
            (np.concatenate([c, c[:1]])[:, 0] + 0.5) * placement.scale + np.array(placement.offset) for c in contours
        ]
        self._log(e.OUTLINE, rr.LineStrips2D(strips, colors=palette.GREY, radii=rr.Radius.ui_points(0.6)), static=True)
        for entity in (e.ASSUMED, e.REFINED, e.TRUE, e.CHANGE, e.UNCERTAINTY):
            self._log(entity, maps.placed(placement), static=True)
        self._log_styles()
        self._log_series()
        self._log(e.PHASE, rr.StateConfiguration(values=list(_PHASES), colors=list(_PHASES.values())), static=True)
        self._log(
            e.SIGHT, rr.StateConfiguration(values=["seen", "lost"], colors=[palette.GREEN, palette.RED]), static=True
        )

    def _log_styles(self) -> None:
        """What never changes of the things that move; in each tick only their places are logged."""
        style, points, above = self._style, rr.Radius.ui_points, float(self._prefix == "replayed")
        self._log(
            e.TRAIL,
            rr.LineStrips2D.from_fields(colors=(*style.robot, 150), radii=points(1.0), draw_order=24.0),
            static=True,
        )
        self._log(e.ROBOT, rr.LineStrips2D.from_fields(radii=points(style.width), draw_order=30.0 + above), static=True)
        self._log(e.ROBOT_LABEL, rr.Points2D.from_fields(radii=points(0.0), show_labels=True), static=True)
        self._log(
            e.REFERENCE,
            rr.Points2D.from_fields(
                colors=palette.YELLOW,
                radii=points(3.5),
                labels=[f"{style.word}reference"],
                show_labels=False,
                draw_order=28.0,
            ),
            static=True,
        )
        colour = style.robot if self._prefix else palette.WHITE
        self._log(e.COMMAND, rr.Arrows2D.from_fields(colors=colour, radii=points(1.6), draw_order=29.0), static=True)

    def _log_series(self) -> None:
        """Names and colours of all lines. One line of each session in a plot: the session's name says which."""

        def lines(entity: str, *named: tuple[str, palette.Rgb]) -> None:
            names = [self._style.word + name for name, _ in named]
            if self._prefix and len(named) == 1:
                names = [self._prefix]
            colours = [colour for _, colour in named]
            self._log(entity, rr.SeriesLines(names=names, colors=colours, widths=[1.5] * len(named)), static=True)

        own = self._style.path if self._prefix else palette.YELLOW
        paler = palette.BLUE if self._prefix == "replayed" else palette.YELLOW
        lines(e.CURRENT, ("x (A)", palette.RED), ("y (A)", palette.GREEN), ("z (A)", palette.BLUE))
        lines(e.FREQUENCY, ("frequency (Hz)", own))
        lines(e.HEADING, ("heading (°)", own))
        lines(e.TRACKING_ERROR, ("tracking error (µm)", own))
        lines(e.ESTIMATE_ERROR, ("estimate error (µm)", own))
        lines(e.NIS, ("NIS", own))
        truth = () if self._prefix == "replayed" else (("truth", palette.GREEN),)  # the same in both
        lines(e.FLOW_SPEED, ("observer", self._style.path), ("map", paler), *truth)
        lines(
            e.FLOW_COMPONENTS,
            ("vx observer", palette.CYAN),
            ("vx map", palette.BLUE),
            ("vy observer", palette.YELLOW),
            ("vy map", palette.ORANGE),
        )
        lines(
            e.TIMING,
            ("track (ms)", palette.CYAN),
            ("observe (ms)", palette.PURPLE),
            ("control (ms)", palette.YELLOW),
            ("sinks (ms)", palette.BLUE),
            ("total (ms)", palette.WHITE),
        )

    # ---- camera

    def _log_image(self, frame: Frame) -> None:
        if not self._images or frame.image.size == 0:
            return
        if self._placed_step != self.image_step:
            self._placed_step = self.image_step
            self._log(e.IMAGE, maps.placed(self._scene.preview_placement(self.image_step)), static=True)
        done, jpeg = cv2.imencode(".jpg", frame.image, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])
        assert done
        self._log(e.IMAGE, rr.EncodedImage(contents=jpeg.tobytes(), media_type="image/jpeg", draw_order=-20.0))

    def _log_route(self, route: Route) -> None:
        self.present.add("route")
        if not route.reachable or len(route.waypoints_um) < 2:
            self._log(e.PATH, rr.LineStrips2D([]))
            self._log(e.PATH_LABEL, rr.Points2D([]))
            return
        points = self._scene.to_plane(route.waypoints_um)
        radius = rr.Radius.ui_points(self._style.width)
        self._log(
            e.PATH,
            rr.LineStrips2D(
                [points], colors=self._style.path, radii=radius, draw_order=20.0 + (self._prefix == "replayed")
            ),
        )
        at = points[int(self._style.label_at * (len(points) - 1))]
        self._log(e.PATH_LABEL, _label(at, f"{self._style.word}path", self._style.path))

    def _log_mission(self, mission: Mission, last: Mission | None) -> None:
        if last is None or not np.array_equal(mission.goal_um, last.goal_um, equal_nan=True):
            self._log_goal(mission.goal_um)
        state = _state(mission)
        if last is None or state != _state(last):
            self._log(e.PHASE, rr.StateChange(state=state))
            if state not in _PHASES:
                values, colours = [*_PHASES, state], [*_PHASES.values(), palette.GREEN]
                self._log(e.PHASE, rr.StateConfiguration(values=values, colors=colours), static=True)

    def _log_goal(self, goal_um: NDArray[np.float64]) -> None:
        if not np.isfinite(goal_um).all():
            self._log(e.GOAL, rr.Clear(recursive=False))
            return
        centre = self._scene.to_plane(goal_um)
        radius = max(1.6 * self._robot_px, 4.0)
        cross = np.array([[-1.0, 0.0], [1.0, 0.0]]), np.array([[0.0, -1.0], [0.0, 1.0]])
        self._log(
            e.GOAL,
            rr.LineStrips2D(
                [centre + radius * part for part in (self._ring, *cross)],
                colors=palette.GREEN,
                radii=rr.Radius.ui_points(1.2),
                draw_order=25.0,
            ),
            _label(centre + np.array([0.0, radius]), "goal", palette.GREEN),
        )

    def _log_sight(self, track: Track, last: Track | None) -> None:
        if last is None or track.seen != last.seen:
            self._log(e.SIGHT, rr.StateChange(state="seen" if track.seen else "lost"))

    def _log_estimate(self, estimate: Estimate, field: FlowField | None, truth: Truth | None) -> None:
        centre = self._scene.to_plane(estimate.position_um)
        colour = self._style.robot if estimate.seen else palette.PALE
        ring = [centre + self._robot_px * self._ring]
        self._log(e.ROBOT, rr.LineStrips2D.from_fields(strips=ring, colors=colour))
        # Recorded and replayed robots mostly coincide: their labels go to either side.
        aside = self._robot_px + 2.0 * self._unit_px
        if self._prefix == "recorded":
            aside = -self._robot_px - 24.0 * self._unit_px
        word = f"{self._style.word}robot" + ("" if estimate.seen else " (not seen)")
        position = [centre + np.array([0.0, aside])]
        self._log(e.ROBOT_LABEL, rr.Points2D.from_fields(positions=position, labels=[word], colors=colour))
        self._log_trail(estimate.stamp_ns, centre)
        flow = estimate.flow_um_s
        on_map = sample(field, estimate.position_um) if field is not None else np.full(2, np.nan)
        self._log(e.FLOW_COMPONENTS, rr.Scalars([flow[0], on_map[0], flow[1], on_map[1]]))
        speeds = [math.hypot(*flow), math.hypot(*on_map)]
        if truth is not None:
            if self._prefix != "replayed":
                speeds.append(math.hypot(*truth.flow_um_s))
            self._log(e.ESTIMATE_ERROR, rr.Scalars(math.dist(estimate.position_um, truth.position_um)))
            self.present.add("true robot")
        self._log(e.FLOW_SPEED, rr.Scalars(speeds))
        if math.isfinite(estimate.nis):
            self._log(e.NIS, rr.Scalars(estimate.nis))

    def _log_trail(self, stamp_ns: int, centre: NDArray[np.float64]) -> None:
        trail = self._trail
        if not trail or math.dist(trail[-1][1], centre) >= _TRAIL_STEP_PX * self._unit_px:
            trail.append((stamp_ns, centre))
        while trail and stamp_ns - trail[0][0] > _TRAIL_S * NS_PER_S:
            trail.popleft()
        if len(trail) > 1:
            self._log(e.TRAIL, rr.LineStrips2D.from_fields(strips=[np.array([point for _, point in trail])]))

    def _log_demand(self, demand: Demand, estimate: Estimate | None) -> None:
        # No data, not NaN, where there is no reference: the plot shows a gap either way, a statistic does not.
        if math.isfinite(demand.error_um):
            self._log(e.TRACKING_ERROR, rr.Scalars(demand.error_um))
            reference = self._scene.to_plane(demand.reference_um)
            self._log(e.REFERENCE, rr.Points2D.from_fields(positions=[reference]))
        if estimate is not None:
            vector = demand.velocity_um_s * (_COMMAND_PX * self._unit_px / self._scene.robot.speed_limit_um_s)
            position = self._scene.to_plane(estimate.position_um)
            self._log(e.COMMAND, rr.Arrows2D.from_fields(origins=[position], vectors=[vector]))

    # ---- flow

    def _log_not_yet(self, refined: FlowField | None, last: Tick) -> None:
        """Say in the maps that wait for a refinement that they do."""
        if refined is None and last.stamp_ns < 0:
            left, top, right, bottom = self._scene.chip_bounds()
            centre = np.array([0.5 * (left + right), 0.5 * (top + bottom)])
            for entity in (e.REFINED, e.CHANGE):
                self._log(_beside(entity), _label(centre, "not refined yet", palette.PALE))
        elif refined is not None and last.refined is None:
            for entity in (e.REFINED, e.CHANGE):
                self._log(_beside(entity), rr.Clear(recursive=False))

    def _log_fields(self, tick: Tick, last: Tick) -> None:
        new = [
            field
            for field, before in (
                (tick.assumed, last.assumed),
                (tick.refined, last.refined),
                (tick.true_field, last.true_field),
            )
            if field is not None and field is not before
        ]
        for field in new:
            self._speeds.hold(maps.peak(field))
        if self._speeds.scale is None or (tick.field is None and tick.true_field is None):
            return
        repaint = self._painted != self._speeds.version
        if not new and not repaint:
            return
        self._painted = self._speeds.version
        scale, mask = self._speeds.scale, self._scene.chip.mask
        if repaint:
            self._log_scale(e.SPEED_SCALE, scale)
        known = (
            (e.ASSUMED, "assumed", tick.assumed),
            (e.REFINED, "refined", tick.refined),
            (e.TRUE, "truth", tick.true_field),
        )
        for entity, name, known_field in known:
            if known_field is not None and (repaint or any(known_field is other for other in new)):
                self.present.add(name)
                self._log(entity, maps.picture(maps.speed(known_field, mask), scale))
        self._log_change(tick.refined, tick.assumed, new)
        self._log_uncertainty(tick.field, new)
        if tick.field is not None and (repaint or tick.field is not last.field):
            self._log_arrows(tick.field)

    def _log_change(self, refined: FlowField | None, assumed: FlowField | None, new: list[FlowField]) -> None:
        if refined is None or assumed is None or not any(field is refined or field is assumed for field in new):
            return
        self.present.add("change")
        values = maps.change(refined, assumed, self._scene.chip.mask)
        scale = maps.scale_of(values, "change")
        self._log(e.CHANGE, maps.picture(values, scale))
        self._log_scale(e.CHANGE_SCALE, scale)

    def _log_uncertainty(self, field: FlowField | None, new: list[FlowField]) -> None:
        if field is None or field.std_um_s is None or not any(field is other for other in new):
            return
        self.present.add("uncertainty")
        values = maps.uncertainty(field, self._scene.chip.mask)
        scale = maps.scale_of(values, "uncertainty")
        self._log(e.UNCERTAINTY, maps.picture(values, scale))
        self._log_scale(e.UNCERTAINTY_SCALE, scale)

    def _log_scale(self, entity: str, scale: palette.Scale) -> None:
        self._log(f"{entity}/bar", *self._bar.strip(scale))
        self._log(f"{entity}/ticks", *self._bar.ticks(scale))

    def _log_arrows(self, field: FlowField) -> None:
        assert self._speeds.scale is not None
        origins, vectors, speed = flow_arrows(self._scene, field, self._grid)
        radius = 0.08 * self._scene.length_px(self._grid[1])
        self._log(
            e.ARROWS,
            rr.Arrows2D(
                origins=origins, vectors=vectors, colors=self._speeds.scale.paint(speed), radii=radius, draw_order=5.0
            ),
        )

    # ---- coils, timing, events

    def _log_currents(self, currents: Currents) -> None:
        self._log(e.CURRENT, rr.Scalars(currents.currents_a))
        self._log(e.FREQUENCY, rr.Scalars(currents.frequency_hz))
        self._log(e.HEADING, rr.Scalars(math.degrees(currents.heading_rad)))

    def _log_timing(self, timing: Timing) -> None:
        self.present.add("timing")
        self._log(
            e.TIMING,
            rr.Scalars([timing.track_ms, timing.observe_ms, timing.control_ms, timing.sinks_ms, timing.total_ms]),
        )

    def _log_event(self, event: Event) -> None:
        self._log(e.EVENTS, rr.TextLog(self._said(event.text), level=_LEVELS.get(event.level, "INFO")))

    def _log_operator(self, event: OperatorEvent) -> None:
        text = f"operator: {event.action}" + (f": {event.text}" if event.text else "")
        self._log(e.OPERATOR, rr.TextLog(self._said(text), level="INFO"))

    def _said(self, text: str) -> str:
        return f"{self._prefix}: {text}" if self._prefix else text


def _beside(entity: str) -> str:
    """Where a map's word about its absence is logged."""
    return f"{entity.rsplit('/', 1)[0]}/{e.NOT_YET}"


def _label(at: NDArray[np.float64], text: str, colour: palette.Rgb) -> rr.Points2D:
    """A word that stays readable at any zoom, just below a point (2,) of the picture plane."""
    return rr.Points2D([at], labels=[text], show_labels=True, colors=colour, radii=rr.Radius.ui_points(0.0))


def _state(mission: Mission) -> str:
    """What the timeline of phases says of a mission."""
    return f"{mission.phase}: {mission.outcome}" if mission.finished and mission.outcome else mission.phase
