"""The robot as a refinement found it, for the stages of a tick: at the place where it was a tick ago.

A sphere near side walls rolls less per revolution than in the open, and the flow carries it more slowly than the fluid
around it goes. For the stages both are properties of the robot: the flow that they know and estimate is that of the
fluid.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from flowrec.core import Applied, Estimate, Floats, Floats32, FlowField, Tick, bilinear
from flowrec.physics import ChannelWidths, Chip, Robot, SphereBetweenWalls, on_chip, sample
from flowrec.stages.control.tracking_laws import limit_length
from flowrec.stages.refine import Refiner

_STEP_RADII = float(np.sqrt(2.0 / 3.0))  # over which the flow is differentiated: within the sphere, and not into a wall
_CROSS = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0], [-1.0, 0.0], [0.0, -1.0]])


class Swimming(Protocol):
    """The robot as it is stated, in its chip, and what of a refinement corrects it; a Pipeline has all of them."""

    @property
    def chip(self) -> Chip: ...
    @property
    def robot(self) -> Robot: ...
    @property
    def clearance_um(self) -> Floats32: ...
    @property
    def widths(self) -> ChannelWidths: ...
    @property
    def refiner(self) -> Refiner: ...


@dataclass(frozen=True, slots=True, eq=False)
class LearnedRobot:
    """The robot with the corrections that are significant, or itself."""

    known: Robot  # on the mean of all places: a mission does not plan anew at each wall
    here: Robot  # where it is
    turn: Floats | None = None  # (2, 2) from heading to course; None: the same
    slip_um_s: Floats | None = None  # (2,) velocity with which the flow carries it, less the flow; None: none is known

    def is_other_than(self, stated: Robot) -> bool:
        """True if any correction changes the motion that is expected of the stated robot."""
        return self.here is not stated or self.turn is not None or self.slip_um_s is not None

    def correct_turns(self, before: Applied | None, rolled: Applied) -> Applied:
        """The message with the turns that would move a robot without turn and slip as far as this one."""
        turns = rolled.turns if self.turn is None else self.turn @ rolled.turns
        if self.slip_um_s is not None:
            turns = turns + rolled.since_s(before) / self.here.um_per_rev * self.slip_um_s
        return rolled if turns is rolled.turns else replace(rolled, turns=turns)

    def heading_velocity(self, wanted_um_s: Floats, limit_um_s: float, *, slips: bool) -> Floats:
        """The velocity (2,) to give the coils for one that is wanted relative to the fluid.

        `slips` False: it is not to make up for the slip, where nothing is wanted or somebody else steers.
        """
        if slips and self.slip_um_s is not None and wanted_um_s.any():
            wanted_um_s = limit_length(wanted_um_s - self.slip_um_s, limit_um_s)[0]
        return wanted_um_s if self.turn is None else self.turn.T @ wanted_um_s


def learned_robot(p: Swimming, last: Tick, refined: FlowField | None, flow: FlowField | None) -> LearnedRobot:
    """The robot as a refinement found it; `flow` is the map in use at this time."""
    refiner = p.refiner
    known = p.robot.learned_from(refined) if refiner.correct_robot else p.robot
    turn = known.course_turn(refined) if refiner.correct_heading else None
    found = LearnedRobot(known, known, turn)
    if refined is None or last.estimate is None or not (refiner.correct_robot or refiner.correct_lag):
        return found
    point_um = place_on_chip(last.estimate, refined).position_um
    if not np.isfinite(point_um).all():
        return found
    sphere = _sphere(p, point_um)
    if refiner.correct_robot:
        found = replace(found, here=_between_walls(known, p, sphere, refined))
    if refiner.correct_lag and flow is not None:
        found = replace(found, slip_um_s=_slip_um_s(p, sphere, point_um, refined, flow))
    return found


def place_on_chip(estimate: Estimate, refined: FlowField | None) -> Estimate:
    """The estimate with its position on the chip, by the registration that the refinement found."""
    if refined is None or refined.registration is None:
        return estimate
    return replace(estimate, position_um=on_chip(refined.registration, estimate.position_um))


def _sphere(p: Swimming, point_um: Floats) -> SphereBetweenWalls:
    """The robot as a sphere at a point (2,)."""
    point = np.clip(point_um / p.chip.um_per_px, 0.0, np.array(p.clearance_um.shape[::-1]) - 1.0)
    near_px = np.array([bilinear(p.clearance_um, *point.tolist()) / p.chip.um_per_px])
    return SphereBetweenWalls.of(p.robot.radius_um / p.chip.um_per_px, near_px, p.widths.at(point[None]))


def _between_walls(known: Robot, p: Swimming, sphere: SphereBetweenWalls, refined: FlowField) -> Robot:
    """The known robot with the um per revolution that a refinement found for a sphere at this place."""
    found = p.robot.um_per_rev_at(float(sphere.drag[0]), refined)
    if found is None:
        return known
    # At a higher frequency than the fastest one by which the robot is stated to go it may step out.
    slower = min(found / known.um_per_rev, 1.0)
    return replace(known, um_per_rev=found, max_speed_um_s=slower * known.max_speed_um_s)


def _slip_um_s(
    p: Swimming, sphere: SphereBetweenWalls, point_um: Floats, refined: FlowField, flow: FlowField
) -> Floats | None:
    """Velocity (2,) by which the flow carries a sphere otherwise than the fluid; None: the refinement has found none.

    The refinement states a fraction of what the laws of sphere_between_walls.py give: its mean, significant or not,
    because a robot of some size lags. A negative one has another cause: walls do not hurry a robot.
    """
    share = refined.parameter("sphere_share")
    if share is None or share[0] <= 0.0:
        return None
    step_px = _STEP_RADII * sphere.radius_px
    v, *beside = sample(flow, point_um + step_px * p.chip.um_per_px * _CROSS)
    laplacian = (np.sum(beside, axis=0) - 4.0 * v) / step_px**2
    return np.asarray(share[0] * sphere.transport_slip(v[None], laplacian[None])[0])
