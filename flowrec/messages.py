"""Every record that flowrec keeps: frozen, read-only, units in the field names.

Whatever a stage carries from one frame to the next is one of these, and each of them is recorded
(see topics.py), so a session can be replayed from any tick. The wire format is derived from these
annotations in store/; nothing is declared twice.

Chip frame: origin at the centre of the mask's pixel (0, 0), x right, y down; headings from +x towards +y.
Points are (x, y); arrays are [row, column] = [y, x]. Stamps are nanoseconds on the session clock.
"""

from __future__ import annotations

import functools
import typing
from dataclasses import MISSING, dataclass, field, fields
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray

from flowrec.errors import RigError

# The second word is the wire form: a `vector` becomes a repeated double that viewers can plot,
# an `array` keeps its shape and its bytes.
Vector = Annotated[NDArray[np.float64], "vector"]
Matrix = Annotated[NDArray[np.float64], "array"]
Raster = Annotated[NDArray[np.float32], "array"]
Image = Annotated[NDArray[np.uint8], "array"]


@functools.cache
def array_fields(message_type: type) -> tuple[tuple[str, np.dtype[Any]], ...]:
    """Name and dtype of each array field of a message type, in order."""
    found = []
    for name, hint in typing.get_type_hints(message_type, include_extras=True).items():
        for option in (hint, *typing.get_args(hint)):
            if typing.get_origin(option) is Annotated:
                scalar = typing.get_args(typing.get_args(typing.get_args(option)[0])[1])[0]
                found.append((name, np.dtype(scalar)))
    return tuple(found)


def defaulted_fields(message_type: type) -> frozenset[str]:
    """Names of the fields with a default: those that a file made before they existed does without.

    The default must be what the wire's absence means: None, an empty vector, 0, False or "".
    """
    return frozenset(
        each.name for each in fields(message_type) if each.default is not MISSING or each.default_factory is not MISSING
    )


class Message:
    """Base of all records: fixes the dtype of the arrays and makes them read-only."""

    __slots__ = ()

    def __post_init__(self) -> None:
        for name, dtype in array_fields(type(self)):  # type: ignore[arg-type]
            given = getattr(self, name)
            if given is None:
                continue
            array = np.ascontiguousarray(given, dtype)
            if array.flags.writeable:
                array = array.view()
                array.flags.writeable = False
            object.__setattr__(self, name, array)

    def same_as(self, other: object) -> bool:
        """Bit for bit the same record (NaN equals NaN)."""
        if type(other) is not type(self):
            return False
        for part in fields(self):  # type: ignore[arg-type]
            mine, theirs = getattr(self, part.name), getattr(other, part.name)
            if isinstance(mine, np.ndarray) and isinstance(theirs, np.ndarray):
                if mine.shape != theirs.shape or mine.tobytes() != theirs.tobytes():
                    return False
            elif mine != theirs and not (mine != mine and theirs != theirs):
                return False
        return True


@dataclass(frozen=True, slots=True, eq=False)
class Frame(Message):
    """One camera image. The stamp is the middle of the exposure.

    Raises
    ------
    RigError : the image is not one of 8-bit grey levels. Nothing is converted: that would change what was seen.
    """

    stamp_ns: int
    index: int
    image: Image  # (h, w) grey levels

    def __post_init__(self) -> None:
        image = np.asarray(self.image)
        if image.dtype != np.uint8 or image.ndim != 2:
            shape = " x ".join(map(str, image.shape))
            raise RigError(
                f"frame {self.index}: an image of {image.dtype} and shape {shape}, where uint8 and shape height x "
                "width is expected: it can not be kept exactly; set the camera to 8-bit grey levels (Mono8)"
            )
        Message.__post_init__(self)


