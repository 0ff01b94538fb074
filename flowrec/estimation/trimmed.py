"""`trimmed`: the paper's treatment of a survey. "To reduce noise, the top and bottom 20% of the velocity values are
discarded, followed by polynomial smoothing."

The paper does not say of which values. Over a whole survey the top 20 % are the narrow branches, where the flow is
fast and nothing is wrong, so we discard within a window that slides along the way, each component for itself; `over`
= "survey" is the other reading.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray

from flowrec.messages import Observations
from flowrec.ranges import Range

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Trimmed:
    """Settings of the paper's treatment."""

    discarded_share: Annotated[float, Range(0.0, 0.49)] = 0.2  # at the top, and as many at the bottom
    over: Literal["window", "survey"] = "window"
    window: Annotated[int, Range(1, 1001)] = 9  # observations along the way
    degree: Annotated[int, Range(0, 9)] = 2  # of the polynomial in the way travelled

    def treat(self, observations: Observations) -> Observations:
        """As many observations at the same places, smoothed; those that are not finite numbers are left out.

        The standard deviation is what one of the values kept has: the larger of the stated one and of what scatters
        around the polynomial. Its mean is known better than that, but neighbours share the values that made them, so
        to whoever takes them as independent they are worth no more (the Sampler holds it the same way).
        """
        sound = (
            np.isfinite(observations.position_um).all(axis=1)
            & np.isfinite(observations.flow_um_s).all(axis=1)
            & np.isfinite(observations.std_um_s)
        )
        position, flow, std = (
            array[sound] for array in (observations.position_um, observations.flow_um_s, observations.std_um_s)
        )
        count = len(std)
        if count < self.degree + 3:
            return Observations(observations.stamp_ns, position, flow, std)
        way = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(position, axis=0).T))])
        kept = np.stack([_kept(flow[:, axis], self.discarded_share) for axis in (0, 1)], axis=1)
        smooth, scatter = flow.copy(), np.tile(std[:, None], 2)
        for index in range(count):
            first = min(max(index - self.window // 2, 0), max(count - self.window, 0))
            near = slice(first, first + self.window)
            for axis in (0, 1):
                values = flow[near, axis]
                use = kept[near, axis] if self.over == "survey" else _kept(values, self.discarded_share)
                if np.count_nonzero(use) > self.degree + 1:
                    smooth[index, axis], rms = _polynomial(
                        way[near][use] - way[index], values[use], std[near][use], self.degree
                    )
                    scatter[index, axis] = max(std[index], rms)
        return Observations(observations.stamp_ns, position, smooth, np.sqrt((scatter**2).mean(axis=1)))


def _kept(values: Floats, share: float) -> NDArray[np.bool_]:
    """Where the values are neither among the largest nor among the smallest."""
    rank = np.argsort(np.argsort(values, kind="stable"), kind="stable")
    out = int(share * len(values))
    return np.asarray((rank >= out) & (rank < len(values) - out))


def _polynomial(way: Floats, values: Floats, std: Floats, degree: int) -> tuple[float, float]:
    """Value of the least squares polynomial at way 0, and the scatter around it with its lost freedom made up for."""
    scale = max(float(np.abs(way).max()), 1e-12)
    powers = np.vander(way / scale, degree + 1, increasing=True)
    weight = 1.0 / np.maximum(std, 1e-6 * max(float(std.max()), 1e-12))
    found = np.linalg.lstsq(powers * weight[:, None], values * weight, rcond=None)[0]
    free = len(values) - degree - 1
    return float(found[0]), float(np.sqrt(((values - powers @ found) ** 2).sum() / free))
