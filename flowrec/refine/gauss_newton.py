"""The field that equations, observations and assumed boundary values agree on best: Gauss-Newton on the pixels.

The PI-UNet's loss is nearly quadratic in the field but badly conditioned: how much flows in a branch hardly shows in
residuals of single pixels, so a descent through a network does not find its minimum. The normal equations of a few
thousand fluid pixels are sparse and factorise at once. With x the velocities and pressures of the fluid pixels,

    minimise  |W (R(x) - Z v - r)|^2 + |smoothness of x - x0|^2 + |openings of x - x0|^2 + Student-t(H v - observed)

R is `Physics`. What it leaves of the initial field x0 is truncation error, which goes with the flow: Z (h, w) turns and
scales v into it, so a branch that carries a tenth more leaves a tenth more; r is the rest. Central differences do not
see a checkerboard, the smoothness does. W and Z are found again as the flow becomes known, the observations weigh as
the tails of their noise say. The inverse of the normal matrix is the covariance; samples of it give error bars.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import scipy.sparse as sp
import torch
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt, maximum_filter, uniform_filter
from scipy.sparse.linalg import splu

from flowrec.refine.case import Case
from flowrec.refine.data_misfit import TAIL
from flowrec.refine.jacobian import jacobian
from flowrec.refine.observation_operator import Floats
from flowrec.refine.residuals import Physics

LARGEST_PX = 12_000  # fluid pixels: 2 s for two thousand of them, 10 s for five, and beyond these too long
# They hardly matter: half of either, or twice the roughness, changes the mean error of 24 cases by 0.002 at most.
CONTINUITY, MOMENTUM = 0.01, 0.1  # allowed share of the speed around, on one pixel
ROUGH = 6.0  # allowed second difference of the correction, in speeds around
ASSUMED_SPEED = 0.3  # std of an inlet's speed, of what is assumed
ASSUMED_PRESSURE = 0.07  # std of a pressure at an opening, of the largest
INLET_SHAPE, OUTLET_SHAPE, OUTLET_EVEN = 0.03, 0.2, 0.003  # how closely an opening keeps its profile
# A flow that nobody assumed has truncation errors that nobody knows: tolerances start wide (in V) and close.
FLOORS = (1.0, 0.5, 0.2)
REWEIGHTED = 3  # times for each of them
ANNEALED = 4.0  # noise is taken this much larger, one reweighting before the last of the first round; squared before


@dataclass(slots=True)
class _Rows:
    """Equations sum_j a_ij x_j = b_i with unit weights, collected as they come."""

    unknowns: int
    count: int = 0
    parts: list[tuple[NDArray[np.intp], NDArray[np.intp], Floats]] = field(default_factory=list)
    right: list[Floats] = field(default_factory=list)

    def add(self, columns: NDArray[np.intp], values: Floats, right: Floats | None = None) -> None:
        """Rows with values (n, m) at columns (n, m); a column of -1 is left out."""
        n, m = columns.shape
        rows = np.repeat(np.arange(n) + self.count, m)
        kept = columns.ravel() >= 0
        self.parts.append((rows[kept], columns.ravel()[kept], np.broadcast_to(values, (n, m)).ravel()[kept]))
        self.right.append(np.zeros(n) if right is None else right)
        self.count += n

    def done(self) -> tuple[sp.csr_array, Floats]:
        """Matrix (rows, unknowns) and right side (rows,)."""
        rows, columns, values = (np.concatenate(part) for part in zip(*self.parts, strict=True))
        matrix = sp.csr_array((values, (rows, columns)), shape=(self.count, self.unknowns))
        return matrix, np.concatenate(self.right)


def balance(case: Case, used: NDArray[np.bool_], guess: Floats | None = None) -> tuple[Floats, Floats]:
    """Velocity (h, w, 2) and pressure (h, w), in the units of the case, for the observations `used` (n,).

    `guess` (h, w, 2) only says how fast the flow may be where.
    """
    return _Balance(case, used).solve(guess)


class _Balance:
    """The least squares problem of one case. Unknowns: vx, vy, p of the fluid pixels, then two for each opening."""

    def __init__(self, case: Case, used: NDArray[np.bool_]) -> None:
        self.case = case
        self.fluid = case.fluid
        h, w = case.fluid.shape
        self.pixels, self.width = h * w, w
        self.which = np.flatnonzero(np.tile(case.fluid.ravel(), 3))  # in (3, h, w)
        self.unknowns = len(self.which) + 2 * len(case.doors)
        self.place = np.full(3 * self.pixels, -1)
        self.place[self.which] = np.arange(len(self.which))
        self.start = np.concatenate([np.moveaxis(case.velocity, -1, 0).ravel(), case.pressure.ravel()])
        self.largest = max(float(np.abs(case.pressure).max()), 1.0)
        # The profile of a channel: its residual per relative error of the speed is 12 / width^2.
        reach = distance_transform_edt(np.pad(case.fluid, 1, mode="edge"))[1:-1, 1:-1]
        self.wide = np.maximum(2.0 * maximum_filter(reach, 9) * case.fluid, 2.0)
        fluid, inside = (self._tensor(mask)[None] for mask in (case.fluid, case.inside))
        self.physics = Physics.of(fluid, inside, case.reynolds, case.friction)
        self.speed = self._around(case.velocity)
        self._truncation()
        flat = (case.rows * w + case.columns)[used]
        self.noise = case.noise[used]
        self.sees, self.gap = [], []
        for axis in range(2):
            rows = _Rows(self.unknowns)
            rows.add(self.place[flat + axis * self.pixels], case.weights[used])
            self.sees.append(rows.done()[0] if len(flat) else sp.csr_array((0, self.unknowns)))
            initial = (self.start[flat + axis * self.pixels] * case.weights[used]).sum(axis=1)
            self.gap.append(case.flow[used][:, axis] - initial)

    def solve(self, guess: Floats | None) -> tuple[Floats, Floats]:
        """Tolerances from wide to narrow, each with observations reweighted."""
        speed = self.speed if guess is None else np.hypot(self.speed, self._around(guess)) / np.sqrt(2.0)
        change = np.zeros(self.unknowns)
        for number, floor in enumerate(FLOORS):
            prior, wanted = self._prior(speed, floor)
            physics, target = self._equations(speed, floor, change)
            rows = sp.vstack([prior, physics]).tocsr()
            normal, load = (rows.T @ rows).tocsc(), rows.T @ np.concatenate([wanted, target])
            for left in reversed(range(REWEIGHTED)):
                scale = ANNEALED**left if number == 0 else 1.0
                plain = number == 0 and left == REWEIGHTED - 1  # nothing is known yet: no observation is an outlier
                trust = np.full(len(self.noise), 1.0) if plain else self._trust(change, scale)
                trust = trust / self.noise**2
                full = normal + sum((a.T @ sp.diags_array(trust) @ a for a in self.sees), start=0.0 * normal)
                factors = splu(
                    full.tocsc(), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True}
                )
                pull = sum(a.T @ (trust * b) for a, b in zip(self.sees, self.gap, strict=True))
                change = factors.solve(load + pull)
            speed = np.hypot(self.speed, self._around(self._image(change)[..., :2])) / np.sqrt(2.0)
        image = self._image(change)
        return image[..., :2], image[..., 2]

    def _trust(self, change: Floats, scale: float) -> Floats:
        """(n,) weights of observations whose noise has Student-t tails."""
        square = sum((a @ change - b) ** 2 for a, b in zip(self.sees, self.gap, strict=True)) / self.noise**2
        return np.asarray((TAIL + 2.0) / (TAIL + square / scale**2))

    def _image(self, change: Floats) -> Floats:
        """(h, w, 3) velocity and pressure."""
        full = self.start.copy()
        full[self.which] += change[: len(self.which)]
        return np.moveaxis(full.reshape(3, *self.fluid.shape), 0, -1)

    def _truncation(self) -> None:
        """What the equations leave of the initial field, as a matrix on its velocity and a rest."""
        h, w = self.fluid.shape
        vx, vy = np.moveaxis(self.case.velocity, -1, 0)
        mass, push_x, push_y = self._residual(self.start)
        size = vx**2 + vy**2 + (0.1 * (self.speed + 1e-3)) ** 2
        along, across = (push_x * vx + push_y * vy) / size, (push_y * vx - push_x * vy) / size
        z = np.array([[mass * vx / size, mass * vy / size], [along, -across], [across, along]])  # (3, 2, h, w)
        blocks = [
            [sp.diags_array(z[r, c].ravel()) for c in range(2)] + [sp.csr_array((h * w, h * w))] for r in range(3)
        ]
        self.drag = sp.block_array(blocks).tocsr()
        self.rest = np.stack([mass, push_x, push_y]).ravel() - self.drag @ self.start

    def _equations(self, speed: Floats, floor: float, change: Floats) -> tuple[sp.csr_array, Floats]:
        """Weighted continuity and momentum on the pixels inside, linear around a change of the initial field."""
        full = np.moveaxis(self._image(change), -1, 0).ravel()
        slope = (jacobian(self.physics, self._tensor(full.reshape(3, *self.fluid.shape))) - self.drag)[:, self.which]
        left = self._residual(full).ravel() - self.drag @ full - self.rest
        allowed = speed + floor
        push = self.wide**2 / 12.0 / (MOMENTUM * allowed)
        weight = (np.stack([1.0 / (CONTINUITY * allowed), push, push]) * (self.case.inside & self.fluid)).ravel()
        kept = np.flatnonzero(weight > 0.0)
        none = sp.csr_array((len(kept), self.unknowns - len(self.which)))
        slope, weight = slope[kept], weight[kept]
        target = weight * (slope @ change[: len(self.which)] - left[kept])
        return sp.hstack([sp.diags_array(weight) @ slope, none]).tocsr(), target

    def _prior(self, speed: Floats, floor: float) -> tuple[sp.csr_array, Floats]:
        """What is believed of the change before any observation."""
        rows = _Rows(self.unknowns)
        each = np.arange(len(self.which))[:, None]
        rows.add(each, np.where(self.which < 2 * self.pixels, 1e-3, 0.1 / self.largest)[:, None])  # no free constant
        self._smooth(rows, speed, floor)
        for number, door in enumerate(self.case.doors):
            speed_at, pressure_at = len(self.which) + number, len(self.which) + len(self.case.doors) + number
            pixels = np.flatnonzero((self.case.door.ravel() == number + 1) & self.fluid.ravel())
            inward = {"left": 1, "right": -1, "top": self.width, "bottom": -self.width}[door.side]
            size = max(
                float(np.sqrt((self.start[np.add.outer([0, self.pixels], pixels)] ** 2).sum(axis=0).mean())), 0.01
            )
            for axis in range(2):
                here = self.place[pixels + axis * self.pixels]
                if door.kind == "inlet":
                    values = np.column_stack([np.ones(len(pixels)), -self.start[pixels + axis * self.pixels]])
                    rows.add(np.column_stack([here, np.full(len(here), speed_at)]), values / (INLET_SHAPE * size))
                else:  # the flow leaves as it comes
                    beside = self.place[pixels + inward + axis * self.pixels]
                    weight = (beside >= 0) / (OUTLET_SHAPE * (speed.ravel()[pixels] + floor))
                    rows.add(np.column_stack([here, beside]), weight[:, None] * np.array([1.0, -1.0]))
            rows.add(np.array([[speed_at]]), np.array([[1.0 / ASSUMED_SPEED]]))
            if door.kind == "outlet":
                columns = np.column_stack([self.place[pixels + 2 * self.pixels], np.full(len(pixels), pressure_at)])
                rows.add(columns, np.array([[1.0, -1.0]]) / (OUTLET_EVEN * self.largest))
            rows.add(np.array([[pressure_at]]), np.array([[1.0 / (ASSUMED_PRESSURE * self.largest)]]))
        return rows.done()

    def _smooth(self, rows: _Rows, speed: Floats, floor: float) -> None:
        """Second differences along rows and columns, where three pixels in a line are fluid."""
        slope = np.hypot(*np.gradient(self.case.pressure))
        per_speed = 12.0 / self.wide**2
        slope = np.minimum(slope, 6.0 * per_speed * speed) + per_speed * floor
        scales = [speed + floor, speed + floor, slope]
        for axis, step in enumerate((self.width, 1)):
            middle = np.zeros_like(self.fluid)
            inner = np.moveaxis(self.fluid, axis, 0)
            np.moveaxis(middle, axis, 0)[1:-1] = inner[:-2] & inner[1:-1] & inner[2:]
            at = np.flatnonzero(middle)
            for channel, scale in enumerate(scales):
                columns = self.place[at[:, None] + np.array([-step, 0, step]) + channel * self.pixels]
                rows.add(columns, np.array([1.0, -2.0, 1.0]) / (ROUGH * scale.ravel()[at, None]))

    def _around(self, velocity: Floats) -> Floats:
        """(h, w) root mean square of the speed of (h, w, 2) around each pixel, off the walls."""
        free = (self.fluid & ~self.case.walled).astype(np.float64)
        square = uniform_filter((velocity**2).sum(axis=-1) * free, 5, mode="constant")
        return np.asarray(np.sqrt(np.maximum(square, 0.0) / np.maximum(uniform_filter(free, 5, mode="constant"), 0.04)))

    def _residual(self, full: Floats) -> Floats:
        """(3, h, w) of velocities and pressures (3 h w,)."""
        image = self._tensor(full.reshape(3, *self.fluid.shape))
        return np.asarray(self.physics.residuals(image[:, :2], image[:, 2:])[0].numpy(), np.float64)

    @staticmethod
    def _tensor(array: NDArray[np.generic]) -> torch.Tensor:
        """(1, ...) in double precision: residuals are small differences."""
        return torch.from_numpy(np.array(array, np.float64))[None]
