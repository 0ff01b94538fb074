"""Extension of a time to go to the fluid nearer to the walls than the robot should be, so that -grad T leads back.

Layer by layer from the free pixels, a pixel gets the largest time of its neighbours one layer nearer to them, plus a
penalty for the clearance that it lacks. So no path through the band is shorter, and where two free regions meet in a
passage too narrow for the robot, the band is closed.
"""

from __future__ import annotations

import math

import numpy as np

from flowrec.core import compiled
from flowrec.stages.planning.cost_rasters import NEIGHBOUR_X, NEIGHBOUR_Y, Ints, Mask, Raster

# A lacking pixel of clearance costs this many times what a pixel takes in still fluid: then -grad T leads out of the
# band within some 20 degrees of straight.
_BAND_PENALTY = 3.0
_LEAST_PENALTY = 0.05  # px
# A step between neighbours that costs more than swimming this far connects two regions through too narrow a passage.
_TORN_PX = 30.0


def extend_to_walls(times: Raster, free: Mask, clearance: Raster, need: float, speed: float) -> Raster:
    """The times (h, w) with those of the fluid outside `free`; clearance and `need` in px, `speed` in px/s."""
    # A border of solid pixels without a time spares the kernel the question whether a neighbour exists.
    padded = np.pad(times, 1, constant_values=np.inf)
    solid = np.pad(clearance, 1, constant_values=-1.0)
    inside = np.pad(free, 1)
    # Breadth-first from the free pixels beside the band: the number of steps from them, -1 before they are counted.
    # Made here, because numba takes seconds to compile `where`.
    layer = np.where(inside, 0, -1)
    _fill_band(padded, inside, layer, solid, need, _BAND_PENALTY / speed, _TORN_PX / speed)
    band = padded[1:-1, 1:-1]
    # Beyond the border nothing is known, and no camera looks there: half a pixel counts as lacking.
    half = 0.5 * _BAND_PENALTY / speed
    for edge, inner in ((band[0], band[1]), (band[-1], band[-2]), (band[:, 0], band[:, 1]), (band[:, -1], band[:, -2])):
        np.maximum(edge, inner + half, out=edge, where=np.isfinite(edge) & np.isfinite(inner))
    return band


@compiled
def _fill_band(
    times: Raster, free: Mask, layer: Ints, clearance: Raster, need: float, penalty: float, torn: float
) -> None:
    """Set the times of the band in place; `layer` is 0 in free pixels, -1 elsewhere. Arrays have a solid border."""
    fluid = clearance > 0.0
    rows, columns, border, tail = _count_layers(times, free, fluid, layer)
    for m in range(border, tail):
        j = rows[m]
        i = columns[m]
        # Neighbours along the axes first: a diagonal one is also farther up or down the channel.
        for diagonal in range(2):
            worst = -1.0
            for k in range(diagonal, 8, 2):
                a = i + NEIGHBOUR_X[k]
                b = j + NEIGHBOUR_Y[k]
                if layer[b, a] == layer[j, i] - 1 and (fluid[j, a] or fluid[b, i]) and math.isfinite(times[b, a]):
                    lacking = max(min(clearance[b, a], need) - clearance[j, i], _LEAST_PENALTY)
                    worst = max(worst, times[b, a] + penalty * lacking)
            if worst >= 0.0:
                times[j, i] = worst
                break
    closed = np.zeros(tail, np.bool_)
    for m in range(border, tail):
        j = rows[m]
        i = columns[m]
        for k in range(8):
            a = i + NEIGHBOUR_X[k]
            b = j + NEIGHBOUR_Y[k]
            if math.isfinite(times[b, a]) and abs(times[b, a] - times[j, i]) > torn:
                closed[m] = closed[m] or fluid[j, a] or fluid[b, i]
    for m in range(border, tail):
        if closed[m]:
            times[rows[m], columns[m]] = math.inf


@compiled
def _count_layers(times: Raster, free: Mask, fluid: Mask, layer: Ints) -> tuple[Ints, Ints, int, int]:
    """Number the layers of the band in place, breadth first from the free pixels beside it.

    Returns
    -------
    rows, columns : pixels in the order of their layers: before `border` the free ones, up to `tail` those of the band.
    """
    h, w = free.shape
    rows = np.empty(h * w, np.int64)
    columns = np.empty(h * w, np.int64)
    tail = 0
    for j in range(1, h - 1):
        for i in range(1, w - 1):
            if not free[j, i] or not math.isfinite(times[j, i]):
                continue
            for k in range(8):
                a = i + NEIGHBOUR_X[k]
                b = j + NEIGHBOUR_Y[k]
                if fluid[b, a] and not free[b, a]:
                    rows[tail] = j
                    columns[tail] = i
                    tail += 1
                    break
    border = tail
    head = 0
    while head < tail:
        j = rows[head]
        i = columns[head]
        head += 1
        for k in range(8):
            a = i + NEIGHBOUR_X[k]
            b = j + NEIGHBOUR_Y[k]
            # Between two solid pixels that touch at their corners there is no way.
            if fluid[b, a] and layer[b, a] < 0 and (fluid[j, a] or fluid[b, i]):
                layer[b, a] = layer[j, i] + 1
                rows[tail] = b
                columns[tail] = a
                tail += 1
    return rows, columns, border, tail
