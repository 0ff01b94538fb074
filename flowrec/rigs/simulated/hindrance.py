"""Drag of the walls on a sphere at small Reynolds numbers: its own motion, and how a flow carries it.

The robot is a sphere of radius a that rolls over the floor of the chip, beside one or two side walls. With l the
distance of its centre from a wall and g = l / a - 1 the gap in radii, the drag relative to Stokes' 6 pi mu a is

    along the wall     -8/15 ln g + 0.9543 - 64/375 g ln g + 0.4295 g    for g < 1
                       1 / (1 - 9/16 s + s^3/8 - 45/256 s^4 - s^5/16)    for g >= 1, s = a / l
    towards the wall   (6 g^2 + 9 g + 2) / (6 g^2 + 2 g)

The first is the lubrication limit of Goldman, Cox and Brenner, Chem. Eng. Sci. 22 (1967) 637, with the next terms of
Chaoui and Feuillebois, Q. J. Mech. Appl. Math. 56 (2003) 381; it is within 0.3 % of Goldman's exact values. The second
is Faxen's (1922), within 0.2 % there. The third is Bevan and Prieve's, J. Chem. Phys. 113 (2000) 1228, within 1.5 % of
Brenner's exact series. The drags of several walls are superposed, as Oseen did: excess adds to excess. In the middle of
a channel that is within 3 % of Faxen's formula for two walls up to a sphere of half its width.

A roller is driven by the floor, which also holds most of its drag, so a side wall slows it down less than a sphere that
is pulled through open fluid: by (floor) / (floor + excess of the side walls), in each direction. A force-free sphere of
50 um radius that rolls 25 um per revolution moves at 8 % of the speed of its surface, which by Goldman's formulas is at
a gap of 2.7 % of its radius over the floor; so the floor's drag is 2.9. Revolutions do not become fewer: they follow
the field. Torque and step-out change by at most a fifth (Jeffery 1915: 1.202 at contact) and are left as they are.

The flow carries a sphere of finite size with the mean over its surface, which is Faxen's law 1 + a^2 / 6 Laplacian; in
a plane that is the mean over four points at sqrt(2/3) a. A wall holds it back in proportion to the shear rate S at its
centre, by (1 - c) S l: c is the speed of a free sphere in a shear flow along a wall over that of the flow at its
centre, Goldman, Cox and Brenner, Chem. Eng. Sci. 22 (1967) 653, with the exact values of their table, and
1 - 5/16 (a / l)^3 far from the wall. The lags of two walls are added; in the middle of a channel there is no shear and
no lag, as in Happel and Brenner (1973), section 7-4, up to terms of (a / l)^5: 3 % for a sphere of half the width. What
carries the sphere towards the nearest wall is squeezed out of the gap like its own motion: of that component
g / (g + 1 / 3.23) is left. Near the wall that is 3.23 g, the force of a stagnation flow on a held sphere, 3.23 times
Stokes' (Goren and O'Neill, Chem. Eng. Sci. 26 (1971) 325), over the drag 1 / g. Without it a flow would press the robot
to a wall that it can not leave. The surface is not smooth: no gap is less than half a percent of the radius.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np

from flowrec.core import Floats, Floats32, bilinear, compiled

FLOOR_DRAG = 2.9  # of the roller over its floor, relative to Stokes' drag
FAXEN = math.sqrt(2.0 / 3.0)  # radii from the centre to the four points
_LEAST_GAP = 0.005  # roughness, in radii
_STAGNATION = 3.23  # force of a stagnation flow on a sphere at the wall over Stokes'
# Goldman, Cox and Brenner (1967, part II): speed of a free sphere over that of the shear flow at its centre, by ln gap.
_LAG_AT = np.log(np.array([0.003202, 0.005004, 0.0453, 0.1276, 0.5431, 1.3524, 2.7622, 9.0677]))
_LAG = np.array([0.45022, 0.47861, 0.65375, 0.76692, 0.92185, 0.97768, 0.99436, 0.9997])
_FARTHEST_WIDTHS = 4.0  # of the median channel: farther walls do not matter


@compiled
def drag_along(gap: float) -> float:
    """Drag along a plane wall over Stokes' drag, at a gap in radii."""
    gap = max(gap, _LEAST_GAP)
    if gap < 1.0:
        log = math.log(gap)
        return -8.0 / 15.0 * log + 0.954293724783876 - 64.0 / 375.0 * gap * log + 0.4294501325645 * gap
    s = 1.0 / (1.0 + gap)
    return 1.0 / (1.0 - 9.0 / 16.0 * s + s**3 / 8.0 - 45.0 / 256.0 * s**4 - s**5 / 16.0)


@compiled
def drag_towards(gap: float) -> float:
    """Drag of a motion towards a plane wall over Stokes' drag, at a gap in radii."""
    gap = max(gap, _LEAST_GAP)
    return (6.0 * gap * gap + 9.0 * gap + 2.0) / (6.0 * gap * gap + 2.0 * gap)


@compiled
def shear_mobility(gap: float) -> float:
    """Speed of a sphere that a shear flow carries along a wall over that of the flow at its centre, at a gap in radii.

    Beyond the table 1 - 5/16 (a / l)^3, of the method of reflections.
    """
    gap = max(gap, _LEAST_GAP)
    if gap > 9.0:
        return 1.0 - 5.0 / 16.0 / (1.0 + gap) ** 3
    at = math.log(gap)
    k = 0  # np.interp takes seconds to compile
    while at >= _LAG_AT[k + 1]:
        k += 1
    return float((_LAG[k + 1] - _LAG[k]) / (_LAG_AT[k + 1] - _LAG_AT[k]) * (at - _LAG_AT[k]) + _LAG[k])


