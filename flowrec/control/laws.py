"""The control laws: from reference and position to the velocity asked of the robot, relative to the fluid.

All vectors are (2,) in um and um/s.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

Vector = NDArray[np.float64]


def vector_law(error_um: Vector, moving_um_s: Vector, flow_um_s: Vector, kp_per_s: float, limit_um_s: float) -> Vector:
    """u = sat(xd_dot - v + Kp (xd - x)), `error_um` being xd - x and `moving_um_s` xd_dot."""
    return saturate(moving_um_s + kp_per_s * error_um, flow_um_s, limit_um_s)


def saturate(ground_um_s: Vector, flow_um_s: Vector, limit_um_s: float) -> Vector:
    """The demand within the limit that moves the robot along the wanted ground velocity, if slower than wanted.

    The robot is to stay on its course, so the flow across it is cancelled first: among the u = s g - v that the
    limit allows, that with s nearest to 1. Where the flow across alone is too fast, all goes against it.
    """
    demand = ground_um_s - flow_um_s
    if math.hypot(demand[0], demand[1]) <= limit_um_s:
        return demand
    gg = float(ground_um_s @ ground_um_s)
    if gg <= 0.0:
        return _shortened(demand, limit_um_s)
    gv = float(ground_um_s @ flow_um_s)
    root = gv * gv - gg * (float(flow_um_s @ flow_um_s) - limit_um_s**2)
    spread = math.sqrt(root) if root > 0.0 else 0.0
    s = min(max(1.0, (gv - spread) / gg), (gv + spread) / gg)
    return _shortened(s * ground_um_s - flow_um_s, limit_um_s)


def ff_fb_law(
    error_um: Vector, moving_um_s: Vector, flow_um_s: Vector, kp_per_s: float, limit_um_s: float, dt_s: float
) -> Vector:
    """The paper's feedforward-feedback law, made sound.

    u = u_ff + Kp (e cos phi + e sin phi) at the heading phi, which is the average of that of the feedforward
    xd_dot - v and that of the error, weighted by the errors along and across the reference's heading. As printed,
    but for: the average is that of directions on the circle, without an error it is the feedforward's, and the
    whole is kept within the limit (science.md, section 5). e is xd - x - v dt.
    """
    e = error_um - flow_um_s * dt_s
    forward = moving_um_s - flow_um_s
    course = math.atan2(moving_um_s[1], moving_um_s[0])
    along = abs(math.cos(course) * e[0] + math.sin(course) * e[1])
    across = abs(-math.sin(course) * e[0] + math.cos(course) * e[1])
    ahead, back = math.atan2(forward[1], forward[0]), math.atan2(e[1], e[0])
    share = across / (along + across) if along + across > 1e-9 else 0.0
    turn = math.atan2(math.sin(back - ahead), math.cos(back - ahead))
    heading = ahead + share * turn
    unit = np.array([math.cos(heading), math.sin(heading)])
    return _shortened((math.hypot(forward[0], forward[1]) + kp_per_s * float(e @ unit)) * unit, limit_um_s)


def _shortened(vector: Vector, limit: float) -> Vector:
    length = math.hypot(vector[0], vector[1])
    return vector if length <= limit else vector * (limit / length)
