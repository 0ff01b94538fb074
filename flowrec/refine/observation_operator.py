"""Which pixels an observation sees: bilinear weights, so that a field can be compared with what was measured."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from flowrec.messages import Observations

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class Sight:
    """The usable observations of a mask: each is a weighted mean of four pixels."""

    rows: NDArray[np.intp]  # (n, 4)
    columns: NDArray[np.intp]  # (n, 4)
    weights: Floats  # (n, 4) summing to 1
    flow_um_s: Floats  # (n, 2)
    std_um_s: Floats  # (n,)
    ignored: str = ""  # how many others there were, and why they are of no use; for people

    @property
    def count(self) -> int:
        """Number of usable observations."""
        return len(self.std_um_s)

    def of(self, velocity: NDArray[np.floating]) -> Floats:
        """What would be measured in fields (..., h, w, 2): (..., n, 2)."""
        seen = velocity[..., self.rows, self.columns, :]
        return np.asarray(np.einsum("...nkc,nk->...nc", seen, self.weights), np.float64)


def sight(observations: Observations, mask: NDArray[np.bool_], um_per_px: float) -> Sight:
    """The observations that are finite, have a std and lie in a fluid pixel."""
    h, w = mask.shape
    points = observations.position_um / um_per_px
    numbers = (
        np.isfinite(points).all(axis=1)
        & np.isfinite(observations.flow_um_s).all(axis=1)
        & np.isfinite(observations.std_um_s)
        & (observations.std_um_s >= 0.0)
    )
    with np.errstate(invalid="ignore"):
        usable = numbers & (points >= -0.5).all(axis=1) & (points <= np.array([w, h]) - 0.5).all(axis=1)
    usable[usable] = mask[tuple(np.clip(np.rint(points[usable]).astype(np.intp), 0, [w - 1, h - 1]).T[::-1])]
    x, y = np.clip(points[usable], 0.0, [w - 1.0, h - 1.0]).T
    column, row = np.minimum(x.astype(np.intp), max(w - 2, 0)), np.minimum(y.astype(np.intp), max(h - 2, 0))
    right, below = np.minimum(column + 1, w - 1), np.minimum(row + 1, h - 1)
    a, b = x - column, y - row
    return Sight(
        np.stack([row, row, below, below], axis=1),
        np.stack([column, right, column, right], axis=1),
        np.stack([(1 - a) * (1 - b), a * (1 - b), (1 - a) * b, a * b], axis=1),
        observations.flow_um_s[usable],
        observations.std_um_s[usable],
        _ignored(int((~numbers).sum()), int((numbers & ~usable).sum())),
    )


def _ignored(broken: int, outside: int) -> str:
    parts = [
        f"{count} {why}" for count, why in ((broken, "without finite numbers"), (outside, "outside the fluid")) if count
    ]
    return " and ".join(parts)
