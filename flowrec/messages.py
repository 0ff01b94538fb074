"""The records that rigs, stages and the operator make: frozen, read-only, with units in the field names.

What a stage carries from one frame to the next is one of these, and each of them is recorded, so a session can be
replayed from any tick. Annotations (declarations.py) state the shape of each array and the topic of each field of
`Tick`; the wire format, the checks of what is read and the table of topics derive from them.

Chip frame: origin at the centre of the mask's pixel (0, 0), x right, y down; headings from +x towards +y.
Points are (x, y); arrays are [row, column] = [y, x]. Stamps are nanoseconds on the session clock.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Annotated

import numpy as np
from numpy.typing import ArrayLike, NDArray

from flowrec.declarations import (
    Image,
    Matrix,
    Message,
    NanFloat,
    Raster,
    Shape,
    Vector,
    Vector2,
    Vector3,
)
from flowrec.errors import RigError

if TYPE_CHECKING:
    import pandas
    import xarray
    from matplotlib.axes import Axes

    from flowrec.field_views import Shown

PIXEL_BITS = (8, 10, 12, 14, 16)


def pixel_type(bits: int) -> np.dtype[np.uint8 | np.uint16]:
    """The type of the pixels of images of a depth."""
    return np.dtype(np.uint8 if bits <= 8 else np.uint16)


@dataclass(frozen=True, slots=True, eq=False)
class Frame(Message):
    """One camera image. The stamp is the middle of the exposure.

    Raises
    ------
    RigError : the image does not hold grey levels of `bits`: uint8 for 8 bits, for more uint16 in the host's byte order
        and no level above 2^bits - 1. Nothing is converted, because that would change the data.
    """

    stamp_ns: int
    index: int
    image: Annotated[Image, Shape("h", "w")]  # grey levels
    bits: int = 8  # depth of the camera's pixels: 8, 10, 12, 14 or 16

    def __post_init__(self) -> None:
        image = np.asarray(self.image)
        if self.bits not in PIXEL_BITS:
            raise RigError(
                f"frame {self.index}: an image of {self.bits} bit; the depths are {', '.join(map(str, PIXEL_BITS))}"
            )
        expected = pixel_type(self.bits)
        if image.dtype != expected or image.ndim != 2:
            shape = " x ".join(map(str, image.shape))
            raise RigError(
                f"frame {self.index}: an image of {image.dtype} and shape {shape}, where {expected} and shape height x "
                f"width is expected for {self.bits} bit: it can not be kept exactly; set the camera to grey levels "
                "(Mono8 to Mono16) and camera.bits to its depth"
            )
        image = np.ascontiguousarray(image)
        if 8 < self.bits < 16 and image.max(initial=0) >> self.bits:  # 0.2 ms for 5 Mpx
            raise RigError(
                f"frame {self.index}: a grey level of {image.max()} in an image of {self.bits} bit; set camera.bits to "
                "the depth of the camera, or the camera to unpacked pixels aligned to the lowest bit"
            )
        if image.flags.writeable:
            image = image.view()
            image.flags.writeable = False
        object.__setattr__(self, "image", image)


@dataclass(frozen=True, slots=True, eq=False)
class Applied(Message):
    """What the coils did up to this frame, read back from the rig; the command is in `Currents`."""

    stamp_ns: int
    frequency_hz: float  # of the rotating field, now
    heading_rad: float
    amplitude_mt: float
    currents_a: Vector3  # coil currents x, y, z, now
    # Revolutions along x and y since the previous frame: the integral of f (cos phi, sin phi) dt. Multiplied by
    # um per revolution it is the robot's own displacement, with every delay and switching in between.
    turns: Vector2
    # Stamp of the first of the consecutive frames that have the same image as this one; this frame's stamp if the
    # image is new. Images are compared on arrival, because a file may hold them in part or with losses. None: not
    # compared (older files); then only the number of frames decides on a loss of the robot.
    image_since_ns: int | None = None
    # Stamp of the last tick to which the camera had no image to give, because it was absent or had delivered its last
    # one. None: there was none.
    absent_until_ns: int | None = None

    @property
    def repeats_image(self) -> bool:
        """Whether the camera repeated the image of the previous frame, or gave none."""
        return self.image_since_ns is not None and self.image_since_ns < self.stamp_ns

    @property
    def without_image(self) -> bool:
        """Whether the camera had no image to give to this tick."""
        return self.absent_until_ns == self.stamp_ns


@dataclass(frozen=True, slots=True, eq=False)
class OperatorEvent(Message):
    """An action of the operator."""

    stamp_ns: int
    action: str  # enums.Action
    text: str
    goal_um: Annotated[Vector, Shape("n")] = field(default_factory=lambda: np.zeros(0))  # (2,) of goal; (0,) of others
    speed_limit_um_s: float | None = None  # of speed; None: the limit is taken away


@dataclass(frozen=True, slots=True, eq=False)
class FlowField(Message):
    """A steady flow on the pixels of the chip's mask. `request` is the number of the work order that it answers.

    Velocities are values at the centres of the pixels, never means over them. The speed between centres is what
    `flow.sample` gives: it follows the profile of the channel and is zero at its walls, for which it needs `wall_px`.
    Sums over pixels are sums over points: the flow rate through a section is not theirs, but that of the boundary
    values, which are means over an opening. In a field without `wall_px`, from numerics 1, velocities are means.
    """

    stamp_ns: int
    request: int
    method: str  # fvm, assimilate, pi_unet, ...
    um_per_px: float
    velocity_um_s: Annotated[Raster, Shape("h", "w", 2)]  # x then y, at pixel centres; 0 in solid
    pressure_pa: Annotated[Raster, Shape("h", "w")]  # 0 in solid
    # One standard deviation of each component; None if the method does not estimate it.
    std_um_s: Annotated[Raster, Shape("h", "w", 2)] | None
    boundary_values: Annotated[Vector, Shape("n")]  # of inlets: mean inward speed, um/s; of outlets: pressure, Pa
    viscosity_mpa_s: float
    density_kg_m3: float
    note: str  # human-readable remark of the method on its result
    # Signed distance from the pixel centres to the wall in pixels, negative in solid; exact near the wall only, and
    # the wall lies where it is 0 between two centres. None: not stated.
    wall_px: Annotated[Raster, Shape("h", "w")] | None = None
    # Expected relative RMSE of the velocity over the fluid pixels: from the posterior, or from the prior where no
    # observation was used. None: not known.
    error_share: float | None = None
    # What the refinement found besides the boundary values and the fluid: "; " between the names, one value and one
    # standard deviation per name. The names are listed in refine/causes.py.
    parameter_names: str = ""
    parameters: Annotated[Vector, Shape("m")] = field(default_factory=lambda: np.zeros(0))
    parameter_std: Annotated[Vector, Shape("m")] = field(default_factory=lambda: np.zeros(0))
    # How the viscosity over viscosity_mpa_s depends on the shear rate, for people; the chip holds the law. '': it does
    # not, or not stated.
    viscosity_law: str = ""
    # The registration that the refinement found: a measured place x (2,) lies on the chip at R (x, 1). None: as stated.
    registration: Annotated[Matrix, Shape(2, 3)] | None = None
    # Why this is the flow that was in use before, with the number of the order that it answers, and not the flow that
    # was ordered. '': it is that one.
    refused: str = ""
    # Mean ln probability density, per observation and in 1/(um/s)^2, of observations that were held back: under the
    # flow that was ordered, under the flow in use before it, and one standard error of their difference. None: not
    # tested. See refine/held_back.py.
    log_score: float | None = None
    log_score_before: float | None = None
    log_score_error: float | None = None

    def to_xarray(self) -> xarray.Dataset:
        """The field as an xarray Dataset with the dimensions y_um, x_um and component; see field_views.py."""
        from flowrec.field_views import to_xarray

        return to_xarray(self)

    def to_pandas(self) -> pandas.DataFrame:
        """The field as a DataFrame with a row for each pixel of fluid; see field_views.py."""
        from flowrec.field_views import to_pandas

        return to_pandas(self)

    def plot(self, ax: Axes | None = None, show: Shown = "speed", path_um: ArrayLike | None = None) -> Axes:
        """Draw speed and arrows, or with `show="error"` the stated error, with Matplotlib; see field_views.py."""
        from flowrec.field_views import plot

        return plot(self, ax, show, path_um)


@dataclass(frozen=True, slots=True, eq=False)
class Route(Message):
    """A path with the time at which each point should be passed, or the reason why no path exists."""

    stamp_ns: int
    request: int
    method: str
    reachable: bool
    reason: str  # why not, when it is not
    waypoints_um: Annotated[Matrix, Shape("n", 2)]  # n = 0 when unreachable
    arrival_s: Annotated[Vector, Shape("n")]  # since the start of the route, strictly increasing
    # Seconds to the goal by the fastest way; the first point is the centre of the chip's first pixel. inf: there is no
    # way. None: the planner knows the time along its path only. -grad T is the best heading at every point (a policy).
    # Narrow channels have several points per pixel.
    time_to_go_s: Annotated[Raster, Shape("h", "w", finite=False)] | None = None
    time_to_go_um_per_px: float = 0.0  # distance between points; 0: that of the chip's pixels
    # Of a survey: the next stretch is to be ordered on the way. A route that is ordered on the way begins as the one
    # before, with the same times.
    more: bool = False
    # Of a survey that remembers, for each stretch: the relative error of the flow when it was chosen, the one expected
    # after it, the relative change of the most probable flow since the choice before, and in s along the route the
    # progress at the choice and the end of the stretch.
    stretches: Annotated[Matrix, Shape("m", 5)] | None = None
    # most probable flow when the latest stretch was chosen, at evenly spread fluid pixels
    survey_flow_um_s: Annotated[Matrix, Shape("o", 2)] | None = None
    # (2,) the goal that was asked for, which its last point may be near only; (0,): none, or not stated
    goal_um: Annotated[Vector, Shape("q")] = field(default_factory=lambda: np.zeros(0))
    # Why this is the route that was in use before, or none, and not the result of the order. '': it is that result.
    refused: str = ""


@dataclass(frozen=True, slots=True, eq=False)
class Track(Message):
    """Position of the robot in one image; the last known one if it was not seen."""

    stamp_ns: int
    seen: bool
    position_um: Vector2
    score: float  # 0 to 1, similarity to the robot's appearance
    lost_frames: int  # in a row
    radius_px: float  # of the robot's image, low-pass filtered
    roi_px: Annotated[Vector, Shape(4)]  # x0, y0, x1, y1 of the searched region
    seen_ns: int | None = None  # stamp of the latest frame in which it was seen; None: never, or not recorded
    # Motion of a robot that is tracked by its learned appearance, and the objects around it.
    velocity_px_s: Annotated[Vector, Shape("n")] = field(default_factory=lambda: np.zeros(0))  # (2,) mean; (0,): none
    spread_px: float = 0.0  # mean distance from where it was expected
    energy: float = 0.0  # mean of its squared foreground, in units of the noise's variance
    # x, y and energy of each object nearby, (3 k,)
    neighbours_px: Annotated[Vector, Shape("m")] = field(default_factory=lambda: np.zeros(0))


@dataclass(frozen=True, slots=True, eq=False)
class Appearance(Message):
    """How the robot looks, as far as the tracker has found out."""

    stamp_ns: int
    polarity: str  # dark, bright or mixed, relative to the background
    noise: float  # of a pixel, one standard deviation in grey levels
    foreground_noise: float  # of the foreground (vision/foreground.py), likewise
    radius_px: float  # of the object in `views`, in camera px
    centre_px: Vector2  # where it was when it was learned
    # Foreground around the centre, in blocks of whole camera pixels: the first look, a slow mean, other looks.
    # n = 0: nothing was learned, the robot is a disc.
    views: Annotated[Raster, Shape("n", "p", "p")]
    note: str = ""  # why nothing was found at the given place


@dataclass(frozen=True, slots=True, eq=False)
class Background(Message):
    """What the solid of the chip looks like in the image to which later ones are registered."""

    stamp_ns: int
    # Column, row, grey level, and the change of the grey level per pixel along columns and rows. n = 0: the image shows
    # no structure of the solid, so no shift can be measured.
    pixels: Annotated[Matrix, Shape("n", 5)]
    noise: float  # of a pixel, one standard deviation in grey levels


@dataclass(frozen=True, slots=True, eq=False)
class Shift(Message):
    """How far the image lies from where the registration of the chip holds, because the stage or the camera shakes."""

    stamp_ns: int
    shift_px: Vector2  # columns, rows: what the registration puts at p is seen at p + shift
    found: bool  # False: the image is not like the background, and the shift is the one before
    alike: float  # share of the background that agrees, 0 to 1
    rests: bool = False  # the image rests: it did not move for a second, and small shifts are noise


@dataclass(frozen=True, slots=True, eq=False)
class Estimate(Message):
    """The observer's estimate of the robot and of the flow that carries it."""

    stamp_ns: int
    position_um: Vector2
    flow_um_s: Vector2  # the disturbance: flow velocity at the robot
    # Of [x, y, vx, vy], then the slopes (without a map) and um_per_rev if estimated: um2, um2/s, um2/s2, ...
    covariance: Annotated[Matrix, Shape("k", "k")]
    nis: NanFloat  # normalised innovation squared; NaN on a frame without measurement
    measured_um: Annotated[Vector, Shape(2, finite=False)]  # last measured position that was used
    seen: bool
    # (3,) gradient of the flow at the robot: dvx/dx, dvx/dy, dvy/dx; dvy/dy = -dvx/dx. (0,): not known
    slopes_per_s: Annotated[Vector, Shape("n")] = field(default_factory=lambda: np.zeros(0))
    # (2,) sliding mean of the innovations, in standard deviations; (0,): not known
    surprise: Annotated[Vector, Shape("m")] = field(default_factory=lambda: np.zeros(0))
    um_per_rev: float | None = None  # of the robot; None: the nominal one is used
    # (2,) the robot's own motion through the fluid, averaged over time as `flow_um_s` is; (0,): not known
    rolled_um_s: Annotated[Vector, Shape("o")] = field(default_factory=lambda: np.zeros(0))


