"""The estimate of the observer, its consistency, and the observations of the flow."""

from __future__ import annotations

import functools
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Annotated, Any

import numpy as np

from flowrec.core.declarations import (
    NOT_STATED,
    Bools,
    Ints,
    Matrix,
    Message,
    NanFloat,
    Shape,
    Vector,
    Vector2,
    array_fields,
)


@dataclass(frozen=True, slots=True, eq=False)
class Estimate(Message):
    """The observer's estimate of the robot and of the flow that carries it."""

    stamp_ns: int
    position_um: Annotated[Vector2, "estimated position of the robot"]
    flow_um_s: Annotated[Vector2, "the disturbance: flow velocity at the robot"]
    covariance: Annotated[
        Matrix,
        Shape("k", "k"),
        "Of [x, y, vx, vy], then the slopes (without a map) and um_per_rev if estimated: um2, um2/s, um2/s2, ...",
    ]
    nis: Annotated[NanFloat, "normalised innovation squared; NaN on a frame without measurement"]
    measured_um: Annotated[Vector, Shape(2, finite=False), "last measured position that was used"]
    seen: Annotated[bool, "the robot was seen in the image of this tick"]
    slopes_per_s: Annotated[
        Vector,
        Shape("n"),
        "gradient of the flow at the robot (3,): dvx/dx, dvx/dy, dvy/dx; dvy/dy = -dvx/dx. (0,): not known",
    ] = NOT_STATED
    surprise: Annotated[
        Vector, Shape("m"), "sliding mean of the innovations (2,), in standard deviations; (0,): not known"
    ] = NOT_STATED
    um_per_rev: Annotated[
        float | None, "um per revolution of the robot as estimated; None: the nominal one is used"
    ] = None
    rolled_um_s: Annotated[
        Vector,
        Shape("o"),
        "the robot's own motion through the fluid (2,), averaged over time as `flow_um_s` is; (0,): not known",
    ] = NOT_STATED

    @property
    def flow_variance(self) -> float:
        """Variance of the flow, um2/s2, mean of both components."""
        return 0.5 * float(self.covariance[2, 2] + self.covariance[3, 3])


@dataclass(frozen=True, slots=True, eq=False)
class Health(Message):
    """Consistency of the observer. All means are exponential averages; the message holds their state."""

    stamp_ns: int
    alarm: Annotated[str, "words of enums.Alarm, separated by \"; \"; '' without an alarm"]
    nis: Annotated[NanFloat, "mean normalised innovation squared; 2 if the noise settings are right"]
    lost_share: Annotated[float, "fraction of the frames without the robot, 0 to 1"]
    heard_s: Annotated[float, "duration for which the flow estimate was accurate enough for the spectral monitor"]
    pulsation_hz: Annotated[float, "frequency of the strongest spectral line of the flow"]
    pulsation_share: Annotated[float, "amplitude of that line divided by the mean flow"]
    line_share: Annotated[float, "fraction of the flow's variance in that line, 0 to 1"]
    bank_re: Annotated[Vector, Shape("n"), "state of the resonators, relative to the mean flow; real part"]
    bank_im: Annotated[Vector, Shape("n"), "state of the resonators, relative to the mean flow; imaginary part"]
    bank_power: Annotated[Vector, Shape("n"), "mean square of the input of each resonator"]
    mean_um_s: Annotated[Vector2, "mean flow"]
    offset_share: Annotated[float, "mean of the resonators' input, which is subtracted from it"]
    rolled_sums: Annotated[
        Vector,
        Shape("m"),
        "Motion per revolution, which shows step-out. (4,) exponential sums: um rolled along the heading, um "
        "expected from the revolutions, um by which the map's flow carried the robot, s. (0,): none yet, or not "
        "recorded.",
    ] = NOT_STATED
    limit_hz: Annotated[float | None, "limit of the field's frequency because of step-out; None: the robot's own"] = (
        None
    )
    limited_ns: Annotated[int | None, "stamp of the last change of the limit"] = None
    rolled_before_um_s: Annotated[
        Vector,
        Shape("o"),
        "um/s rolled and um/s expected from the revolutions (2,), just before the limit was lowered; (0,): no limit "
        "to test",
    ] = NOT_STATED

    @property
    def alarms(self) -> list[str]:
        """The words of the alarm."""
        return self.alarm.split("; ") if self.alarm else []


WALLS = "/robots/walls"  # path of the topic