@dataclass(frozen=True, slots=True, eq=False)
class Applied(Message):
    """What the coils really did up to this frame, read back from the rig, not what was asked of them."""

    stamp_ns: int
    frequency_hz: float  # of the rotating field, now
    heading_rad: float
    amplitude_mt: float
    currents_a: Vector  # (3,) coil currents x, y, z, now
    # (2,) revolutions along x and y since the previous frame: the integral of f (cos phi, sin phi) dt.
    # Times um per revolution it is the robot's own displacement, whatever delay or switching lay in between.
    turns: Vector
    # Stamp of the first frame of those in a row that have the same image as this one: this frame's stamp where the
    # image is new. Compared on arrival, as files may hold images in part or not exactly. None: not compared (older
    # files), and then nothing is concluded from a loss of sight but what the number of frames says.
    image_since_ns: int | None = None

    @property
    def repeats_image(self) -> bool:
        """Whether the camera sent the image of the frame before once more."""
        return self.image_since_ns is not None and self.image_since_ns < self.stamp_ns


@dataclass(frozen=True, slots=True, eq=False)
class OperatorEvent(Message):
    """Something a person did: stop, mark, note, pause, resume, zero."""

    stamp_ns: int
    action: str
    text: str


@dataclass(frozen=True, slots=True, eq=False)
class FlowField(Message):
    """A steady flow on the pixels of the chip's mask. `request` numbers the work order that it answers."""

    stamp_ns: int
    request: int
    method: str  # fvm, assimilate, pi_unet, ...
    um_per_px: float
    velocity_um_s: Raster  # (h, w, 2) x then y, at pixel centres; 0 in solid
    pressure_pa: Raster  # (h, w); 0 in solid
    std_um_s: Raster | None  # (h, w, 2) one standard deviation of each component, where the method knows it
    boundary_values: Vector  # (openings,) inlets: mean inward speed, um/s; outlets: pressure, Pa
    viscosity_mpa_s: float
    density_kg_m3: float
    note: str  # what the method says of its own result, for people


@dataclass(frozen=True, slots=True, eq=False)
class Route(Message):
    """A path with the times at which it should be passed, or the honest answer that there is none."""

    stamp_ns: int
    request: int
    method: str
    reachable: bool
    reason: str  # why not, when it is not
    waypoints_um: Matrix  # (n, 2), n = 0 when unreachable
    arrival_s: Vector  # (n,) since the start of the route, strictly increasing
    # (h, w) s to the goal by the fastest way, the first from the centre of the chip's first pixel; inf where there is
    # none, None where the planner knows it along its path only. Its slope is a policy: -grad T is the best heading
    # anywhere. Where channels are narrow there are several points to a pixel.
    time_to_go_s: Raster | None = None
    time_to_go_um_per_px: float = 0.0  # from point to point; 0: as the chip's pixels


@dataclass(frozen=True, slots=True, eq=False)
class Track(Message):
    """Where the robot is in one image. `seen` False keeps the last known position."""

    stamp_ns: int
    seen: bool
    position_um: Vector  # (2,)
    score: float  # 0 to 1, likeness to the robot's appearance
    lost_frames: int  # in a row
    radius_px: float  # of the robot's image, tracked slowly
    roi_px: Vector  # (4,) x0, y0, x1, y1 of the searched region
    seen_ns: int | None = None  # stamp of the latest frame in which it was seen; None: never so far, or not said


@dataclass(frozen=True, slots=True, eq=False)
class Estimate(Message):
    """The observer's belief about the robot and the flow that carries it."""

    stamp_ns: int
    position_um: Vector  # (2,)
    flow_um_s: Vector  # (2,) the disturbance: flow velocity at the robot
    # (n, n) of [x, y, vx, vy], then the slopes (without a map) and um_per_rev if estimated: um2, um2/s, um2/s2, ...
    covariance: Matrix
    nis: float  # normalised innovation squared; NaN on a frame without measurement
    measured_um: Vector  # (2,) last measured position that went in
    seen: bool
    # (3,) of the flow at the robot: dvx/dx, dvx/dy, dvy/dx, where dvy/dy = -dvx/dx; (0,) where not known
    slopes_per_s: Vector = field(default_factory=lambda: np.zeros(0))
    surprise: Vector = field(default_factory=lambda: np.zeros(0))  # (2,) sliding mean of the innovations in sigma
    um_per_rev: float | None = None  # of the robot; None where its nominal one is taken as true


