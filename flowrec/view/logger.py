"""From ticks to Rerun entities. Only what is new in a tick is logged."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Mapping
from typing import Any

import cv2
import numpy as np
import rerun as rr
from numpy.typing import NDArray

from flowrec.core import (
    NS_PER_S,
    Currents,
    Demand,
    Estimate,
    Event,
    Frame,
    Health,
    Level,
    Message,
    Mission,
    OperatorEvent,
    Route,
    Tick,
    Timing,
    Track,
    message_fields,
    seconds,
)
from flowrec.physics import on_chip, sample
from flowrec.view import colours, maps
from flowrec.view import entities as e
from flowrec.view.entities import EntityLogger, label, points
from flowrec.view.flow_logger import FlowLogger
from flowrec.view.scene import Scene
from flowrec.view.state_logger import StateLogger
from flowrec.view.window_images import WindowCompleter

_JPEG_QUALITY = 85
_NOMINAL_PX = 640.0  # width of the image that the sizes below are meant for
_TRAIL_S = 4.0
_TRAIL_STEP_PX = 1.0
_COMMAND_PX = 60.0  # length of the arrow of the fastest command
_LEVELS: dict[str, str] = {Level.INFO: "INFO", Level.WARNING: "WARN", Level.ERROR: "ERROR"}
_WORD_SHARE = 0.16, 0.12  # of the view: half the width, and the height, of the longest word about the robot
_CROSS = np.array([[-1.0, 0.0], [1.0, 0.0]]), np.array([[0.0, -1.0], [0.0, 1.0]])


class TickLogger:
    """Logs the ticks of one session into a recording stream, below `prefix` ('' or one of entities.REPLAY or PAIR).

    Parameters
    ----------
    images : whether the camera's images are logged.
    speeds : scale of the maps; loggers that share it paint their maps alike.

    Attributes
    ----------
    image_step : in a preview only each `image_step`-th row and column of the image is present.
    present : names of what was ever logged, for the blueprint.
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
        self.image_step = 1
        self._stream = stream
        self._scene = scene
        self._prefix = prefix
        self._entities = EntityLogger(stream, prefix)
        self._log = self._entities.log
        self._style = self._entities.style
        self._images = images
        self._windows = WindowCompleter()
        self._placed_step = 0
        self._flow = FlowLogger(self._entities, scene, maps.SpeedScale() if speeds is None else speeds, self.present)
        self._tick = self._last = Tick()
        self._trail: deque[tuple[int, NDArray[np.float64]]] = deque()
        left, _, right, _ = scene.image_bounds()
        self._unit_px = (right - left) / _NOMINAL_PX
        self._robot_px = scene.length_px(scene.robot.radius_um)
        angle = np.linspace(0.0, 2.0 * np.pi, 33)
        self._ring = np.stack([np.cos(angle), np.sin(angle)], 1)
        self._states = StateLogger(self._entities, self.present, doubtful=bool(scene.doubts))
        self._moved = scene.image_to_plane(None)  # (2, 3) of measured points, by the registration of the refined field
        self._placed = self._moved  # (2, 3) of the image, with the shift of a shaking stage
        self._log_static()
        self._by_field: dict[str, Callable[[Any], None]] = {
            "route": self._log_route,
            "mission": self._log_mission,
            "track": self._log_track,
            "estimate": self._log_estimate,
            "demand": self._log_demand,
            "currents": self._log_currents,
            "health": self._log_health,
            "timing": self._log_timing,
            "event": self._log_event,
            "operator": self._log_operator,
            "drops": self._states.log_drops,
            "losses": self._states.log_losses,
        }

    @property
    def doubtful(self) -> bool:
        """True if the result is doubtful: then an outcome is amber."""
        return self._states.doubtful

    @doubtful.setter
    def doubtful(self, doubtful: bool) -> None:
        self._states.doubtful = doubtful

    @property
    def phases(self) -> Mapping[str, int]:
        """See StateLogger."""
        return self._states.phases

    def log(self, tick: Tick, frame_index: int | None = None) -> None:
        """Log what is new since the previous tick; `frame_index` is for a tick without its frame."""
        self._last, self._tick = self._tick, tick
        self._stream.set_time(e.SESSION_TIME, duration=np.timedelta64(tick.stamp_ns, "ns"))
        index = tick.frame.index if tick.frame is not None else frame_index
        if index is not None:
            self._stream.set_time(e.FRAME, sequence=index)
        else:
            self._stream.disable_timeline(e.FRAME)
        if tick.refined is not self._last.refined or tick.shift is not self._last.shift:
            self._log_registration(tick)
        self._states.end_marks(tick.stamp_ns)
        if tick.frame is not None and tick.frame is not self._last.frame:
            self._log_image(tick.frame)
        self._flow.log_not_yet(tick.refined, self._last)
        self._flow.log_fields(tick, self._last)
        for field, log_message in self._by_field.items():
            message = getattr(tick, field)
            if message is not None and message is not getattr(self._last, field):
                log_message(message)
        for path, message in tick.extra.items():
            if message is not self._last.extra.get(path):
                self._log_extra(path, message)

    def _log_extra(self, path: str, message: Message) -> None:
        """The floats of a message as lines over time, a vector as a line an element."""
        for each in message_fields(type(message)):
            if not each.is_float or each.kind == "array":
                continue
            values = np.atleast_1d(np.asarray(getattr(message, each.name), np.float64))  # None becomes NaN
            if np.isfinite(values).any():
                entity = f"{e.EXTRA}{path}/{each.name}"
                self.present.add(entity)
                self._log(entity, rr.Scalars(values))

    def _log_static(self) -> None:
        chip = self._scene.chip
        contours, _ = cv2.findContours(chip.mask.astype(np.uint8), cv2.RETR_CCOMP, cv2.CHAIN_APPROX_SIMPLE)
        strips = [self._scene.to_plane(np.concatenate([c, c[:1]])[:, 0] * chip.um_per_px) for c in contours]
        self._log(e.OUTLINE, rr.LineStrips2D(strips, colors=colours.GREY, radii=points(0.6)), static=True)
        self._entities.log_styles()
        self._entities.log_series()

    def _log_image(self, frame: Frame) -> None:
        if not self._images or frame.image.size == 0:
            return
        if self._placed_step != self.image_step:
            self._placed_step = self.image_step
            self._log(e.IMAGE, maps.transform_of(self._scene.preview_placement(self.image_step)), static=True)
        image = self._windows.complete(frame.image) if self._scene.windows else frame.image
        if frame.bits > 8:
            image = (image >> (frame.bits - 8)).astype(np.uint8)
        done, jpeg = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])
        assert done
        self._log(e.IMAGE, rr.EncodedImage(contents=jpeg.tobytes(), media_type="image/jpeg", draw_order=-20.0))

    def _log_route(self, route: Route) -> None:
        self.present.add("route")
        self._flow.log_time_to_go(route)
        if not route.reachable or len(route.waypoints_um) < 2:
            self._log(e.PATH, rr.LineStrips2D([]))
            return
        path, style = self._scene.to_plane(route.waypoints_um), self._style
        order = 20.0 + self._style.second
        self._log(e.PATH, rr.LineStrips2D([path], colors=style.path, radii=points(style.width), draw_order=order))

    def _log_mission(self, mission: Mission) -> None:
        last = self._last.mission
        if last is None or not np.array_equal(mission.goal_um, last.goal_um, equal_nan=True):
            self._log_goal(mission.goal_um)
        self._states.log_mission(mission)

    def _log_goal(self, goal_um: NDArray[np.float64]) -> None:
        if not np.isfinite(goal_um).all():
            self._log(e.GOAL, rr.Clear(recursive=False))
            return
        centre = self._scene.to_plane(goal_um)
        radius = max(1.6 * self._robot_px, 4.0)
        strips = [centre + radius * part for part in (self._ring, *_CROSS)]
        self._log(
            e.GOAL,
            rr.LineStrips2D(strips, colors=colours.GREEN, radii=points(1.2), draw_order=25.0),
            label(centre + np.array([0.0, radius]), "goal", colours.GREEN),
        )

    def _log_track(self, track: Track) -> None:
        self._states.log_sight(track.seen)

    def _log_estimate(self, estimate: Estimate) -> None:
        field, truth = self._tick.field, self._tick.truth
        centre = self._on_chip(self._scene.to_plane(estimate.position_um))
        colour = self._style.robot if estimate.seen else colours.PALE
        ring = [centre + self._robot_px * self._ring]
        self._log(e.ROBOT, rr.LineStrips2D.from_fields(strips=ring, colors=colour))
        # A word only where something is wrong: the title of the view states the colours, and words hide each other.
        last = self._last.estimate
        if not estimate.seen:
            position = [self._place_of_word(centre)]
            word = f"{self._style.word}not seen" if self._prefix else "robot not seen"
            self._log(e.ROBOT_LABEL, rr.Points2D.from_fields(positions=position, labels=[word], colors=colour))
        elif last is not None and not last.seen:
            self._log(e.ROBOT_LABEL, rr.Points2D.from_fields(positions=[], labels=[]))
        self._log_trail(estimate.stamp_ns, centre)
        flow = estimate.flow_um_s
        on_map = sample(field, self._chip_um(estimate.position_um)) if field is not None else np.full(2, np.nan)
        self._log(e.FLOW_COMPONENTS, rr.Scalars([flow[0], on_map[0], flow[1], on_map[1]]))
        speeds = [math.hypot(*flow), math.hypot(*on_map)]
        if truth is not None:
            if not self._style.second:
                speeds.append(math.hypot(*truth.flow_um_s))
            self._log(e.ESTIMATE_ERROR, rr.Scalars(math.dist(estimate.position_um, truth.position_um)))
            self.present.add("true robot")
        self._log(e.FLOW_SPEED, rr.Scalars(speeds))
        if math.isfinite(estimate.nis):
            self._log(e.NIS, rr.Scalars(estimate.nis))

    def _place_of_word(self, centre: NDArray[np.float64]) -> NDArray[np.float64]:
        """Position of a word about the robot at which neither the view's border nor the second session's robot cuts it.

        Rerun centres it below the place.
        """
        left, top, right, bottom = self._scene.shown_bounds()
        aside, high = _WORD_SHARE[0] * (right - left), _WORD_SHARE[1] * (bottom - top)
        y = centre[1] + self._robot_px + 2.0 * self._unit_px
        if y > bottom - high or (self._prefix and not self._style.second):
            y = centre[1] - self._robot_px - high
        return np.array([np.clip(centre[0], left + aside, right - aside), np.clip(y, top, bottom - high)])

    def _log_trail(self, stamp_ns: int, centre: NDArray[np.float64]) -> None:
        trail = self._trail
        if not trail or math.dist(trail[-1][1], centre) >= _TRAIL_STEP_PX * self._unit_px:
            trail.append((stamp_ns, centre))
        while trail and stamp_ns - trail[0][0] > _TRAIL_S * NS_PER_S:
            trail.popleft()
        if len(trail) > 1:
            self._log(e.TRAIL, rr.LineStrips2D.from_fields(strips=[np.array([point for _, point in trail])]))

    def _log_demand(self, demand: Demand) -> None:
        if self._tick.mission is not None and self._tick.mission.finished:
            return
        # Without a reference nothing is logged, not NaN: the plot shows a gap either way, but statistics differ.
        if math.isfinite(demand.error_um):
            if demand.error_um > 0.0:  # a policy has no reference
                self._log(e.TRACKING_ERROR, rr.Scalars(demand.error_um))
                self.present.add("tracking")
            reference = self._scene.to_plane(demand.reference_um)
            self._log(e.REFERENCE, rr.Points2D.from_fields(positions=[reference]))
        if self._tick.estimate is not None:
            length = _COMMAND_PX * self._unit_px / self._scene.robot.speed_limit_um_s
            vector = self._scene.directions(demand.velocity_um_s * length)
            position = self._on_chip(self._scene.to_plane(self._tick.estimate.position_um))
            self._log(e.COMMAND, rr.Arrows2D.from_fields(origins=[position], vectors=[vector]))

    def _log_currents(self, currents: Currents) -> None:
        # The currents themselves oscillate at this frequency, too fast to be drawn from a sample a frame.
        self._log(e.AMPLITUDE, rr.Scalars(currents.amplitude_mt))
        self._log(e.FREQUENCY, rr.Scalars(currents.frequency_hz))
        self._log(e.HEADING, rr.Scalars(math.degrees(currents.heading_rad)))

    def _log_health(self, health: Health) -> None:
        self.present.add("health")
        self._states.log_alarm(health.alarm)
        if math.isfinite(health.nis):
            self._log(e.NIS_MEAN, rr.Scalars(health.nis))
        self._log(e.PULSATION, rr.Scalars(100.0 * health.pulsation_share))

    def _log_timing(self, timing: Timing) -> None:
        self.present.add("timing")
        parts = [timing.track_ms, timing.observe_ms, timing.control_ms, timing.sinks_ms, timing.total_ms]
        self._log(e.TIMING, rr.Scalars(parts))

    def _log_event(self, event: Event) -> None:
        self._log_text(e.EVENTS, event.text, _LEVELS.get(event.level, "INFO"))

    def _log_operator(self, event: OperatorEvent) -> None:
        self._states.log_mark(event)
        self._log_text(e.OPERATOR, f"operator: {event.action}" + (f": {event.text}" if event.text else ""), "INFO")

    def _log_text(self, entity: str, text: str, level: str) -> None:
        # The time is in the text: a column of the view shows it to the nanosecond.
        whose = f"{self._prefix}: " if self._prefix else ""
        self._log(entity, rr.TextLog(f"{seconds(self._tick.stamp_ns):.1f} s  {whose}{text}", level=level))

    def _log_registration(self, tick: Tick) -> None:
        """Move the image, and from now on what was measured."""
        registration = tick.refined.registration if tick.refined is not None else None
        self._moved = self._scene.image_to_plane(registration)
        moved = self._scene.image_to_plane(registration, tick.shift)
        if not np.array_equal(moved, self._placed):
            self._placed = moved
            matrix = np.eye(3)
            matrix[:2, :2] = moved[:, :2]
            self._log(e.MEASURED, rr.Transform3D(translation=[*moved[:, 2], 0.0], mat3x3=matrix))

    def _on_chip(self, plane: NDArray[np.float64]) -> NDArray[np.float64]:
        """A measured point (2,) of the picture plane, moved by the registration of the refined field."""
        return self._moved[:, :2] @ plane + self._moved[:, 2]

    def _chip_um(self, measured_um: NDArray[np.float64]) -> NDArray[np.float64]:
        """Position on the chip of a measured point (2,) in um."""
        refined = self._tick.refined
        return on_chip(None if refined is None else refined.registration, measured_um)
