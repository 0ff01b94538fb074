"""LU factors of a matrix on a grid: which engine factorises it, and nested dissection for the large ones.

Most systems go to SuperLU (minimum degree). Large wide ones to our own multifrontal elimination: the unknowns are cut
in two at the middle of the longer side of the box they lie in, again and again; the few that touch both halves come
last (A. George, Nested dissection of a regular finite element mesh, SIAM J. Numer. Anal. 10 (1973) 345-363). Each
part is then one dense matrix for LAPACK and BLAS (I. Duff and J. Reid, ACM TOMS 9 (1983) 302-325). Values need not
be symmetric; rows are exchanged within a part only, which is enough for the diagonal blocks of a viscous flow.

Measured on one thread of a shared 2.8 GHz Xeon, Stokes matrices, seconds to factorise / to solve, and MB beyond what
was loaded (ours includes about 130 MB of compiler in this measurement):

    mask                    unknowns  SuperLU, MMD        multifrontal         UMFPACK       PARDISO       CHOLMOD
    open 512 x 512, k=1      259,584  8.9 / 0.11,  665    2.6 / 0.14, 1213 *   6.0 / 0.48    6.3 / 0.28    -
    posts 512, 68 % fluid    167,726  4.9 / 0.08,  273    2.8 / 0.20,  533     2.9 / 0.30    3.6 / 0.24    1.7 / 0.07
    posts 1024, 47 %         436,276  7.4 / 0.15,  506    6.1 / 0.37, 1009     5.8 / 0.42    6.0 / 0.49    2.3 / 0.08
    vessels 1024, k=2, 8 %   309,326  5.8 / 0.18,  344    7.0 / 0.34,  766     6.4 / 0.50    4.6 / 0.28    2.3 / 0.09
    vessels 1024, k=1         69,071  0.9 / 0.03,   67    1.2 / 0.07,  257     2.6 / 0.17    3.9 / 0.15    1.1 / 0.03
    vessels 128, k=4          26,483  0.8 / 0.01,   55    0.5 / 0.03,  209     1.0 / 0.09    1.5 / 0.08    0.4 / 0.02

    SuperLU and ours ran side by side, the others minutes apart under another load: they tell the order of magnitude.
    * cuts at the median; cuts where the fewest unknowns lie, as now, took 7.6 s beside 13.7 s of SuperLU under load.

CHOLMOD needs symmetric values, which convection does not have; the others are no wheels or no gain worth a dependency.
On several threads of a busy machine the BLAS calls wait for each other: OMP_NUM_THREADS=1 is then far quicker.
"""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np
import scipy.sparse as sp
from numba import njit
from numpy.typing import NDArray
from scipy.linalg import blas, lapack
from scipy.sparse.linalg import splu

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

# The multifrontal engine pays on many unknowns that fill much of the box they lie in: cuts across a network of
# channels are so short that SuperLU's minimum degree is as quick with half the memory.
LARGE = 100_000
FILLED = 0.3
LEAF = 96  # unknowns that are no longer cut: dense work on so few costs less than the calls it would save
# A wall that many faces touch is a long row; it goes between the halves, not its many neighbours.
WIDE = 100
BALANCE = 0.25  # least share of the unknowns on either side of a cut


class Factors(Protocol):
    """What is left of a matrix that was factorised."""

    def solve(self, right: Floats) -> Floats:
        """Solution (n,) or (n, m) of right sides of the same shape."""


def factorise(matrix: Any, places: Floats) -> Factors:
    """LU factors of a sparse matrix (n, n) of symmetric pattern whose diagonal blocks are well conditioned.

    Parameters
    ----------
    matrix
        Sparse, (n, n); values need not be symmetric.
    places
        (n, 2) where the unknowns lie, in any unit; they decide on speed and memory, not on the result.
    """
    if matrix.shape[0] == 0:  # a channel of one cell between inlets has no freedom left
        return _Nothing()
    if not _is_wide(places):
        factors: Factors = splu(
            sp.csc_matrix(matrix),
            permc_spec="MMD_AT_PLUS_A",
            diag_pivot_thresh=0.01,
            options={"SymmetricMode": True},
        )
        return factors
    return _Fronts(sp.csc_array(matrix), np.ascontiguousarray(places, np.float64))


def _is_wide(places: Floats) -> bool:
    """Whether there are many unknowns in a wide place."""
    return len(places) >= LARGE and len(places) >= FILLED * float(np.prod(np.ptp(places, axis=0) + 1.0))


class _Nothing:
    """Factors of the empty matrix."""

    @staticmethod
    def solve(right: Floats) -> Floats:
        """Solution (0, ...)."""
        return right


