"""Region of interest: of most images only the window that the tracker read is recorded, the rest is black.

A window contains every pixel that influenced the track, so a replay with the recorded tracker is exact. The image
keeps its size and its schema: every viewer reads it, and the black compresses to almost nothing.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from flowrec.core import Frame, Image, Track, nanoseconds

Window = tuple[int, int, int, int]  # x0, y0, x1, y1 in camera px, the latter two exclusive

# In the metadata of the channel.
_NOTE, _PAD, _EVERY = "region", "pad_px", "full_every_s"
_ROBOT = "robot"


@dataclass(frozen=True, slots=True)
class Region:
    """Rule by which images are reduced to a window around the robot."""

    pad_px: int  # how much larger than the region searched (Track.roi_px) a window is on each side
    everywhere_px: Window  # the searched region of a tracker that looks everywhere; such images stay whole
    full_every_s: float  # interval in s at which another image stays whole
    cut: bool = True  # False where the images have been cut before, and are recorded as they come

    @property
    def notes(self) -> dict[str, str]:
        """Metadata of the channel that a reader of such images needs."""
        return {
            _NOTE: _ROBOT,
            _PAD: str(self.pad_px),
            _EVERY: f"{self.full_every_s:.6g}",
            "outside": "0 where the tracker did not look, but for the images that are whole",
        }


def region_from(notes: Mapping[str, str]) -> Region | None:
    """The region from the metadata of a channel, which is not applied again; None: its images are not cut."""
    if notes.get(_NOTE) != _ROBOT:
        return None
    pad, every = notes.get(_PAD, ""), notes.get(_EVERY, "")
    pad_px = int(pad) if pad.isdecimal() and len(pad) < 9 else 0
    every_s = float(every) if re.fullmatch(r"\d{1,9}(\.\d{1,9})?", every) else 0.0
    return Region(pad_px, (0, 0, 0, 0), every_s, cut=False)


class WindowSelector:
    """Selects the window of one image after the other."""

    def __init__(self, region: Region) -> None:
        self._region = region
        self._every_ns = nanoseconds(region.full_every_s)
        self._whole_ns: int | None = None  # stamp of the last image that stayed whole

    def window_of(self, frame: Frame, track: Track | None) -> Window | None:
        """The window of an image that is to be recorded; None: the whole image."""
        window = self._searched_window(frame, track)
        if window is None or self._whole_ns is None or frame.stamp_ns >= self._whole_ns + self._every_ns:
            self._whole_ns = frame.stamp_ns
            return None
        return window

    def _searched_window(self, frame: Frame, track: Track | None) -> Window | None:
        # A track of another image, the last before a failure, says nothing about this one.
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


class WindowCutter:
    """Blackens images outside of a window. The image is reused: what `cut` returns is valid until the next call."""

    def __init__(self) -> None:
        self._image: Image = np.zeros((0, 0), np.uint8)
        self._filled: Window = (0, 0, 0, 0)

    def cut(self, frame: Frame, window: Window) -> Frame:
        """The frame with all pixels outside of the window 0."""
        if self._image.shape != frame.image.shape or self._image.dtype != frame.image.dtype:
            self._image = np.zeros_like(frame.image)
            self._filled = (0, 0, 0, 0)
        x0, y0, x1, y1 = self._filled
        self._image[y0:y1, x0:x1] = 0
        x0, y0, x1, y1 = self._filled = window
        self._image[y0:y1, x0:x1] = frame.image[y0:y1, x0:x1]
        return replace(frame, image=self._image)


def nonzero_window(image: Image) -> Window:
    """The smallest window outside of which an image is 0; the whole image where all four edges have a pixel above 0."""
    height, width = image.shape
    if image.size and image[0].any() and image[-1].any() and image[:, 0].any() and image[:, -1].any():
        return 0, 0, width, height
    rows = np.flatnonzero(image.any(axis=1))
    if not len(rows):
        return 0, 0, 0, 0
    columns = np.flatnonzero(image[rows[0] : rows[-1] + 1].any(axis=0))
    return int(columns[0]), int(rows[0]), int(columns[-1]) + 1, int(rows[-1]) + 1
