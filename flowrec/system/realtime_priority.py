"""The control loop before everything else that the machine has to do."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager

# Above every ordinary thread, below those of the kernel and of sound and field-bus servers, which ask for more.
_PRIORITY = 1


@contextmanager
def first_of_all(priority: int = _PRIORITY) -> Iterator[bool]:
    """Run this thread in real time, where that is allowed: yields whether it is.

    For loops that wait for a camera; one that never waits would keep a core for itself. Threads and processes that
    are begun meanwhile are ordinary ones. Linux allows it to root and within the limit `rtprio`
    (/etc/security/limits.conf); other systems are left alone.
    """
    if not hasattr(os, "sched_setscheduler"):
        yield False
        return
    before = os.sched_getscheduler(0), os.sched_getparam(0)
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, os.sched_param(priority))
    except OSError:
        yield False
        return
    try:
        yield True
    finally:
        os.sched_setscheduler(0, *before)
