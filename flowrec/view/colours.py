"""Numbers to colours, and the scale from which a person reads them back."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

Rgb = tuple[int, int, int]

SOLID: Rgb = (48, 48, 54)  # where nothing flows: walls, and what is not known
NO_WAY: Rgb = (110, 40, 44)  # fluid from which the goal can not be reached
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

# Viridis for speeds: as bright as it is fast, also for the colour-blind; the others so that no map is mistaken.
_TABLES: dict[str, NDArray[np.uint8]] = {
    name: np.ascontiguousarray(cv2.applyColorMap(np.arange(256, dtype=np.uint8)[:, None], code)[:, 0, ::-1])
    for name, code in (
        ("speed", cv2.COLORMAP_VIRIDIS),
        ("uncertainty", cv2.COLORMAP_INFERNO),
        ("time", cv2.COLORMAP_CIVIDIS),
    )
}


def _diverging() -> NDArray[np.uint8]:
    """(256, 3) blue, almost white at zero, red."""
    knots = np.array([(24, 78, 190), (116, 173, 240), (238, 238, 238), (244, 140, 96), (190, 24, 40)], np.float64)
    at = np.linspace(0.0, 1.0, len(knots))
    return np.stack([np.interp(np.linspace(0.0, 1.0, 256), at, knots[:, c]) for c in range(3)], 1).astype(np.uint8)


_TABLES["change"] = _diverging()

Colours = Literal["speed", "uncertainty", "change", "time"]


@dataclass(frozen=True, slots=True)
class Scale:
    """Values from `low` to `high` in the colours of one table, with round ticks."""

    colours: Colours
    low: float
    high: float
    step: float  # between ticks

    @property
    def unit(self) -> str:
        """What the numbers are in."""
        return "s" if self.colours == "time" else "µm/s"

    @classmethod
    def up_to(cls, largest: float, colours: Colours) -> Scale:
        """From zero (a change: from its negative) to a round number that is not below `largest`."""
        largest = max(largest, 1e-9)
        step = _round_step(largest / (3.0 if colours == "change" else 6.0))
        high = step * math.ceil(largest / step - 1e-9)
        return cls(colours, -high if colours == "change" else 0.0, high, step)

    @property
    def ticks(self) -> list[float]:
        """Round values from low to high."""
        return [self.low + self.step * i for i in range(round((self.high - self.low) / self.step) + 1)]

    def paint(self, values: ArrayLike) -> NDArray[np.uint8]:
        """Colours (..., 3) of values (...); NaN becomes the colour of solid."""
        values = np.asarray(values, np.float64)
        known = np.isfinite(values)
        share = (np.where(known, values, self.low) - self.low) / (self.high - self.low)
        table = _TABLES[self.colours]
        colours = table[np.clip(np.rint(share * 255.0), 0, 255).astype(np.intp)]
        return np.where(known[..., None], colours, np.array(SOLID, np.uint8)).astype(np.uint8)


def _round_step(step: float) -> float:
    """The next of 1, 2, 2.5, 5, 10 times a power of ten that is not below `step`."""
    power = 10.0 ** math.floor(math.log10(step))
    return next(m * power for m in (1.0, 2.0, 2.5, 5.0, 10.0) if m * power >= step * (1 - 1e-9))
