"""Residuals of continuity and momentum on pixels, by fixed convolutions; the balances of blocks of pixels.

Dimensionless with length px, velocity V and pressure mu V / px, the equations are

    div v = 0,   Re (v . grad) v + grad p - lap v + f v = 0,   Re = rho V px / mu,   f = 12 px^2 / H^2

with true central differences and the five-point Laplacian (the paper's kernel (6) is -1/4 of it). Walls lie half a
pixel beyond the last fluid pixel: the velocity beyond is the negative of the one before, the pressure is one-sided.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional

_DX = [[0.0, 0.0, 0.0], [-0.5, 0.0, 0.5], [0.0, 0.0, 0.0]]
_LAPLACIAN = [[0.0, 1.0, 0.0], [1.0, -4.0, 1.0], [0.0, 1.0, 0.0]]


@dataclass(frozen=True, slots=True, eq=False)
class Physics:
    """The equations on the fluid pixels of masks (n, 1, h, w); borders of the image are left out."""

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
        lines = [slopes[0][0] + slopes[1][1]]
        p_slopes = (self._one_sided(pressure, 0, right, left), self._one_sided(pressure, 1, below, above))
        walls = right + left + below + above
        for v, (by_x, by_y), push in zip((vx, vy), slopes, p_slopes, strict=True):
            spread = functional.conv2d(v, self.kernels[2], padding=1) - walls * v
            lines.append(self.reynolds * (vx * by_x + vy * by_y) + push - spread + self.friction * v)
        return torch.cat(lines, dim=1) * self.where

    def _slope(self, v: Tensor, axis: int, after: Tensor, before: Tensor) -> Tensor:
        """Central difference of a velocity that is 0 in solid, with -v beyond a wall."""
        return functional.conv2d(v, self.kernels[axis], padding=1) + 0.5 * (before - after) * v

    def _one_sided(self, p: Tensor, axis: int, after: Tensor, before: Tensor) -> Tensor:
        """Central difference of a pressure that is 0 in solid, one-sided beside a wall."""
        inside = functional.conv2d(p, self.kernels[axis], padding=1) + 0.5 * (after - before) * p
        return inside * 2.0 / (2.0 - after - before).clamp(min=1.0) * (after + before < 2.0)


def balances(residual: Tensor, sides: Sequence[int]) -> Tensor:
    """(n,) sum of the squared sums of residuals (n, c, h, w) over blocks, which overlap by half, of several sides.

    The sum of the divergence over a block is the flux through its sides, so a branch that carries more than enters it
    counts the same wherever along it the surplus appears; on pixels alone a slow change of the flux hardly shows.
    """
    total = (residual**2).sum(dim=(1, 2, 3))
    for side in sides:
        if side > max(residual.shape[-2:]):
            break
        blocks = functional.avg_pool2d(residual, side, max(side // 2, 1), side // 2) * float(side * side)
        total = total + (blocks**2).sum(dim=(1, 2, 3)) / 4.0  # each pixel is in four blocks
    return total
