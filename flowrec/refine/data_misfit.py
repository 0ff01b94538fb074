"""How well a field predicts the observations, and whether a correction is to be believed."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from flowrec.refine.observation_operator import Floats, Sight

TAIL = 4.0  # Student-t noise, as in the assimilation
RELATIVE_NOISE = 0.03  # of the measured speed, beside its std: what the pixels can not represent


def misfit(velocity: NDArray[np.floating], sight: Sight) -> Floats:
    """(n,) squared distance of what a field (h, w, 2) predicts, in standard deviations; 2 on average if all is well."""
    return np.asarray((((sight.of(velocity) - sight.flow_um_s) / noise_of(sight)[:, None]) ** 2).sum(axis=1))


def noise_of(sight: Sight) -> Floats:
    """(n,) std of the observations with what pixels can not represent, um/s."""
    speed = np.linalg.norm(sight.flow_um_s, axis=1)
    return np.asarray(np.hypot(sight.std_um_s, RELATIVE_NOISE * np.maximum(speed, 0.1 * speed.max()) + 1e-9))


def doubt(misfits: Floats) -> float:
    """Mean negative log-likelihood of Student-t noise: an outlier can not decide."""
    return float(0.5 * (TAIL + 2.0) * np.log1p(misfits / TAIL).mean()) if len(misfits) else float("inf")
