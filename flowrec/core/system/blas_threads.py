"""One BLAS thread: the matrices of an assimilation are too small to share, and the result is the same on any machine.

OpenBLAS has a thread for each core, and idle ones spin. On two cores the tests of the assimilation took 35 s with two
threads and 8 s with one, and a mission 19 s of CPU time instead of 11 s. The order in which threads add numbers depends
on how many there are, and a session must replay identically on a machine with other cores.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from functools import lru_cache

from threadpoolctl import ThreadpoolController


@lru_cache(maxsize=1)
def _blas(_modules: int) -> ThreadpoolController:
    """The BLAS libraries of this process; imports load them, so they are searched anew where the modules are more."""
    return ThreadpoolController().select(user_api="blas")


@contextmanager
def one_blas_thread() -> Iterator[None]:
    """NumPy and SciPy compute with one thread in this block, or function that it decorates; then as before."""
    with _blas(len(sys.modules)).limit(limits=1):
        yield