@dataclass(frozen=True, slots=True, eq=False)
class Health(Message):
    """Consistency of the observer. All means are exponential averages; the message holds their state."""

    stamp_ns: int
    alarm: str  # words of enums.Alarm, separated by "; "; '' without an alarm
    nis: NanFloat  # mean normalised innovation squared; 2 if the noise settings are right
    lost_share: float  # fraction of the frames without the robot, 0 to 1
    heard_s: float  # duration for which the flow estimate was accurate enough for the spectral monitor
    pulsation_hz: float  # frequency of the strongest spectral line of the flow
    pulsation_share: float  # amplitude of that line divided by the mean flow
    line_share: float  # fraction of the flow's variance in that line, 0 to 1
    bank_re: Annotated[Vector, Shape("n")]  # state of the resonators, relative to the mean flow; real part
    bank_im: Annotated[Vector, Shape("n")]  # imaginary part
    bank_power: Annotated[Vector, Shape("n")]  # mean square of the input of each resonator
    mean_um_s: Vector2  # mean flow
    offset_share: float  # mean of the resonators' input, which is subtracted from it
    # Motion per revolution, see estimation/step_out.py.
    # (4,) exponential sums: um rolled along the heading, um expected from the revolutions, um by which the map's flow
    # carried the robot, s. (0,): none yet, or not recorded.
    rolled_sums: Annotated[Vector, Shape("m")] = field(default_factory=lambda: np.zeros(0))
    limit_hz: float | None = None  # limit of the field's frequency because of step-out; None: the robot's own
    limited_ns: int | None = None  # stamp of the last change of the limit
    # (2,) um/s rolled and um/s expected from the revolutions, just before the limit was lowered; (0,): no limit to test
    rolled_before_um_s: Annotated[Vector, Shape("o")] = field(default_factory=lambda: np.zeros(0))


