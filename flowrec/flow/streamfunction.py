"""Flows without divergence: every admissible face velocity is w = C z + B q with a stream function z.

The stream function lives on the corners of the cells; a face carries the difference of its two ends. A wall carries
nothing, so all its corners share one value; an inlet carries what it is told, so its corners follow from each other.
The pressure drops out of C' (momentum), which leaves one small, well posed system, and mass is conserved to rounding.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.sparse as sp
from scipy.sparse.csgraph import connected_components

from flowrec.errors import FlowError
from flowrec.flow.grid import WALL, Floats, Grid, Ints


@dataclass(frozen=True, slots=True, eq=False)
class Stream:
    """The basis: w (faces,) = curl @ z + inflow @ values."""

    curl: Any  # C (faces, unknowns)
    inflow: Floats  # B (faces, openings): columns of outlets are zero


def assemble(grid: Grid) -> Stream:
    """Basis of the divergence-free flows of a grid that obey walls and inlets.

    Raises
    ------
    FlowError
        If a part of the fluid has inlets only.
    """
    h, w = grid.fluid.shape
    corner = np.arange((h + 1) * (w + 1)).reshape(h + 1, w + 1)
    # w = psi[head] - psi[tail]: u = d psi/dy, v = -d psi/dx.
    tail = np.concatenate([corner[:-1].ravel(), corner[:, 1:].ravel()])
    head = np.concatenate([corner[1:].ravel(), corner[:, :-1].ravel()])
    wall = np.concatenate([grid.kind_u.ravel(), grid.kind_v.ravel()]) == WALL
    joined = sp.coo_array((np.ones(wall.sum(), bool), (tail[wall], head[wall])), shape=(corner.size, corner.size))
    _, label = connected_components(joined, directed=False)
    tail, head = label[tail[~wall]].astype(np.int64), label[head[~wall]].astype(np.int64)

    root, offset = _chain_inlets(grid, label[corner].astype(np.int64))
    openings, faces = len(grid.mouths), grid.faces
    # The gauge is the wall that most faces touch: it would be the densest row of the system.
    ends = np.concatenate([root[tail], root[head]])
    count = np.bincount(ends)
    gauge = int(np.argmax(count))
    unknown = np.full(len(root), -1, np.int64)
    used = np.flatnonzero(count)
    used = used[used != gauge]
    unknown[used] = np.arange(len(used))
    rows = np.arange(faces)
    parts = [(rows, unknown[root[head]], 1.0), (rows, unknown[root[tail]], -1.0)]
    curl = sum(
        sp.coo_array((np.full((c >= 0).sum(), s), (r[c >= 0], c[c >= 0])), shape=(faces, len(used)))
        for r, c, s in parts
    )
    # Row 0 of the table: corners that no inlet has moved.
    table = np.stack([np.zeros(openings), *offset.values()])
    place = np.zeros(len(root), np.int64)
    place[list(offset)] = np.arange(1, len(table))
    inflow = table[place[head]] - table[place[tail]]
    curl = sp.csr_array(curl)
    curl.eliminate_zeros()
    return Stream(curl, inflow)


def _chain_inlets(grid: Grid, label: Ints) -> tuple[Ints, dict[int, Floats]]:
    """Tie the corners of inlets together: root of every label, and its offset (openings,) where there is one.

    psi[label] = psi[root] + offset @ values.
    """
    openings = len(grid.mouths)
    root = np.arange(int(label.max()) + 1)
    offset: dict[int, Floats] = {}
    members: dict[int, list[int]] = {}
    for index, mouth in enumerate(grid.mouths):
        if mouth.kind != "inlet":
            continue
        corners = label[mouth.vertices]
        # Walking along a side, psi grows by u on upright faces and falls by v on level ones.
        sign = mouth.inward * (1.0 if mouth.side in ("left", "right") else -1.0)
        for a, b, share in zip(corners[:-1].tolist(), corners[1:].tolist(), mouth.profile, strict=True):
            ra, rb = int(root[a]), int(root[b])
            if ra == rb:
                raise FlowError(
                    f"inlet {index} ({mouth.side}) leads into fluid without an outlet: make one of its openings one"
                )
            shift = offset.get(a, np.zeros(openings)).copy()
            shift[index] += sign * share
            shift -= offset.get(b, np.zeros(openings))
            for node in members.pop(rb, [rb]):
                offset[node] = offset.get(node, np.zeros(openings)) + shift
                root[node] = ra
                members.setdefault(ra, [ra]).append(node)
    return root, offset
