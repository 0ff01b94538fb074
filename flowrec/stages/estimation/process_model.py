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

from dataclasses import dataclass

import numpy as np

from flowrec.core import Floats, FlowField
from flowrec.physics import sample_as_seen

ISOTROPIC = np.array([0.5, 1.0, 1.0])  # relative variances of [sxx, sxy, syx] that do not depend on the axes


@dataclass(frozen=True, slots=True)
class StateLayout:
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
    position, flow = state[:2], state[2:4]
    moved = (float(state[-1]) if layout.gain else um_per_rev) * turns
    displacement = moved + dt * flow
    gradient = np.zeros((2, 2))
    ahead = state.copy()
    if field is not None:
        here = sample_as_seen(field, position)
        middle = flow + sample_as_seen(field, position + 0.5 * displacement) - here
        ahead[:2] = position + moved + dt * middle
        ahead[2:4] = flow + sample_as_seen(field, ahead[:2]) - here
        gradient = gradient_at(field, ahead[:2])
    else:
        if layout.gradient and not constant_flow:
            gradient = np.array([[state[4], state[5]], [state[6], -state[4]]])
        change = gradient @ displacement
        ahead[:2] = position + displacement + 0.5 * dt * change
        ahead[2:4] = flow + change
    jacobian = np.eye(layout.size)
    jacobian[0, 2] = jacobian[1, 3] = dt
    jacobian[2:4, 2:4] += dt * gradient
    if layout.gradient:
        dx, dy = displacement
        jacobian[2, 4], jacobian[2, 5], jacobian[3, 6], jacobian[3, 4] = dx, dy, dx, -dy
    if layout.gain:
        jacobian[:2, -1] = turns
        jacobian[2:4, -1] = gradient @ turns
    return ahead, jacobian


def process_noise(layout: StateLayout, dt: float, flow: float, gradient: float, gain: float, drift: float) -> Floats:
    """(n, n) covariance that one step adds.

    Parameters
    ----------
    flow : variance, um2/s2, of a white acceleration over dt, which also displaces the robot.
    gradient, gain : variances, 1/s2 and um2.
    drift : variance of the position per time, um2/s.
    """
    matrix = np.zeros((layout.size, layout.size))
    for axis in (0, 1):
        matrix[axis, axis] = flow * dt**2 / 3.0 + drift * dt
        matrix[axis, axis + 2] = matrix[axis + 2, axis] = flow * dt / 2.0
        matrix[axis + 2, axis + 2] = flow
    if layout.gradient:
        matrix[4, 4], matrix[5, 5], matrix[6, 6] = gradient * ISOTROPIC
    if layout.gain:
        matrix[-1, -1] = gain
    return matrix


def gradient_at(field: FlowField, point_um: Floats) -> Floats:
    """(2, 2) 1/s: dv_i/dx_j of a map, central differences over one of its pixels."""
    right, down = np.array([[0.5, 0.0], [0.0, 0.5]]) * field.um_per_px
    by_x = sample_as_seen(field, point_um + right) - sample_as_seen(field, point_um - right)
    by_y = sample_as_seen(field, point_um + down) - sample_as_seen(field, point_um - down)
    return np.column_stack((by_x, by_y)) / field.um_per_px