@dataclass(frozen=True, slots=True, eq=False)
class Observations(Message):
    """Local flow measured along the robot's way: the data of a refinement.

    The measured flow is the robot's velocity over ground less its own motion as assumed, `rolled_um_s`. So a wrong um
    per revolution, slip and hindered motion near walls appear as a part of the flow along `rolled_um_s`.
    """

    stamp_ns: int
    position_um: Annotated[Matrix, Shape("n", 2)]
    flow_um_s: Annotated[Matrix, Shape("n", 2)]
    std_um_s: Annotated[Vector, Shape("n")]  # one standard deviation per component
    # um_per_rev times revolutions per second along the heading, a mean over the time that the flow is a mean of; None:
    # not stated
    rolled_um_s: Annotated[Matrix, Shape("n", 2)] | None = None
    time_s: Annotated[Vector, Shape("n")] | None = None  # middle of that time on the session clock; None: not stated
    radius_um: float | None = None  # of the robot, which the flow carries as a sphere; None: not stated

    def only(self, which: slice | NDArray[np.bool_] | NDArray[np.intp]) -> Observations:
        """Some of the observations, chosen by an index of arrays."""
        return Observations(
            self.stamp_ns,
            self.position_um[which],
            self.flow_um_s[which],
            self.std_um_s[which],
            None if self.rolled_um_s is None else self.rolled_um_s[which],
            None if self.time_s is None else self.time_s[which],
            self.radius_um,
        )

    def followed_by(self, more: Observations) -> Observations:
        """These observations, then more; the stamp is that of the later ones. What one does not state, both do not."""
        rolled = (self.rolled_um_s, more.rolled_um_s)
        time = (self.time_s, more.time_s)
        return Observations(
            more.stamp_ns,
            np.concatenate((self.position_um, more.position_um)),
            np.concatenate((self.flow_um_s, more.flow_um_s)),
            np.concatenate((self.std_um_s, more.std_um_s)),
            None if rolled[0] is None or rolled[1] is None else np.concatenate((rolled[0], rolled[1])),
            None if time[0] is None or time[1] is None else np.concatenate((time[0], time[1])),
            more.radius_um if self.radius_um == more.radius_um else None,
        )


