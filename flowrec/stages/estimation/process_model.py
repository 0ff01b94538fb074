"""Process model of the Kalman filter: how robot and flow change from one frame to the next.

State [x, y, vx, vy], then, where they are estimated, the gradient of the flow [dvx/dx, dvx/dy, dvy/dx] and the robot's
um per revolution k. With turns n of the field, x' = x + v dt + k n. There are three models of the flow:

- random walk: v' = v, all change is noise;
- gradient: v' = v + S (x' - x) with S = [[sxx, sxy], [syx, -sxx]], which is free of divergence: the flow is steady and
  smooth, so its change along the way follows from the displacement;
- map: v' = v + m(x') - m(x) with a known map m that may be wrong by a constant. The state is the whole flow, so it does
  not jump when another map is adopted.

The last two are not linear: the filter is an extended one, with the midpoint rule for the displacement.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from flowrec.core import Floats, Floats32, FlowField, compiled
from flowrec.physics import MapRaster, raster_velocity

ISOTROPIC = np.array([0.5, 1.0, 1.0])  # relative variances of [sxx, sxy, syx] that do not depend on the axes
_XX, _XY, _YX = ISOTROPIC.tolist()


class StateLayout(NamedTuple):
    """Components of a state besides position and flow."""

    gradient: bool
    gain: bool  # um per revolution

    @property
    def size(self) -> int:
        """Length of the state."""
        return 4 + 3 * self.gradient + self.gain


def propagate(
    state: Floats,
    layout: StateLayout,
    turns: Floats,
    um_per_rev: float,
    dt: float,
    field: FlowField | None,
    constant_flow: bool,
) -> tuple[Floats, Floats]:
    """The state (n,) after dt and its Jacobian (n, n).

    Parameters
    ----------
    um_per_rev : used where the state has no gain of its own.
    constant_flow : ignore the gradient: it is valid over a frame, but not while the robot is out of sight.
    """
    rolled_um = float(state[-1]) if layout.gain else um_per_rev
    raster = MapRaster.of(field)
    return _propagate(state, layout.gradient, layout.gain, constant_flow, turns, rolled_um, dt, *raster)


@compiled
def _propagate(
    state: Floats,
    has_gradient: bool,
    has_gain: bool,
    constant_flow: bool,
    turns: Floats,
    um_per_rev: float,
    dt: float,
    velocity: Floats32,
    wall_px: Floats32,
    um_per_px: float,
    registration: Floats,
) -> tuple[Floats, Floats]:
    n = len(state)
    ahead, jacobian = state.copy(), np.zeros((n, n))
    for k in range(n):
        jacobian[k, k] = 1.0
    x, y, vx, vy = state[0], state[1], state[2], state[3]
    moved_x, moved_y = um_per_rev * turns[0], um_per_rev * turns[1]
    dx, dy = moved_x + dt * vx, moved_y + dt * vy
    xx, xy, yx, yy = 0.0, 0.0, 0.0, 0.0
    if velocity.size > 0:
        hx, hy = raster_velocity(velocity, wall_px, um_per_px, registration, x, y)
        mx, my = raster_velocity(velocity, wall_px, um_per_px, registration, x + 0.5 * dx, y + 0.5 * dy)
        ahead[0], ahead[1] = x + moved_x + dt * (vx + mx - hx), y + moved_y + dt * (vy + my - hy)
        ex, ey = raster_velocity(velocity, wall_px, um_per_px, registration, ahead[0], ahead[1])
        ahead[2], ahead[3] = vx + ex - hx, vy + ey - hy
        xx, xy, yx, yy = _gradient(velocity, wall_px, um_per_px, registration, ahead[0], ahead[1])
    else:
        if has_gradient and not constant_flow:
            xx, xy, yx, yy = state[4], state[5], state[6], -state[4]
        cx, cy = xx * dx + xy * dy, yx * dx + yy * dy
        ahead[0], ahead[1] = x + dx + 0.5 * dt * cx, y + dy + 0.5 * dt * cy
        ahead[2], ahead[3] = vx + cx, vy + cy
    jacobian[0, 2] = jacobian[1, 3] = dt
    jacobian[2, 2] += dt * xx
    jacobian[2, 3] = dt * xy
    jacobian[3, 2] = dt * yx
    jacobian[3, 3] += dt * yy
    if has_gradient:
        jacobian[2, 4], jacobian[2, 5], jacobian[3, 6], jacobian[3, 4] = dx, dy, dx, -dy
    if has_gain:
        jacobian[0, n - 1], jacobian[1, n - 1] = turns[0], turns[1]
        jacobian[2, n - 1] = xx * turns[0] + xy * turns[1]
        jacobian[3, n - 1] = yx * turns[0] + yy * turns[1]
    return ahead, jacobian


@compiled
def advance_covariance(
    covariance: Floats,
    jacobian: Floats,
    has_gradient: bool,
    has_gain: bool,
    dt: float,
    flow: float,
    gradient: float,
    gain: float,
    drift: float,
) -> Floats:
    """F P F^T + Q (n, n): the covariance after a step, with what the step adds.

    Parameters
    ----------
    flow : variance, um2/s2, of a white acceleration over dt, which also displaces the robot.
    gradient, gain : variances, 1/s2 and um2.
    drift : variance of the position per time, um2/s.
    """
    n = len(covariance)
    carried, after = np.zeros((n, n)), np.zeros((n, n))
    for i in range(n):
        for j in range(n):
            for k in range(n):
                carried[i, j] += jacobian[i, k] * covariance[k, j]
    for i in range(n):
        for j in range(n):
            for k in range(n):
                after[i, j] += carried[i, k] * jacobian[j, k]
    for axis in (0, 1):
        after[axis, axis] += flow * dt**2 / 3.0 + drift * dt
        after[axis, axis + 2] += flow * dt / 2.0
        after[axis + 2, axis] += flow * dt / 2.0
        after[axis + 2, axis + 2] += flow
    if has_gradient:
        after[4, 4] += gradient * _XX
        after[5, 5] += gradient * _XY
        after[6, 6] += gradient * _YX
    if has_gain:
        after[n - 1, n - 1] += gain
    return after


@compiled
def _gradient(
    velocity: Floats32, wall_px: Floats32, um_per_px: float, registration: Floats, x_um: float, y_um: float
) -> tuple[float, float, float, float]:
    half = 0.5 * um_per_px
    ax, ay = raster_velocity(velocity, wall_px, um_per_px, registration, x_um + half, y_um)
    bx, by = raster_velocity(velocity, wall_px, um_per_px, registration, x_um - half, y_um)
    cx, cy = raster_velocity(velocity, wall_px, um_per_px, registration, x_um, y_um + half)
    ex, ey = raster_velocity(velocity, wall_px, um_per_px, registration, x_um, y_um - half)
    return (ax - bx) / um_per_px, (cx - ex) / um_per_px, (ay - by) / um_per_px, (cy - ey) / um_per_px


def gradient_at(field: FlowField, x_um: float, y_um: float) -> tuple[float, float, float, float]:
    """dvx/dx, dvx/dy, dvy/dx, dvy/dy of a map in 1/s, by central differences over one of its pixels."""
    return _gradient(*MapRaster.of(field), x_um, y_um)
