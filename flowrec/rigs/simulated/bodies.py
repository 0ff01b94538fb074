"""Moving bodies in the simulated flow: the robot, and particles that a tracker must not follow.

The robot moves by xdot = u(f) (cos phi, sin phi) + v(x), the paper's kinematics, with the true flow at its centre;
where walls hinder it, as hindrance.py describes. Added is what the controller can not know: a rolling direction and a
speed that wander (Ornstein-Uhlenbeck process, correlation time one second), and a random walk of the position, of which
Brownian motion is a small part: by Stokes and Einstein D = k T / (6 pi mu a), so a sphere of 50 um radius in water
walks 0.09 um in a second. Particles drift with the flow or lie still.
"""

from __future__ import annotations

import math

import numpy as np

from flowrec.core import UM_PER_M, Bools, Floats, Floats32, FlowField, bilinear, compiled
from flowrec.physics import Chip, Robot, sample, velocity_at, walls_of
from flowrec.rigs.simulated.hindrance import FAXEN, NO_HINDRANCE, Around, Hindrance, hindered_velocity
from flowrec.rigs.simulated.pump import Pump
from flowrec.rigs.simulated.world import true_pump
from flowrec.stages import Simulated

_SUBSTEP_S = 1.0 / 240.0  # at least eight to a frame at 30 per second, at most 4 um at 1000 um/s
_CORRELATION_S = 1.0  # of the wander
_BOLTZMANN_J_K = 1.380649e-23


@compiled
def _moves(x: float, y: float, own_x: float, own_y: float, around: Around) -> tuple[float, float]:
    """Velocity of the robot at (x, y) um."""
    px, strength = around.um_per_px, around.strength
    if around.hindrance == 0.0:
        vx, vy = velocity_at(around.velocity, around.wall_px, x / px, y / px)
        return own_x + strength * vx, own_y + strength * vy
    flow = np.empty((4, 2))
    away = FAXEN * around.radius
    for n, (dx, dy) in enumerate(((away, 0.0), (-away, 0.0), (0.0, away), (0.0, -away))):
        vx, vy = velocity_at(around.velocity, around.wall_px, (x + dx) / px, (y + dy) / px)
        flow[n, 0] = strength * vx
        flow[n, 1] = strength * vy
    return hindered_velocity(x, y, own_x, own_y, flow, around)