@dataclass(frozen=True, slots=True, eq=False)
class Mission(Message):
    """State of the mission, and the work that it waits for."""

    stamp_ns: int
    phase: str  # enums.Phase
    since_ns: int  # when the phase began
    request: int  # number of the latest work order
    wanted: str  # enums.WorkOrder; '' when nothing is pending
    requested_ns: int  # when it was ordered
    start_um: Annotated[Vector, Shape(2, finite=False)]  # where the ordered route begins; NaN without a route
    goal_um: Annotated[Vector, Shape(2, finite=False)]  # NaN without a goal
    finished: bool
    outcome: str  # enums.Outcome; '' while the mission runs
    note: str
    held_since_ns: int | None = None  # stamp at which the operator held the robot; None: not held
    held_ns: int = 0  # duration of earlier holds in this phase; the time limit of the phase does not count it
    swept: bool = False  # held but carried away, because the flow is faster than the robot
    blind_since_ns: int | None = None  # stamp at which the robot was held because it was not seen; None: it is seen
    blind: str = ""  # why it is not seen, human-readable
    field_off: bool = False  # not seen for so long that the field must be off
    input_ended: bool = False  # no more frames come; in the phase observe only
    # work orders so far that no disturbance has caused: stretches of a survey after the first, refinements on the way
    routine_orders: int = 0
    planned_um_s: float | None = None  # speed limit of the robot at the latest work order; None: not recorded
    # (2,) while the goal was set during the run and no route leads to it yet: the goal before, to which the present
    # route leads; (0,) otherwise
    former_goal_um: Annotated[Vector, Shape("n")] = field(default_factory=lambda: np.zeros(0))
    goal_set_ns: int | None = None  # stamp at which the operator set the latest goal; None: it is the configured one
    goal_from_s: float = 0.0  # time along the route at which the way to the latest goal begins
    speed_limit_um_s: float | None = None  # of the robot through the fluid, set by the operator; None: its own
    speed_set_ns: int | None = None  # stamp at which the operator set or took away the limit; None: never
    # duration of the phase, without holds, after which the robot began to wait at the goal for another one; None:
    # it does not wait
    arrived_s: float | None = None


