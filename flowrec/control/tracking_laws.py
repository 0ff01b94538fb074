"""The control laws: from the error of the position to the velocity asked of the robot.

All vectors are (2,) in um and um/s; the flow is what the controller believes of it.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

Vector = NDArray[np.float64]


def vector_law(error_um: Vector, moving_um_s: Vector, kp_per_s: float) -> Vector:
    """The velocity over ground xd_dot + Kp (xd - x); `saturated` makes u = sat(xd_dot - v + Kp (xd - x)) of it."""
    return moving_um_s + kp_per_s * error_um


def saturated(ground_um_s: Vector, flow_um_s: Vector, limit_um_s: float) -> tuple[Vector, bool]:
    """The demand relative to the fluid for a velocity over ground, and whether the limit had to cut it.

    The robot is to stay on its course, so the flow across it is cancelled first: of all u = s g - v within the
    limit it is the one with s nearest to 1. Where the flow across alone is too fast, all goes against that.
    """
    demand = ground_um_s - flow_um_s
    if math.hypot(demand[0], demand[1]) <= limit_um_s:
        return demand, False
    gg = float(ground_um_s @ ground_um_s)
    if gg <= 0.0:
        return shortened(demand, limit_um_s)
    gv = float(ground_um_s @ flow_um_s)
    spread = math.sqrt(max(gv * gv - gg * (float(flow_um_s @ flow_um_s) - limit_um_s**2), 0.0))
    s = min(max(1.0, (gv - spread) / gg), (gv + spread) / gg)
    return shortened(s * ground_um_s - flow_um_s, limit_um_s)[0], True


def ff_fb_law(error_um: Vector, moving_um_s: Vector, flow_um_s: Vector, kp_per_s: float, dt_s: float) -> Vector:
    """The paper's feedforward-feedback law, made sound; u (2,), not yet within any limit.

    |u| = |xd_dot - v| + Kp (e_x cos phi + e_y sin phi), with the heading phi the average of those of xd_dot - v and
    of e = xd - x - v dt, weighted by the errors along and across the heading of xd_dot. As printed, but that the
    average is one of directions on the circle, and that of the feedforward where there is no error (science.md, 5).
    """
    return _ff_fb(_average_direction, error_um, moving_um_s, flow_um_s, kp_per_s, dt_s)


def ff_fb_literal_law(error_um: Vector, moving_um_s: Vector, flow_um_s: Vector, kp_per_s: float, dt_s: float) -> Vector:
    """The same as the paper prints it: the raw average of two angles, which wraps around. Only 0/0 is caught."""
    return _ff_fb(_average_angle, error_um, moving_um_s, flow_um_s, kp_per_s, dt_s)


def _ff_fb(
    average: Callable[[float, float, float], float],
    error_um: Vector,
    moving_um_s: Vector,
    flow_um_s: Vector,
    kp_per_s: float,
    dt_s: float,
) -> Vector:
    e = error_um - flow_um_s * dt_s
    forward = moving_um_s - flow_um_s
    course = math.atan2(moving_um_s[1], moving_um_s[0])
    along = abs(math.cos(course) * e[0] + math.sin(course) * e[1])
    across = abs(-math.sin(course) * e[0] + math.cos(course) * e[1])
    share = across / (along + across) if along + across > 1e-9 else 0.0
    heading = average(math.atan2(forward[1], forward[0]), math.atan2(e[1], e[0]), share)
    unit = np.array([math.cos(heading), math.sin(heading)])
    return (math.hypot(forward[0], forward[1]) + kp_per_s * float(e @ unit)) * unit


def _average_direction(ahead: float, back: float, share: float) -> float:
    """The heading a share of the shorter way round from one to another."""
    return ahead + share * math.atan2(math.sin(back - ahead), math.cos(back - ahead))


def _average_angle(ahead: float, back: float, share: float) -> float:
    """The mean of two numbers, which of 179 and -179 degrees is 0."""
    return (1.0 - share) * ahead + share * back


def shortened(vector: Vector, limit: float) -> tuple[Vector, bool]:
    """The vector at no more than a length, and whether it was longer."""
    length = math.hypot(vector[0], vector[1])
    return (vector, False) if length <= limit else (vector * (limit / length), True)