class _Fronts:
    """Block LU: a front eliminates its own unknowns and passes what is left to the part that encloses it.

    With the blocks [[F11, F12], [F21, F22]] of own unknowns and boundary: W = F11^-1 F12, and F22 - F21 W goes up.
    """

    def __init__(self, matrix: Any, places: Floats) -> None:
        n = matrix.shape[0]
        graph = sp.csc_array((np.ones(matrix.nnz), matrix.indices, matrix.indptr), shape=(n, n))
        graph = sp.csc_array(graph + graph.T)
        order, nodes = _dissect(*_pattern(graph), places, LEAF, WIDE)
        nodes = nodes[np.argsort(nodes[:, 0])]  # starts ascend: children come before what encloses them
        start, end, parent = nodes[:, 0], nodes[:, 1], np.searchsorted(nodes[:, 0], nodes[:, 2])
        parent[nodes[:, 2] < 0] = -1
        place = np.empty(n, np.int64)
        place[order] = np.arange(n)
        by_column = _ordered(matrix, place)
        by_row = by_column.tocsr()
        columns = (*_pattern(by_column), by_column.data)
        rows = (*_pattern(by_row), by_row.data)
        ends, beyond = _boundaries(start, end, parent, *_pattern(_ordered(graph, place)))
        self._order = order
        self._fronts: list[tuple[int, int, Ints, Floats, Any, Floats, Floats]] = []
        waiting: list[list[tuple[Ints, Floats]]] = [[] for _ in range(len(nodes))]
        local = np.zeros(n, np.int64)
        for number, (a, b, up) in enumerate(zip(start.tolist(), end.tolist(), parent.tolist(), strict=True)):
            boundary = beyond[ends[number] : ends[number + 1]]
            own, outer = b - a, len(boundary)
            # LAPACK wants columns side by side; the compiled loops see the transposes, rows side by side.
            f11, f12 = np.zeros((own, own)), np.zeros((outer, own))
            f21, f22 = np.zeros((own, outer)), np.zeros((outer, outer))
            _gather(a, b, boundary, local, *columns, f11, f21, True)
            _gather(a, b, boundary, local, *rows, f11, f12, False)
            for inner, rest in waiting[number]:
                _extend(local[inner], own, rest, f11, f12, f21, f22)
            waiting[number] = []
            lu, pivots, _ = lapack.dgetrf(f11.T, overwrite_a=1)
            w, _ = lapack.dgetrs(lu, pivots, f12.T, overwrite_b=1) if outer else (f12.T, 0)
            if up >= 0 and outer:
                rest = blas.dgemm(-1.0, f21.T, w, 1.0, f22.T, overwrite_c=1)
                waiting[up].append((boundary, rest.T))
            self._fronts.append((a, b, boundary, lu, pivots, f21.T, w))

    def solve(self, right: Floats) -> Floats:
        """Solution of A x = right, (n,) or (n, m)."""
        x: Floats = right[self._order]
        for a, b, boundary, lu, pivots, f21, _ in self._fronts:
            y, _ = lapack.dgetrs(lu, pivots, x[a:b])
            x[a:b] = y.reshape(x[a:b].shape)
            x[boundary] -= f21 @ x[a:b]
        for a, b, boundary, _, _, _, w in reversed(self._fronts):
            x[a:b] -= w @ x[boundary]
        solution = np.empty_like(x)
        solution[self._order] = x
        return solution


def _ordered(matrix: Any, place: Ints) -> Any:
    """A CSC matrix with row and column v moved to place[v]."""
    column = np.repeat(np.arange(matrix.shape[1]), np.diff(matrix.indptr))
    return sp.csc_array((matrix.data, (place[matrix.indices], place[column])), shape=matrix.shape)


def _pattern(matrix: Any) -> tuple[Ints, Ints]:
    """Pointers and indices, always of the same type: SciPy's depends on size, and each would be compiled anew."""
    return matrix.indptr.astype(np.int64), matrix.indices.astype(np.int64)


