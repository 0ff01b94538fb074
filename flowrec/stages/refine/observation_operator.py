"""Observation operator: what would be measured in a flow field, and how well a field predicts the observations."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from flowrec.core import Floats, Observations, cells_at, nearest_pixels
from flowrec.physics import pixel_weights

Disturbance = tuple[str, Floats]  # name, and (p, n, 2) what 1 um/s of each unknown adds to observations, whatever flows

TAIL = 4.0  # degrees of freedom of the observations' Student-t noise
RELATIVE_NOISE = 0.03  # of the measured speed, in addition to its std: what pixels can not represent


class Window(NamedTuple):
    """The square around each point over whose fluid an observation is a mean."""

    side_px: float
    mask: NDArray[np.bool_]  # (h, w) of the fluid

    def stencils(self, points: Floats) -> tuple[NDArray[np.intp], Floats]:
        """Pixels (n, m), the nearest first, and their parts (n, m) of the fluid in the squares around points (n, 2)."""
        half, (h, w) = 0.5 * self.side_px, self.mask.shape
        first = np.floor(points - half + 0.5).astype(np.intp)
        at = first[:, None] + np.arange(int(np.ceil(self.side_px)) + 1)[:, None]  # (n, k, 2)
        low, high = (points - half)[:, None], (points + half)[:, None]
        covered = np.maximum(np.minimum(at + 0.5, high) - np.maximum(at - 0.5, low), 0.0)
        covered[(at < 0) | (at >= [w, h])] = 0.0
        columns, rows = np.clip(at[..., 0], 0, w - 1), np.clip(at[..., 1], 0, h - 1)
        pixels = (rows[:, :, None] * w + columns[:, None, :]).reshape(len(points), -1)
        weights = (covered[..., 1][:, :, None] * covered[..., 0][:, None, :]).reshape(pixels.shape)
        weights *= self.mask.ravel()[pixels]
        nearest = nearest_pixels(points, self.mask.shape)
        order = np.argsort(pixels != (nearest[0] * w + nearest[1])[:, None], axis=1, kind="stable")
        pixels, weights = (np.take_along_axis(each, order, axis=1) for each in (pixels, weights))
        return pixels, weights / np.maximum(weights.sum(axis=1, keepdims=True), 1e-12)


@dataclass(frozen=True, slots=True, eq=False)
class ObservationOperator:
    """The usable observations of a mask. Each is a weighted sum of pixels: what `flow.sample` gives there."""

    points: Floats  # (n, 2) x and y in pixels of the mask
    pixels: NDArray[np.intp]  # (n, m) indices into the raster, row by row; the first is the nearest one
    weights: Floats  # (n, m), 0 where pixels are left out
    width: int  # columns of the raster
    flow_um_s: Floats  # (n, 2)
    std_um_s: Floats  # (n,)
    ignored: str = ""  # number of unusable observations and why; for people
    rolled_um_s: Floats | None = None  # (n, 2) the robot's own motion; None: not stated, see Observations
    time_s: Floats | None = None  # (n,)
    radius_px: float | None = None  # of the robot; None: not stated
    disturbances: tuple[Disturbance, ...] = ()  # see disturbances.py
    tracer: Floats | None = None  # (n,) number of the tracer that was observed, -1: the robot; None: all are of it
    window: Window | None = None  # over which each is a mean; None: that at its point

    @property
    def count(self) -> int:
        """Number of usable observations."""
        return len(self.std_um_s)

    @property
    def robot(self) -> Floats:
        """(n,) number of the robot that was observed; below 0 for a tracer."""
        return np.zeros(self.count) if self.tracer is None else -1.0 - self.tracer

    @property
    def rms_um_s(self) -> float:
        """Root mean square of the measured speed."""
        return float(np.sqrt((self.flow_um_s**2).sum(axis=1).mean()))

    def predict(self, values: NDArray[np.floating]) -> Floats:
        """Predicted observations (..., n, 2) of velocities (..., pixels, 2)."""
        return np.asarray(np.einsum("...nkc,nk->...nc", values[..., self.pixels, :], self.weights), np.float64)

    def renumber(self, number: NDArray[np.intp]) -> ObservationOperator:
        """The operator on the pixels with a number (h, w) >= 0; the velocity of all others is 0."""
        pixels = number.ravel()[self.pixels]
        return replace(self, pixels=np.maximum(pixels, 0), weights=np.where(pixels >= 0, self.weights, 0.0))

    def on_fluid(self, mask: NDArray[np.bool_]) -> ObservationOperator:
        """The operator on the fluid pixels of a mask (h, w) in raster order."""
        return self.renumber(_fluid_number(mask))

    def distinct(self) -> ObservationOperator:
        """The operator without copies: an observation that was given several times counts once."""
        identity = np.concatenate([self.points, self.flow_um_s], axis=1)
        first = np.sort(np.unique(identity, axis=0, return_index=True)[1])
        return replace(
            self,
            points=self.points[first],
            pixels=self.pixels[first],
            weights=self.weights[first],
            flow_um_s=self.flow_um_s[first],
            std_um_s=self.std_um_s[first],
            rolled_um_s=None if self.rolled_um_s is None else self.rolled_um_s[first],
            time_s=None if self.time_s is None else self.time_s[first],
            tracer=None if self.tracer is None else self.tracer[first],
        )

    def with_walls(self, wall_px: NDArray[np.float32]) -> ObservationOperator:
        """The operator in a field with the walls of a raster (h, w), see FlowField."""
        pixels, weights = _stencils(self.points, wall_px.shape, wall_px, self.window)
        return replace(self, pixels=pixels, weights=weights)

    def beside(
        self, steps: Floats, wall_px: NDArray[np.float32], mask: NDArray[np.bool_]
    ) -> tuple[ObservationOperator, ...]:
        """The operators whose points are moved by steps (k, 2), and no farther than to the border of the image.

        In a field with the walls of a raster (h, w), on the fluid pixels of a mask.
        """
        points = np.clip(self.points + steps[:, None], 0.0, np.array(mask.shape[::-1]) - 1.0)
        stencils = _stencils(points.reshape(-1, 2), wall_px.shape, wall_px, self.window)
        both = (np.split(each, len(steps)) for each in stencils)
        number = _fluid_number(mask)
        return tuple(
            replace(self, points=at, pixels=pixels, weights=weights).renumber(number)
            for at, pixels, weights in zip(points, *both, strict=True)
        )

    def misfit(self, velocity: NDArray[np.floating]) -> Floats:
        """(n,) squared distance of the prediction of a field (h, w, 2), in standard deviations.

        Its mean is 2 if the field is right.
        """
        error = self.predict(velocity.reshape(-1, 2)) - self.flow_um_s
        return np.asarray(((error / self.noise_um_s[:, None]) ** 2).sum(axis=1))

    @property
    def noise_um_s(self) -> Floats:
        """(n,) standard deviation of the observations, with what pixels can not represent."""
        speed = np.linalg.norm(self.flow_um_s, axis=1)
        return np.asarray(np.hypot(self.std_um_s, RELATIVE_NOISE * np.maximum(speed, 0.1 * speed.max()) + 1e-9))


def observation_operator(
    observations: Observations,
    mask: NDArray[np.bool_],
    um_per_px: float,
    wall_px: NDArray[np.float32] | None,
) -> ObservationOperator:
    """Operator of the observations that are finite, have a standard deviation and lie in a fluid pixel of a mask.

    `wall_px` (h, w) is that of the field in which they are predicted; without it the operator is bilinear.
    """
    points = observations.position_um / um_per_px
    finite = (
        np.isfinite(points).all(axis=1)
        & np.isfinite(observations.flow_um_s).all(axis=1)
        & np.isfinite(observations.std_um_s)
        & (observations.std_um_s >= 0.0)
    )
    for more in (observations.rolled_um_s, observations.time_s):
        finite &= True if more is None else np.isfinite(more.reshape(len(finite), -1)).all(axis=1)
    usable = finite & cells_at(points, mask.shape).inside
    usable[usable] = mask[nearest_pixels(points[usable], mask.shape)]
    side_px = 0.0 if observations.window_um is None else observations.window_um / um_per_px
    window = (
        Window(side_px, mask) if side_px > 1.0 else None
    )  # a mean over less than a pixel is the value in its middle
    pixels, weights = _stencils(points[usable], mask.shape, wall_px, window)
    unusable = ((~finite, "without finite numbers"), (finite & ~usable, "outside the fluid"))
    return ObservationOperator(
        points[usable],
        pixels,
        weights,
        mask.shape[1],
        observations.flow_um_s[usable],
        observations.std_um_s[usable],
        " and ".join(f"{which.sum()} {why}" for which, why in unusable if which.any()),
        None if observations.rolled_um_s is None else observations.rolled_um_s[usable],
        None if observations.time_s is None else observations.time_s[usable],
        None if observations.radius_um is None else observations.radius_um / um_per_px,
        tracer=None if observations.tracer is None else observations.tracer[usable],
        window=window,
    )


def _fluid_number(mask: NDArray[np.bool_]) -> NDArray[np.intp]:
    """(h, w) number of each fluid pixel in raster order, -1 in solid."""
    number = np.full(mask.shape, -1, np.intp)
    number[mask] = np.arange(np.count_nonzero(mask))
    return number


def _stencils(
    points: Floats, shape: tuple[int, ...], wall_px: NDArray[np.float32] | None, window: Window | None = None
) -> tuple[NDArray[np.intp], Floats]:
    """Pixels (n, m) and weights (n, m) of `flow.sample` at points (n, 2) in px, or of its mean over their windows."""
    if window is not None:
        return window.stencils(points)
    if wall_px is not None and min(shape) > 1:
        return pixel_weights(wall_px, points)
    cells = cells_at(points, shape)
    # The nearest pixel, that of the largest weight, goes first.
    order = np.argsort(-cells.weights, axis=1, kind="stable")
    pixels = cells.rows * shape[1] + cells.columns
    return np.take_along_axis(pixels, order, axis=1), np.take_along_axis(cells.weights, order, axis=1)


def student_t_loss(misfits: Floats) -> float:
    """Mean negative log-likelihood of Student-t noise, bounded in its effect by outliers, but for a constant."""
    return float(0.5 * (TAIL + 2.0) * np.log1p(misfits / TAIL).mean()) if len(misfits) else float("inf")
