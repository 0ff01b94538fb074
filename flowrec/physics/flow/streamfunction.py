"""Divergence-free flows: every admissible face flux is w = C z + B q with a stream function z.

The stream function is defined on the corners of the cells; the flux of a face is the difference between its two ends.
A wall has no flux, so all its corners have one value. An inlet has a prescribed flux, so its corners follow from one
another. The pressure drops out of C' (momentum), which leaves one small, well posed system, and mass is conserved to
rounding.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from flowrec.core import Floats, FlowError, Ints
from flowrec.physics.flow.assembly import Triplets, components
from flowrec.physics.flow.grid import WALL, Grid, number_where


@dataclass(frozen=True, slots=True, eq=False)
class StreamBasis:
    """The basis: w (faces,) = curl @ z + inflow @ values."""

    curl: Any  # C (faces, unknowns)
    inflow: Floats  # B (faces, openings): columns of outlets are zero


def assemble(grid: Grid) -> StreamBasis:
    """Basis of the divergence-free flows of a grid that satisfy walls and inlets.

    Raises FlowError if a part of the fluid has inlets only.
    """
    h, w = grid.fluid.shape
    corner = np.arange((h + 1) * (w + 1)).reshape(h + 1, w + 1)
    # w = psi[head] - psi[tail]: u = d psi/dy, v = -d psi/dx.
    tail = np.concatenate([corner[:-1].ravel(), corner[:, 1:].ravel()])
    head = np.concatenate([corner[1:].ravel(), corner[:, :-1].ravel()])
    wall = np.concatenate([grid.u.kind.ravel(), grid.v.kind.ravel()]) == WALL
    label = components(tail[wall], head[wall], corner.size)
    tail, head = label[tail[~wall]], label[head[~wall]]

    root, offset = _chain_inlets(grid, label[corner])
    # The gauge is the wall with most faces: its row would be the densest of the system.
    count = np.bincount(np.concatenate([root[tail], root[head]]))
    used = count > 0
    used[np.argmax(count)] = False
    unknown, unknowns = number_where(used, 0)
    entries = Triplets((grid.faces, unknowns))
    for end, sign in ((head, 1.0), (tail, -1.0)):
        entries.add(np.arange(grid.faces), unknown[root[end]], sign)
    curl = entries.matrix()
    curl.eliminate_zeros()
    # Row 0 of the table: corners without an offset.
    table = np.stack([np.zeros(len(grid.openings)), *offset.values()])
    place = np.zeros(len(root), np.int64)
    place[list(offset)] = np.arange(1, len(table))
    return StreamBasis(curl, table[place[head]] - table[place[tail]])


def _chain_inlets(grid: Grid, label: Ints) -> tuple[Ints, dict[int, Floats]]:
    """Connect the corners of inlets: root of every label, and its offset (openings,) where there is one.

    psi[label] = psi[root] + offset @ values.
    """
    openings = len(grid.openings)
    root = np.arange(int(label.max()) + 1)
    offset: dict[int, Floats] = {}
    members: dict[int, list[int]] = {}
    for index, opening in enumerate(grid.openings):
        if opening.kind != "inlet":
            continue
        corners = label[opening.vertices].tolist()
        for a, b, flux in zip(corners[:-1], corners[1:], opening.profile, strict=True):
            root_a, root_b = int(root[a]), int(root[b])
            if root_a == root_b:
                raise FlowError(
                    f"inlet {index} ({opening.side}) leads into fluid without an outlet: make one of its openings one"
                )
            shift = offset.get(a, np.zeros(openings)).copy()
            shift[index] += opening.streamfunction_sign * flux
            shift -= offset.get(b, np.zeros(openings))
            for node in members.pop(root_b, [root_b]):
                offset[node] = offset.get(node, np.zeros(openings)) + shift
                root[node] = root_a
                members.setdefault(root_a, [root_a]).append(node)
    return root, offset