@compiled
def _swim(
    x: float, y: float, own_x: float, own_y: float, dt: float, noise: Floats, around: Around
) -> tuple[float, float, int, float]:
    """Advance by len(noise) midpoint steps of dt. Returns x, y (um), steps that touched a wall, last clearance."""
    clearance, um_per_px, radius = around.clearance, around.um_per_px, around.radius
    touched = 0
    free = 0.0
    for n in range(noise.shape[0]):
        # Midpoint rule in the flow, then the random walk.
        wx, wy = _moves(x, y, own_x, own_y, around)
        wx, wy = _moves(x + 0.5 * dt * wx, y + 0.5 * dt * wy, own_x, own_y, around)
        x += dt * wx + noise[n, 0]
        y += dt * wy + noise[n, 1]
        free = bilinear(clearance, x / um_per_px, y / um_per_px)
        if free < radius:
            touched += 1
            # Pushed out along the gradient of the clearance: the robot slides along the wall.
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
    """Position and wall contacts of the robot.

    Parameters
    ----------
    robot : as it truly is.
    field, clearance_um : the steady flow; (h, w) from pixel centres to walls.
    pump : of the flow; None: made of `simulated`.
    hindrance : drag of the side walls.
    rng : of its noise; None: that of the first robot of the seed.
    """

    def __init__(
        self,
        position_um: tuple[float, float],
        robot: Robot,
        simulated: Simulated,
        field: FlowField,
        clearance_um: Floats32,
        um_per_px: float,
        pump: Pump | None = None,
        hindrance: Hindrance = NO_HINDRANCE,
        rng: np.random.Generator | None = None,
    ) -> None:
        self.position_um = np.array(position_um, np.float64)
        self.contacts = 0
        self.gone = False
        self._touching = False
        self._time_s = 0.0
        self._robot = robot
        self._pump = pump if pump is not None else true_pump(simulated)
        self._hindrance = hindrance
        # Of the random walk after a second; the fluid's viscosity is that of the field.
        diffusion = _BOLTZMANN_J_K * simulated.value("temperature_k") / (6.0 * math.pi * field.viscosity_mpa_s * 1e-3)
        brownian_um = math.sqrt(2.0 * diffusion / (robot.radius_um * 1e-6)) * UM_PER_M
        self._walk_um = math.hypot(simulated.value("position_noise_um"), brownian_um)
        self._heading_noise_rad: float = simulated.value("heading_noise_rad")
        self._speed_noise: float = simulated.value("speed_noise")
        self._field = field
        self._clearance = clearance_um
        self._um_per_px = um_per_px
        self._rng = np.random.default_rng([simulated.seed, 1]) if rng is None else rng
        self._wander = np.zeros(2)  # heading, speed: in standard deviations
        self._run(0.0, 0.0, 0.0, np.zeros((0, 2)))  # compiles, so that the second frame is not late

    @property
    def flow_um_s(self) -> Floats:
        """(2,) true flow at the centre; zero after it has left the chip."""
        if self.gone:
            return np.zeros(2)
        return self._pump.strength(self._time_s) * sample(self._field, self.position_um)

    @property
    def clearance_um(self) -> float:
        """From the surface to the nearest wall; NaN after it has left the chip."""
        if self.gone:
            return math.nan
        x, y = self.position_um / self._um_per_px
        return float(bilinear(self._clearance, x, y)) - self._robot.radius_um

    def wait(self, duration_s: float) -> None:
        """Stay in place for a duration, held by something else than the field."""
        self._time_s += duration_s

    def advance(self, duration_s: float, frequency_hz: float, heading_rad: float, strength: float) -> None:
        """Move for a duration under a constant field whose amplitude is `strength` times the full one.

        The torque is proportional to the amplitude, so the robot steps out at `strength` times the frequency. Without a
        field it only drifts.
        """
        if self.gone or duration_s <= 0:
            return
        self._time_s += duration_s
        steps = max(4, math.ceil(duration_s / _SUBSTEP_S))
        dt = duration_s / steps
        decay = math.exp(-duration_s / _CORRELATION_S)
        self._wander = decay * self._wander + math.sqrt(1 - decay**2) * self._rng.standard_normal(2)
        noise = self._rng.standard_normal((steps, 2)) * (self._walk_um * math.sqrt(dt))
        speed = strength * self._robot.rolled_speed_um_s(frequency_hz / strength) if strength > 0 else 0.0
        speed *= 1.0 + self._speed_noise * self._wander[1]
        heading = heading_rad + self._heading_noise_rad * self._wander[0]
        touched, free = self._run(speed * math.cos(heading), speed * math.sin(heading), dt, noise)
        # A contact ends when the robot is off the wall by a twentieth of its radius.
        if touched and not self._touching:
            self.contacts += 1
        self._touching = bool(touched) or (self._touching and free < 1.05 * self._robot.radius_um)
        height, width = self._clearance.shape
        column, row = self.position_um / self._um_per_px
        self.gone = not (-0.5 <= column <= width - 0.5 and -0.5 <= row <= height - 0.5)

    def _run(self, own_x: float, own_y: float, dt: float, noise: Floats) -> tuple[int, float]:
        around = Around(
            self._field.velocity_um_s,
            walls_of(self._field),
            self._pump.strength(self._time_s - 0.5 * dt * len(noise)),
            self._clearance,
            self._um_per_px,
            self._robot.radius_um,
            self._hindrance.share,
            self._hindrance.walls,
        )
        x, y = self.position_um.tolist()
        x, y, touched, free = _swim(x, y, own_x, own_y, dt, noise, around)
        self.position_um = np.array([x, y])
        return touched, free


