"""From ticks to Rerun entities. Only what is new in a tick is logged."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import rerun as rr

from flowrec.core import (
    SAMPLES,
    STREAMS,
    Applied,
    Currents,
    Demand,
    Estimate,
    Event,
    Floats,
    Frame,
    Health,
    Level,
    Measured,
    Message,
    Mission,
    OperatorEvent,
    Phase,
    Route,
    Tick,
    Timing,
    Tracers,
    coil_names,
    message_fields,
    seconds,
    with_micro,
)
from flowrec.physics import sample
from flowrec.stages import estimates_of_others, robot_number, tells_flow
from flowrec.view import colours, maps
from flowrec.view import entities as e
from flowrec.view.drawing import CIRCLE, CROSS, NOMINAL_PX, Trail, WindowCompleter, encode_jpeg
from flowrec.view.entities import ColumnBuffer, EntityLogger, label, points
from flowrec.view.scene import Scene, goal_of, place_on_chip, tracer_ways_um, way_of
from flowrec.view.state_lanes import StateLogger

_JPEG_QUALITY = 85  # 0 to 100, of OpenCV's encoder
_TRAIL_STEP_PX = 1.0  # of NOMINAL_PX, between two points of the robot's trail
_COMMAND_PX = 60.0  # length of the arrow of the fastest command
_LEVELS: dict[str, str] = {Level.WARNING: "WARN", Level.ERROR: "ERROR"}
_SHOWN = (  # fields of a tick, in the order in which they are logged
    *("route", "mission", "track", "estimate", "demand", "applied", "currents"),
    *("health", "timing", "event", "operator", "drops", "losses", "tracers", "measured"),
)
_WORD_SHARE = 0.16, 0.12  # of the view: half the width, and the height, of the longest word about the robot


class TickLogger:
    """Logs the ticks of one session into a recording stream, below `prefix` ('' or one of entities.REPLAY or PAIR).

    Parameters
    ----------
    speeds : scale of the maps; loggers that share it paint their maps alike.
    columns : see EntityLogger.

    Attributes
    ----------
    image_step : in a preview only each `image_step`-th row and column of the image is present.
    present : entities that were ever logged, for the blueprint; see EntityLogger.
    states : logs the lanes of states.
    """

    def __init__(
        self,
        stream: rr.RecordingStream,
        scene: Scene,
        prefix: str = "",
        *,
        speeds: maps.SpeedScale | None = None,
        columns: ColumnBuffer | None = None,
    ) -> None:
        self.image_step = 1
        self._scene = scene
        self._entities = EntityLogger(stream, prefix, columns)
        self._log, self._row, self._scalars = self._entities.log, self._entities.row, self._entities.scalars
        self.present = self._entities.present
        self._style = self._entities.style
        self._windows = WindowCompleter()
        self._placed_step = 0
        self._flow = maps.FlowLogger(self._entities, scene, maps.SpeedScale() if speeds is None else speeds)
        self._tick = self._last = Tick()
        self._tells_flow = True
        self._named: dict[str, int] = {}  # number of lines of the plots whose number a run decides
        left, _, right, _ = scene.image_bounds()
        self._unit_px = (right - left) / NOMINAL_PX
        self._trail = Trail(_TRAIL_STEP_PX * self._unit_px)
        self._robot_px = scene.length_px(scene.robot.radius_um)
        self.states = StateLogger(self._entities, doubtful=bool(scene.doubts))
        self._placed = scene.image_to_plane(self._tick)  # (2, 3) of the image
        outlines = rr.LineStrips2D(scene.outlines(), colors=colours.GREY, radii=points(0.6))
        self._log(e.OUTLINE, outlines, static=True)
        self._entities.log_styles()
        self._entities.log_series()

    def log(self, tick: Tick, frame_index: int | None = None) -> None:
        """Log what is new since the previous tick; `frame_index` is for a tick without its frame."""
        self._last, self._tick = self._tick, tick.at_images(self._tick)
        tick = self._tick
        self._entities.set_time(tick.stamp_ns, tick.frame.index if tick.frame is not None else frame_index)
        if tick.refined is not self._last.refined or tick.shift is not self._last.shift:
            # The image moves as the registration that a refinement found, and the shift of a shaking stage, say.
            placed = self._scene.image_to_plane(tick)
            if not np.array_equal(placed, self._placed):
                self._placed = placed
                self._log(e.MEASURED, maps.transform_of(placed))
        self.states.end_marks(tick.stamp_ns)
        if tick.frame is not None and tick.frame is not self._last.frame:
            self._log_image(tick.frame)
        self._tells_flow = tells_flow(self._scene.chip, tick)
        if self._tells_flow:
            self._flow.log_not_yet(tick, self._last)
            self._flow.log_fields(tick, self._last)
        for message in tick.news(self._last, _SHOWN).values():
            self._log_message(message)
        for path, message in tick.extra.items():
            if message is self._last.extra.get(path):
                continue
            if robot_number(path):  # drawn in the image
                continue
            if path == SAMPLES and hasattr(message, "latest") and hasattr(tick.extra.get(STREAMS), "channels"):
                self._log_streams(message, tick.extra[STREAMS])
            else:
                self._log_extra(path, message)
        if tick.extra is not self._last.extra:
            self._log_others(estimates_of_others(tick))

    def _log_message(self, message: Message) -> None:
        """Log a new message of the last tick."""
        self.states.log(message)
        match message:
            case Route():
                self._log_route(message)
            case Mission():
                last = self._last.mission
                if last is None or not np.array_equal(message.goal_um, last.goal_um, equal_nan=True):
                    self._log_goal(goal_of(message))
            case Estimate():
                self._log_estimate(message)
            case Tracers():
                self._log_tracers(message)
            case Demand():
                self._log_demand(message)
            case Applied() if self._observes:  # nothing is commanded: the log of a movie says what the coils did
                self._log_field(message)
            case Currents() if not self._observes:
                # The currents themselves oscillate at this frequency, too fast to be drawn from a sample a frame.
                self._log_field(message)
            case Measured():
                coils = len(message.currents_a)
                self._lines(e.READ_BACK, [f"coil {name} (A)" for name in coil_names(coils)])
                self._scalars(e.READ_BACK, *(message.currents_a - message.put_out_a))
            case Health():
                if math.isfinite(message.nis):
                    self._scalars(e.NIS_MEAN, message.nis)
                self._scalars(e.PULSATION, 100.0 * message.pulsation_share)
            case Timing():
                computing = [message.track_ms, message.observe_ms, message.control_ms]
                self._scalars(e.TIMING, *computing, message.sinks_ms, message.total_ms)
            case Event():
                self._log_text(e.EVENTS, message.text, _LEVELS.get(message.level, "INFO"))
            case OperatorEvent():
                said = f": {message.text}" if message.text else ""
                self._log_text(e.OPERATOR, f"operator: {message.action}{said}", "INFO")

    @property
    def _observes(self) -> bool:
        return self._tick.mission is not None and self._tick.mission.phase == Phase.OBSERVE

    def _log_field(self, message: Applied | Currents) -> None:
        self._scalars(e.AMPLITUDE, message.amplitude_mt)
        self._scalars(e.FREQUENCY, message.frequency_hz)
        self._scalars(e.HEADING, math.degrees(message.heading_rad))

    def _log_extra(self, path: str, message: Message) -> None:
        """The floats of a message as lines over time, a vector as a line an element."""
        for each in message_fields(type(message)):
            if not each.is_float or each.kind == "array":
                continue
            values = np.atleast_1d(np.asarray(getattr(message, each.name), np.float64))  # None becomes NaN
            if np.isfinite(values).any():
                self._scalars(f"{e.EXTRA}{path}/{each.name}", *values.tolist())

    def _log_streams(self, samples: Message, states: Message) -> None:
        """The latest values of the channels: the lines of a stream in one plot. Of a file the types are not ours."""
        lines: dict[str, dict[str, float]] = {}
        for name, value in zip(states.channels.split("\n"), samples.latest, strict=False):  # type: ignore[attr-defined]
            stream, _, channel = name.partition("/")
            lines.setdefault(f"{e.EXTRA}/streams/{stream}", {})[channel] = float(value)
        for entity, values in lines.items():
            self._lines(entity, list(values))
            self._scalars(entity, *values.values())

    def _lines(self, entity: str, names: list[str]) -> None:
        """Name the lines of a plot whose number a run decides; a stream may have a channel more later."""
        if self._named.get(entity) != len(names):
            self._named[entity] = len(names)
            self._log(entity, rr.SeriesLines(names=names), static=True)

    def _log_image(self, frame: Frame) -> None:
        if self._style.second or frame.image.size == 0:  # the images of two sessions are those of the first
            return
        if self._placed_step != self.image_step:
            self._placed_step = self.image_step
            placed = maps.transform_of(self._scene.preview_to_plane(self.image_step))
            drawn = rr.EncodedImage.from_fields(media_type="image/jpeg", draw_order=-20.0)
            self._log(e.IMAGE, placed, drawn, static=True)
        image = self._windows.complete(frame.image) if self._scene.windows else frame.image
        jpeg = self._entities.encode(encode_jpeg, image, frame.bits, _JPEG_QUALITY)
        self._row(e.IMAGE, rr.EncodedImage, blob=[jpeg])

    def _log_route(self, route: Route) -> None:
        self._flow.log_time_to_go(route)
        path, style = self._scene.to_plane(way_of(route)), self._style
        if not len(path):
            self._log(e.PATH, rr.LineStrips2D([]))
            return
        order = 20.0 + style.second
        self._log(e.PATH, rr.LineStrips2D([path], colors=style.path, radii=points(style.width), draw_order=order))

    def _log_goal(self, goal_um: Floats | None) -> None:
        if goal_um is None:
            self._entities.clear(e.GOAL)
            return
        centre = self._scene.to_plane(goal_um)
        radius = max(1.6 * self._robot_px, 4.0)
        strips = [centre + radius * part for part in (CIRCLE, *CROSS)]
        self._log(
            e.GOAL,
            rr.LineStrips2D(strips, colors=colours.GREEN, radii=points(1.2), draw_order=25.0),
            label(centre + np.array([0.0, radius]), "goal", colours.GREEN),
        )

    def _log_estimate(self, estimate: Estimate) -> None:
        field, truth = self._tick.field, self._tick.truth
        place_um = place_on_chip(self._tick, estimate.position_um)
        centre = self._scene.to_plane(place_um)
        colour = self._style.robot if estimate.seen else colours.PALE
        ring = [centre + self._robot_px * CIRCLE]
        self._row(e.ROBOT, rr.LineStrips2D, strips=ring, colors=[colour])
        # A word only where something is wrong: the title of the view states the colours, and words hide each other.
        last = self._last.estimate
        if not estimate.seen:
            position = [self._place_of_word(centre)]
            word = f"{self._style.word}not seen" if self._style.word else "robot not seen"
            self._log(e.ROBOT_LABEL, rr.Points2D.from_fields(positions=position, labels=[word], colors=colour))
        elif last is not None and not last.seen:
            self._log(e.ROBOT_LABEL, rr.Points2D.from_fields(positions=[], labels=[]))
        trail = self._trail.add(estimate.stamp_ns, centre)
        if len(trail) > 1:
            self._row(e.TRAIL, rr.LineStrips2D, strips=[np.array(trail)])
        if not self._tells_flow:
            self._scalars(e.POSITION, *place_um)
            return
        flow = estimate.flow_um_s
        on_map = sample(field, place_um) if field is not None else (math.nan, math.nan)
        self._scalars(e.FLOW_COMPONENTS, flow[0], on_map[0], flow[1], on_map[1])
        speeds = [math.hypot(*flow), math.hypot(*on_map)]
        if truth is not None:
            if not self._style.second:
                speeds.append(math.hypot(*truth.flow_um_s))
            self._scalars(e.ESTIMATE_ERROR, math.dist(estimate.position_um, truth.position_um))
        self._scalars(e.FLOW_SPEED, *speeds)
        if math.isfinite(estimate.nis):
            self._scalars(e.NIS, estimate.nis)

    def _log_others(self, estimates: Sequence[Estimate]) -> None:
        """A ring in its colour around each robot that is not the mission's; pale while it is not seen."""
        if not estimates:
            return
        centres = [self._scene.to_plane(place_on_chip(self._tick, each.position_um)) for each in estimates]
        drawn = [colours.of_robot(n) if each.seen else colours.PALE for n, each in enumerate(estimates, start=1)]
        rings = [centre + self._robot_px * CIRCLE for centre in centres]
        self._log(e.OTHERS, rr.LineStrips2D(rings, colors=drawn, radii=points(1.2), draw_order=27.5))

    def _log_tracers(self, tracers: Tracers) -> None:
        """An arrow from each tracer that moves to where it will be soon."""
        origins, tips = (self._scene.to_plane(place_on_chip(self._tick, ends)) for ends in tracer_ways_um(tracers))
        drawing = rr.Arrows2D(
            origins=origins, vectors=tips - origins, colors=colours.PURPLE, radii=points(1.0), draw_order=27.0
        )
        self._log(e.TRACERS, drawing)

    def _place_of_word(self, centre: Floats) -> Floats:
        """Position of a word about the robot at which neither the view's border nor the second session's robot cuts it.

        Rerun centres it below the place.
        """
        left, top, right, bottom = self._scene.shown_bounds()
        aside, high = _WORD_SHARE[0] * (right - left), _WORD_SHARE[1] * (bottom - top)
        y = centre[1] + self._robot_px + 2.0 * self._unit_px
        if y > bottom - high or (self._style.word and not self._style.second):
            y = centre[1] - self._robot_px - high
        return np.array([np.clip(centre[0], left + aside, right - aside), np.clip(y, top, bottom - high)])

    def _log_demand(self, demand: Demand) -> None:
        if self._tick.mission is not None and self._tick.mission.finished:
            return
        # Without a reference nothing is logged, not NaN: the plot shows a gap either way, but statistics differ.
        if math.isfinite(demand.error_um):
            if demand.error_um > 0.0:  # a policy has no reference
                self._scalars(e.TRACKING_ERROR, demand.error_um)
            reference = self._scene.to_plane(demand.reference_um)
            self._row(e.REFERENCE, rr.Points2D, positions=[reference])
        if self._tick.estimate is not None:
            length = _COMMAND_PX * self._unit_px / self._scene.robot.speed_limit_um_s
            vector = self._scene.directions(demand.velocity_um_s * length)
            position = self._scene.to_plane(place_on_chip(self._tick, self._tick.estimate.position_um))
            self._row(e.COMMAND, rr.Arrows2D, origins=[position], vectors=[vector])

    def _log_text(self, entity: str, text: str, level: str) -> None:
        # The time is in the text: a column of the view shows it to the nanosecond.
        whose = f"{self._entities.prefix}: " if self._entities.prefix else ""
        self._log(entity, rr.TextLog(f"{seconds(self._tick.stamp_ns):.1f} s  {whose}{with_micro(text)}", level=level))
