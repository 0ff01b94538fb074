"""What tests of drivers share."""

from __future__ import annotations

import time
from collections.abc import Callable

from flowrec.core import CameraLosses
from flowrec.rigs.lab.cameras.grabber import Captured, Grabber

HANG_S = 30.0  # a test that waits longer than this has failed


def frames_of(grabber: Grabber, number: int) -> list[Captured]:
    """The next frames."""
    return list(frames_until(grabber, lambda frames: len(frames) == number))


def frames_until(grabber: Grabber, enough: Callable[[list[Captured]], bool]) -> list[Captured]:
    """Frames until there are enough."""
    frames: list[Captured] = []
    end_s = time.monotonic() + HANG_S
    while not enough(frames):
        assert time.monotonic() < end_s, f"{len(frames)} frames; {grabber.absent}"
        frame = grabber.next(0.2)
        if frame is not None:
            frames.append(frame)
    return frames


def rest_of(grabber: Grabber) -> list[Captured]:
    """The frames that still come, until none comes for a while."""
    return list(iter(lambda: grabber.next(0.3), None))


def absent(grabber: Grabber) -> str:
    """Wait until the camera is recognised as absent; why."""
    end_s = time.monotonic() + HANG_S
    while not grabber.absent and time.monotonic() < end_s:
        grabber.next(0.01)
    return grabber.absent


def adds_up(losses: CameraLosses | None) -> bool:
    """Whether frames and losses add up to the ids."""
    assert losses is not None
    lost = losses.link + losses.incomplete + losses.driver + losses.backlog
    return losses.frames + lost == losses.ids
