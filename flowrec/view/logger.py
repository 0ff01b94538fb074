"""From ticks to Rerun entities. What is new in a tick is logged, what is not is not."""

from __future__ import annotations

import math
from collections import deque

import cv2
import numpy as np
import rerun as rr
from numpy.typing import NDArray

from flowrec.declarations import Image
from flowrec.flow import sample
from flowrec.messages import (
    Currents,
    Demand,
    Estimate,
    Event,
    FlowField,
    Frame,
    Health,
    Mission,
    OperatorEvent,
    Route,
    Tick,
    Timing,
    Track,
    Truth,
)
from flowrec.store import nonzero_window
from flowrec.units import NS_PER_S
from flowrec.view import colours, maps
from flowrec.view import entities as e
from flowrec.view.entity_logger import Pen, label
from flowrec.view.flow_log import FlowLogger
from flowrec.view.scene import Scene
from flowrec.view.styles import log_series, log_styles

_JPEG_QUALITY = 85
_DIMMED = 0.6  # what is not of now, beside a window that is
_TRAIL_S = 4.0
_TRAIL_STEP_PX = 1.0  # likewise
_COMMAND_PX = 60.0  # length of the arrow of the fastest command, in an image of 640 pixels
_LEVELS = {"info": "INFO", "warning": "WARN", "error": "ERROR"}
_PHASES = {
    "start": colours.GREY,
    "survey": colours.PURPLE,
    "refine": colours.BLUE,
    "plan": colours.YELLOW,
    "navigate": colours.ORANGE,
    "done": colours.GREEN,
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
        self._scene = scene
        self._pen = Pen(stream, prefix)
        self._images = images
        self._whole: Image | None = None  # the last one, and the same dimmed
        self._around: Image | None = None
        self.image_step = 1
        self._placed_step = 0
        self._flow = FlowLogger(self._pen, scene, maps.SpeedScale() if speeds is None else speeds, self.present)
        self._last = Tick()
        self._trail: deque[tuple[int, NDArray[np.float64]]] = deque()
        left, _, right, _ = scene.image_bounds()
        self._unit_px = (right - left) / 640.0  # sizes that suit a 640 pixel image, whatever the camera
        self._robot_px = scene.length_px(scene.robot.radius_um)
        turn = np.linspace(0.0, 2.0 * np.pi, 33)
        self._ring = np.stack([np.cos(turn), np.sin(turn)], 1)
        self._log_static()

    def log(self, tick: Tick, frame_index: int | None = None) -> None:
        """Log what is new since the previous tick; the index is for a tick that comes without its frame."""
        last, self._last = self._last, tick
        self._set_time(tick, frame_index)
        if tick.frame is not None and tick.frame is not last.frame:
            self._log_image(tick.frame)
        self._flow.log_not_yet(tick.refined, last)
        self._flow.log_fields(tick, last)
        if tick.route is not None and tick.route is not last.route:
            self._log_route(tick.route)
            self._flow.log_time_to_go(tick.route)
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
        if tick.health is not None and tick.health is not last.health:
            self._log_health(tick.health)
        if tick.timing is not None and tick.timing is not last.timing:
            self._log_timing(tick.timing)
        if tick.event is not None and tick.event is not last.event:
            self._log_event(tick.event)
        if tick.operator is not None and tick.operator is not last.operator:
            self._log_operator(tick.operator)

    # ---- time and names

    def _set_time(self, tick: Tick, frame_index: int | None) -> None:
        self._pen.stream.set_time(e.SESSION_TIME, duration=np.timedelta64(tick.stamp_ns, "ns"))
        index = tick.frame.index if tick.frame is not None else frame_index
        if index is not None:
            self._pen.stream.set_time(e.FRAME, sequence=index)
        else:
            self._pen.stream.disable_timeline(e.FRAME)

    def _log_static(self) -> None:
        placement = self._scene.mask_placement(self._scene.chip.um_per_px)
        mask = self._scene.chip.mask.astype(np.uint8)
        contours, _ = cv2.findContours(mask, cv2.RETR_CCOMP, cv2.CHAIN_APPROX_SIMPLE)
        strips = [
            (np.concatenate([c, c[:1]])[:, 0] + 0.5) * placement.scale + np.array(placement.offset) for c in contours
        ]
        self._pen.log(
            e.OUTLINE, rr.LineStrips2D(strips, colors=colours.GREY, radii=rr.Radius.ui_points(0.6)), static=True
        )
        log_styles(self._pen)
        log_series(self._pen)
        self._pen.log(e.PHASE, rr.StateConfiguration(values=list(_PHASES), colors=list(_PHASES.values())), static=True)
        self._pen.log(
            e.SIGHT, rr.StateConfiguration(values=["seen", "lost"], colors=[colours.GREEN, colours.RED]), static=True
        )

    # ---- camera

    def _log_image(self, frame: Frame) -> None:
        if not self._images or frame.image.size == 0:
            return
        if self._placed_step != self.image_step:
            self._placed_step = self.image_step
            self._pen.log(e.IMAGE, maps.placed(self._scene.preview_placement(self.image_step)), static=True)
        image = self._completed(frame.image) if self._scene.windows else frame.image
        done, jpeg = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])
        assert done
        self._pen.log(e.IMAGE, rr.EncodedImage(contents=jpeg.tobytes(), media_type="image/jpeg", draw_order=-20.0))

    def _completed(self, image: Image) -> Image:
        """A window in the last whole image, dimmed, which says where it is and that the rest is not of now."""
        x0, y0, x1, y1 = nonzero_window(image)
        if (x0, y0) == (0, 0) and (y1, x1) == image.shape:
            self._whole, self._around = image, None
            return image
        if self._whole is None or self._whole.shape != image.shape:
            return image
        if self._around is None:
            self._around = (_DIMMED * self._whole).astype(np.uint8)
        completed = self._around.copy()
        completed[y0:y1, x0:x1] = image[y0:y1, x0:x1]
        return completed

    def _log_route(self, route: Route) -> None:
        self.present.add("route")
        if not route.reachable or len(route.waypoints_um) < 2:
            self._pen.log(e.PATH, rr.LineStrips2D([]))
            self._pen.log(e.PATH_LABEL, rr.Points2D([]))
            return
        points = self._scene.to_plane(route.waypoints_um)
        radius = rr.Radius.ui_points(self._pen.style.width)
        self._pen.log(
            e.PATH,
            rr.LineStrips2D(
                [points], colors=self._pen.style.path, radii=radius, draw_order=20.0 + (self._pen.prefix == "replayed")
            ),
        )
        at = points[int(self._pen.style.label_at * (len(points) - 1))]
        self._pen.log(e.PATH_LABEL, label(at, f"{self._pen.style.word}path", self._pen.style.path))

    def _log_mission(self, mission: Mission, last: Mission | None) -> None:
        if last is None or not np.array_equal(mission.goal_um, last.goal_um, equal_nan=True):
            self._log_goal(mission.goal_um)
        state = _state(mission)
        if last is None or state != _state(last):
            self._pen.log(e.PHASE, rr.StateChange(state=state))
            if state not in _PHASES:
                values, filled = [*_PHASES, state], [*_PHASES.values(), colours.GREEN]
                self._pen.log(e.PHASE, rr.StateConfiguration(values=values, colors=filled), static=True)

    def _log_goal(self, goal_um: NDArray[np.float64]) -> None:
        if not np.isfinite(goal_um).all():
            self._pen.log(e.GOAL, rr.Clear(recursive=False))
            return
        centre = self._scene.to_plane(goal_um)
        radius = max(1.6 * self._robot_px, 4.0)
        cross = np.array([[-1.0, 0.0], [1.0, 0.0]]), np.array([[0.0, -1.0], [0.0, 1.0]])
        self._pen.log(
            e.GOAL,
            rr.LineStrips2D(
                [centre + radius * part for part in (self._ring, *cross)],
                colors=colours.GREEN,
                radii=rr.Radius.ui_points(1.2),
                draw_order=25.0,
            ),
            label(centre + np.array([0.0, radius]), "goal", colours.GREEN),
        )

    def _log_sight(self, track: Track, last: Track | None) -> None:
        if last is None or track.seen != last.seen:
            self._pen.log(e.SIGHT, rr.StateChange(state="seen" if track.seen else "lost"))

    def _log_estimate(self, estimate: Estimate, field: FlowField | None, truth: Truth | None) -> None:
        centre = self._scene.to_plane(estimate.position_um)
        colour = self._pen.style.robot if estimate.seen else colours.PALE
        ring = [centre + self._robot_px * self._ring]
        self._pen.log(e.ROBOT, rr.LineStrips2D.from_fields(strips=ring, colors=colour))
        # Recorded and replayed robots mostly coincide: their labels go to either side.
        aside = self._robot_px + 2.0 * self._unit_px
        if self._pen.prefix == "recorded":
            aside = -self._robot_px - 24.0 * self._unit_px
        word = f"{self._pen.style.word}robot" + ("" if estimate.seen else " (not seen)")
        position = [centre + np.array([0.0, aside])]
        self._pen.log(e.ROBOT_LABEL, rr.Points2D.from_fields(positions=position, labels=[word], colors=colour))
        self._log_trail(estimate.stamp_ns, centre)
        flow = estimate.flow_um_s
        on_map = sample(field, estimate.position_um) if field is not None else np.full(2, np.nan)
        self._pen.log(e.FLOW_COMPONENTS, rr.Scalars([flow[0], on_map[0], flow[1], on_map[1]]))
        speeds = [math.hypot(*flow), math.hypot(*on_map)]
        if truth is not None:
            if self._pen.prefix != "replayed":
                speeds.append(math.hypot(*truth.flow_um_s))
            self._pen.log(e.ESTIMATE_ERROR, rr.Scalars(math.dist(estimate.position_um, truth.position_um)))
            self.present.add("true robot")
        self._pen.log(e.FLOW_SPEED, rr.Scalars(speeds))
        if math.isfinite(estimate.nis):
            self._pen.log(e.NIS, rr.Scalars(estimate.nis))

    def _log_trail(self, stamp_ns: int, centre: NDArray[np.float64]) -> None:
        trail = self._trail
        if not trail or math.dist(trail[-1][1], centre) >= _TRAIL_STEP_PX * self._unit_px:
            trail.append((stamp_ns, centre))
        while trail and stamp_ns - trail[0][0] > _TRAIL_S * NS_PER_S:
            trail.popleft()
        if len(trail) > 1:
            self._pen.log(e.TRAIL, rr.LineStrips2D.from_fields(strips=[np.array([point for _, point in trail])]))

    def _log_demand(self, demand: Demand, estimate: Estimate | None) -> None:
        # No data, not NaN, where there is no reference: the plot shows a gap either way, a statistic does not.
        if math.isfinite(demand.error_um):
            if demand.error_um > 0.0:  # a policy has no reference to be off
                self._pen.log(e.TRACKING_ERROR, rr.Scalars(demand.error_um))
            reference = self._scene.to_plane(demand.reference_um)
            self._pen.log(e.REFERENCE, rr.Points2D.from_fields(positions=[reference]))
        if estimate is not None:
            vector = demand.velocity_um_s * (_COMMAND_PX * self._unit_px / self._scene.robot.speed_limit_um_s)
            position = self._scene.to_plane(estimate.position_um)
            self._pen.log(e.COMMAND, rr.Arrows2D.from_fields(origins=[position], vectors=[vector]))

    # ---- flow

    # ---- coils, timing, events

    def _log_currents(self, currents: Currents) -> None:
        self._pen.log(e.CURRENT, rr.Scalars(currents.currents_a))
        if len(currents.voltages_v):
            self.present.add("voltages")
            self._pen.log(e.VOLTAGE, rr.Scalars(currents.voltages_v))
        self._pen.log(e.FREQUENCY, rr.Scalars(currents.frequency_hz))
        self._pen.log(e.HEADING, rr.Scalars(math.degrees(currents.heading_rad)))

    def _log_health(self, health: Health) -> None:
        self.present.add("health")
        if math.isfinite(health.nis):
            self._pen.log(e.NIS_MEAN, rr.Scalars(health.nis))
        self._pen.log(e.PULSATION, rr.Scalars(100.0 * health.pulsation_share))

    def _log_timing(self, timing: Timing) -> None:
        self.present.add("timing")
        self._pen.log(
            e.TIMING,
            rr.Scalars([timing.track_ms, timing.observe_ms, timing.control_ms, timing.sinks_ms, timing.total_ms]),
        )

    def _log_event(self, event: Event) -> None:
        self._pen.log(e.EVENTS, rr.TextLog(self._said(event.text), level=_LEVELS.get(event.level, "INFO")))

    def _log_operator(self, event: OperatorEvent) -> None:
        text = f"operator: {event.action}" + (f": {event.text}" if event.text else "")
        self._pen.log(e.OPERATOR, rr.TextLog(self._said(text), level="INFO"))

    def _said(self, text: str) -> str:
        return f"{self._pen.prefix}: {text}" if self._pen.prefix else text


def _state(mission: Mission) -> str:
    """What the timeline of phases says of a mission."""
    return f"{mission.phase}: {mission.outcome}" if mission.finished and mission.outcome else mission.phase