@compiled
def carry(
    points: Floats,
    share: Floats,
    velocity: Floats32,
    wall_px: Floats32,
    clearance: Floats32,
    um_per_px: float,
    dt: float,
    lost: Bools,
) -> None:
    """Move points (n, 2) in um with shares (n,) of the flow by dt, in two steps; `lost` (n,): outside the fluid."""
    height, width = clearance.shape
    for n in range(points.shape[0]):
        for _ in range(2):
            i, j = points[n, 0] / um_per_px, points[n, 1] / um_per_px
            vx, vy = velocity_at(velocity, wall_px, i, j)
            points[n, 0] += 0.5 * dt * (share[n] * vx)
            points[n, 1] += 0.5 * dt * (share[n] * vy)
        i, j = points[n, 0] / um_per_px, points[n, 1] / um_per_px
        lost[n] = not (-0.5 <= i <= width - 0.5 and -0.5 <= j <= height - 0.5) or bilinear(clearance, i, j) < 0.0


class Carried:
    """Bodies that the flow carries: `points_um` (n, 2). One that has left the chip comes in again at an inlet."""

    points_um: Floats

    def __init__(self, chip: Chip, field: FlowField, clearance_um: Floats32, rng: np.random.Generator) -> None:
        self._chip, self._field, self._clearance, self._rng = chip, field, clearance_um, rng
        self._inlets = [opening for opening in chip.openings if opening.kind == "inlet"]

    def _scatter(self, count: int, room_um: float) -> None:
        """Draw their first places, with room for the largest: one that overlaps a wall would look wrong."""
        rows, columns = np.nonzero(self._chip.mask & (self._clearance > room_um))
        if not len(rows):
            rows, columns = np.nonzero(self._chip.mask)
        chosen = self._rng.integers(0, len(rows), count)
        places = np.stack((columns[chosen], rows[chosen]), -1) + self._rng.uniform(-0.5, 0.5, (count, 2))
        self.points_um = places * self._chip.um_per_px

    def _carry(self, share: Floats, dt_s: float) -> list[int]:
        """Move the first n of them by dt, each with its share (n,) of the flow; numbers of those that have left."""
        lost = np.zeros(len(share), np.bool_)
        carry(
            self.points_um[: len(share)],
            share,
            self._field.velocity_um_s,
            walls_of(self._field),
            self._clearance,
            self._chip.um_per_px,
            dt_s,
            lost,
        )
        return np.flatnonzero(lost).tolist()

    def _enter(self, n: int) -> None:
        """Let one come in at a drawn place: more enter where the inflow is faster."""
        inlet = self._inlets[int(self._rng.integers(len(self._inlets)))]
        # The mean of three uniform draws is nearly a parabola.
        along = inlet.first + (inlet.width_px - 1) * float(self._rng.random(3).mean())
        height, width = self._chip.mask.shape
        place = {
            "left": (0.0, along),
            "right": (width - 1.0, along),
            "top": (along, 0.0),
            "bottom": (along, height - 1.0),
        }[inlet.side]
        self.points_um[n] = np.array(place) * self._chip.um_per_px


class Debris(Carried):
    """`points_um` (n, 2), `radii_um` (n,) and `darkness` (n,) from 0 to 1; the last `still` of them never move."""

    def __init__(
        self, chip: Chip, count: int, robot_radius_um: float, field: FlowField, clearance_um: Floats32, seed: int
    ) -> None:
        super().__init__(chip, field, clearance_um, np.random.default_rng([seed, 2]))
        self.still = count // 6
        total = count + self.still
        self.radii_um = robot_radius_um * self._rng.uniform(0.3, 0.7, total)
        self.darkness = self._rng.uniform(0.15, 0.45, total)
        self._scatter(total, 0.7 * robot_radius_um)
        self._whole = np.ones(count)

    def drift(self, dt_s: float) -> None:
        """Move all by dt."""
        for n in self._carry(self._whole, dt_s):
            self._enter(n)
