"""LU factors of a matrix on a grid, and why SuperLU makes them.

Measured on one thread of a shared 2.8 GHz Xeon, Stokes matrices, seconds to factorise / to solve, and MB beyond what
was loaded:

    mask                    unknowns  SuperLU, MMD        multifrontal         UMFPACK       PARDISO       CHOLMOD
    open 512 x 512, k=1      259,584  8.9 / 0.11,  665    2.6 / 0.14, 1213     6.0 / 0.48    6.3 / 0.28    -
    posts 512, 68 % fluid    167,726  4.9 / 0.08,  273    2.8 / 0.20,  533     2.9 / 0.30    3.6 / 0.24    1.7 / 0.07
    posts 1024, 47 %         436,276  7.4 / 0.15,  506    6.1 / 0.37, 1009     5.8 / 0.42    6.0 / 0.49    2.3 / 0.08
    vessels 1024, k=2, 8 %   309,326  5.8 / 0.18,  344    7.0 / 0.34,  766     6.4 / 0.50    4.6 / 0.28    2.3 / 0.09
    vessels 1024, k=1         69,071  0.9 / 0.03,   67    1.2 / 0.07,  257     2.6 / 0.17    3.9 / 0.15    1.1 / 0.03
    vessels 128, k=4          26,483  0.8 / 0.01,   55    0.5 / 0.03,  209     1.0 / 0.09    1.5 / 0.08    0.4 / 0.02

SuperLU and multifrontal (a nested dissection of our own with dense fronts) ran side by side, the others minutes apart
under another load: they tell the order of magnitude. CHOLMOD needs symmetric values, which neither cut walls nor
convection have. UMFPACK and PARDISO are as quick, not quicker, where channels are channels, and no better kept than
what SciPy brings; multifrontal pays on wide open masks only, with twice the memory. SuperLU with a geometric nested
dissection, with METIS and KLU were slower than with minimum degree.
"""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray
from scipy.sparse.linalg import splu

Floats = NDArray[np.float64]


class Factors(Protocol):
    """What is left of a matrix that was factorised."""

    def solve(self, right: Floats) -> Floats:
        """Solution (n,) or (n, m) of right sides of the same shape."""


def factorise(matrix: Any) -> Factors:
    """LU factors of a sparse matrix (n, n) of symmetric pattern whose diagonal blocks are well conditioned.

    Values need not be symmetric.
    """
    if matrix.shape[0] == 0:  # a channel of one cell between inlets has no freedom left
        return _Nothing()
    factors: Factors = splu(
        sp.csc_matrix(matrix),
        permc_spec="MMD_AT_PLUS_A",
        diag_pivot_thresh=0.01,
        options={"SymmetricMode": True},
    )
    return factors


class _Nothing:
    """Factors of the empty matrix."""

    @staticmethod
    def solve(right: Floats) -> Floats:
        """Solution (0, ...)."""
        return right
