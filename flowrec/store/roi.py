"""Part of an image is enough: the window that the tracker read, the rest black, and now and then the whole image.

A window holds every pixel that had a say in where the robot is, so a replay with the recorded tracker is exact. The
image keeps its size and its schema: every viewer reads it, and compression makes next to nothing of the black.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from flowrec.declarations import Image
from flowrec.messages import Frame, Track
from flowrec.units import nanoseconds

Window = tuple[int, int, int, int]  # x0, y0, x1, y1 in camera px, the latter two exclusive

# In the metadata of the channel.
_NOTE, _PAD, _EVERY = "region", "pad_px", "full_every_s"
_ROBOT = "robot"


@dataclass(frozen=True, slots=True)
class Region:
    """Which images are cut down to a window, and to which.

    Attributes
    ----------
    pad_px : how much larger than the region searched (Track.roi_px) a window is on each side.
    everywhere_px : the searched region of a tracker that looks everywhere; such images stay whole.
    full_every_s : so often another one stays whole.
    cut : False where the images have been cut before, and are to be kept as they come.
    """

    pad_px: int
    everywhere_px: Window
    full_every_s: float
    cut: bool = True

    @property
    def notes(self) -> dict[str, str]:
        """For the metadata of the channel: what a reader must know."""
        return {
            _NOTE: _ROBOT,
            _PAD: str(self.pad_px),
            _EVERY: f"{self.full_every_s:.6g}",
            "outside": "0 where the tracker did not look, but for the images that are whole",
        }


def region_from(notes: Mapping[str, str]) -> Region | None:
    """What the metadata of a channel says; None: its images are whole. They have been cut, and are not to be again."""
    if notes.get(_NOTE) != _ROBOT:
        return None
    pad, every = notes.get(_PAD, ""), notes.get(_EVERY, "")
    pad_px = int(pad) if pad.isdecimal() and len(pad) < 9 else 0
    every_s = float(every) if re.fullmatch(r"\d{1,9}(\.\d{1,9})?", every) else 0.0
    return Region(pad_px, (0, 0, 0, 0), every_s, cut=False)


class Windows:
    """The window of one image after the other, of those that are kept."""

    def __init__(self, region: Region) -> None:
        self.images = 0
        self.windows = 0  # images that are not whole
        self._region = region
        self._every_ns = nanoseconds(region.full_every_s)
        self._whole_ns: int | None = None

    def begin(self) -> None:
        """A file begins: its first image is whole."""
        self._whole_ns = None

    def of(self, frame: Frame, track: Track | None) -> Window | None:
        """What is to be kept of an image; None: all of it."""
        self.images += 1
        window = self._looked_at(frame, track)
        due = self._whole_ns is None or frame.stamp_ns >= self._whole_ns + self._every_ns
        if window is None or due:
            self._whole_ns = frame.stamp_ns
            return None
        self.windows += 1
        return window

    def _looked_at(self, frame: Frame, track: Track | None) -> Window | None:
        # A track of another image says nothing about this one: it was the last before a failure.
        if (
            not self._region.cut
            or track is None
            or not track.seen
            or track.stamp_ns != frame.stamp_ns
            or len(track.roi_px) != 4
        ):
            return None
        x0, y0, x1, y1 = map(int, track.roi_px)
        if (x0, y0, x1, y1) == self._region.everywhere_px:
            return None
        pad, (height, width) = self._region.pad_px, frame.image.shape
        window = max(x0 - pad, 0), max(y0 - pad, 0), min(x1 + pad, width), min(y1 + pad, height)
        return None if window == (0, 0, width, height) or window[0] >= window[2] or window[1] >= window[3] else window


class Blank:
    """Black images with a window in them, in one piece of memory: what `cut` returns is good until the next one."""

    def __init__(self) -> None:
        self._image: Image = np.zeros((0, 0), np.uint8)
        self._open: Window = (0, 0, 0, 0)

    def cut(self, frame: Frame, window: Window) -> Frame:
        """The frame with all pixels outside of the window 0."""
        if self._image.shape != frame.image.shape:
            self._image = np.zeros(frame.image.shape, np.uint8)
        x0, y0, x1, y1 = self._open
        self._image[y0:y1, x0:x1] = 0
        x0, y0, x1, y1 = self._open = window
        self._image[y0:y1, x0:x1] = frame.image[y0:y1, x0:x1]
        return replace(frame, image=self._image)


def lit(image: Image) -> Window:
    """The smallest window outside of which an image is 0; all of it in one that is whole, for cameras are not blind."""
    height, width = image.shape
    if image.size and image[0].any() and image[-1].any() and image[:, 0].any() and image[:, -1].any():
        return 0, 0, width, height
    rows = np.flatnonzero(image.any(axis=1))
    if not len(rows):
        return 0, 0, 0, 0
    columns = np.flatnonzero(image[rows[0] : rows[-1] + 1].any(axis=0))
    return int(columns[0]), int(rows[0]), int(columns[-1]) + 1, int(rows[-1]) + 1
