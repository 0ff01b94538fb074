"""LU factorisation of the grid's sparse matrices, and the LRU cache that keeps factors and solutions.

SuperLU with minimum-degree ordering was chosen by measurement. On one thread of a shared 2.8 GHz Xeon, Stokes
matrices, seconds to factorise / seconds to solve, and MB of memory beyond what was in use:

    mask                    unknowns  SuperLU, MMD        multifrontal         UMFPACK       PARDISO       CHOLMOD
    open 512 x 512, k=1      259,584  8.9 / 0.11,  665    2.6 / 0.14, 1213     6.0 / 0.48    6.3 / 0.28    -
    posts 512, 68 % fluid    167,726  4.9 / 0.08,  273    2.8 / 0.20,  533     2.9 / 0.30    3.6 / 0.24    1.7 / 0.07
    posts 1024, 47 %         436,276  7.4 / 0.15,  506    6.1 / 0.37, 1009     5.8 / 0.42    6.0 / 0.49    2.3 / 0.08
    vessels 1024, k=2, 8 %   309,326  5.8 / 0.18,  344    7.0 / 0.34,  766     6.4 / 0.50    4.6 / 0.28    2.3 / 0.09
    vessels 1024, k=1         69,071  0.9 / 0.03,   67    1.2 / 0.07,  257     2.6 / 0.17    3.9 / 0.15    1.1 / 0.03
    vessels 128, k=4          26,483  0.8 / 0.01,   55    0.5 / 0.03,  209     1.0 / 0.09    1.5 / 0.08    0.4 / 0.02

SuperLU and multifrontal (a nested dissection with dense fronts, written for the comparison) ran side by side; the
others ran minutes apart under another load and show the order of magnitude only. CHOLMOD needs a symmetric matrix,
which neither cut walls nor convection give. UMFPACK and PARDISO are about as fast on channels and are maintained no
better than SciPy. Multifrontal is faster on wide open masks only and needs twice the memory. SuperLU with geometric
nested dissection, SuperLU with METIS, and KLU were slower than SuperLU with minimum degree.
"""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable, Hashable, Iterable, Sized
from dataclasses import fields, is_dataclass
from typing import Any, Protocol

import numpy as np
import scipy  # its sparse loads at first use, not at start-up

from flowrec.core import Floats, separate_large_blocks
from flowrec.physics.chip.chip import Chip

# An assimilation on a network holds 0.45 GB, a bifurcation 0.27 GB (five depths, k = 1).
LARGEST_BYTES, FEWEST_ENTRIES = 700_000_000, 4

# A number of L or U is 8 bytes and a row index that the columns of a supernode share: 9.2 to 10.8 bytes measured on
# five chips (0.7 to 38 million numbers).
_BYTES_PER_FACTOR = 11

_lock = threading.Lock()


class Factors(Protocol):
    """A factorised matrix."""

    def solve(self, right: Floats) -> Floats:
        """Solution (n,) or (n, m) for right sides of the same shape."""


class _EmptyFactors:
    """Factors of the matrix of size zero."""

    @staticmethod
    def solve(right: Floats) -> Floats:
        """Solution (0, ...)."""
        return right


def factorise(matrix: Any) -> Factors:
    """LU factors of a sparse matrix (n, n) with a symmetric pattern and well conditioned diagonal blocks.

    The values need not be symmetric.
    """
    if matrix.shape[0] == 0:  # a channel of one cell between inlets has no degree of freedom
        return _EmptyFactors()
    separate_large_blocks()
    return scipy.sparse.linalg.splu(
        scipy.sparse.csc_matrix(matrix),
        permc_spec="MMD_AT_PLUS_A",
        diag_pivot_thresh=0.01,
        options={"SymmetricMode": True},
    )


class _Entry:
    """A cached result, and the bytes of the arrays, factors and byte strings that it and its key consist of."""

    def __init__(self, key: Hashable, result: Any) -> None:
        self.key, self.result = key, result
        self.sizes, self.growing = held_bytes([key, result])

    def part_sizes(self) -> dict[int, int]:
        """Bytes of each part by its identity.

        A result grows where a part of it is made when it is first used: then one of its dictionaries or lists is
        longer than before, and all parts are measured again.
        """
        if any(len(part) != count for part, count in self.growing):
            self.sizes, self.growing = held_bytes([self.key, self.result])
        return self.sizes


_entries: OrderedDict[Hashable, _Entry] = OrderedDict()


def compute_cached(key: Hashable, compute: Callable[[], Any]) -> Any:
    """The result of `compute` for this key, from the cache if it is still there.

    The key must hold every input of `compute`, so that the cache can not change a result. When all results together
    have more than LARGEST_BYTES, the least recently used ones are dropped, but for the last FEWEST_ENTRIES.
    """
    with _lock:
        if key in _entries:
            _entries.move_to_end(key)
            return _entries[key].result
    result = compute()
    with _lock:
        _entries[key] = _Entry(key, result)
        _entries.move_to_end(key)
        held: dict[int, int] = {}
        for number, entry in enumerate(reversed(list(_entries.values()))):  # the latest first
            held |= entry.part_sizes()
            if sum(held.values()) > LARGEST_BYTES and number >= FEWEST_ENTRIES:
                del _entries[entry.key]
    return result


def held_bytes(results: Iterable[Any]) -> tuple[dict[int, int], list[tuple[Sized, int]]]:
    """Bytes, by identity, of all arrays, factors and byte strings in results; and what can grow, with its length."""
    sizes: dict[int, int] = {}
    growing: list[tuple[Sized, int]] = []
    seen: set[int] = set()
    waiting = list(results)
    while waiting:
        part = waiting.pop()
        while isinstance(part, np.ndarray) and isinstance(part.base, np.ndarray):
            part = part.base  # a view keeps the whole array
        if id(part) in seen or isinstance(part, type):
            continue
        seen.add(id(part))
        if isinstance(part, np.ndarray):
            sizes[id(part)] = part.nbytes
        elif isinstance(part, scipy.sparse.linalg.SuperLU):
            sizes[id(part)] = _BYTES_PER_FACTOR * part.nnz
        elif isinstance(part, bytes):
            sizes[id(part)] = len(part)
        elif isinstance(part, dict | list):
            members = list(part.values() if isinstance(part, dict) else part)  # another thread may add to it
            growing.append((part, len(members)))
            waiting += members
        elif isinstance(part, tuple):
            waiting += part
        elif hasattr(part, "__dict__"):
            waiting.append(vars(part))
        elif is_dataclass(part):
            waiting += [getattr(part, field.name) for field in fields(part)]
    return sizes, growing


def clear_cache() -> None:
    """Drop all cached results, as in a process that has just started."""
    with _lock:
        _entries.clear()


def chip_key(chip: Chip) -> Hashable:
    """All of a chip except its name, as part of a cache key."""
    return tuple(array_key(getattr(chip, field.name)) for field in fields(chip) if field.name != "name")


def array_key(value: Any) -> Hashable:
    """A value, or shape and bytes of an array, as part of a cache key."""
    return (value.shape, value.tobytes()) if isinstance(value, np.ndarray) else value
