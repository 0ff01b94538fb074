"""A camera over its vendor's Python package: a row of `flowrec.cameras`.

pyproject.toml of the package:

    [project.entry-points."flowrec.cameras"]
    acme = "lab_acme:AcmeCamera"

and then `lab.camera = "acme"`. flowrec queues, counts losses by the numbers of the images, fits the clock, and opens
the camera again when it was unplugged; the driver opens, hands images on, says when the camera is gone, and closes.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np

from flowrec.core import Range, RigError
from flowrec.rigs import CameraInfo, Grabbed, Wanted, bits_of
from flowrec.rigs.lab.cameras.camera import Camera


class AcmeCamera(Camera):
    """cameras of Acme, by the package acme_sdk."""

    @dataclass(frozen=True, slots=True)
    class Settings:
        """Section [lab.acme] of a configuration."""

        buffers: Annotated[int, Range(2, 100)] = 8  # images that the vendor's library keeps

    def __init__(self, wanted: Wanted) -> None:
        self._wanted, self._bits, self._camera = wanted, bits_of(wanted.pixel_format), None

    def open(self) -> CameraInfo:
        import acme_sdk  # here: the package is not needed to read a session

        wanted = self._wanted
        if wanted.trigger:
            raise RigError(f"lab.trigger = {wanted.trigger!r}: the driver of acme knows no trigger; set ''")
        try:
            self._camera = camera = acme_sdk.connect(wanted.device or None, buffers=wanted.settings.buffers)
            camera.region = (wanted.width_px, wanted.height_px)
            camera.exposure_us, camera.rate_hz = 1e6 * wanted.exposure_s, wanted.rate_hz
            camera.start()
        except acme_sdk.AcmeError as error:
            raise RigError(f"acme: {error}; see to its cable, and whether another program uses it") from error
        region = camera.region  # as the camera took it: the rig refuses another size
        return CameraInfo(
            *(camera.model, camera.serial, *region, self._bits, camera.rate_hz),
            exposure_s=1e-6 * camera.exposure_us,
            id_bits=16,  # so the vendor's manual: images lost on the cable are seen by their numbers
            ticks_per_s=1e6,  # likewise: stamps in us, which flowrec fits to the host's clock
        )

    def grab(self, timeout_s: float) -> Grabbed | None:
        import acme_sdk

        camera: Any = self._camera
        try:
            image = camera.next_image(timeout_ms=1e3 * timeout_s)
        except acme_sdk.NoImage:
            return None  # slow, or it waits for a trigger: flowrec asks `alive` in time
        except acme_sdk.AcmeError as error:
            raise RigError(f"acme: the camera is gone ({error})") from error
        arrival_ns = time.monotonic_ns()  # at once, before the pixels are copied
        pixels = None if image.damaged else np.array(image.pixels)  # the library uses its memory again
        return Grabbed(pixels, self._bits, image.number, image.stamp_us, arrival_ns, incomplete=image.damaged)

    def alive(self) -> bool:
        return self._camera is not None and bool(self._camera.ping())

    def discarded(self) -> int:
        return int(self._camera.overruns) if self._camera is not None else 0

    def close(self) -> None:
        if self._camera is not None:
            self._camera.stop()
