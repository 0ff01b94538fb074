"""The part of an image that a network sees: the box around the fluid, padded so that it can be halved."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flowrec.refine.observation_operator import Floats


@dataclass(frozen=True, slots=True)
class Crop:
    """A box of `size` (rows, columns) at `corner` of an image of `shape`; padded to multiples of `multiple`."""

    corner: tuple[int, int]
    size: tuple[int, int]
    shape: tuple[int, int]
    multiple: int

    @classmethod
    def around(cls, mask: NDArray[np.bool_], multiple: int) -> Crop:
        """The box around the fluid of a mask (h, w); all of a mask without fluid."""
        if not mask.any():
            mask = np.ones_like(mask)
        rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
        corner = (int(rows[0]), int(columns[0]))
        size = (int(rows[-1]) + 1 - corner[0], int(columns[-1]) + 1 - corner[1])
        return cls(corner, size, (mask.shape[0], mask.shape[1]), multiple)

    def part(self, image: NDArray[Any]) -> NDArray[Any]:
        """The padded part of an image (h, w, ...); zeros beyond the box."""
        rows, columns = self._box
        padding = [(0, -length % self.multiple) for length in self.size]
        return np.pad(image[rows, columns], padding + [(0, 0)] * (image.ndim - 2))

    def whole(self, channels: NDArray[Any]) -> Floats:
        """(h, w, c) of channels (c, rows, columns) on the padded part; zeros beyond the box."""
        image = np.zeros((*self.shape, len(channels)))
        image[self._box] = np.moveaxis(channels[:, : self.size[0], : self.size[1]], 0, -1)
        return image

    @property
    def _box(self) -> tuple[slice, slice]:
        rows, columns = (slice(at, at + length) for at, length in zip(self.corner, self.size, strict=True))
        return rows, columns
