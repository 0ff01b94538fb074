"""What the recorder and the process of an NI output send each other, besides commands."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from flowrec.control.coils import Coils
from flowrec.control.field_rotation import MotionSegment
from flowrec.rig_settings import OutputLimits
from flowrec.robot import Robot


@dataclass(frozen=True, slots=True)
class Settings:
    """What the process needs to know."""

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
