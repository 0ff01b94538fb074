"""Track and applied field to Estimate: where the robot is and which flow carries it."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from flowrec.estimation.kalman import Kalman
from flowrec.estimation.luenberger import Luenberger
from flowrec.messages import Applied, Estimate, Track
from flowrec.robot import Robot


@dataclass(frozen=True, slots=True)
class Observer:
    """Chooses the method; every method has the same verb."""

    method: Literal["kalman", "luenberger"] = "kalman"
    kalman: Kalman = field(default_factory=Kalman)
    luenberger: Luenberger = field(default_factory=Luenberger)

    def estimate(self, previous: Estimate | None, track: Track, applied: Applied, robot: Robot) -> Estimate:
        """The belief after this frame. The robot's own displacement is um_per_rev times the turns really applied."""
        method = self.kalman if self.method == "kalman" else self.luenberger
        return method.estimate(previous, track, applied, robot)
