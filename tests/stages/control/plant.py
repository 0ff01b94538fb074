"""A robot in a flow that is known in closed form, 1 kHz, with delayed commands, and an observer to close the loop."""

from collections import deque
from dataclasses import dataclass

import numpy as np

from flowrec.core import Estimate, FlowField, Mission, Route, nanoseconds
from flowrec.physics import Robot

CENTRE_UM = np.array([2500.0, 2500.0])
ROBOT = Robot(radius_um=50.0, max_speed_um_s=2000.0, step_out_hz=200.0, step_out_margin=1.0, delay_s=0.04)


def field_of(velocity, h=101, w=101, um_per_px=50.0):
    """A field (h, w) of velocity(x, y) -> (vx, vy), um/s."""
    y, x = np.mgrid[0:h, 0:w] * um_per_px
    vx, vy = velocity(x, y)
    flow = np.stack([np.broadcast_to(vx, (h, w)), np.broadcast_to(vy, (h, w))], -1)
    return FlowField(0, 0, "made up", um_per_px, flow, np.zeros((h, w)), None, np.zeros(0), 1.0, 1000.0, "")


def vortex(x, y):
    """The paper's v = [-0.2 y, 0.2 x] about the centre."""
    return -0.2 * (y - CENTRE_UM[1]), 0.2 * (x - CENTRE_UM[0])


def mission(phase="navigate", since_ns=0, finished=False):
    zero = np.zeros(2)
    return Mission(since_ns, phase, since_ns, 1, "", 0, zero, zero, finished, "", "")


def lemniscate(turns=2, period_s=40.0, a_um=1800.0, b_um=1500.0):
    """The paper's reference as a route."""
    time = np.linspace(0.0, turns * period_s, turns * 4000 + 1)
    theta = 2.0 * np.pi * time / period_s
    spread = 1.0 + np.sin(theta) ** 2
    points = np.stack([a_um * np.cos(theta), b_um * np.sin(theta) * np.cos(theta)], -1) / spread[:, None]
    return Route(0, 1, "lemniscate", True, "", points + CENTRE_UM, time)


def straight(length_um=3000.0, speed_um_s=300.0, start_um=(500.0, 2500.0)):
    along = np.linspace(0.0, length_um, 301)
    return Route(0, 1, "straight", True, "", np.stack([along, 0 * along], -1) + start_um, along / speed_um_s)


@dataclass
class Run:
    time_s: np.ndarray
    position_um: np.ndarray
    demands: list
    estimates: list

    def error_um(self, route):
        reference = [np.interp(self.time_s, route.arrival_s, route.waypoints_um[:, i]) for i in (0, 1)]
        return np.hypot(*(np.stack(reference, -1) - self.position_um).T)


def fly(controller, route, flow, duration_s, start_um, field, **options):
    """Drive the plant; `flow(x, y)` is the true one, `field` what the controller is told.

    `noise_um` of the camera, `blind` (from, to) s, `robot`, `clearance` (raster, um_per_px), `seed`.
    """
    robot, noise_um = options.get("robot", ROBOT), options.get("noise_um", 0.0)
    raster, um_per_px = options.get("clearance", (None, 1.0))
    blind = options.get("blind", (np.inf, np.inf))
    rng = np.random.default_rng(options.get("seed", 0))
    frame_ms, delay_ms = 33, round(1000 * robot.delay_s)
    position, demand = np.array(start_um, np.float64), None
    pending = deque([np.zeros(2)] * (delay_ms + 1), maxlen=delay_ms + 1)
    state, spread, moved = np.r_[position, 0.0, 0.0], np.diag([noise_um**2 + 1.0] * 2 + [300.0**2] * 2), np.zeros(2)
    run = Run([], [], [], [])
    for ms in range(round(1000 * duration_s)):
        if ms % frame_ms == 0:
            seen = not blind[0] <= ms / 1000 < blind[1]
            if ms:
                state, spread = _observe(state, spread, moved, frame_ms / 1000)
            if seen:
                state, spread = _correct(state, spread, position + noise_um * rng.standard_normal(2), noise_um)
            moved = np.zeros(2)
            stamp = nanoseconds(ms / 1000)
            estimate = Estimate(stamp, state[:2], state[2:], spread, 2.0, state[:2], seen)
            mission_now = options.get("mission", mission())
            demand = controller.control(demand, mission_now, route, estimate, field, robot, raster, um_per_px)
            run.demands.append(demand)
            run.estimates.append(estimate)
        pending.append(demand.velocity_um_s)
        applied = pending[0]
        moved = moved + 0.001 * applied
        position = position + 0.001 * (applied + np.array(flow(*position)))
        run.time_s.append((ms + 1) / 1000)
        run.position_um.append(position)
    return Run(np.array(run.time_s), np.array(run.position_um), run.demands, run.estimates)


def _observe(state, spread, moved, dt):
    step = np.eye(4)
    step[0, 2] = step[1, 3] = dt
    q, noise = 1e3, np.zeros((4, 4))  # random-walk flow, um2/s3
    for i in (0, 1):
        noise[i, i], noise[i, i + 2], noise[i + 2, i], noise[i + 2, i + 2] = (
            q * dt**3 / 3 + 0.1,
            q * dt**2 / 2,
            q * dt**2 / 2,
            q * dt,
        )
    return step @ state + np.r_[moved, 0.0, 0.0], step @ spread @ step.T + noise


def _correct(state, spread, measured, noise_um):
    gain = spread[:, :2] @ np.linalg.inv(spread[:2, :2] + (noise_um**2 + 0.01) * np.eye(2))
    return state + gain @ (measured - state[:2]), spread - gain @ spread[:2]
