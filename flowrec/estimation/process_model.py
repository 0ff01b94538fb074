"""How robot and flow go on from one frame to the next, in the Kalman filter's state.

State [x, y, vx, vy], then where they are estimated the slopes of the flow [dvx/dx, dvx/dy, dvy/dx] and the robot's
um per revolution k. With turns n of the field, x' = x + v dt + k n. The flow itself goes on in one of three ways:

- walk: v' = v, all change is noise;
- slopes: v' = v + S (x' - x) with S = [[sxx, sxy], [syx, -sxx]], which has no divergence: the flow is steady and
  smooth, so what changes along the way is told by where the robot goes;
- map: v' = v + m(x') - m(x) with a known map m, whatever constant the map misses. The state stays the whole flow, so
  nothing jumps when another map is adopted.

The last two are not linear: an extended filter, with the midpoint rule for the way.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from flowrec.flow import sample
from flowrec.messages import FlowField

Floats = NDArray[np.float64]

ISOTROPIC = np.array([0.5, 1.0, 1.0])  # variances of [sxx, sxy, syx] that are the same along any axes


@dataclass(frozen=True, slots=True)
class Layout:
    """What a state holds besides position and flow."""

    slopes: bool
    gain: bool

    @property
    def size(self) -> int:
        """Length of the state."""
        return 4 + 3 * self.slopes + self.gain


def onward(
    state: Floats, layout: Layout, turns: Floats, um_per_rev: float, dt: float, field: FlowField | None, held: bool
) -> tuple[Floats, Floats]:
    """The state (n,) after dt and its derivative (n, n) by the state before.

    `um_per_rev` counts where the state has no gain of its own. `held` keeps the flow as it is: an extrapolation by
    slopes is worth something over a frame, not while the robot is out of sight.
    """
    position, flow = state[:2], state[2:4]
    moved = (float(state[-1]) if layout.gain else um_per_rev) * turns
    way = moved + dt * flow
    slope = np.zeros((2, 2))
    ahead = state.copy()
    if field is not None:
        here = sample(field, position)
        middle = flow + sample(field, position + 0.5 * way) - here
        ahead[:2] = position + moved + dt * middle
        ahead[2:4] = flow + sample(field, ahead[:2]) - here
        slope = slope_of(field, ahead[:2])
    else:
        if layout.slopes and not held:
            slope = np.array([[state[4], state[5]], [state[6], -state[4]]])
        change = slope @ way
        ahead[:2] = position + way + 0.5 * dt * change
        ahead[2:4] = flow + change
    step = np.eye(layout.size)
    step[0, 2] = step[1, 3] = dt
    step[2:4, 2:4] += dt * slope
    if layout.slopes:
        step[2, 4], step[2, 5], step[3, 6], step[3, 4] = way[0], way[1], way[0], -way[1]
    if layout.gain:
        step[:2, -1] = turns
        step[2:4, -1] = slope @ turns
    return ahead, step


def noise(layout: Layout, dt: float, flow: float, slope: float, gain: float, drift: float) -> Floats:
    """(n, n) covariance of what one step adds: variances of flow (um2/s2), slopes (1/s2) and gain, and um2/s of drift.

    The flow's is a white acceleration over dt, which also moves the robot.
    """
    matrix = np.zeros((layout.size, layout.size))
    for axis in (0, 1):
        matrix[axis, axis] = flow * dt**2 / 3.0 + drift * dt
        matrix[axis, axis + 2] = matrix[axis + 2, axis] = flow * dt / 2.0
        matrix[axis + 2, axis + 2] = flow
    if layout.slopes:
        matrix[4, 4], matrix[5, 5], matrix[6, 6] = slope * ISOTROPIC
    if layout.gain:
        matrix[-1, -1] = gain
    return matrix


def slope_of(field: FlowField, point_um: Floats) -> Floats:
    """(2, 2) 1/s: dv_i/dx_j of a map over one of its pixels."""
    right, down = np.array([[0.5, 0.0], [0.0, 0.5]]) * field.um_per_px
    by_x = sample(field, point_um + right) - sample(field, point_um - right)
    by_y = sample(field, point_um + down) - sample(field, point_um - down)
    return np.column_stack((by_x, by_y)) / field.um_per_px
