"""The mission, the check of the axes, the demanded motion, the currents, and events for people."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from flowrec.core.declarations import NOT_STATED, Matrix, Message, NanFloat, PerCoil, Shape, Vector, Vector2
from flowrec.core.enums import AxesVerdict, Level, Phase, WorkOrder


@dataclass(frozen=True, slots=True, eq=False)
class Mission(Message):
    """State of the mission, and the work that it waits for."""

    stamp_ns: int
    phase: Annotated[str, f"phase of the mission: {', '.join(Phase)}"]
    since_ns: Annotated[int, "stamp at which the phase began"]
    request: Annotated[int, "number of the latest work order"]
    wanted: Annotated[str, f"work that is pending: {', '.join(WorkOrder)}; '' when nothing is"]
    requested_ns: Annotated[int, "stamp at which the latest work was ordered"]
    start_um: Annotated[Vector, Shape(2, finite=False), "place where the ordered route begins; NaN without a route"]
    goal_um: Annotated[Vector, Shape(2, finite=False), "place where the mission ends; NaN without a goal"]
    finished: Annotated[bool, "the mission has ended"]
    outcome: Annotated[str, "word of enums.Outcome: how the mission ended; '' while it runs"]
    note: Annotated[str, "reason of the phase or of the outcome, human-readable"]
    held_since_ns: Annotated[int | None, "stamp at which the operator held the robot; None: not held"] = None
    held_ns: Annotated[
        int, "duration of earlier holds in this phase; the time limit of the phase does not count it"
    ] = 0
    swept: Annotated[bool, "held but carried away, because the flow is faster than the robot"] = False
    blind_since_ns: Annotated[
        int | None, "stamp at which the robot was held because it was not seen; None: it is seen"
    ] = None
    blind: Annotated[str, "reason why the robot is not seen, human-readable"] = ""
    field_off: Annotated[bool, "not seen for so long that the field must be off"] = False
    input_ended: Annotated[bool, "no more frames come; in the phase observe only"] = False
    routine_orders: Annotated[
        int,
        "work orders so far that no disturbance has caused: stretches of a survey after the first, refinements on the "
        "way",
    ] = 0
    planned_um_s: Annotated[float | None, "speed limit of the robot at the latest work order; None: not recorded"] = (
        None
    )
    former_goal_um: Annotated[
        Vector,
        Shape("n"),
        "the goal before (2,), to which the present route leads, while a goal that was set during the run has no "
        "route yet; (0,) otherwise",
    ] = NOT_STATED
    goal_set_ns: Annotated[
        int | None, "stamp at which the operator set the latest goal; None: it is the configured one"
    ] = None
    goal_from_s: Annotated[float, "time along the route at which the way to the latest goal begins"] = 0.0
    speed_limit_um_s: Annotated[
        float | None, "speed limit of the robot through the fluid, set by the operator; None: its own"
    ] = None
    speed_set_ns: Annotated[int | None, "stamp at which the operator set or took away the limit; None: never"] = None
    arrived_s: Annotated[
        float | None,
        "duration of the phase, without holds, after which the robot began to wait at the goal for another one; None: "
        "it does not wait",
    ] = None
    by_hand: Annotated[
        bool,
        "held because it was steered by hand: but for the ticks on which a hand steers the field is off, until the "
        "operator lets the mission go on",
    ] = False


@dataclass(frozen=True, slots=True, eq=False)
class AxesCheck(Message):
    """The check of the axes before the mission: what the robot's first small motions say, see control/axes_check.py.

    A round is four legs: along x, back, along y, back. The sums of a round are those of a regression of its positions
    on 1, t, t^2, t^3 (the flow) and the two components of the robot's own motion as commanded.
    """

    stamp_ns: int
    leg: Annotated[int, "number of the leg since the check began, from 0; four are a round"]
    leg_ns: Annotated[int, "stamp at which the leg began"]
    driven_s: Annotated[float, "duration of the check so far"]
    round_ns: Annotated[int, "stamp at which the round began"]
    from_um: Annotated[Vector2, "position when the leg began"]
    own_um: Annotated[Vector2, "the robot's own motion since then: um_per_rev times the revolutions along x and y"]
    steady_um: Annotated[Vector2, "the part of it that was demanded against the flow, not for the legs"]
    speed_um_s: Annotated[float, "speed of the legs of this round"]
    reach_um: Annotated[float, "own motion after which a leg turns round"]
    count: Annotated[int, "positions in the sums"]
    normal: Annotated[Matrix, Shape(6, 6), "normal matrix of the round's regression"]
    moment: Annotated[Matrix, Shape(6, 2), "right-hand side of the round's regression"]
    square_um2: Annotated[Vector2, "sums of the squares of the positions"]
    gain: Annotated[
        Matrix,
        Shape("n", "n"),
        "Of the most exact round so far: displacement seen (rows) per own motion as commanded (columns); the identity "
        "if all is as stated. (0, 0): no round is complete",
    ]
    gain_std: Annotated[float, "one standard deviation of each of its elements"] = 0.0
    against_um_s: Annotated[
        Vector, Shape("m"), "velocity (2,) that, by the last round, holds the robot against the flow; (0,): not known"
    ] = NOT_STATED
    verdict: Annotated[str, f"verdict: {', '.join(AxesVerdict)}; '' while the check is under way"] = ""
    text: Annotated[str, "the verdict in a sentence, with what to do"] = ""


@dataclass(frozen=True, slots=True, eq=False)
class Demand(Message):
    """The motion that the controller demands of the robot."""

    stamp_ns: int
    velocity_um_s: Annotated[Vector2, "the robot's own velocity that is demanded, relative to the fluid"]
    reference_um: Annotated[Vector, Shape(2, finite=False), "place where the robot should be now; NaN without a route"]
    progress_s: Annotated[float, "time along the route, slowed while the robot lags behind"]
    error_um: Annotated[
        NanFloat,
        "Distance to the reference, NaN without one. With a policy, which may leave the route: distance to the nearest "
        "point from which a way to the goal is known.",
    ]
    saturated: Annotated[bool, "the demand is limited by the robot's speed"]
    sent_um_s: Annotated[Matrix, Shape("m", 2), "the latest demands, oldest first; the coils may not yet apply them"]


@dataclass(frozen=True, slots=True, eq=False)
class Currents(Message):
    """The rotating field and the coil currents that make it."""

    stamp_ns: int
    frequency_hz: Annotated[float, "frequency of the rotating field that is commanded"]
    heading_rad: Annotated[float, "heading of the demanded motion"]
    amplitude_mt: Annotated[float, "amplitude of the field"]
    phase_rad: Annotated[float, "phase of the field, accumulated over all changes of frequency and heading"]
    currents_a: Annotated[PerCoil, "current of each coil at this phase; of three coils x, y, z"]
    saturated: Annotated[bool, "the coils can not generate the full amplitude"]
    plane_rad: Annotated[float, "heading of the plane of rotation; it turns towards heading_rad or its opposite"] = 0.0
    limit_hz: Annotated[float, "step-out frequency at this amplitude; the field's direction never turns faster"] = 0.0
    voltages_v: Annotated[Vector, Shape("n"), "inputs of the amplifiers, one a coil; (0,) in older files"] = NOT_STATED
    unmet_mt: Annotated[
        float,
        "amplitude that the settings ask for and the limits of current and voltage do not permit; 0 in older files",
    ] = 0.0


@dataclass(frozen=True, slots=True, eq=False)
class Event(Message):
    """A message of the pipeline for people."""

    stamp_ns: int
    level: Annotated[str, f"weight of the event: {', '.join(Level)}"]
    text: Annotated[str, "what happened, human-readable"]
