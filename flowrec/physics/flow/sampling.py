"""Use of a flow field: its value between pixel centres, its error, and values of fluid pixels as an image."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from flowrec.core import Bools, Floats, FlowError, FlowField
from flowrec.physics.chip.registration import on_chip
from flowrec.physics.flow.velocity_stencil import velocities_at, velocity_at

_NO_WALLS = np.zeros((0, 0), np.float32)
_NO_WALLS.flags.writeable = False


def sample(field: FlowField, points_um: ArrayLike) -> Floats:
    """Velocity (..., 2) in um/s at points (..., 2) in um; zero in solid and outside the mask's image.

    It follows the profile of the channel between pixel centres (velocity_stencil); a field that does not state its
    walls is bilinear. In the outer half pixel the value of the border pixel holds. A single point takes a few
    microseconds, for use in the control loop.
    """
    points = np.asarray(points_um, np.float64) / field.um_per_px
    velocity, wall_px = field.velocity_um_s, walls_of(field)
    if points.ndim > 1:
        return velocities_at(velocity, wall_px, np.ascontiguousarray(points.reshape(-1, 2))).reshape(points.shape)
    x, y = points.tolist()
    h, w = velocity.shape[:2]
    inside = -0.5 <= x <= w - 0.5 and -0.5 <= y <= h - 0.5
    return np.array(velocity_at(velocity, wall_px, x, y) if inside else (0.0, 0.0))


def sample_as_seen(field: FlowField, points_um: ArrayLike) -> Floats:
    """`sample` at points (..., 2) as the image shows them, in its um/s, by the registration that a refinement found."""
    if field.registration is None:
        return sample(field, points_um)
    velocity = sample(field, on_chip(field.registration, points_um))
    (xx, xy, _), (yx, yy, _) = field.registration
    x, y = velocity[..., 0], velocity[..., 1]
    return np.asarray(np.stack((yy * x - xy * y, xx * y - yx * x), -1) / (xx * yy - xy * yx))


def walls_of(field: FlowField) -> NDArray[np.float32]:
    """`wall_px` of a field for the kernels of velocity_stencil: of no pixels where the field is to be bilinear."""
    return field.wall_px if field.wall_px is not None and min(field.wall_px.shape) > 1 else _NO_WALLS


@dataclass(frozen=True, slots=True)
class FieldError:
    """Relative RMSE over the fluid pixels, of each component and of the vector."""

    vx: float
    vy: float
    v: float


def relative_rmse(field: FlowField, truth: FlowField, mask: Bools) -> FieldError:
    """sqrt(sum |v - v*|^2 / sum |v*|^2) at the centres of the fluid pixels of a mask (h, w): Table I of the paper.

    Both sums are over points, so both fields must hold values at pixel centres. A true field at rest gives NaN.

    Raises
    ------
    FlowError
        If the two fields have different sizes.
    """
    if field.velocity_um_s.shape != truth.velocity_um_s.shape:
        raise FlowError(
            f"flow fields of {field.velocity_um_s.shape[:2]} and {truth.velocity_um_s.shape[:2]} pixels can not be "
            "compared; use fields of the same chip"
        )
    error = (field.velocity_um_s - truth.velocity_um_s)[mask].astype(np.float64)
    true = truth.velocity_um_s[mask].astype(np.float64)

    def ratio(error: Floats, true: Floats) -> float:
        total = float((true**2).sum())
        return float(np.sqrt((error**2).sum() / total)) if total > 0 else float("nan")

    return FieldError(ratio(error[:, 0], true[:, 0]), ratio(error[:, 1], true[:, 1]), ratio(error, true))


def fluid_image(mask: Bools, values: NDArray[Any]) -> NDArray[Any]:
    """Values (n, ...) of the fluid pixels in raster order as an image (h, w, ...) that is 0 in solid."""
    image = np.zeros((*mask.shape, *values.shape[1:]), values.dtype)
    image[mask] = values
    return image
