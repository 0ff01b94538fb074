"""Track and applied field to Estimate: where the robot is and which flow carries it."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from flowrec.estimation.kalman import Kalman, memory_s
from flowrec.estimation.luenberger import Luenberger
from flowrec.messages import Applied, Estimate, FlowField, Track
from flowrec.methods import Method, Methods
from flowrec.robot import Robot
from flowrec.units import seconds

_KALMAN, _LUENBERGER = "flowrec.estimation.kalman:Kalman", "flowrec.estimation.luenberger:Luenberger"
# The only option of a row is the section of its settings, an object of the class that implements it.
OBSERVERS = Methods(
    "observer.method",
    Method("kalman", _KALMAN, "Kalman filter for position and flow", ("kalman",)),
    Method("kalman_map", _KALMAN, "the same with the best known flow field as its model", ("kalman",), needs=("map",)),
    Method("luenberger", _LUENBERGER, "disturbance observer of the paper", ("luenberger",)),
)


@dataclass(frozen=True, slots=True)
class Observer:
    """Settings of the observer stage; `method` selects a row of OBSERVERS."""

    method: Annotated[str, OBSERVERS] = "kalman"
    kalman: Kalman = field(default_factory=Kalman)
    luenberger: Luenberger = field(default_factory=Luenberger)

    @property
    def uses_map(self) -> bool:
        """Whether the estimate corrects the flow field rather than ignoring it."""
        return "map" in OBSERVERS[self.method].needs

    def estimate(
        self,
        previous: Estimate | None,
        track: Track,
        applied: Applied,
        robot: Robot,
        field: FlowField | None = None,
    ) -> Estimate:
        """The estimate after this frame. The robot's own displacement is um_per_rev times the turns really applied.

        Parameters
        ----------
        field : the best flow known; ignored by methods that do not use a map. Without one, kalman_map is kalman.

        Raises
        ------
        UsageError : `method` is not in the table.
        """
        settings = getattr(self, OBSERVERS[self.method].options[0])
        estimate: Estimate = settings.estimate(previous, track, applied, robot, field if self.uses_map else None)
        return replace(estimate, rolled_um_s=_rolled_um_s(previous, estimate, applied, robot))


def _rolled_um_s(previous: Estimate | None, estimate: Estimate, applied: Applied, robot: Robot) -> NDArray[np.float64]:
    """(2,) mean of the robot's own motion over the filter's memory, which is the delay of the estimated flow."""
    dt = 0.0 if previous is None else seconds(estimate.stamp_ns - previous.stamp_ns)
    if previous is None or dt <= 0.0:
        return np.zeros(2) if previous is None else previous.rolled_um_s
    um_per_rev = robot.um_per_rev if estimate.um_per_rev is None else estimate.um_per_rev
    now = um_per_rev / dt * applied.turns
    before = previous.rolled_um_s if previous.rolled_um_s.size else now
    memory = memory_s(estimate.covariance)
    return np.asarray(before + (1.0 - math.exp(-dt / memory) if memory > 0.0 else 1.0) * (now - before))
