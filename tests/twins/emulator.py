"""The camera emulator of pylon: how many cameras it has, and the images it shows."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray


@contextmanager
def emulated(cameras: int = 1) -> Iterator[None]:
    """Context in which pylon finds so many emulated cameras; their serial numbers are 0815-0000, 0815-0001, ..."""
    before = os.environ.get("PYLON_CAMEMU")
    os.environ["PYLON_CAMEMU"] = str(cameras)
    try:
        yield
    finally:
        del os.environ["PYLON_CAMEMU"]
        if before is not None:
            os.environ["PYLON_CAMEMU"] = before


def showing(folder: Path, images: list[NDArray[np.uint8]]) -> Path:
    """Writes the images, and the feature file (lab.device_config) with which the emulator shows them in a circle."""
    shown = folder / "shown"  # of this folder, the emulator takes every file for an image
    shown.mkdir()
    for number, image in enumerate(images):
        cv2.imwrite(str(shown / f"{number:04d}.png"), image)
    file = folder / "emulator.pfs"
    lines = ("TestImageSelector\tOff", f"ImageFilename\t{shown}", "ImageFileMode\tOn")
    head = "# {05D8C294-F295-4dfb-9D01-096BD04049F4}\n# GenApi persistence file (version 3.1.0)\n"
    file.write_text(head + "\n".join(lines) + "\n")
    return file
