"""The paper's tracking study: a lemniscate in a vortex, v = [-0.2 y, 0.2 x], on a plant that is solved exactly.

Between two commands the robot obeys z' = i w z + u with z = x + i y about the vortex' centre and constant u, so that
z(t) = e^(i w t) z(0) + u (e^(i w t) - 1) / (i w): no step size enters.
"""

from __future__ import annotations

import cmath
import math
from dataclasses import dataclass

import numpy as np

from flowrec.core import NS_PER_S, Applied, Demand, Estimate, Floats, FlowField, Mission, Route, Track, seconds
from flowrec.physics import Robot
from flowrec.stages import Controller, Observer

SPIN_PER_S = 0.2  # of the vortex
A_UM, B_UM = 1800.0, 1500.0
PERIOD_S = 40.0
RATE_HZ = 30.0
CENTRE_UM = 2500.0  # of chip and vortex
_START_UM = (1200.0, 600.0)  # from the centre
_UM_PER_PX = 50.0  # the vortex is linear, bilinear sampling of it exact


@dataclass(frozen=True, slots=True)
class RunDisturbances:
    """Disturbances of a run."""

    delay_s: float = 0.0  # from command to motion
    noise_um: float = 0.0  # one sigma of a measured position
    map_error: float = 0.0  # relative: the map is too strong by it
    step_out_um_s: float | None = None  # None: the robot follows every field

    def robot(self, v_max_um_s: float) -> Robot:
        """A sphere of 100 um, as the paper's."""
        rev_um = 25.0
        top = v_max_um_s if self.step_out_um_s is None else self.step_out_um_s
        margin = 1.0 if self.step_out_um_s is None else 0.95
        return Robot(
            radius_um=50.0,
            um_per_rev=rev_um,
            max_speed_um_s=v_max_um_s,
            step_out_hz=top / rev_um,
            step_out_margin=margin,
            delay_s=self.delay_s,
        )


@dataclass(frozen=True, slots=True, eq=False)
class LemniscateRun:
    """A run, frame by frame, in um about the centre."""

    time_s: Floats  # (n,)
    position_um: Floats  # (n, 2)
    reference_um: Floats  # (n, 2)
    progress_s: Floats  # (n,)
    demand_um_s: Floats  # (n, 2)
    flow_miss_um_s: Floats  # (n,) error of the estimated flow

    @property
    def error_um(self) -> Floats:
        """(n,) distance to the reference."""
        return np.hypot(*(self.reference_um - self.position_um).T)


def lemniscate(turns: int = 2) -> Route:
    """The reference of the paper: one lap in 40 s."""
    time = np.linspace(0.0, turns * PERIOD_S, turns * 4000 + 1)
    return Route(0, 1, "lemniscate", True, "", place_um(time), time)


def place_um(time_s: Floats) -> Floats:
    """(n, 2) position of the reference at times (n,)."""
    theta = 2.0 * np.pi * time_s / PERIOD_S
    spread = (1.0 + np.sin(theta) ** 2)[:, None]
    points = np.stack([A_UM * np.cos(theta), B_UM * np.sin(theta) * np.cos(theta)], -1) / spread
    return CENTRE_UM + points


def vortex_map(error: float) -> FlowField:
    """The vortex with a relative error of its strength."""
    size = round(2 * CENTRE_UM / _UM_PER_PX) + 1
    y, x = np.mgrid[0:size, 0:size] * _UM_PER_PX - CENTRE_UM
    velocity = ((1.0 + error) * SPIN_PER_S * np.stack([-y, x], -1)).astype(np.float32)
    zero = np.zeros((size, size), np.float32)
    return FlowField(0, 0, "vortex", _UM_PER_PX, velocity, zero, None, np.zeros(0), 1.0, 1000.0, "")


def fly(
    controller: Controller, observer: Observer, robot: Robot, world: RunDisturbances, seed: int, turns: int = 2
) -> LemniscateRun:
    """Two laps (80 s) of the Observer and Controller stages, from 600 um beside the start of the curve."""
    rng = np.random.default_rng([seed, 19])
    field, route = vortex_map(world.map_error), lemniscate(turns)
    mission = Mission(0, "navigate", 0, 1, "", 0, np.zeros(2), np.zeros(2), False, "", "")
    z, acting, turned = complex(*_START_UM), 0j, 0j  # position, commanded own velocity, revolutions
    coming: list[tuple[float, complex]] = []
    estimate: Estimate | None = None
    demand: Demand | None = None
    rows = []
    for index in range(round(turns * PERIOD_S * RATE_HZ)):
        stamp = round(index * NS_PER_S / RATE_HZ)
        seen = np.array([z.real, z.imag]) + CENTRE_UM + world.noise_um * rng.standard_normal(2)
        track = Track(stamp, True, seen, 1.0, 0, 10.0, np.zeros(4))
        applied = Applied(stamp, 0.0, 0.0, 1.0, np.zeros(3), np.array([turned.real, turned.imag]))
        estimate = observer.estimate(estimate, track, applied, robot, field)
        inputs = (mission, route, estimate, field, robot, None, _UM_PER_PX)
        demand = controller.control(demand, *inputs, estimate_uses_map=observer.uses_map(estimate))
        flow = 1j * SPIN_PER_S * z
        miss = math.hypot(estimate.flow_um_s[0] - flow.real, estimate.flow_um_s[1] - flow.imag)
        reference_um, own_um_s = demand.reference_um - CENTRE_UM, demand.velocity_um_s
        rows.append((seconds(stamp), z.real, z.imag, *reference_um, demand.progress_s, miss, *own_um_s))
        now, end = index / RATE_HZ, (index + 1) / RATE_HZ
        coming.append((now + world.delay_s, complex(*own_um_s)))
        turned = 0j
        while now < end:
            while coming and coming[0][0] <= now:
                acting = coming.pop(0)[1]
            until = min(coming[0][0], end) if coming else end
            turned += acting / robot.um_per_rev * (until - now)
            z = _advance(z, _own(acting, robot), until - now)
            now = until
    made = np.array(rows)
    return LemniscateRun(made[:, 0], made[:, 1:3], made[:, 3:5], made[:, 5], made[:, 7:9], made[:, 6])


def _own(commanded: complex, robot: Robot) -> complex:
    """The robot's own velocity, which falls beyond step-out."""
    speed = abs(commanded)
    return commanded / speed * robot.rolled_speed_um_s(speed / robot.um_per_rev) if speed > 0.0 else 0j


def _advance(z: complex, own: complex, dt_s: float) -> complex:
    turn = cmath.exp(1j * SPIN_PER_S * dt_s)
    return turn * z + own * (turn - 1.0) / (1j * SPIN_PER_S)
