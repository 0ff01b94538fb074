"""Use of a flow field: its value between pixel centres, its error, and values of fluid pixels as an image."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from flowrec.core import Bools, Floats, Floats32, FlowError, FlowField, compiled
from flowrec.physics.chip.registration import on_chip
from flowrec.physics.flow.velocity_stencil import velocities_at, velocity_at

_NO_WALLS, _NO_MAP, _AS_STATED = np.zeros((0, 0), np.float32), np.zeros((0, 0, 2), np.float32), np.eye(2, 3)
for _each in (_NO_WALLS, _NO_MAP, _AS_STATED):
    _each.flags.writeable = False  # as the arrays of messages are: kernels are compiled for either kind


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
    return np.stack((yy * x - xy * y, xx * y - yx * x), -1) / (xx * yy - xy * yx)


class MapRaster(NamedTuple):
    """A flow field, or none, as the kernels of the control loop take it."""

    velocity_um_s: Floats32  # (h, w, 2); of no pixels without a field
    wall_px: Floats32
    um_per_px: float
    registration: Floats  # (2, 3)

    @classmethod
    def of(cls, field: FlowField | None, *, as_seen: bool = True) -> MapRaster:
        """The raster of a field, with its registration for `sample_as_seen` and without it for `sample`."""
        if field is None:
            return cls(_NO_MAP, _NO_WALLS, 1.0, _AS_STATED)
        registration = field.registration if as_seen and field.registration is not None else _AS_STATED
        return cls(field.velocity_um_s, walls_of(field), field.um_per_px, registration)


@compiled
def raster_velocity(
    velocity: Floats32,
    wall_px: Floats32,
    um_per_px: float,
    registration: Floats,
    x_um: float,
    y_um: float,
) -> tuple[float, float]:
    """Velocity of a MapRaster at one point in um, as `sample_as_seen`; compiled, for other kernels."""
    xx, xy, yx, yy = registration[0, 0], registration[0, 1], registration[1, 0], registration[1, 1]
    x = (xx * x_um + xy * y_um + registration[0, 2]) / um_per_px
    y = (yx * x_um + yy * y_um + registration[1, 2]) / um_per_px
    h, w = velocity.shape[:2]
    if not (x >= -0.5 and y >= -0.5 and x <= w - 0.5 and y <= h - 0.5):
        return 0.0, 0.0
    u, v = velocity_at(velocity, wall_px, x, y)
    area = xx * yy - xy * yx
    return (yy * u - xy * v) / area, (xx * v - yx * u) / area


def walls_of(field: FlowField) -> Floats32:
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

    Both sums are over points, so both fields must hold values at pixel centres. A true field at rest gives NaN. Raises
    FlowError if the two fields have different sizes.
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
