"""Messages between the recorder and the process of an NI output, besides commands."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from flowrec.physics import Robot
from flowrec.stages import Coils, MotionSegment, OutputLimits


@dataclass(frozen=True, slots=True)
class NiSettings:
    """Settings of the process."""

    channels: str
    server: str
    coils: Coils
    robot: Robot
    output: OutputLimits
    silence_s: float


@dataclass(frozen=True, slots=True)
class Played:
    """A block that was written: when its first sample is put out, on the host's monotonic clock, and what it does."""

    from_ns: int
    segments: tuple[MotionSegment, ...]
    amplitude_mt: float
    currents_a: NDArray[np.float64]  # (3,) at the first sample
