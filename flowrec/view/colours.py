"""Colours, and the scales by which numbers become colours."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Literal

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from flowrec.core import Floats, Phase

Rgb = tuple[int, int, int]
Table = Literal["speed", "uncertainty", "change", "time", "arrows"]

SOLID: Rgb = (48, 48, 54)  # walls, and what is not known
UNREACHABLE: Rgb = (110, 40, 44)  # fluid from which the goal can not be reached
# For lines and words over a grey image, or on black.
ORANGE: Rgb = (255, 140, 26)
CYAN: Rgb = (64, 214, 255)
GREEN: Rgb = (92, 224, 92)
YELLOW: Rgb = (255, 226, 64)
RED: Rgb = (255, 84, 84)
BLUE: Rgb = (92, 146, 255)
PURPLE: Rgb = (196, 140, 255)
GREY: Rgb = (150, 150, 158)
PALE: Rgb = (206, 206, 212)
WHITE: Rgb = (236, 236, 240)
_OF_OTHERS: tuple[Rgb, ...] = (BLUE, YELLOW, RED, WHITE, GREEN, PURPLE)  # of the robots from number 1 on, in turn
# Of a phase of the mission, in all pictures; the report has tints of them. The others are grey.
OF_PHASE: dict[str, Rgb] = {
    Phase.SURVEY: PURPLE,
    Phase.REFINE: BLUE,
    Phase.PLAN: YELLOW,
    Phase.NAVIGATE: ORANGE,
    Phase.OBSERVE: PURPLE,
    Phase.DONE: GREEN,
}
# Of arrows over a camera's grey image: all of them light.
_LIGHT = np.array([(222, 236, 255), (255, 252, 214), (255, 236, 96)], np.float64)
# Of a change: blue, almost white at zero, red.
_DIVERGING = np.array([(24, 78, 190), (116, 173, 240), (238, 238, 238), (244, 140, 96), (190, 24, 40)], np.float64)


def _between(knots: Floats) -> NDArray[np.uint8]:
    """(256, 3) colours between evenly spaced knots (n, 3)."""
    at, places = np.linspace(0.0, 1.0, 256), np.linspace(0.0, 1.0, len(knots))
    return np.stack([np.interp(at, places, channel) for channel in knots.T], 1).astype(np.uint8)


# Viridis for speeds: its brightness increases with speed, also for the colour-blind. Other quantities have other
# tables, so that no map is mistaken for another.
_LEVELS = np.arange(256, dtype=np.uint8)[:, None]
_TABLES: dict[Table, NDArray[Any]] = {
    "speed": cv2.applyColorMap(_LEVELS, cv2.COLORMAP_VIRIDIS)[:, 0, ::-1],
    "uncertainty": cv2.applyColorMap(_LEVELS, cv2.COLORMAP_INFERNO)[:, 0, ::-1],
    "time": cv2.applyColorMap(_LEVELS, cv2.COLORMAP_CIVIDIS)[:, 0, ::-1],
    "change": _between(_DIVERGING),
    "arrows": _between(_LIGHT),
}


@dataclass(frozen=True, slots=True)
class ColourScale:
    """Values from `low` to `high` in the colours of one table, with round ticks."""

    table: Table
    low: float
    high: float
    step: float  # between ticks

    @classmethod
    def up_to(cls, largest: float, table: Table) -> ColourScale:
        """From zero (a change: from its negative) to a round number that is not below `largest`."""
        largest = max(largest, 1e-9)
        step = _round_step(largest / (3.0 if table == "change" else 6.0))
        high = 0.5 * step * math.ceil(2.0 * largest / step - 1e-9)
        return cls(table, -high if table == "change" else 0.0, high, step)

    @property
    def ticks(self) -> list[float]:
        """The multiples of the step from low to high."""
        first, last = (math.floor(abs(end) / self.step + 1e-9) for end in (self.low, self.high))
        return [self.step * i for i in range(-first, last + 1)]

    @property
    def labels(self) -> list[str]:
        """The ticks as text; of a change with their sign."""
        sign = "+" if self.table == "change" else ""
        return [f"{tick:{sign}g}" if abs(tick) > 1e-9 * self.high else "0" for tick in self.ticks]

    def paint(self, values: ArrayLike) -> NDArray[np.uint8]:
        """Colours (..., 3) of values (...); NaN becomes the colour of solid."""
        values = np.asarray(values, np.float64)
        known = np.isfinite(values)
        fraction = (np.where(known, values, self.low) - self.low) / (self.high - self.low)
        painted = _TABLES[self.table][np.clip(np.rint(fraction * 255.0), 0, 255).astype(np.intp)]
        return np.where(known[..., None], painted, np.array(SOLID, np.uint8)).astype(np.uint8)


def _round_step(step: float) -> float:
    """The smallest of 1, 2, 2.5, 5, 10 times a power of ten that is not below `step`."""
    power = 10.0 ** math.floor(math.log10(step))
    return next(m * power for m in (1.0, 2.0, 2.5, 5.0, 10.0) if m * power >= step * (1 - 1e-9))


def of_robot(number: int) -> Rgb:
    """The colour of a robot; the first one, number 0, is orange."""
    return _OF_OTHERS[(number - 1) % len(_OF_OTHERS)] if number else ORANGE


def round_below(number: float) -> float:
    """The largest of 1, 2, 5 times a power of ten that is not above a positive number."""
    power = 10.0 ** math.floor(math.log10(number))
    return max(m * power for m in (0.5, 1.0, 2.0, 5.0) if m * power <= number * (1 + 1e-9))
