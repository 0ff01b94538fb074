"""A console with a made-up chip, and a browser's side of it by other people's clients."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest

from flowrec.core import Frame, Mission, Tick
from flowrec.physics import Calibration, Chip, Robot
from flowrec.view import Scene

CALIBRATION = Calibration(2.5, (400.0, -100.0), 120.0, mirror=True)
SIZE_PX = (640, 512)


@pytest.fixture(scope="session")
def scene() -> Scene:
    mask = np.zeros((100, 200), bool)
    mask[40:60] = True
    robot = Robot(radius_um=20.0, max_speed_um_s=600.0, step_out_hz=30.0)
    return Scene(Chip("made up", mask, 10.0, (), 1.0, 998.0), CALIBRATION, robot, "made up", image_px=SIZE_PX)


@pytest.fixture
def ticks() -> Callable[[int], Iterator[Tick]]:
    """Ticks with an image of noise, which no encoder makes small."""

    def made(count: int) -> Iterator[Tick]:
        noise = np.random.default_rng(0).integers(0, 256, (512, 640 + count), np.uint8)
        nowhere: Any = np.full(2, np.nan)
        mission = Mission(0, "observe", 0, 0, "", 0, nowhere, nowhere, False, "", "")
        for i in range(count):
            now_ns = (i + 1) * 10_000_000
            yield Tick(now_ns, frame=Frame(now_ns, i, noise[:, i : i + 640]), mission=mission)

    return made
