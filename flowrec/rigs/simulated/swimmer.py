"""The robot's body in the simulated world: rolling, carried by the flow, jittering, stopped by walls.

xdot = u(f) (cos phi, sin phi) + v(x), the paper's kinematics, with the true flow at the robot's centre: no lag of a
finite sphere behind the fluid. What the controller can not know is added: a rolling direction and speed that
wander (Ornstein-Uhlenbeck, forgotten within a second) and a random walk of the position.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from flowrec.rig_settings import Simulated
from flowrec.robot import Robot
from flowrec.system.numba_setup import compiled

_SUBSTEP_S = 1.0 / 240.0  # at least eight to a frame at 30 per second, at most 4 um at 1000 um/s
_MEMORY_S = 1.0  # of the wander


@compiled
def bilinear(raster: NDArray[np.float32], x: float, y: float) -> float:
    """Value of a raster (h, w) at pixel coordinates, held constant beyond its outermost pixel centres."""
    height, width = raster.shape
    x = min(max(x, 0.0), width - 1.0)
    y = min(max(y, 0.0), height - 1.0)
    i, j = min(int(x), width - 2), min(int(y), height - 2)
    a, b = x - i, y - j
    top = (1 - a) * raster[j, i] + a * raster[j, i + 1]
    bottom = (1 - a) * raster[j + 1, i] + a * raster[j + 1, i + 1]
    return float((1 - b) * top + b * bottom)


@compiled
def _swim(
    x: float,
    y: float,
    own_x: float,
    own_y: float,
    dt: float,
    noise: NDArray[np.float64],
    vx: NDArray[np.float32],
    vy: NDArray[np.float32],
    strength: float,
    clearance: NDArray[np.float32],
    um_per_px: float,
    radius: float,
) -> tuple[float, float, int, float]:
    """Advance by len(noise) midpoint steps of dt. Returns x, y (um), steps that touched a wall, last clearance."""
    touched = 0
    free = 0.0
    for n in range(noise.shape[0]):
        # Midpoint rule in the flow, then the random walk.
        mx = x + 0.5 * dt * (own_x + strength * bilinear(vx, x / um_per_px, y / um_per_px))
        my = y + 0.5 * dt * (own_y + strength * bilinear(vy, x / um_per_px, y / um_per_px))
        x += dt * (own_x + strength * bilinear(vx, mx / um_per_px, my / um_per_px)) + noise[n, 0]
        y += dt * (own_y + strength * bilinear(vy, mx / um_per_px, my / um_per_px)) + noise[n, 1]
        free = bilinear(clearance, x / um_per_px, y / um_per_px)
        if free < radius:
            touched += 1
            # Pushed out along the slope of the distance: what was normal to the wall is lost, it slides along.
            for _ in range(4):
                i, j = x / um_per_px, y / um_per_px
                gx = bilinear(clearance, i + 0.5, j) - bilinear(clearance, i - 0.5, j)
                gy = bilinear(clearance, i, j + 0.5) - bilinear(clearance, i, j - 0.5)
                size = math.hypot(gx, gy)
                if size < 1e-6:
                    break
                x += (radius - free) * gx / size
                y += (radius - free) * gy / size
                free = bilinear(clearance, x / um_per_px, y / um_per_px)
                if free >= radius - 1e-3:
                    break
    return x, y, touched, free


class Swimmer:
    """Position and wall contacts of the one robot. `clearance_um` (h, w) from pixel centres to walls."""

    def __init__(
        self,
        position_um: tuple[float, float],
        robot: Robot,
        simulated: Simulated,
        velocity_um_s: NDArray[np.float32],
        clearance_um: NDArray[np.float32],
        um_per_px: float,
    ) -> None:
        self.position_um = np.array(position_um, np.float64)
        self.contacts = 0
        self.gone = False
        self._touching = False
        self._time_s = 0.0
        self._robot = replace(robot, step_out_hz=simulated.step_out_share * robot.step_out_hz)
        self._simulated = simulated
        self._vx = np.ascontiguousarray(velocity_um_s[..., 0])
        self._vy = np.ascontiguousarray(velocity_um_s[..., 1])
        self._clearance = clearance_um
        self._um_per_px = um_per_px
        self._rng = np.random.default_rng([simulated.seed, 1])
        self._wander = np.zeros(2)  # heading, speed: in standard deviations
        self._run(0.0, 0.0, 0.0, np.zeros((0, 2)))  # compiles, so that the second frame is not late

    @property
    def flow_um_s(self) -> NDArray[np.float64]:
        """(2,) true flow at the centre; zero once it is gone."""
        if self.gone:
            return np.zeros(2)
        x, y = self.position_um / self._um_per_px
        return self._strength(self._time_s) * np.array([bilinear(self._vx, x, y), bilinear(self._vy, x, y)])

    def _strength(self, time_s: float) -> float:
        """Of the pulsating flow as a share of the steady one."""
        pulse = self._simulated
        return 1.0 + pulse.pulsation_share * math.sin(2.0 * math.pi * pulse.pulsation_hz * time_s)

    @property
    def clearance_um(self) -> float:
        """From the surface to the nearest wall; NaN once it is gone."""
        if self.gone:
            return math.nan
        x, y = self.position_um / self._um_per_px
        return float(bilinear(self._clearance, x, y)) - self._robot.radius_um

    def advance(self, duration_s: float, frequency_hz: float, heading_rad: float, strength: float) -> None:
        """Move on for a while under a constant field, as strong as the full one or a share of it.

        The torque goes with the field, so the robot steps out at that share of the frequency; without a field it
        only drifts.
        """
        if self.gone or duration_s <= 0:
            return
        self._time_s += duration_s
        steps = max(4, math.ceil(duration_s / _SUBSTEP_S))
        dt = duration_s / steps
        keep = math.exp(-duration_s / _MEMORY_S)
        self._wander = keep * self._wander + math.sqrt(1 - keep**2) * self._rng.standard_normal(2)
        noise = self._rng.standard_normal((steps, 2)) * (self._simulated.position_noise_um * math.sqrt(dt))
        speed = strength * self._robot.rolled_speed_um_s(frequency_hz / strength) if strength > 0 else 0.0
        speed *= 1.0 + self._simulated.speed_noise * self._wander[1]
        heading = heading_rad + self._simulated.heading_noise_rad * self._wander[0]
        touched, free = self._run(speed * math.cos(heading), speed * math.sin(heading), dt, noise)
        # One contact lasts until the robot has come off the wall by a twentieth of its radius.
        if touched and not self._touching:
            self.contacts += 1
        self._touching = bool(touched) or (self._touching and free < 1.05 * self._robot.radius_um)
        height, width = self._clearance.shape
        column, row = self.position_um / self._um_per_px
        self.gone = not (-0.5 <= column <= width - 0.5 and -0.5 <= row <= height - 0.5)

    def _run(self, own_x: float, own_y: float, dt: float, noise: NDArray[np.float64]) -> tuple[int, float]:
        x, y, touched, free = _swim(
            float(self.position_um[0]),
            float(self.position_um[1]),
            own_x,
            own_y,
            dt,
            noise,
            self._vx,
            self._vy,
            self._strength(self._time_s - 0.5 * dt * len(noise)),
            self._clearance,
            self._um_per_px,
            self._robot.radius_um,
        )
        self.position_um = np.array([x, y])
        return touched, free
