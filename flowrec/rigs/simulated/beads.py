"""Tracers in the simulated flow: beads of two sizes, each at a height of its own in the channel's depth.

A bead goes with the true flow times its height's part of the profile over the depth. In a rectangular channel of width
w and depth h that is, by the fit of Natarajan and Lakshmanan (1972; Shah and London 1978),

    u / u_mean = (1 + n) / n (1 - |2 z / h - 1|^n),   n = 2 + 0.3 max(h / w - 1/3, 0) where h < w,
                                                      n = 1.7 + 0.5 (w / h)^-1.4   where h > w.

Near floor and ceiling it lags (Goldman, Cox and Brenner 1967): by 1 - 5/16 (a / d)^3 of its radius over the distance
of its centre, and in touch by the lubrication limit. It settles by Stokes' law, and one that lies on the floor sticks
there after a time. Beads that come in are drawn by the flux at each height.
"""

from __future__ import annotations

import math

import numpy as np

from flowrec.core import Floats, Floats32, FlowField, TracerTruth
from flowrec.physics import Chip, median_width_um
from flowrec.rigs.simulated.bodies import Carried
from flowrec.rigs.simulated.pump import Pump
from flowrec.stages import Simulated

_STREAM = 9  # of the seed
_RADII = (0.2, 0.3)  # of the robot's radius: the two sizes
_DARKNESS = (0.35, 0.6)  # of a bead against the channel, least and most; the robot's is 1
_STUCK_SHARE = 0.05  # of the beads from the start
_TOUCH = 1.005  # radii between the centre and the floor of a bead that lies there
_STICKS_PER_S = 0.05  # rate at which a bead that lies on the floor sticks
_G_M_S2 = 9.81  # standard gravity


class Beads(Carried):
    """`points_um` (n, 2), `radii_um` (n,) and `darkness` (n,) of the beads of a world.

    Parameters
    ----------
    depth_um : true depth; None: two-dimensional, so that the height does not matter.
    field, clearance_um : the steady flow; (h, w) from pixel centres to walls.
    """

    def __init__(
        self,
        chip: Chip,
        simulated: Simulated,
        robot_radius_um: float,
        depth_um: float | None,
        field: FlowField,
        clearance_um: Floats32,
        pump: Pump,
    ) -> None:
        count = simulated.tracers
        rng = np.random.default_rng([simulated.seed, _STREAM])
        super().__init__(chip, field, clearance_um, rng)
        self.radii_um = robot_radius_um * rng.choice(_RADII, count)
        self.darkness = rng.uniform(*_DARKNESS, count)
        self._scatter(count, _RADII[1] * robot_radius_um)
        self._pump = pump
        self._depth_um = depth_um
        self._exponent = 0.0 if depth_um is None else profile_exponent(depth_um / median_width_um(chip))
        room = 0.5 if depth_um is None else np.minimum(_TOUCH * self.radii_um / depth_um, 0.5)
        self._height = rng.uniform(room, 1.0 - room, count)  # of the centre, over the depth
        self._stuck = rng.random(count) < _STUCK_SHARE
        self._id = np.arange(count, dtype=np.float64)
        self._time_s = 0.0
        self._velocity_um_s = np.zeros((count, 2))
        settles = 2.0 / 9.0 * simulated.tracer_excess_kg_m3 * _G_M_S2 / (1e-3 * field.viscosity_mpa_s)
        self._settling_um_s = settles * (1e-6 * self.radii_um) ** 2 * 1e6

    def speed_share(self) -> Floats:
        """(n,) speed of each bead over the mean of the flow over the depth."""
        if self._depth_um is None:
            return np.where(self._stuck, 0.0, 1.0)
        n = self._exponent
        profile = (1.0 + n) / n * (1.0 - np.abs(2.0 * self._height - 1.0) ** n)
        away = self._depth_um * np.minimum(self._height, 1.0 - self._height) / self.radii_um
        return np.where(self._stuck, 0.0, profile * _lag(away))

    def drift(self, dt_s: float) -> None:
        """Move all by dt; a bead that has left the chip comes in again as another one."""
        before = self.points_um.copy()
        strength = self._pump.strength(self._time_s + 0.5 * dt_s)
        left = self._carry(strength * self.speed_share(), dt_s)
        self._time_s += dt_s
        if dt_s > 0.0:
            self._velocity_um_s = (self.points_um - before) / dt_s
        if self._depth_um is not None:
            least = np.minimum(_TOUCH * self.radii_um / self._depth_um, 0.5)
            lower = self._height - np.where(self._stuck, 0.0, self._settling_um_s * dt_s / self._depth_um)
            self._height = np.clip(lower, least, 1.0 - least)
            lies = self._height <= least
            self._stuck |= lies & (self._rng.random(len(lies)) < -math.expm1(-_STICKS_PER_S * dt_s))
        for n in left:
            self._enter(n)

    def _enter(self, n: int) -> None:
        """Another bead in place of one: as many come in at each height as flow through there."""
        super()._enter(n)
        self._id[n] = self._id.max() + 1.0
        self._stuck[n] = False
        self._velocity_um_s[n] = 0.0
        if self._depth_um is None:
            return
        least = min(_TOUCH * self.radii_um[n] / self._depth_um, 0.5)
        while True:
            self._height[n] = self._rng.uniform(least, 1.0 - least)
            if self._rng.random() < 1.0 - abs(2.0 * self._height[n] - 1.0) ** self._exponent:
                return

    def truth(self, stamp_ns: int) -> TracerTruth:
        """All that is true of them now."""
        return TracerTruth(
            stamp_ns,
            self._id.copy(),
            self.points_um.copy(),
            self._velocity_um_s.copy(),
            self._height.copy(),
            self.radii_um,
            self._stuck.astype(np.float64),
        )


def profile_exponent(depth_over_width: float) -> float:
    """Exponent n of the profile over the depth, see above."""
    if depth_over_width <= 1.0:
        return 2.0 + 0.3 * max(depth_over_width - 1.0 / 3.0, 0.0)
    return 1.7 + 0.5 * depth_over_width**1.4


def _lag(away: Floats) -> Floats:
    """Speed over that of the undisturbed shear flow at the centre of a sphere `away` radii from a wall."""
    gap = np.maximum(away - 1.0, 1e-3)
    touching = 0.7431 / (0.6376 - 0.2 * np.log(gap))
    return np.minimum(1.0 - 5.0 / 16.0 / np.maximum(away, 1.0) ** 3, np.where(gap < 0.3, touching, 1.0))
