"""Track and applied field to Estimate: where the robot is and which flow carries it."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Annotated

import numpy as np

from flowrec.core import Alarm, Applied, Estimate, FlowField, Health, Method, Methods, Share, Track
from flowrec.physics import Robot
from flowrec.stages.estimation.kalman import Kalman, corrects_map, memory_s, newest_share
from flowrec.stages.estimation.luenberger import Luenberger

_GIVEN_UP = 1.5  # times the deviation at which a map is taken up
_KALMAN, _LUENBERGER = "flowrec.stages.estimation.kalman:Kalman", "flowrec.stages.estimation.luenberger:Luenberger"
# The only option of a row is the section of its settings, an object of the class that implements it.
OBSERVERS = Methods(
    "observer.method",
    Method(
        "kalman_auto",
        _KALMAN,
        "kalman_map while the map states a small error and the measured flow agrees with it, else kalman",
        ("kalman",),
        needs=("good map",),
    ),
    Method("kalman", _KALMAN, "Kalman filter for position and flow", ("kalman",)),
    Method("kalman_map", _KALMAN, "the same with the best known flow field as its model", ("kalman",), needs=("map",)),
    Method("luenberger", _LUENBERGER, "disturbance observer of the paper", ("luenberger",)),
    group="flowrec.observers",
    verb="estimate",
)


@dataclass(frozen=True, slots=True)
class Observer:
    """Estimates position of the robot and flow around it; `method` selects a row of OBSERVERS."""

    method: Annotated[str, OBSERVERS] = "kalman_auto"
    kalman: Kalman = field(default_factory=Kalman)
    # kalman_auto: largest error that a map may state, and by which the measured flow may deviate from it, to be used
    map_good_share: Share = 0.1
    luenberger: Luenberger = field(default_factory=Luenberger)

    def uses_map(self, estimate: Estimate) -> bool:
        """True if an estimate of this observer corrects the flow field rather than ignoring it."""
        needs = OBSERVERS[self.method].needs
        return "map" in needs or ("good map" in needs and corrects_map(estimate))

    def estimate(
        self,
        previous: Estimate | None,
        track: Track,
        applied: Applied,
        robot: Robot,
        field: FlowField | None = None,
        health: Health | None = None,
    ) -> Estimate:
        """The estimate after this frame. The robot's own displacement is um_per_rev times the turns really applied.

        Raises UsageError: `method` is not in the table.

        Parameters
        ----------
        field : the best flow known; ignored by methods that do not use a map. Without one, kalman_map is kalman.
        health : of the frame before, by which kalman_auto judges the map. None: not judged.
        """
        row = OBSERVERS[self.method]
        settings, needs = row.section(self), row.needs
        used = "map" in needs or ("good map" in needs and self._good(previous, field, health))
        estimate: Estimate = settings.estimate(previous, track, applied, robot, field if used else None)
        return _with_own_motion(previous, estimate, applied, robot)

    def without_map(
        self,
        previous: Estimate | None,
        before: Estimate | None,
        estimate: Estimate,
        track: Track,
        applied: Applied,
        robot: Robot,
        *,
        corrected: bool = False,
    ) -> Estimate | None:
        """The estimate of the same filter without a map, while `estimate` corrects one; else `previous` itself.

        An estimate that corrects a map contains it: a refinement of that map would take what it has found before for
        another measurement.

        Parameters
        ----------
        previous : what this method returned last.
        before : the estimate of the frame before, from which the filter continues where that did not use a map.
        robot : as it is stated.
        corrected : `estimate` is that of a robot that a refinement has corrected; this one never is.
        """
        if not corrected and not corrects_map(estimate):
            return previous
        if before is not None:
            before = self.measured_estimate(previous, before)
        return _with_own_motion(before, self.kalman.estimate(before, track, applied, robot), applied, robot)

    @staticmethod
    def measured_estimate(mapless: Estimate | None, estimate: Estimate) -> Estimate:
        """Estimate whose flow was measured on a frame: the one without a map if there is one of that frame."""
        return mapless if mapless is not None and mapless.stamp_ns == estimate.stamp_ns else estimate

    def _good(self, previous: Estimate | None, field: FlowField | None, health: Health | None) -> bool:
        """True if the map is good enough to be corrected instead of ignored.

        It states an error within `map_good_share`; the innovations are consistent; and the flow that the monitor has
        found on the way agrees with the map on the mean. A map that is in use is given up at one and a half times the
        deviation at which it is taken up, so that the choice does not alternate.
        """
        if field is None or field.error_share is None or field.error_share > self.map_good_share:
            return False
        if health is None:
            return True
        most = self.map_good_share * (_GIVEN_UP if previous is not None and corrects_map(previous) else 1.0)
        return Alarm.NIS not in health.alarms and abs(health.offset_share) <= most


def _with_own_motion(previous: Estimate | None, estimate: Estimate, applied: Applied, robot: Robot) -> Estimate:
    """The estimate with the robot's mean own motion over the filter's memory, which is the delay of its flow."""
    dt = estimate.since_s(previous)
    if previous is None or dt <= 0.0:
        return replace(estimate, rolled_um_s=np.zeros(2) if previous is None else previous.rolled_um_s)
    um_per_rev = robot.um_per_rev if estimate.um_per_rev is None else estimate.um_per_rev
    now = um_per_rev / dt * applied.turns
    before = previous.rolled_um_s if previous.rolled_um_s.size else now
    weight = newest_share(dt, memory_s(estimate.covariance))
    return replace(estimate, rolled_um_s=before + weight * (now - before))
