"""Residuals of continuity and momentum on pixels, by fixed convolutions, and their Jacobian.

Dimensionless with length px, velocity V and pressure mu V / px, the equations are

    div v = 0,   Re (v . grad) v + grad p - lap v + f v = 0,   Re = rho V px / mu,   f = 12 px^2 / H^2

with central differences and the five-point Laplacian (the paper's kernel (6) is -1/4 of it). Walls lie half a pixel
beyond the last fluid pixel: the velocity beyond is minus the one before, and the pressure is differenced one-sided.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
import torch
from torch import Tensor
from torch.nn import functional

_DX = [[0.0, 0.0, 0.0], [-0.5, 0.0, 0.5], [0.0, 0.0, 0.0]]
_LAPLACIAN = [[0.0, 1.0, 0.0], [1.0, -4.0, 1.0], [0.0, 1.0, 0.0]]

REACH = 3  # pixels this far apart have no equation in common


@dataclass(frozen=True, slots=True, eq=False)
class Physics:
    """The equations on the fluid pixels of masks (n, 1, h, w), without the border of the image."""

    fluid: Tensor  # (n, 1, h, w) 1 in fluid
    where: Tensor  # (n, 1, h, w) 1 where the residual counts
    solid: tuple[Tensor, Tensor, Tensor, Tensor]  # 1 where the pixel to the right, left, below, above is solid
    reynolds: Tensor | float  # (n, 1, 1, 1) or one for all
    friction: Tensor | float
    kernels: tuple[Tensor, Tensor, Tensor]  # d/dx, d/dy, Laplacian

    @classmethod
    def of(cls, fluid: Tensor, inside: Tensor, reynolds: Tensor | float, friction: Tensor | float) -> Physics:
        """Equations of masks; `inside` (n, 1, h, w) is 1 where all four neighbours lie in the image."""
        beyond = functional.pad(1.0 - fluid, (1, 1, 1, 1), value=0.0)
        solid = (beyond[..., 1:-1, 2:], beyond[..., 1:-1, :-2], beyond[..., 2:, 1:-1], beyond[..., :-2, 1:-1])
        dx = torch.tensor(_DX).to(fluid)
        kernels = tuple(kernel[None, None] for kernel in (dx, dx.T, torch.tensor(_LAPLACIAN).to(fluid)))
        return cls(fluid, fluid * inside, solid, reynolds, friction, kernels)  # type: ignore[arg-type]

    def residuals(self, velocity: Tensor, pressure: Tensor) -> Tensor:
        """(n, 3, h, w): continuity and the two momentum equations of v (n, 2, h, w) and p (n, 1, h, w), 0 in solid."""
        vx, vy = velocity[:, :1], velocity[:, 1:]
        right, left, below, above = self.solid
        slopes = [(self._slope(v, 0, right, left), self._slope(v, 1, below, above)) for v in (vx, vy)]
        equations = [slopes[0][0] + slopes[1][1]]
        gradient = (self._one_sided(pressure, 0, right, left), self._one_sided(pressure, 1, below, above))
        walls = right + left + below + above
        for v, (by_x, by_y), push in zip((vx, vy), slopes, gradient, strict=True):
            laplacian = functional.conv2d(v, self.kernels[2], padding=1) - walls * v
            equations.append(self.reynolds * (vx * by_x + vy * by_y) + push - laplacian + self.friction * v)
        return torch.cat(equations, dim=1) * self.where

    def _slope(self, v: Tensor, axis: int, after: Tensor, before: Tensor) -> Tensor:
        """Central difference of a velocity that is 0 in solid, with -v beyond a wall."""
        return functional.conv2d(v, self.kernels[axis], padding=1) + 0.5 * (before - after) * v

    def _one_sided(self, p: Tensor, axis: int, after: Tensor, before: Tensor) -> Tensor:
        """Central difference of a pressure that is 0 in solid, one-sided beside a wall."""
        inside = functional.conv2d(p, self.kernels[axis], padding=1) + 0.5 * (after - before) * p
        return inside * 2.0 / (2.0 - after - before).clamp(min=1.0) * (after + before < 2.0)

    def jacobian(self, image: Tensor) -> sp.csr_array:
        """(3 h w, 3 h w) derivative of the residuals of one mask around an image (1, 3, h, w) of vx, vy, p.

        The equations are quadratic, so central differences with any step are exact. Pixels that have no equation in
        common are varied at once (Curtis, Powell and Reid, 1974).
        """
        h, w = image.shape[-2:]
        row, column = np.mgrid[:h, :w]
        color = (row % REACH) * REACH + column % REACH
        steps = torch.zeros(3, REACH**2, 3, h, w, dtype=image.dtype)
        for channel in range(3):
            for number in range(REACH**2):
                steps[channel, number, channel] = torch.from_numpy(color == number).to(image.dtype)
        steps = steps.flatten(0, 1)
        more, less = image + steps, image - steps
        change = self.residuals(more[:, :2], more[:, 2:]) - self.residuals(less[:, :2], less[:, 2:])
        slopes = 0.5 * change.numpy().reshape(3, REACH**2, 3, h, w)
        pixel = row * w + column
        parts = []
        for dy, dx in ((0, 0), (0, 1), (0, -1), (1, 0), (-1, 0)):
            varied = (slice(max(dy, 0), h + min(dy, 0)), slice(max(dx, 0), w + min(dx, 0)))
            here = (slice(max(-dy, 0), h + min(-dy, 0)), slice(max(-dx, 0), w + min(-dx, 0)))
            for channel in range(3):
                values = slopes[channel, color[varied], :, row[here], column[here]]  # (h', w', 3 equations)
                y, x, equation = np.nonzero(values)
                rows = equation * h * w + pixel[here][y, x]
                parts.append((values[y, x, equation], rows, channel * h * w + pixel[varied][y, x]))
        data, rows, columns = (np.concatenate(part) for part in zip(*parts, strict=True))
        return sp.csr_array((data, (rows, columns)), shape=(3 * h * w, 3 * h * w))
