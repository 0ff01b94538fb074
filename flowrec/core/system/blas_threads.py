"""One BLAS thread: the matrices of an assimilation are too small to share, and the result is the same on any machine.

OpenBLAS has a thread for each core, and idle ones spin. On two cores the tests of the assimilation took 35 s with two
threads and 8 s with one, and a mission 19 s of CPU time instead of 11 s. The order in which threads add numbers depends
on how many there are, and a session must replay identically on a machine with other cores.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from threadpoolctl import threadpool_limits


@contextmanager
def one_blas_thread() -> Iterator[None]:
    """NumPy and SciPy compute with one thread in this block, or function that it decorates; then as before."""
    with threadpool_limits(limits=1, user_api="blas"):
        yield
