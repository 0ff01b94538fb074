"""Cells along the channels, and what a wrong resistance of each does to the flow.

A map can be wrong in places: a channel is narrower than drawn, deeper, partly blocked. Two things follow, and both
extend along the channel. The resistance of the place changes, and the flow redistributes between the branches; and at
the same flow rate the speed there changes with the cross-section. So the channels are covered by overlapping cells
about two channel widths long, and each cell has these two relative errors as unknowns. Their size is found from the
observations (evidence.py).
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import scipy  # its sparse loads at first use, not at start-up
from numpy.typing import NDArray

from flowrec.core import Floats
from flowrec.physics import Chip, Sensitivities, clearance_um, compute_cached, median_width_um

LENGTH_WIDTHS = 2.0  # reach of a cell in median channel widths: an error of a wall or of a depth is longer than wide
MOST = 40  # cells of a chip; in a larger one they are longer. Each costs one solution with the factors of the flow
LONGER = 1.3  # factor on the length while there are too many


def channel_cells(chip: Chip) -> Any:
    """(cells, n) sparse weights of each cell on the fluid pixels in raster order; their sum is 1 on each pixel."""
    # All depths and laws of a chip have the same cells.
    key = ("channel cells", chip.mask.shape, chip.mask.tobytes(), median_width_um(chip) / chip.um_per_px)
    return compute_cached(key, lambda: _channel_cells(chip))


def _channel_cells(chip: Chip) -> Any:
    graph, clearance = _pixel_graph(chip.mask), clearance_um(chip.mask, 1.0)[chip.mask]
    reach = LENGTH_WIDTHS * median_width_um(chip) / chip.um_per_px
    order = np.argsort(-clearance, kind="stable")
    while True:
        rows = _cover(graph, order, reach)
        if rows is not None:
            break
        reach *= LONGER
    weights = scipy.sparse.csr_array(np.stack(rows))
    return scipy.sparse.csr_array(weights @ scipy.sparse.diags_array(1.0 / np.maximum(weights.sum(axis=0), 1e-12)))


def cell_widening(chip: Chip, cells: Any) -> Floats:
    """(cells,) relative change of the width of each cell per pixel by which each of its two walls is off.

    The walls are off independently, so their distance varies by sqrt(2) times that. The width is twice the largest
    distance from a wall in the middle of the cell.
    """
    clearance = clearance_um(chip.mask, 1.0)[chip.mask].astype(np.float64)
    inside = np.where(np.isfinite(clearance), clearance, 0.5 * max(chip.mask.shape))
    weights = cells.toarray()
    half = np.where(weights > 0.5 * weights.max(axis=1, keepdims=True), inside, 0.0).max(axis=1)
    return np.asarray(np.sqrt(2.0) / (2.0 * np.maximum(half, 0.5)))


def steepness(mask: NDArray[np.bool_], velocity: Floats) -> Floats:
    """(n, 2) size of the gradient of each component of a compact velocity (n, 2), per pixel."""
    slopes = [0.5 * (ahead - behind) for ahead, behind in _neighbours(mask, velocity, np.arange(len(velocity)))]
    return np.asarray(np.hypot(*slopes))


def curvature(mask: NDArray[np.bool_], velocity: Floats, pixels: NDArray[np.intp]) -> Floats:
    """(k, 2) Laplacian of each component of a compact velocity (n, 2) in some of its pixels (k,), per square pixel."""
    both = (ahead + behind for ahead, behind in _neighbours(mask, velocity, pixels))
    return np.asarray(sum(both) - 4.0 * velocity[pixels])


def _neighbours(mask: NDArray[np.bool_], values: Floats, pixels: NDArray[np.intp]) -> Iterator[tuple[Floats, Floats]]:
    """Along each axis, the compact values (n, 2) at the next and at the previous pixel of some pixels (k,).

    The flow vanishes on a wall, half a pixel beyond the last fluid pixel: beyond it is minus that before it. Across the
    border of the image a channel goes on.
    """
    number = np.full(mask.shape, -1, np.intp)
    number[mask] = np.arange(len(values))
    number = np.pad(number, 1, constant_values=-2)
    place = np.flatnonzero(number >= 0)[pixels]
    here = values[pixels]
    for stride in (mask.shape[1] + 2, 1):
        sides = []
        for step in (stride, -stride):
            other = number.ravel()[place + step]
            side = values[np.maximum(other, 0)]
            side[other == -1] = -here[other == -1]
            side[other == -2] = here[other == -2]
            sides.append(side)
        yield sides[0], sides[1]


def _cover(graph: Any, order: NDArray[np.intp], reach: float) -> list[Floats] | None:
    """Unnormalised weights (n,) of each cell: a bell of the distance in the channel; None: more cells than allowed."""
    covered = np.zeros(len(order), bool)
    rows: list[Floats] = []
    for pixel in order:
        if covered[pixel]:
            continue
        if len(rows) == MOST:
            return None
        distance = scipy.sparse.csgraph.dijkstra(graph, directed=False, indices=int(pixel), limit=2.5 * reach)
        rows.append(np.where(np.isfinite(distance), np.exp(-2.0 * (distance / reach) ** 2), 0.0))
        covered |= distance <= reach
    return rows


def _pixel_graph(mask: NDArray[np.bool_]) -> Any:
    """(n, n) distances in px between the fluid pixels and their eight neighbours."""
    number = np.full(mask.shape, -1, np.int64)
    number[mask] = np.arange(np.count_nonzero(mask))
    steps = (
        (number[:, :-1], number[:, 1:], 1.0),
        (number[:-1], number[1:], 1.0),
        (number[:-1, :-1], number[1:, 1:], np.sqrt(2.0)),
        (number[:-1, 1:], number[1:, :-1], np.sqrt(2.0)),
    )
    rows, columns, lengths = [], [], []
    for one, two, length in steps:
        both = (one >= 0) & (two >= 0)
        rows.append(one[both])
        columns.append(two[both])
        lengths.append(np.full(np.count_nonzero(both), length))
    count = int(number.max()) + 1
    return scipy.sparse.csr_array(
        (np.concatenate(lengths), (np.concatenate(rows), np.concatenate(columns))), (count, count)
    )


def resistance_modes(expansion: Sensitivities, cells: Any) -> Floats:
    """(cells, n, 2) um/s: change of the flow per relative change of the viscous resistance in each cell.

    The resistance A (1 + a w) with the weight w of a cell adds the force -a w A q to the linearised equations. In a
    channel A q is the pressure gradient, the same all over the cross-section, so the profile keeps its shape.
    """
    equations = expansion.equations
    curl = equations.stream.curl
    on_faces = _face_average(expansion) @ cells.T.toarray()
    # The residual at rest of all that drives a flow, without inertia, is the viscous force.
    viscous = equations.residual(expansion.flux, np.zeros(expansion.openings), 0.0)
    push = -on_faces * viscous[:, None]
    flux = curl @ expansion.factors.solve(np.ascontiguousarray(curl.T @ push))
    modes = np.ascontiguousarray((equations.momentum.centre @ flux).T) * 1e6
    return np.asarray(modes.reshape(cells.shape[0], -1, 2))


def _face_average(expansion: Sensitivities) -> Any:
    """(faces, n): the mean of the fluid pixels on either side of each face; 0 for a face without any."""
    grid = expansion.equations.grid
    number = np.full(grid.mask.shape, -1, np.int64)
    number[grid.mask] = np.arange(np.count_nonzero(grid.mask))
    pixel = np.repeat(np.repeat(number, grid.k, axis=0), grid.k, axis=1)
    rows, columns = [], []
    for numbers, sides in (
        (
            grid.u.number,
            (np.pad(pixel, ((0, 0), (1, 0)), constant_values=-1), np.pad(pixel, ((0, 0), (0, 1)), constant_values=-1)),
        ),
        (
            grid.v.number,
            (np.pad(pixel, ((1, 0), (0, 0)), constant_values=-1), np.pad(pixel, ((0, 1), (0, 0)), constant_values=-1)),
        ),
    ):
        for side in sides:
            both = (numbers >= 0) & (side >= 0)
            rows.append(numbers[both])
            columns.append(side[both])
    at, beside = np.concatenate(rows), np.concatenate(columns)
    count = np.bincount(at, minlength=grid.faces)
    return scipy.sparse.csr_array((1.0 / count[at], (at, beside)), shape=(grid.faces, int(number.max()) + 1))
