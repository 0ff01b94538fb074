"""Track and applied field to Estimate: where the robot is and which flow carries it."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated

from flowrec.estimation.kalman import Kalman
from flowrec.estimation.luenberger import Luenberger
from flowrec.messages import Applied, Estimate, FlowField, Track
from flowrec.methods import Method, Methods
from flowrec.robot import Robot

OBSERVERS = Methods(
    "observer.method",
    Method("kalman", "flowrec.estimation.kalman:Kalman", "Kalman filter for position and flow", ("kalman",)),
    Method(
        "kalman_map",
        "flowrec.estimation.kalman:Kalman",
        "the same with the best known flow field as its model",
        ("kalman",),
    ),
    Method(
        "luenberger", "flowrec.estimation.luenberger:Luenberger", "disturbance observer of the paper", ("luenberger",)
    ),
)


@dataclass(frozen=True, slots=True)
class Observer:
    """Chooses the method; every method has the same verb."""

    method: Annotated[str, OBSERVERS] = "kalman"
    kalman: Kalman = field(default_factory=Kalman)
    luenberger: Luenberger = field(default_factory=Luenberger)

    def estimate(
        self,
        previous: Estimate | None,
        track: Track,
        applied: Applied,
        robot: Robot,
        field: FlowField | None = None,
    ) -> Estimate:
        """The belief after this frame. The robot's own displacement is um_per_rev times the turns really applied.

        `field` is the best flow known, which only `kalman_map` looks at; without one it is `kalman`.
        """
        if self.method == "luenberger":
            return self.luenberger.estimate(previous, track, applied, robot)
        return self.kalman.estimate(previous, track, applied, robot, field if self.method == "kalman_map" else None)
