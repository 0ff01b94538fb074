"""Residuals of continuity and momentum on pixels, by fixed convolutions, and their Jacobian.

Dimensionless with length px, velocity V and pressure mu V / px, the equations are

    div v = 0,   Re (v . grad) v + grad p - lap v + f v = 0,   Re = rho V px / mu,   f = 12 px^2 / H^2

with central differences and the five-point Laplacian (the paper's kernel (6) is -1/4 of it). Walls lie half a pixel
beyond the last fluid pixel: the velocity beyond is minus the one before, and the pressure is differenced one-sided.

Where the viscosity m depends on the shear rate, m lap v becomes div (m grad v) + (grad v)^T grad m, with the means of m
between pixels, and f v becomes m f v.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy  # its sparse loads at first use, not at start-up
import torch
from torch import Tensor
from torch.nn import functional

from flowrec.stages.refine.local_viscosity import LocalViscosity

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
    viscosity: LocalViscosity | None = None  # None: 1 everywhere

    @classmethod
    def of(
        cls,
        fluid: Tensor,
        inside: Tensor,
        reynolds: Tensor | float,
        friction: Tensor | float,
        viscosity: LocalViscosity | None = None,
    ) -> Physics:
        """Equations of masks; `inside` (n, 1, h, w) is 1 where all four neighbours lie in the image."""
        beyond = functional.pad(1.0 - fluid, (1, 1, 1, 1), value=0.0)
        solid = (beyond[..., 1:-1, 2:], beyond[..., 1:-1, :-2], beyond[..., 2:, 1:-1], beyond[..., :-2, 1:-1])
        dx = torch.tensor(_DX).to(fluid)
        kernels = tuple(kernel[None, None] for kernel in (dx, dx.T, torch.tensor(_LAPLACIAN).to(fluid)))
        return cls(fluid, fluid * inside, solid, reynolds, friction, kernels, viscosity)  # type: ignore[arg-type]

    def residuals(self, velocity: Tensor, pressure: Tensor, viscosity: Tensor | None = None) -> Tensor:
        """(n, 3, h, w): continuity and the two momentum equations of v (n, 2, h, w) and p (n, 1, h, w), 0 in solid.

        `viscosity` (n, 1, h, w) is that of `local_viscosity`, unless it is given.
        """
        vx, vy = velocity[:, :1], velocity[:, 1:]
        right, left, below, above = self.solid
        slopes = [(self._slope(v, 0, right, left), self._slope(v, 1, below, above)) for v in (vx, vy)]
        equations = [slopes[0][0] + slopes[1][1]]
        gradient = (self._one_sided(pressure, 0, right, left), self._one_sided(pressure, 1, below, above))
        walls = right + left + below + above
        if self.viscosity is not None:
            m = self._local_viscosity(velocity, slopes) if viscosity is None else viscosity
            return self._generalised_residual(velocity, slopes, gradient, walls, m)
        for v, (by_x, by_y), push in zip((vx, vy), slopes, gradient, strict=True):
            laplacian = functional.conv2d(v, self.kernels[2], padding=1) - walls * v
            equations.append(self.reynolds * (vx * by_x + vy * by_y) + push - laplacian + self.friction * v)
        return torch.cat(equations, dim=1) * self.where

    def local_viscosity(self, velocity: Tensor) -> Tensor | None:
        """(n, 1, h, w) viscosity at the shear rate of a velocity (n, 2, h, w), 0 in solid; None if it is constant."""
        if self.viscosity is None:
            return None
        right, left, below, above = self.solid
        components = velocity[:, :1], velocity[:, 1:]
        slopes = [(self._slope(v, 0, right, left), self._slope(v, 1, below, above)) for v in components]
        return self._local_viscosity(velocity, slopes)

    def _local_viscosity(self, velocity: Tensor, slopes: list[tuple[Tensor, Tensor]]) -> Tensor:
        """Viscosity from the derivatives of both components; its gradient is that of the law."""
        assert self.viscosity is not None
        (u_x, u_y), (v_x, v_y) = slopes
        rate2 = 2.0 * (u_x**2 + v_y**2) + (u_y + v_x) ** 2
        rate2 = rate2 + self.viscosity.gap**2 * (velocity**2).sum(dim=1, keepdim=True)
        fixed = rate2.detach()
        value, slope = (torch.from_numpy(a).to(fixed) for a in self.viscosity.relative(fixed.cpu().numpy()))
        return (value + slope * (rate2 - fixed)) * self.fluid

    def _generalised_residual(
        self,
        velocity: Tensor,
        slopes: list[tuple[Tensor, Tensor]],
        gradient: tuple[Tensor, Tensor],
        walls: Tensor,
        m: Tensor,
    ) -> Tensor:
        """The equations with a viscosity m (n, 1, h, w)."""
        right, left, below, above = self.solid
        around = self.kernels[2].clone()
        around[..., 1, 1] = 0.0
        m_x, m_y = self._one_sided(m, 0, right, left), self._one_sided(m, 1, below, above)
        (u_x, u_y), (v_x, v_y) = slopes
        transposed = (m_x * u_x + m_y * v_x, m_x * u_y + m_y * v_y)
        neighbours = functional.conv2d(m, around, padding=1)
        equations = [u_x + v_y]
        vx, vy = velocity[:, :1], velocity[:, 1:]
        for v, (by_x, by_y), push, extra in zip((vx, vy), slopes, gradient, transposed, strict=True):
            # Half of (m + m') (v' - v) summed over the neighbours in fluid, and -2 m v for each wall.
            beside = m * functional.conv2d(v, around, padding=1) + functional.conv2d(m * v, around, padding=1)
            viscous = 0.5 * (beside - v * neighbours - (4.0 - walls) * m * v) - 2.0 * walls * m * v
            inertia = self.reynolds * (vx * by_x + vy * by_y)
            equations.append(inertia + push - viscous - extra + self.friction * m * v)
        return torch.cat(equations, dim=1) * self.where

    def _slope(self, v: Tensor, axis: int, after: Tensor, before: Tensor) -> Tensor:
        """Central difference of a velocity that is 0 in solid, with -v beyond a wall."""
        return functional.conv2d(v, self.kernels[axis], padding=1) + 0.5 * (before - after) * v

    def _one_sided(self, p: Tensor, axis: int, after: Tensor, before: Tensor) -> Tensor:
        """Central difference of a pressure that is 0 in solid, one-sided beside a wall."""
        inside = functional.conv2d(p, self.kernels[axis], padding=1) + 0.5 * (after - before) * p
        return inside * 2.0 / (2.0 - after - before).clamp(min=1.0) * (after + before < 2.0)

    def jacobian(self, image: Tensor) -> scipy.sparse.csr_array:
        """(3 h w, 3 h w) derivative of the residuals of one mask around an image (1, 3, h, w) of vx, vy, p.

        The equations are quadratic, so central differences with any step are exact; a viscosity that depends on the
        shear rate is that of the image (Picard). Pixels that have no equation in common are varied at once (Curtis,
        Powell and Reid, 1974).
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
        m = self.local_viscosity(image[:, :2])
        change = self.residuals(more[:, :2], more[:, 2:], m) - self.residuals(less[:, :2], less[:, 2:], m)
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
        return scipy.sparse.csr_array((data, (rows, columns)), shape=(3 * h * w, 3 * h * w))
