"""Webcams, V4L2 devices and streams by OpenCV; a movie file or a URL too.

OpenCV tells neither a number nor a time of an image: what is lost before it is not seen, and stamps are arrivals.
"""

from __future__ import annotations

import os
import time
from pathlib import Path
from typing import cast

import cv2
import numpy as np

from flowrec.core import Image, RigError
from flowrec.rigs.lab.cameras.camera import Camera, CameraInfo, Grabbed, NoCameraError, Wanted, bits_of, difference

_TIMEOUT_MS = 1000
_COLOUR_NOTE = "the camera sends colours: their luminance is used"


class OpencvCamera(Camera):
    """See camera.Camera. `Wanted.device` is a number (/dev/videoN), a path or a URL; '' is the first device."""

    def __init__(self, wanted: Wanted) -> None:
        self._wanted = wanted
        self._capture: cv2.VideoCapture | None = None
        self._bits = bits_of(wanted.pixel_format)
        self._file = False
        self._first: Image | None = None  # read by `open`, which looks at its size
        self._due_s = 0.0

    def open(self) -> CameraInfo:
        wanted = self._wanted
        if wanted.trigger:
            raise RigError(f"lab.trigger = {wanted.trigger!r}: opencv knows no trigger; use another driver")
        source = wanted.device or "0"
        number = int(source) if source.isdecimal() else None
        self._file = Path(source).is_file()
        if number is None and not self._file and "://" not in source:
            raise RigError(f"lab.device = {source!r}: no such file; opencv takes a number, a file or a URL")
        # OpenCV and FFmpeg print their failures; they are told here.
        os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
        cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
        limits = [cv2.CAP_PROP_OPEN_TIMEOUT_MSEC, _TIMEOUT_MS, cv2.CAP_PROP_READ_TIMEOUT_MSEC, _TIMEOUT_MS]
        if number is not None:
            self._capture = capture = cv2.VideoCapture(number)
        else:
            self._capture = capture = cv2.VideoCapture(source, cv2.CAP_FFMPEG, limits)
        if not capture.isOpened():
            absent = RigError if wanted.device else NoCameraError
            raise absent(f"opencv: no camera answers at {source}; see its cable, and whether another program uses it")
        notes = self._set(capture) if number is not None else ()
        self._first = first = self._read(capture)
        image = self._grey(first)
        height, width = image.shape
        if wanted.width_px and (width, height) != (wanted.width_px, wanted.height_px):
            raise RigError(
                f"camera.width_px x camera.height_px = {wanted.width_px} x {wanted.height_px}: images of {source} have "
                f"{width} x {height}; set that"
            )
        if first.ndim == 3 and not _is_grey(first):
            notes += (_COLOUR_NOTE,)
        rate_hz = wanted.rate_hz if self._file else float(capture.get(cv2.CAP_PROP_FPS))
        notes += difference("camera.rate_hz", wanted.rate_hz, rate_hz or None, "Hz")
        self._due_s = time.monotonic()
        return CameraInfo(
            model=f"OpenCV {capture.getBackendName()}",
            serial=source,
            width_px=width,
            height_px=height,
            bits=self._bits,
            rate_hz=max(rate_hz, 0.0),
            exposure_s=wanted.exposure_s,
            pixel_format=f"Mono{self._bits}",
            notes=notes,
        )

    def _set(self, capture: cv2.VideoCapture) -> tuple[str, ...]:
        """Set what is wanted; returns the notes. The unit of the exposure is the driver's, so it is left alone."""
        wanted = self._wanted
        if self._bits > 8:
            capture.set(cv2.CAP_PROP_FOURCC, cv2.VideoWriter.fourcc(*"Y16 "))
            capture.set(cv2.CAP_PROP_CONVERT_RGB, 0)
        if wanted.width_px:
            capture.set(cv2.CAP_PROP_FRAME_WIDTH, wanted.width_px)
            capture.set(cv2.CAP_PROP_FRAME_HEIGHT, wanted.height_px)
        capture.set(cv2.CAP_PROP_FPS, wanted.rate_hz)
        if wanted.gain is not None:
            capture.set(cv2.CAP_PROP_GAIN, wanted.gain)
        notes = difference("lab.gain", wanted.gain, capture.get(cv2.CAP_PROP_GAIN), "")
        return (*notes, "opencv can not set an exposure in seconds: set it in the camera's own program")

    def _read(self, capture: cv2.VideoCapture) -> Image:
        read, image = capture.read()
        if not read:
            raise RigError("the camera is gone: no image can be read")
        return cast(Image, image)

    def _grey(self, image: Image) -> Image:
        """One channel, unchanged if the three of a colour image are the same.

        Raises
        ------
        RigError : another depth than wanted.
        """
        if image.dtype != (np.uint8 if self._bits == 8 else np.uint16):
            raise RigError(f"camera.bits = {self._bits}: opencv delivers {image.dtype} here; set camera.bits = 8")
        if image.ndim == 2:
            return image
        grey = image[:, :, 0].copy() if _is_grey(image) else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
        return cast(Image, grey)

    def grab(self, timeout_s: float) -> Grabbed | None:
        assert self._capture is not None, "grab() after open()"
        if self._file:  # at the rate that is wanted
            wait_s = self._due_s - time.monotonic()
            if wait_s > timeout_s:
                time.sleep(timeout_s)
                return None
            time.sleep(max(wait_s, 0.0))
            self._due_s += 1.0 / self._wanted.rate_hz
        image, self._first = self._first if self._first is not None else self._read(self._capture), None
        return Grabbed(self._grey(image), self._bits, None, None, time.monotonic_ns())

    def alive(self) -> bool:
        return self._capture is not None and self._capture.isOpened()

    def trigger(self) -> None:
        raise RigError("opencv knows no trigger")

    def close(self) -> None:
        if self._capture is not None:
            self._capture.release()


def _is_grey(image: Image) -> bool:
    """True if the three channels of a colour image are the same."""
    return bool(np.array_equal(image[:, :, 0], image[:, :, 1]) and np.array_equal(image[:, :, 0], image[:, :, 2]))