@dataclass(frozen=True, slots=True, eq=False)
class Health(Message):
    """Whether the observer can be believed. All means are leaky; the message is their memory."""

    stamp_ns: int
    alarm: str  # nis, pulsation, tracking, parted by "; "; '' when all is well
    nis: float  # mean normalised innovation squared; 2 when all noise is stated right
    lost_share: float  # of the frames, without the robot
    heard_s: float  # for how long the flow was known well enough to listen to it
    pulsation_hz: float  # the strongest line in the flow ...
    pulsation_share: float  # ... its amplitude as a share of the flow ...
    line_share: float  # ... and the part of the flow's unrest that it is, 0 to 1
    bank_re: Vector  # (24,) resonators, as shares of the flow
    bank_im: Vector  # (24,)
    bank_power: Vector  # (24,) mean square of what they listen to
    mean_um_s: Vector  # (2,) flow
    offset_share: float  # mean of what the resonators listen to, taken out of it
    # Motion per revolution, see estimation/step_out.py.
    # (4,) leaky sums: um rolled along the heading, um that the turns should have given, um that the map's flow carried
    # the robot, s. (0,): none yet, or not said.
    rolled_sums: Vector = field(default_factory=lambda: np.zeros(0))
    limit_hz: float | None = None  # of the field's frequency because of step-out; None: the robot's own
    limited_ns: int | None = None  # when the limit was last changed
    # (2,) um/s rolled, and that the turns should have given, just before the limit was lowered; (0,): judged, or none
    rolled_before_um_s: Vector = field(default_factory=lambda: np.zeros(0))


@dataclass(frozen=True, slots=True, eq=False)
class Observations(Message):
    """Local flow measured along the way: what a refinement may use."""

    stamp_ns: int
    position_um: Matrix  # (n, 2)
    flow_um_s: Matrix  # (n, 2)
    std_um_s: Vector  # (n,) one standard deviation per component


@dataclass(frozen=True, slots=True, eq=False)
class Mission(Message):
    """What the run is about just now and which work it waits for."""

    stamp_ns: int
    phase: str  # start, survey, refine, plan, navigate, done
    since_ns: int  # when the phase began
    request: int  # number of the latest work order
    wanted: str  # solve, survey_route, refine, route; '' when nothing is pending
    requested_ns: int  # when it was ordered
    start_um: Vector  # (2,) where the ordered route begins
    goal_um: Vector  # (2,)
    finished: bool
    outcome: str  # reached, survey complete, unreachable, stopped, lost, ...; '' while under way
    note: str
    held_since_ns: int | None = None  # when the operator told the robot to stay; None: not just now
    held_ns: int = 0  # how long it was held in this phase before; that does not count against the phase's time
    swept: bool = False  # held, and yet carried away: the flow is too fast for it
    blind_since_ns: int | None = None  # when the robot was told to stay because it was out of sight; None: it is not
    blind: str = ""  # why it is out of sight, for people
    field_off: bool = False  # out of sight for so long that there must be no field


@dataclass(frozen=True, slots=True, eq=False)
class Demand(Message):
    """The motion that the controller asks of the robot."""

    stamp_ns: int
    velocity_um_s: Vector  # (2,) relative to the fluid
    reference_um: Vector  # (2,) where the robot should be now
    progress_s: float  # time along the route, slowed while the robot lags behind
    # Distance to the reference, NaN without one. Under a policy, which may go another way than the route, that to the
    # nearest place from which a way to the goal is known.
    error_um: float
    saturated: bool
    sent_um_s: Matrix  # (m, 2) the latest demands, oldest first: what may still be on its way to the coils


