"""A look at the camera for some seconds, without a run: what is there, at which rate, and what is lost."""

from __future__ import annotations

import itertools
import logging
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial

from flowrec.core import NS_PER_S, CameraLosses, Image, RigError, UsageError, envelope, seconds
from flowrec.rigs.lab.cameras.camera import CameraInfo, NoCameraError, wanted_of
from flowrec.rigs.lab.cameras.grabber import Captured, Grabber
from flowrec.stages import CAMERAS, CameraSettings, Lab

_TAKEN_S, _PATIENCE_S = 2.5, 3.0  # for which images are taken; besides, for the first one to come


@dataclass(frozen=True, slots=True)
class CameraProbe:
    """Result of a trial of the camera.

    Attributes
    ----------
    rate_hz : of the camera, by its block ids: losses do not lower it; 0 with less than two frames.
    losses : by cause; None: not one frame came.
    clock_slope : time of the host per time of the camera's clock as it states its unit: 1 within some 1e-3 for a probe
        of 2 s, 10 for a camera that states its unit wrongly by as much; 0: no clock.
    arrival_ms : longest interval between two arrivals.
    brightest : grey level of the brightest pixel of the last image; 2**bits - 1 means that it is overexposed.
    notes : settings that differ from what was asked, and what else a person should know, a line each.
    image : (h, w) the last one; None: not one frame came.
    """

    info: CameraInfo
    rate_hz: float
    losses: CameraLosses | None
    clock_slope: float
    arrival_ms: float
    brightest: int
    notes: tuple[str, ...]
    image: Image | None = None


def first_camera(camera: CameraSettings, lab: Lab, drivers: Iterable[str]) -> tuple[str, CameraProbe]:
    """The first of some drivers that finds a camera, and that camera with its whole image and its own exposure.

    Raises
    ------
    RigError : none finds one, or the first that does can not use it.
    """
    found_none: dict[str, NoCameraError | UsageError] = {}
    with _silent(logging.getLogger("pymmcore-plus")):  # what it misses is told below, once for all drivers
        for driver in drivers:
            try:
                return driver, probe_camera(camera, replace(lab, camera=driver), as_it_is=True)
            except (NoCameraError, UsageError) as error:
                found_none[driver] = error
    if len(found_none) == 1:
        raise RigError("; ".join(map(str, found_none.values())))
    looked = [driver for driver, error in found_none.items() if isinstance(error, NoCameraError)]
    missing = dict.fromkeys(str(error) for error in found_none.values() if not isinstance(error, NoCameraError))
    what = f"no camera found by {', '.join(looked)}" if looked else "no driver of a camera can be used"
    raise RigError(
        f"{what}; plug one in, see to its power and cable and whether another program uses it, or try the emulated "
        f"camera of notebooks/08_lab.ipynb{''.join(f'; {text}' for text in missing)}"
    )


@contextmanager
def _silent(logger: logging.Logger) -> Iterator[None]:
    before, logger.disabled = logger.disabled, True
    try:
        yield
    finally:
        logger.disabled = before


def probe_camera(camera: CameraSettings, lab: Lab, *, as_it_is: bool = False) -> CameraProbe:
    """Open the camera of a configuration, take its frames for some seconds, and close it.

    `as_it_is` takes its whole image, and its own exposure.

    Raises
    ------
    RigError : as Camera.open, or no frame comes in time.
    UsageError : a package is not installed; the line names the command.
    """
    wanted = wanted_of(camera, lab)
    if as_it_is:
        wanted = replace(wanted, width_px=0, height_px=0, exposure_s=0.0)
    driver = CAMERAS[lab.camera].load()
    frames: list[Captured] = []
    with Grabber(partial(driver.of, wanted), wanted, lab.queue_frames) as grabber:
        end_s = time.monotonic() + _TAKEN_S
        while time.monotonic() < end_s + (0.0 if frames else _PATIENCE_S):
            frame = grabber.next(0.1)
            if frame is not None:
                if not frames:
                    end_s = time.monotonic() + _TAKEN_S
                frames.append(frame)
        info, notes, losses = grabber.info, grabber.notes, grabber.losses
    if not frames and not wanted.trigger:
        raise RigError(f"camera {info.model} {info.serial}: it delivers no frame; see its trigger, cable and bandwidth")
    if not frames:
        return CameraProbe(info, 0.0, losses, 0.0, 0.0, 0, (*notes, f"no trigger has come at {wanted.trigger}"))
    first, last = frames[0], frames[-1]
    span_s = max(seconds(last.stamp_ns - first.stamp_ns), 1e-9)
    arrivals = [frame.arrival_ns for frame in frames]
    return CameraProbe(
        info,
        rate_hz=(last.index - first.index) / span_s,
        losses=losses,
        clock_slope=_slope(frames, info),
        arrival_ms=max((b - a for a, b in itertools.pairwise(arrivals)), default=0) / 1e6,
        brightest=int(last.image.max()),
        notes=notes,
        image=last.image,
    )


def _slope(frames: list[Captured], info: CameraInfo) -> float:
    """Time of the host per time of the camera, along the earliest arrivals."""
    points = {clock.device: (clock.device, clock.arrival_ns) for frame in frames if (clock := frame.clock) is not None}
    if len(points) < 2 or not info.ticks_per_s:
        return 0.0
    return envelope(tuple(points[ticks] for ticks in sorted(points)))[1] * info.ticks_per_s / NS_PER_S
