"""What observations say of a channel, carried along it: not through walls, as a convolution would."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
SMOOTHINGS = 4  # pixels of double size over which neighbours are averaged
STEPS = 64  # of such pixels, as far as the nearest observation is looked for
LARGEST_GAIN = 1.5  # an outlier speaks for none that boundary values could have


@dataclass(frozen=True, slots=True, eq=False)
class Channels:
    """Pixels of double size that hold fluid, and their neighbours."""

    where: NDArray[np.bool_]  # (h/2, w/2)
    around: NDArray[np.intp]  # (fluid pixels, 9) numbers of pixels; the number after the last where there is none

    @classmethod
    def of(cls, fluid: NDArray[np.bool_]) -> Channels:
        """Channels of a mask (h, w) with even sides."""
        where = np.asarray(fluid.reshape(fluid.shape[0] // 2, 2, fluid.shape[1] // 2, 2).any(axis=(1, 3)))
        count = int(where.sum())
        number = np.full((where.shape[0] + 2, where.shape[1] + 2), count)
        number[1:-1, 1:-1][where] = np.arange(count)
        rows, columns = np.nonzero(where)
        around = [number[rows + 1 + dy, columns + 1 + dx] for dy in (-1, 0, 1) for dx in (-1, 0, 1)]
        return cls(where, np.stack(around, axis=1))

    def mean(self, values: Floats) -> Floats:
        """(fluid pixels, c) sum of values (fluid pixels, c) over the 3 x 3 pixels around, over 9."""
        padded = np.concatenate([values, np.zeros((1, values.shape[1]))])
        return np.asarray(padded[self.around].mean(axis=1))


def spread(fluid: NDArray[np.bool_], velocity: Floats, gaps: Floats) -> Floats:
    """(h, w, 3): relative gain of the nearest observations, the logarithm of its precision, how far they are (0 to 1).

    Mask (h, w) with even sides, initial velocity (h, w, 2), and gaps (h, w, 4) as in `Case.gaps`.
    """
    channels = Channels.of(fluid)
    seen, noise = gaps[..., 0] > 0.0, np.maximum(gaps[..., 3], 1e-3)
    size = (velocity**2).sum(axis=-1)
    gain = (gaps[..., 1:3] * velocity).sum(axis=-1) / np.maximum(size, 1e-9)
    precision = np.where(seen, size / noise**2, 0.0)
    told = np.stack([np.clip(gain, -LARGEST_GAIN, LARGEST_GAIN) * precision, precision], axis=-1)
    h, w = channels.where.shape
    values = told.reshape(h, 2, w, 2, 2).sum(axis=(1, 3))[channels.where]
    for _ in range(SMOOTHINGS):
        values = channels.mean(values)
    known = values[:, 1] > 1e-12
    state = np.column_stack([values[:, 0] / np.maximum(values[:, 1], 1e-12), np.log1p(values[:, 1]) / 7.0, known])
    state[~known] = 0.0
    far = np.where(known, 0.0, 1.0)
    for step in range(1, STEPS):
        total = channels.mean(state)
        new = (state[:, 2] == 0.0) & (total[:, 2] > 0.0)
        if not new.any():
            break
        state[new] = total[new] / total[new, 2:]
        far[new] = step / STEPS
    made = np.zeros((h, w, 3))
    made[channels.where] = np.column_stack([state[:, :2], far])
    return np.asarray(np.repeat(np.repeat(made, 2, axis=0), 2, axis=1) * fluid[..., None])
