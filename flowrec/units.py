"""Units are part of every name (`_um`, `_um_s`, `_pa`); the factors between them stand here once.

The flow solver alone works in SI; everything else in um, um/s, s, rad, Hz, mT, Pa, mPa*s, kg/m3, A.
"""

import math

NS_PER_S = 1_000_000_000
M_PER_UM = 1e-6
UM_PER_M = 1e6
PA_S_PER_MPA_S = 1e-3


def seconds(stamp_ns: int) -> float:
    """A stamp or a difference of stamps in s."""
    return stamp_ns / NS_PER_S


def nanoseconds(time_s: float) -> int:
    """The nearest integer stamp to a time in s."""
    return round(time_s * NS_PER_S)


def wrap_rad(angle_rad: float) -> float:
    """The same angle within (-pi, pi]."""
    return math.pi - (math.pi - angle_rad) % (2.0 * math.pi)