@dataclass(frozen=True, slots=True, eq=False)
class RobotWalls(Message):
    """Distance of each robot but the first one from the walls, in the order of their numbers from 1 on."""

    stamp_ns: int
    wall_um: Annotated[
        Vector, Shape("n", finite=False), "distance from its surface to the nearest wall; NaN: it is not in view"
    ]
    near: Annotated[Vector, Shape("n"), "1: it is so near to the wall that there is an alarm"]
    towards_um_s: Annotated[Vector, Shape("n"), "speed at which the command of the tick before drives it to that wall"]
    limit_um_s: Annotated[float | None, "limit of the first robot's speed for their sake; None: none"] = None


@dataclass(frozen=True, slots=True, eq=False)
class Observations(Message):
    """Local flow measured along the ways of robots and tracers: the data of a refinement.

    The measured flow is the velocity over ground less a robot's own motion as assumed, `rolled_um_s`. So a wrong um
    per revolution, slip and hindered motion near walls appear as a part of the flow along `rolled_um_s`.
    """

    stamp_ns: int
    position_um: Annotated[Matrix, Shape("n", 2), "places of the observations"]
    flow_um_s: Annotated[Matrix, Shape("n", 2), "flow observed at them"]
    std_um_s: Annotated[Vector, Shape("n"), "one standard deviation per component"]
    rolled_um_s: Annotated[
        Matrix | None,
        Shape("n", 2),
        "um_per_rev times revolutions per second along the heading, a mean over the time that the flow is a mean of; "
        "None: not stated",
    ] = None
    time_s: Annotated[
        Vector | None,
        Shape("n"),
        "middle of the time over which the flow is a mean, on the session clock; None: not stated",
    ] = None
    radius_um: Annotated[float | None, "radius of the robot, which the flow carries as a sphere; None: not stated"] = (
        None
    )
    tracer: Annotated[
        Vector | None,
        Shape("n"),
        "number of the tracer that was observed; -1: the robot, -2: robot 1, -3: robot 2; None: all are of the robot",
    ] = None
    entered: Annotated[
        Vector | None, Shape("n"), "1 for a tracer that came in while it was watched, see Tracers; None: no tracers"
    ] = None
    window_um: Annotated[
        float | None,
        "side of the square around each place over which the flow is a mean; None: it is that at the place",
    ] = None

    def with_robots(self, others: Mapping[int, Observations]) -> Observations:
        """The observations of the first robot, then those of others by their numbers; itself if there are none.

        Others are left out where it is not stated what they rolled: their response is not that of the first one.
        """
        known = [(number, one) for number, one in sorted(others.items()) if one.rolled_um_s is not None]
        every = [(number, one) for number, one in ((0, self), *known) if len(one.std_um_s)]
        if not every or every[-1][0] == 0:
            return self
        each = [
            replace(one, tracer=np.full(len(one.std_um_s), -1.0 - number), entered=np.zeros(len(one.std_um_s)))
            for number, one in every
        ]
        return replace(functools.reduce(Observations.followed_by, each), stamp_ns=self.stamp_ns)

    def with_tracers(self, tracers: Observations | None) -> Observations:
        """The observations of robots, then those of tracers, which roll nowhere; itself if there are none."""
        if tracers is None or not len(tracers.std_um_s):
            return self
        robots = np.full(len(self.std_um_s), -1.0) if self.tracer is None else self.tracer
        own = replace(self, tracer=robots, entered=np.zeros(len(robots)))
        if not len(robots):
            return replace(tracers, stamp_ns=self.stamp_ns)
        more = replace(tracers, rolled_um_s=np.zeros_like(tracers.flow_um_s))
        return replace(own.followed_by(more), stamp_ns=self.stamp_ns, radius_um=self.radius_um)

    def only(self, which: slice | Bools | Ints) -> Observations:
        """Some of the observations, chosen by an index of arrays."""
        stated = {name: array for name, array in self._arrays().items() if array is not None}
        return replace(self, **{name: array[which] for name, array in stated.items()})

    def followed_by(self, more: Observations) -> Observations:
        """These observations, then more; the stamp is that of the later ones. What one does not state, both do not."""
        theirs = more._arrays()
        joined: dict[str, Any] = {
            name: None if array is None or theirs[name] is None else np.concatenate((array, theirs[name]))
            for name, array in self._arrays().items()
        }
        scalars = ("radius_um", "window_um")
        joined |= {
            name: getattr(more, name) if getattr(self, name) == getattr(more, name) else None for name in scalars
        }
        return replace(more, **joined)

    def _arrays(self) -> dict[str, Any]:
        return {name: getattr(self, name) for name, _ in array_fields(Observations)}