@njit(cache=True)
def _dissect(indptr, indices, places, leaf, wide):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202
    """Order (n,) of the unknowns, and parts (parts, 3): first and end in the order, first of the enclosing one or -1.

    Every stretch of the order is cut into [low half, high half, those of the low half that touch the high one].
    """
    n = len(indptr) - 1
    order = np.arange(n)
    spare = np.empty(n, np.int64)
    side = np.full(n, -1, np.int64)  # of the stretch in work: 0 low, 1 high, 2 between
    nodes = np.empty((n, 3), np.int64)
    count = 0
    stack = [(0, n, -1)]
    while len(stack) > 0:
        first, end, up = stack.pop()
        size = end - first
        if size == 0:
            continue
        inside = order[first:end]
        low0, high0 = places[inside[0], 0], places[inside[0], 0]
        low1, high1 = places[inside[0], 1], places[inside[0], 1]
        for v in inside:
            low0, high0 = min(low0, places[v, 0]), max(high0, places[v, 0])
            low1, high1 = min(low1, places[v, 1]), max(high1, places[v, 1])
        if size <= leaf or (high0 == low0 and high1 == low1):
            nodes[count, 0], nodes[count, 1], nodes[count, 2] = first, end, up
            count += 1
            continue
        # Where the fewest unknowns lie between the halves: across a channel rather than along it.
        best, axis, middle = np.inf, 0, 0.0
        for candidate in range(2):
            lowest, highest = (low0, high0) if candidate == 0 else (low1, high1)
            bins = np.zeros(int(highest - lowest) + 2, np.int64)
            for v in inside:
                bins[int(places[v, candidate] - lowest)] += 1
            below = 0
            for k in range(len(bins) - 2):
                below += bins[k]
                if below > BALANCE * size and below < (1.0 - BALANCE) * size:
                    between = bins[k] + (bins[k - 1] if k > 0 else 0)
                    price = between * (1.0 + (2.0 * below / size - 1.0) ** 2)
                    if price < best:
                        best, axis, middle = price, candidate, lowest + k + 1
        if best == np.inf:
            axis = 0 if high0 - low0 >= high1 - low1 else 1
            middle = 0.5 * (low0 + high0) if axis == 0 else 0.5 * (low1 + high1)
        for v in inside:
            side[v] = 1 if places[v, axis] >= middle else 0
        # Long rows first, so that their neighbours need not follow them.
        for long in (True, False):
            for v in inside:
                if (indptr[v + 1] - indptr[v] > wide) != long or (side[v] != 0 and not long):
                    continue
                mine = side[v]
                for at in range(indptr[v], indptr[v + 1]):
                    if side[indices[at]] == 1 - mine:
                        side[v] = 2
                        break
        low_end, high_end = 0, 0
        for v in inside:
            low_end += side[v] == 0
            high_end += side[v] <= 1
        to = np.array([0, low_end, high_end])
        for v in inside:
            spare[first + to[side[v]]] = v
            to[side[v]] += 1
        for k in range(first, end):
            side[spare[k]] = -1
            order[k] = spare[k]
        here = up
        if high_end < size:
            here = first + high_end
            nodes[count, 0], nodes[count, 1], nodes[count, 2] = here, end, up
            count += 1
        stack.append((first, first + low_end, here))
        stack.append((first + low_end, first + high_end, here))
    return order, nodes[:count]


@njit(cache=True)
def _boundaries(start, end, parent, indptr, indices):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202
    """Later unknowns that each part is tied to once its inner parts are gone: ends (parts + 1,) and the unknowns."""
    parts = len(start)
    ends = np.zeros(parts + 1, np.int64)
    beyond = np.empty(4 * len(indptr), np.int64)
    seen = np.full(len(indptr) - 1, -1, np.int64)
    child, sibling = np.full(parts, -1, np.int64), np.full(parts, -1, np.int64)
    for part in range(parts):
        found = ends[part]
        own_end = end[part]
        # Room for what can come: the entries of its columns and the boundaries of its children.
        room = indptr[own_end] - indptr[start[part]]
        inner = child[part]
        while inner >= 0:
            room += ends[inner + 1] - ends[inner]
            inner = sibling[inner]
        if found + room > len(beyond):
            grown = np.empty(2 * (found + room), np.int64)
            grown[:found] = beyond[:found]
            beyond = grown
        for at in range(indptr[start[part]], indptr[own_end]):
            v = indices[at]
            if v >= own_end and seen[v] != part:
                seen[v] = part
                beyond[found] = v
                found += 1
        inner = child[part]
        while inner >= 0:
            for at in range(ends[inner], ends[inner + 1]):
                v = beyond[at]
                if v >= own_end and seen[v] != part:
                    seen[v] = part
                    beyond[found] = v
                    found += 1
            inner = sibling[inner]
        beyond[ends[part] : found].sort()
        ends[part + 1] = found
        up = parent[part]
        if up >= 0:
            sibling[part] = child[up]
            child[up] = part
    return ends, beyond[: ends[parts]].copy()


@njit(cache=True)
def _gather(a, b, boundary, local, indptr, indices, data, inner, outer, columns):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202
    """Entries of the matrix that a front a..b meets first: its columns (F11, F21), or its rows (F12).

    All blocks are transposed: F11 (own, own) and F21 (own, outer) by columns, F12 (outer, own).
    """
    own = b - a
    for k in range(own):
        local[a + k] = k
    for k in range(len(boundary)):
        local[boundary[k]] = own + k
    for line in range(a, b):
        for at in range(indptr[line], indptr[line + 1]):
            other = indices[at]
            if columns:
                if other >= b:
                    outer[line - a, local[other] - own] = data[at]
                elif other >= a:
                    inner[line - a, other - a] = data[at]
            elif other >= b:
                outer[local[other] - own, line - a] = data[at]


@njit(cache=True)
def _extend(at, own, rest, f11, f12, f21, f22):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202
    """Add what a child left (transposed, m, m) at the local numbers (m,), which ascend, to the transposed blocks."""
    split = np.searchsorted(at, own)
    for column in range(len(at)):
        into = at[column]
        left, below = (f11, f21) if column < split else (f12, f22)
        if column >= split:
            into -= own
        for row in range(split):
            left[into, at[row]] += rest[column, row]
        for row in range(split, len(at)):
            below[into, at[row] - own] += rest[column, row]
