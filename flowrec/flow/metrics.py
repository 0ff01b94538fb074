"""How far one flow field is from another."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from flowrec.errors import FlowError
from flowrec.messages import FlowField


@dataclass(frozen=True, slots=True)
class FieldError:
    """Relative RMSE over the fluid pixels, of each component and of the vector."""

    vx: float
    vy: float
    v: float


def relative_rmse(field: FlowField, truth: FlowField, mask: NDArray[np.bool_]) -> FieldError:
    """sqrt(sum |v - v*|^2 / sum |v*|^2) over the fluid pixels, as in the paper's Table I.

    A field on another grid than the truth's is a FlowError; a truth at rest gives NaN.
    """
    if field.velocity_um_s.shape != truth.velocity_um_s.shape:
        raise FlowError(
            f"flow fields of {field.velocity_um_s.shape[:2]} and {truth.velocity_um_s.shape[:2]} pixels can not be "
            "compared; use fields of the same chip"
        )
    miss = (field.velocity_um_s - truth.velocity_um_s)[mask].astype(np.float64)
    true = truth.velocity_um_s[mask].astype(np.float64)

    def ratio(error: NDArray[np.float64], size: NDArray[np.float64]) -> float:
        total = float((size**2).sum())
        return float(np.sqrt((error**2).sum() / total)) if total > 0 else float("nan")

    return FieldError(ratio(miss[:, 0], true[:, 0]), ratio(miss[:, 1], true[:, 1]), ratio(miss, true))
