"""A rig in real time, as far as streams know one, and the ticks of its loop."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from flowrec.core import Applied
from flowrec.stages import Inputs

PERIOD_S = 1.0 / 30.0


@dataclass
class Clock:
    """A rig whose stamp 0 is now."""

    epoch_ns: int | None


def ticks(clock: Clock) -> Iterator[Inputs]:
    """The inputs of a loop of 30 ticks a second, without images."""
    while True:
        time.sleep(PERIOD_S)
        assert clock.epoch_ns is not None
        stamp = time.monotonic_ns() - clock.epoch_ns
        yield Inputs(stamp, None, Applied(stamp, 0.0, 0.0, 0.0, np.zeros(3), np.zeros(2)))