@dataclass(frozen=True, slots=True, eq=False)
class AxesCheck(Message):
    """The check of the axes before the mission: what the robot's first small motions say, see control/axes_check.py.

    A round is four legs: along x, back, along y, back. The sums of a round are those of a regression of its positions
    on 1, t, t^2, t^3 (the flow) and the two components of the robot's own motion as commanded.
    """

    stamp_ns: int
    leg: int  # since the check began, from 0; four are a round
    leg_ns: int  # stamp at which it began
    driven_s: float  # duration of the check so far
    round_ns: int  # stamp at which the round began
    from_um: Vector2  # position then
    own_um: Vector2  # since then: um_per_rev times the revolutions along x and y
    steady_um: Vector2  # the part of it that was demanded against the flow, not for the legs
    speed_um_s: float  # of the legs of this round
    reach_um: float  # own motion after which a leg turns round
    count: int  # positions in the sums
    normal: Annotated[Matrix, Shape(6, 6)]
    moment: Annotated[Matrix, Shape(6, 2)]
    square_um2: Vector2
    # Of the most exact round so far: displacement seen (rows) per own motion as commanded (columns); the identity if
    # all is as stated. (0, 0): no round is complete
    gain: Annotated[Matrix, Shape("n", "n")]
    gain_std: float = 0.0  # one standard deviation of each of its elements
    # (2,) velocity that, by the last round, holds the robot against the flow; (0,): not known
    against_um_s: Annotated[Vector, Shape("m")] = field(default_factory=lambda: np.zeros(0))
    verdict: str = ""  # enums.AxesVerdict; '' while the check is under way
    text: str = ""  # the verdict in a sentence, with what to do