@compiled
def approach_mobility(gap: float) -> float:
    """Speed of a sphere that a flow carries towards a wall over that of the flow, at a gap in radii."""
    gap = max(gap, _LEAST_GAP)
    return gap / (gap + 1.0 / _STAGNATION)


class Around(NamedTuple):
    """Flow and walls around a robot of a radius in um."""

    velocity: Floats32  # (h, w, 2) of the steady flow
    wall_px: Floats32
    strength: float  # of the flow now over the steady one
    clearance: Floats32  # (h, w) from pixel centres to walls, um
    um_per_px: float
    radius: float
    hindrance: float  # share of it, 0 to 1
    walls: Floats32  # as of `walls_around`


@compiled
def hindered_velocity(
    x: float, y: float, own_x: float, own_y: float, flow: Floats, around: Around
) -> tuple[float, float]:
    """Velocity of the robot at (x, y) um: own motion and flow, with a share of the hindrance.

    `flow` (4, 2) is the flow FAXEN radii to the right, left, below and above.
    """
    share, clearance, walls, radius = around.hindrance, around.clearance, around.walls, around.radius
    i, j = x / around.um_per_px, y / around.um_per_px
    near = bilinear(clearance, i, j)
    far = max(bilinear(walls[0], i, j) - near, near)
    near_gap, far_gap = near / radius - 1.0, far / radius - 1.0
    # The normal, away from the nearest wall, of its double angle.
    angle = 0.5 * math.atan2(bilinear(walls[2], i, j), bilinear(walls[1], i, j))
    nx, ny = math.cos(angle), math.sin(angle)
    if bilinear(clearance, i + nx, j + ny) < bilinear(clearance, i - nx, j - ny):
        nx, ny = -nx, -ny
    along = FLOOR_DRAG / (FLOOR_DRAG + drag_along(near_gap) + drag_along(far_gap) - 2.0)
    across = FLOOR_DRAG / (FLOOR_DRAG + drag_towards(near_gap) + drag_towards(far_gap) - 2.0)
    along, across = 1.0 - share * (1.0 - along), 1.0 - share * (1.0 - across)
    to_wall = (across - along) * (own_x * nx + own_y * ny)
    apart = 2.0 * FAXEN * radius
    lag = share * ((1.0 - shear_mobility(near_gap)) * near - (1.0 - shear_mobility(far_gap)) * far)
    mean_x, mean_y = flow[:, 0].mean(), flow[:, 1].mean()
    squeezed = share * (1.0 - approach_mobility(near_gap)) * (mean_x * nx + mean_y * ny)
    shear_x = (nx * (flow[0, 0] - flow[1, 0]) + ny * (flow[2, 0] - flow[3, 0])) / apart
    shear_y = (nx * (flow[0, 1] - flow[1, 1]) + ny * (flow[2, 1] - flow[3, 1])) / apart
    return (
        along * own_x + (to_wall - squeezed) * nx + mean_x - lag * shear_x,
        along * own_y + (to_wall - squeezed) * ny + mean_y - lag * shear_y,
    )


@dataclass(frozen=True, slots=True, eq=False)
class Hindrance:
    """Effect of the side walls on the robot: its strength, 0 to 1, and the walls (`walls_around`)."""

    share: float
    walls: Floats32


NO_HINDRANCE = Hindrance(0.0, np.zeros((3, 0, 0), np.float32))


def walls_around(clearance_um: Floats32, um_per_px: float) -> Floats32:
    """(3, h, w): from wall to wall through a pixel, um, along its normal; cosine and sine of twice the normal's angle.

    `clearance_um` (h, w) is the distance of pixel centres to the nearest wall. In the middle of a channel, where that
    has no gradient, the normal is that of the pixels around.
    """
    down, right = np.gradient(clearance_um.astype(np.float64))
    square, mixed = np.asarray(right**2 - down**2), np.asarray(2.0 * right * down)
    cosine, sine = (cv2.GaussianBlur(part, (0, 0), 1.5, borderType=cv2.BORDER_REPLICATE) for part in (square, mixed))
    angle = 0.5 * np.arctan2(sine, cosine)
    fluid = clearance_um > 0.0
    limit_um = _FARTHEST_WIDTHS * 2.0 * float(np.median(clearance_um[fluid])) if fluid.any() else 0.0
    width_um = np.zeros(clearance_um.shape)
    rows, columns = np.nonzero(fluid)
    step_px = 0.5
    for sign in (1.0, -1.0):
        dx, dy = sign * np.cos(angle[fluid]), sign * np.sin(angle[fluid])
        reached = np.zeros(len(rows))
        going = np.ones(len(rows), np.bool_)
        for n in range(1, max(2, math.ceil(limit_um / um_per_px / step_px))):
            x, y = columns[going] + n * step_px * dx[going], rows[going] + n * step_px * dy[going]
            nearest_row = np.clip(np.rint(y).astype(np.intp), 0, fluid.shape[0] - 1)
            nearest_column = np.clip(np.rint(x).astype(np.intp), 0, fluid.shape[1] - 1)
            inside = fluid[nearest_row, nearest_column]
            places = np.flatnonzero(going)
            reached[places[inside]] = n * step_px * um_per_px
            going[places[~inside]] = False
            if not going.any():
                break
        width_um[fluid] += reached
    # Steps end within the last fluid pixel: on the average a quarter of a step before the wall, on either side.
    width_um[fluid] = np.maximum(width_um[fluid] + 0.5 * step_px * um_per_px, 2.0 * clearance_um[fluid])
    return np.ascontiguousarray(np.stack((width_um, cosine, sine)), np.float32)