@dataclass(frozen=True, slots=True, eq=False)
class Currents(Message):
    """The rotating field and the coil currents that make it."""

    stamp_ns: int
    frequency_hz: float
    heading_rad: float  # where the robot is to go
    amplitude_mt: float
    phase_rad: float  # one accumulator over all frequency and heading changes
    currents_a: Vector  # (3,) x, y, z at this phase
    saturated: bool  # the coils can not make the full amplitude
    plane_rad: float = 0.0  # heading of the plane that the field turns in, on its way to heading_rad or its opposite
    limit_hz: float = 0.0  # up to here a robot follows this amplitude; the field's direction never turns faster
    voltages_v: Vector = field(default_factory=lambda: np.zeros(0))  # (3,) what is put out; (0,) in older files


@dataclass(frozen=True, slots=True, eq=False)
class Event(Message):
    """Something worth telling a person, said by the pipeline."""

    stamp_ns: int
    level: str  # info, warning, error
    text: str


@dataclass(frozen=True, slots=True, eq=False)
class Timing(Message):
    """Wall time of each part of this tick. Diagnostic: never compared."""

    stamp_ns: int
    track_ms: float
    observe_ms: float
    control_ms: float
    sinks_ms: float
    total_ms: float
    queue_mb: float  # waiting for the disk
    dropped_frames: int


@dataclass(frozen=True, slots=True, eq=False)
class Drops(Message):
    """What is missing of a topic so far, said by the writer when it begins, changes and ends. Diagnostic."""

    stamp_ns: int
    topic: str
    by_backlog: int  # left out because writing, by disk or processor, was slower than the camera
    by_camera: int  # counted by the camera and never delivered: gaps in the index
    kept_every: int  # from here on one frame in so many is kept; 1: all


@dataclass(frozen=True, slots=True, eq=False)
class Clocks(Message):
    """The clocks beside the session's, about once a second and whenever one is set or goes wrong. Diagnostic."""

    stamp_ns: int
    monotonic_ns: int  # of the host, read together with ...
    wall_ns: int  # ... the time of day, since 1970, UTC
    wall_set_s: float  # by how much the time of day was set since the run began, in all
    wall_jumps: int  # how often
    passed_over: int  # frames left out because their stamp did not grow
    device: int  # counts of the camera's clock at its latest frame, as they came
    arrival_ns: int  # of that frame on the session clock
    fitted_ns: int  # when, by the fit, it would have arrived at the earliest
    rate: float  # ns of the session clock to one count, so the fit is fitted_ns + rate (counts - device); 0: no clock
    known: bool  # whether the rate has been measured by now
    late_s: float  # arrival - fit since the message before: the mean ...
    latest_s: float  # ... and the largest
    duplicates: int  # so far: the same frame again
    disordered: int  # ... one from before the latest
    wraps: int  # ... the counter began again
    resets: int  # ... the camera's clock went back, a new fit was begun
    jumps: int  # ... it went forwards or stood still, likewise
    unit: float  # ns that a count seems to be where it is not what it was said to be; else 0


@dataclass(frozen=True, slots=True, eq=False)
class Truth(Message):
    """What only a simulated rig can know. Recorded for judging; no stage ever sees it."""

    stamp_ns: int
    position_um: Vector  # (2,)
    flow_um_s: Vector  # (2,) true flow at the robot
    clearance_um: float  # from the robot's surface to the nearest wall
    contacts: int  # wall contacts so far


@dataclass(frozen=True, slots=True)
class Tick:
    """All that is known after one frame: the latest message of each topic."""

    stamp_ns: int = -1
    frame: Frame | None = None
    applied: Applied | None = None
    operator: OperatorEvent | None = None
    assumed: FlowField | None = None
    refined: FlowField | None = None
    route: Route | None = None
    track: Track | None = None
    estimate: Estimate | None = None
    health: Health | None = None
    observations: Observations | None = None
    mission: Mission | None = None
    demand: Demand | None = None
    currents: Currents | None = None
    event: Event | None = None
    timing: Timing | None = None
    drops: Drops | None = None
    truth: Truth | None = None
    true_field: FlowField | None = None
    clocks: Clocks | None = None

    @property
    def field(self) -> FlowField | None:
        """The best flow known: refined where there is one, else assumed."""
        return self.refined if self.refined is not None else self.assumed
