"""The controller stage: follow the route, or hold the place, whatever the flow does."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from flowrec.control.laws import ff_fb_law, vector_law
from flowrec.control.prediction import blend, remembered, roll_forward
from flowrec.control.reference import governed_pace, place_on, velocity_on
from flowrec.control.walls import guarded
from flowrec.messages import Demand, Estimate, FlowField, Mission, Route
from flowrec.robot import Robot
from flowrec.units import seconds

Vector = NDArray[np.float64]
_FOLLOWING = ("survey", "navigate")


@dataclass(frozen=True, slots=True)
class Controller:
    """Tracking with the flow compensated (science.md, section 5).

    vector: u = sat(xd_dot - v(x+) + Kp (xd - x+)); x+ is the estimate rolled forward over the demands still on
    their way to the coils. ff_fb: the paper's feedforward-feedback law, made sound.
    """

    method: Literal["vector", "ff_fb"] = "vector"
    kp_per_s: float = 3.0  # of vector
    ff_fb_kp_per_s: float = 1.0  # of ff_fb, as in the paper
    lag_free_radii: float = 0.5  # the robot may be this far off before the reference slows down,
    lag_full_radii: float = 3.0  # and waits for it from here on
    map_error: float = 0.3  # share of the flow's speed that the map is thought to be wrong by
    guard_radii: float = 1.1  # clearance kept from walls, in robot radii; 0: no wall guard
    guard_per_s: float = 5.0  # how fast the room left above that may be used up
    blind_s: float = 0.5  # while the robot is not seen the demand dies away with this time constant

    def control(
        self,
        previous: Demand | None,
        mission: Mission,
        route: Route | None,
        estimate: Estimate,
        field: FlowField | None,
        robot: Robot,
        clearance_um: NDArray[np.float32] | None,
        um_per_px: float,
    ) -> Demand:
        """The demand after this frame.

        In the phases survey and navigate the reference runs along the route, from its start when the phase begins;
        else it is the place where the phase found the robot. A finished mission asks for nothing.

        Parameters
        ----------
        clearance_um : (h, w) distance to the walls at the pixels of the chip, None without walls.
        um_per_px : size of those pixels.
        """
        if previous is not None and previous.stamp_ns == estimate.stamp_ns:
            return previous
        dt_s = seconds(estimate.stamp_ns - previous.stamp_ns) if previous is not None else 0.0
        sent = previous.sent_um_s if previous is not None else np.zeros((0, 2))
        following = mission.phase in _FOLLOWING and route is not None and route.reachable and len(route.arrival_s) > 0
        reference, ahead, moving, progress_s = (
            self._along(previous, mission, route, estimate, robot, dt_s)
            if following and route is not None
            else self._in_place(previous, mission, estimate)
        )
        error = reference - estimate.position_um
        idle = mission.finished or not np.isfinite(reference).all()
        demand, saturated = np.zeros(2), False
        if not idle:
            demand, saturated = self._law(
                ahead, moving, estimate, field, robot, clearance_um, um_per_px, sent, dt_s
            )
            if not estimate.seen:
                demand = self._blind(previous, demand, robot, dt_s)
        return Demand(
            stamp_ns=estimate.stamp_ns,
            velocity_um_s=demand,
            reference_um=reference,
            progress_s=progress_s,
            error_um=math.hypot(error[0], error[1]),
            saturated=saturated,
            sent_um_s=remembered(sent, demand, dt_s, robot.delay_s),
        )
