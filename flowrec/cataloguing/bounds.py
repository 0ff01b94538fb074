"""Bounds of this process while an expression runs that DuckDB itself does not interrupt.

DuckDB looks for an interruption between blocks of rows, and counts its tables but not the text that a function makes:
`repeat('x', 4000000000)` would take minutes and all memory, and Ctrl-C would have to wait for it.
"""

from __future__ import annotations

import contextlib
import os
import sys
import threading
from collections.abc import Iterator
from pathlib import Path

from flowrec.errors import printable

MEMORY_BYTES = 4 << 30  # more than before; address space, of which DuckDB reserves much and uses little
_STATUS = 2


@contextlib.contextmanager
def process_bounds(limit_s: float, complaint: str) -> Iterator[None]:
    """End the process after a time with a line and exit status 2; limit its memory, where the system can."""
    over = threading.Event()

    def watch() -> None:
        if not over.wait(limit_s):
            sys.stderr.write(f"flowrec: {printable(complaint)}\n")
            sys.stderr.flush()
            os._exit(_STATUS)

    threading.Thread(target=watch, daemon=True).start()
    try:
        with _memory_bound():
            yield
    finally:
        over.set()


@contextlib.contextmanager
def _memory_bound() -> Iterator[None]:
    if sys.platform == "linux":
        import resource

        used_bytes = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[0]) * resource.getpagesize()
        before = resource.getrlimit(resource.RLIMIT_AS)
        limit_bytes = used_bytes + MEMORY_BYTES
        if before[0] != resource.RLIM_INFINITY:
            limit_bytes = min(limit_bytes, before[0])
        resource.setrlimit(resource.RLIMIT_AS, (limit_bytes, before[1]))
        try:
            yield
        finally:
            resource.setrlimit(resource.RLIMIT_AS, before)
    else:
        yield
