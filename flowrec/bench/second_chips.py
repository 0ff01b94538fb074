"""Chips of the second generator: a trunk that branches, as strokes whose width changes along the way.

The truth is drawn FINE times as fine as the mask that the laboratory has, so its walls lie anywhere within a pixel of
the mask. Nothing here is shared with the chips of the simulated rig (`physics/chip/synthetic.py`) or of `vessels.py`.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from scipy.ndimage import label

from flowrec.core import Bools, Floats

SIDE_PX = 112
FINE = 3  # pixels of the truth per pixel of the mask; odd, so that the centres coincide
_BEYOND_PX = 10.0  # by which strokes go on beyond the border
_POINTS = 240  # of a stroke
_SHIFT = 4  # binary digits of a fraction of a pixel, for OpenCV
# Where branches leave: a point of the border over the side of the mask, and the direction outwards.
_EXITS = (
    ((0.50, 0.90), None, (0.0, -1.0)),  # top
    (None, (0.12, 0.38), (1.0, 0.0)),  # right, above the middle
    (None, (0.62, 0.88), (1.0, 0.0)),  # right, below the middle
    ((0.50, 0.90), None, (0.0, 1.0)),  # bottom
)


@dataclass(frozen=True, slots=True, eq=False)
class Stroke:
    """A channel: centre line (n, 2) in pixels of the mask and width (n,)."""

    line: Floats
    width: Floats


@dataclass(frozen=True, slots=True, eq=False)
class DrawnChip:
    """Strokes, the first of them the trunk from the inlet, and the ways from the inlet along them to each outlet."""

    strokes: tuple[Stroke, ...]
    ways: tuple[Stroke, ...]

    def fine_mask(self, *more: Stroke) -> Bools:
        """(FINE h, FINE w) True in fluid, the strokes and some more of them."""
        image = np.zeros((FINE * SIDE_PX, FINE * SIDE_PX), np.uint8)
        for stroke in (*self.strokes, *more):
            draw_discs(image, stroke.line, 0.5 * stroke.width)
        parts, _ = label(image)
        x, y = np.round(to_fine(self.strokes[0].line[_POINTS // 2])).astype(int)
        return parts == parts[y, x]


def to_fine(points_px: Floats) -> Floats:
    """Points in pixels of the mask, in pixels of the truth."""
    return FINE * points_px + (FINE - 1) / 2


def draw_discs(image: np.ndarray, centres_px: Floats, radii_px: Floats, value: int = 1) -> None:
    """Fill discs, stated in pixels of the mask, in an image of the truth."""
    scale = 1 << _SHIFT
    for (x, y), radius in zip(to_fine(centres_px) * scale, radii_px * FINE * scale, strict=True):
        cv2.circle(image, (round(x), round(y)), round(radius), value, -1, shift=_SHIFT)


def coarse(fine: Bools) -> Bools:
    """(h, w) the mask whose pixels are fluid where at least half of the truth's pixels in them are."""
    h, w = fine.shape[0] // FINE, fine.shape[1] // FINE
    return fine.reshape(h, FINE, w, FINE).mean(axis=(1, 3)) >= 0.5


def draw_chip(rng: np.random.Generator) -> DrawnChip:
    """Draw a trunk from the left border, two or three branches, perhaps a loop and a pool."""
    side = float(SIDE_PX)
    fork = side * rng.uniform((0.26, 0.38), (0.44, 0.62))
    width = float(rng.uniform(9.0, 15.0))
    start = np.array([-_BEYOND_PX, side * rng.uniform(0.25, 0.75)])
    trunk = _stroke(start, (1.0, 0.0), fork, (1.0, 0.0), width, rng)
    strokes, ways = [trunk], []
    exits = sorted(rng.choice(len(_EXITS), int(rng.integers(2, 4)), replace=False))
    for number in exits:
        x, y, outwards = _EXITS[number]
        place = [side - 1 if x is None else side * rng.uniform(*x), side - 1 if y is None else side * rng.uniform(*y)]
        if outwards[1] < 0.0:
            place[1] = 0.0
        end = np.array(place) + _BEYOND_PX * np.array(outwards)
        turn = (0.8, 0.3 * np.sign(end[1] - fork[1]))
        branch = _stroke(fork, turn, end, outwards, max(width * rng.uniform(0.5, 0.85), 5.0), rng)
        strokes.append(branch)
        ways.append(Stroke(np.r_[trunk.line, branch.line], np.r_[trunk.width, branch.width]))
    if rng.random() < 0.3:  # a loop
        one, two = (strokes[index] for index in (1, 2))
        at = int(_POINTS * rng.uniform(0.45, 0.65))
        towards = two.line[at] - one.line[at]
        strokes.append(_stroke(one.line[at], towards, two.line[at], towards, max(0.35 * width, 4.5), rng))
    if rng.random() < 0.3:  # a pool
        host = strokes[int(rng.integers(len(exits) + 1))]
        at = int(_POINTS * rng.uniform(0.5, 0.7))
        strokes.append(Stroke(host.line[[at]], host.width[[at]] * rng.uniform(1.5, 2.2)))
    return DrawnChip(tuple(strokes), tuple(ways))


def side_channel(chip: DrawnChip, rng: np.random.Generator) -> Stroke:
    """A narrow channel from one of the branches straight to the nearest of the upper and the lower border."""
    host = chip.strokes[int(rng.integers(0, 2))]
    at = host.line[int(_POINTS * rng.uniform(0.45, 0.6))]
    end = np.array([at[0] + rng.uniform(-8.0, 8.0), -_BEYOND_PX if at[1] < SIDE_PX / 2 else SIDE_PX + _BEYOND_PX])
    line = at + np.linspace(0.0, 1.0, _POINTS)[:, None] * (end - at)
    return Stroke(line, np.full(_POINTS, rng.uniform(2.2, 3.5)))


def _stroke(
    start: Floats,
    leaving: tuple[float, float] | Floats,
    end: Floats,
    arriving: tuple[float, float] | Floats,
    width: float,
    rng: np.random.Generator,
) -> Stroke:
    """A cubic Bezier curve with these directions at its ends; the width swings by up to a fifth."""
    t = np.linspace(0.0, 1.0, _POINTS)[:, None]
    reach = 0.4 * np.hypot(*(end - start))
    one, two = (np.array(d) / np.hypot(*d) for d in (leaving, arriving))
    a, b = start + reach * rng.uniform(0.6, 1.2) * one, end - reach * rng.uniform(0.6, 1.2) * two
    line = (1 - t) ** 3 * start + 3 * (1 - t) ** 2 * t * a + 3 * (1 - t) * t**2 * b + t**3 * end
    swing = rng.uniform(0.0, 0.2) * np.sin(2.0 * np.pi * (rng.uniform(0.5, 2.5) * t[:, 0] + rng.random()))
    return Stroke(line, width * (1.0 + swing))