@dataclass(frozen=True, slots=True, eq=False)
class Demand(Message):
    """The motion that the controller demands of the robot."""

    stamp_ns: int
    velocity_um_s: Vector2  # relative to the fluid
    reference_um: Annotated[Vector, Shape(2, finite=False)]  # where the robot should be now
    progress_s: float  # time along the route, slowed while the robot lags behind
    # Distance to the reference, NaN without one. With a policy, which may leave the route: distance to the nearest
    # point from which a way to the goal is known.
    error_um: NanFloat
    saturated: bool
    sent_um_s: Annotated[Matrix, Shape("m", 2)]  # the latest demands, oldest first; the coils may not yet apply them


@dataclass(frozen=True, slots=True, eq=False)
class Currents(Message):
    """The rotating field and the coil currents that make it."""

    stamp_ns: int
    frequency_hz: float
    heading_rad: float  # of the demanded motion
    amplitude_mt: float
    phase_rad: float  # accumulated over all changes of frequency and heading
    currents_a: Vector3  # x, y, z at this phase
    saturated: bool  # the coils can not generate the full amplitude
    plane_rad: float = 0.0  # heading of the plane of rotation; it turns towards heading_rad or its opposite
    limit_hz: float = 0.0  # step-out frequency at this amplitude; the field's direction never turns faster
    # (3,) inputs of the amplifiers; (0,) in older files
    voltages_v: Annotated[Vector, Shape("n")] = field(default_factory=lambda: np.zeros(0))


@dataclass(frozen=True, slots=True, eq=False)
class Event(Message):
    """A message of the pipeline for people."""

    stamp_ns: int
    level: str  # enums.Level
    text: str


@dataclass(frozen=True, slots=True, eq=False)
class Truth(Message):
    """Ground truth of a simulated rig. Recorded for evaluation; no stage reads it."""

    stamp_ns: int
    position_um: Vector2
    flow_um_s: Vector2  # true flow at the robot
    clearance_um: NanFloat  # from the robot's surface to the nearest wall
    contacts: int  # wall contacts so far
