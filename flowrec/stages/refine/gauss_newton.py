"""Gauss-Newton on the pixels: the field that best satisfies equations, observations and assumed boundary values.

The PI-UNet's loss is nearly quadratic in the field but badly conditioned: the flow rate of a branch hardly appears in
residuals of single pixels, so gradient descent through a network does not find the minimum. The normal equations of a
few thousand fluid pixels are sparse and are factorised at once. With x, velocities and pressures of the fluid pixels,

    minimise  |W (R(x) - Z v - r)|^2 + |smoothness of x - x0|^2 + |openings of x - x0|^2 + Student-t(H v - observed)

R are the residuals of `Physics`. Their values at the initial field x0 are its truncation error, which is proportional
to the flow: Z (h, w) rotates and scales v into it, so a branch with a tenth more flow has a tenth more truncation
error; r is the rest. Central differences do not see a checkerboard pattern; the smoothness does. W and Z are computed
again as the flow becomes known, and the observations are reweighted by the tails of their noise.

The sum is minus twice the logarithm of a density of x, at the last weights a normal one. Its standard deviations follow
from samples: the minimum for right sides with noise of variance 1 (Papandreou and Yuille, 2010).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import scipy  # its ndimage and sparse load at first use, not at start-up
import torch
from numpy.typing import NDArray

from flowrec.core import Floats
from flowrec.stages.refine.case import Case
from flowrec.stages.refine.observation_operator import TAIL
from flowrec.stages.refine.residuals import Physics

Ints = NDArray[np.intp]

LARGEST_PX = 12_000  # fluid pixels: 2 s for two thousand of them, 10 s for five, and beyond these too slow
# The result is not sensitive to these: half of either, or twice the roughness, changes the mean error of 24 cases by
# 0.002 at most.
CONTINUITY, MOMENTUM = 0.01, 0.1  # allowed residual on one pixel, of the speed around
ROUGHNESS = 6.0  # allowed second difference of the correction, of the speed around
ASSUMED_SPEED = 0.3  # std of an inlet's speed, of the assumed one
ASSUMED_PRESSURE = 0.07  # std of a pressure at an opening, of the largest
INLET_SHAPE, OUTLET_SHAPE, OUTLET_EVEN = 0.03, 0.2, 0.003  # allowed change of the profiles at openings
# The truncation error of a flow that was not assumed is unknown: tolerances start wide (in V) and close.
FLOORS = (1.0, 0.5, 0.2)
REWEIGHTED = 3  # times for each of them
# Of the standard deviations that the tolerances state: they are wide, so that no case is held too tightly. On five
# procedural vessels the error was 0.03 to 0.27 of what they state.
STATED = 0.3
SAMPLES = 48  # of the posterior: its standard deviations to 10 %, each for one solution with known factors
ANNEALED = 4.0  # factor on the noise, one reweighting before the last of the first round; squared before


@dataclass(slots=True)
class _Rows:
    """Equations sum_j a_ij x_j = b_i with unit weights, collected one group at a time."""

    unknowns: int
    count: int = 0
    parts: list[tuple[Floats, Ints, Ints]] = field(default_factory=list)

    def add(self, columns: Ints, values: Floats) -> None:
        """Equations with the right side 0 and values (n, m) at columns (n, m); a column of -1 is left out."""
        n, m = columns.shape
        rows = np.repeat(np.arange(n) + self.count, m)
        used = columns.ravel() >= 0
        self.parts.append((np.broadcast_to(values, (n, m)).ravel()[used], rows[used], columns.ravel()[used]))
        self.count += n

    def matrix(self) -> scipy.sparse.csr_array:
        """(rows, unknowns)."""
        values, rows, columns = (np.concatenate(part) for part in zip(*self.parts, strict=True))
        return scipy.sparse.csr_array((values, (rows, columns)), shape=(self.count, self.unknowns))


def balance(case: Case, guess: Floats | None = None) -> tuple[Floats, Floats, Floats]:
    """Velocity (h, w, 2), pressure (h, w) and standard deviation of the velocity (h, w, 2) in the units of the case.

    `guess` (h, w, 2) only gives the expected speed of each place.
    """
    return _LeastSquares(case).solve(guess)


class _LeastSquares:
    """The problem of one case. Unknowns: vx, vy, p of the fluid pixels, then two for each opening."""

    def __init__(self, case: Case) -> None:
        self.case = case
        self.fluid = case.fluid
        h, w = case.fluid.shape
        self.pixels, self.width = h * w, w
        self.which = np.flatnonzero(np.tile(case.fluid.ravel(), 3))  # of the channels (3, h, w)
        self.unknowns = len(self.which) + 2 * len(case.openings)
        self.place = np.full(3 * self.pixels, -1)
        self.place[self.which] = np.arange(len(self.which))
        ones = np.ones(len(self.which))
        self.embed = scipy.sparse.csr_array(
            (ones, (self.which, self.place[self.which])), shape=(3 * self.pixels, self.unknowns)
        )
        self.start = np.concatenate([np.moveaxis(case.velocity, -1, 0).ravel(), case.pressure.ravel()])
        self.largest = max(float(np.abs(case.pressure).max()), 1.0)
        # Width of the channel, from which follows the residual per relative error of the speed: 12 / width^2.
        distance = scipy.ndimage.distance_transform_edt(np.pad(case.fluid, 1, mode="edge"))[1:-1, 1:-1]
        self.channel = np.maximum(2.0 * scipy.ndimage.maximum_filter(distance, 9) * case.fluid, 2.0)
        fluid, inside = (_tensor(mask)[None] for mask in (case.fluid, case.inside))
        self.physics = Physics.of(fluid, inside, case.reynolds, case.friction, case.viscosity)
        self.speed = self._local_rms(case.velocity)
        self._truncation()
        self.operators, self.innovations = [], []  # H and observed minus initial velocity, along x and y
        for axis in range(2):
            rows, at = _Rows(self.unknowns), case.pixels + axis * self.pixels
            rows.add(self.place[at], case.weights)
            self.operators.append(rows.matrix())
            self.innovations.append(case.flow[:, axis] - (self.start[at] * case.weights).sum(axis=1))

    def solve(self, guess: Floats | None) -> tuple[Floats, Floats, Floats]:
        """Tolerances from wide to narrow; for each the observations are reweighted several times."""
        speed = self.speed if guess is None else np.hypot(self.speed, self._local_rms(guess)) / np.sqrt(2.0)
        change = np.zeros(self.unknowns)
        for number, floor in enumerate(FLOORS):
            prior = self._prior(speed, floor)
            physics, target = self._equations(speed, floor, change)
            rows = scipy.sparse.vstack([prior, physics]).tocsr()
            normal, load = (rows.T @ rows).tocsc(), rows.T @ np.concatenate([np.zeros(prior.shape[0]), target])
            for left in reversed(range(REWEIGHTED)):
                scale = ANNEALED**left if number == 0 else 1.0
                first = number == 0 and left == REWEIGHTED - 1  # nothing is known yet: no observation is an outlier
                weight = np.full(len(self.case.noise), 1.0) if first else self._robust_weight(change, scale)
                weight = weight / self.case.noise**2
                full = normal + sum(
                    (h.T @ scipy.sparse.diags_array(weight) @ h for h in self.operators), start=0.0 * normal
                )
                factors = scipy.sparse.linalg.splu(
                    full.tocsc(), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True}
                )
                observed = zip(self.operators, self.innovations, strict=True)
                change = factors.solve(load + sum(h.T @ (weight * b) for h, b in observed))
            speed = np.hypot(self.speed, self._local_rms(self._image(change)[..., :2])) / np.sqrt(2.0)
        image = self._image(change)
        return image[..., :2], image[..., 2], self._std(rows, weight, factors)

    def _std(self, rows: scipy.sparse.csr_array, weight: Floats, factors: Any) -> Floats:
        """(h, w, 2) standard deviation of the velocity, where the observations have weights (n,)."""
        rng = np.random.default_rng(0)
        square = np.zeros(self.unknowns)
        for _ in range(SAMPLES):
            load = rows.T @ rng.standard_normal(rows.shape[0])
            for h in self.operators:
                load = load + h.T @ (np.sqrt(weight) * rng.standard_normal(len(weight)))
            square += factors.solve(load) ** 2
        variance = STATED**2 * (self.embed @ (square / SAMPLES))
        return np.moveaxis(np.sqrt(variance).reshape(3, *self.fluid.shape)[:2], 0, -1)

    def _robust_weight(self, change: Floats, scale: float) -> Floats:
        """(n,) weights of observations whose noise has Student-t tails."""
        residuals = ((h @ change - b) ** 2 for h, b in zip(self.operators, self.innovations, strict=True))
        return np.asarray((TAIL + 2.0) / (TAIL + sum(residuals) / self.case.noise**2 / scale**2))

    def _image(self, change: Floats) -> Floats:
        """(h, w, 3) velocity and pressure."""
        return np.moveaxis((self.start + self.embed @ change).reshape(3, *self.fluid.shape), 0, -1)

    def _truncation(self) -> None:
        """Residuals of the initial field, as a matrix Z on its velocity and a rest r."""
        h, w = self.fluid.shape
        vx, vy = np.moveaxis(self.case.velocity, -1, 0)
        mass, push_x, push_y = self._residual(self.start)
        size = vx**2 + vy**2 + (0.1 * (self.speed + 1e-3)) ** 2
        along, across = (push_x * vx + push_y * vy) / size, (push_y * vx - push_x * vy) / size
        z = np.array([[mass * vx / size, mass * vy / size], [along, -across], [across, along]])  # (3, 2, h, w)
        blocks = [
            [scipy.sparse.diags_array(z[r, c].ravel()) for c in range(2)] + [scipy.sparse.csr_array((h * w, h * w))]
            for r in range(3)
        ]
        self.drag = scipy.sparse.block_array(blocks).tocsr()
        self.rest = np.stack([mass, push_x, push_y]).ravel() - self.drag @ self.start

    def _equations(self, speed: Floats, floor: float, change: Floats) -> tuple[scipy.sparse.csr_array, Floats]:
        """Weighted continuity and momentum on the pixels inside, linearised around a change of the initial field."""
        full = self.start + self.embed @ change
        jacobian = self.physics.jacobian(_tensor(full.reshape(3, *self.fluid.shape)))
        slope = ((jacobian - self.drag) @ self.embed).sorted_indices()
        residual = self._residual(full).ravel() - self.drag @ full - self.rest
        allowed = speed + floor
        momentum = self.channel**2 / 12.0 / (MOMENTUM * allowed)
        weight = np.stack([1.0 / (CONTINUITY * allowed), momentum, momentum])
        weight = (weight * (self.case.inside & self.fluid)).ravel()
        used = np.flatnonzero(weight > 0.0)
        slope, weight = slope[used], weight[used]
        return scipy.sparse.diags_array(weight) @ slope, weight * (slope @ change - residual[used])

    def _prior(self, speed: Floats, floor: float) -> scipy.sparse.csr_array:
        """Prior of the change: small and smooth, with the profiles at openings nearly as assumed."""
        rows = _Rows(self.unknowns)
        each = np.arange(len(self.which))[:, None]
        # A weak bound on every unknown, so that no constant is free.
        rows.add(each, np.where(self.which < 2 * self.pixels, 1e-3, 0.1 / self.largest)[:, None])
        self._smoothness(rows, speed, floor)
        for number, opening in enumerate(self.case.openings):
            speed_at, pressure_at = len(self.which) + number, len(self.which) + len(self.case.openings) + number
            pixels = np.flatnonzero((self.case.opening.ravel() == number + 1) & self.fluid.ravel())
            inward = {"left": 1, "right": -1, "top": self.width, "bottom": -self.width}[opening.side]
            square = (self.start[np.add.outer([0, self.pixels], pixels)] ** 2).sum(axis=0)
            size = max(float(np.sqrt(square.mean())), 0.01)
            for axis in range(2):
                here = self.place[pixels + axis * self.pixels]
                if opening.kind == "inlet":
                    values = np.column_stack([np.ones(len(pixels)), -self.start[pixels + axis * self.pixels]])
                    rows.add(np.column_stack([here, np.full(len(here), speed_at)]), values / (INLET_SHAPE * size))
                else:  # no change along the flow
                    beside = self.place[pixels + inward + axis * self.pixels]
                    weight = (beside >= 0) / (OUTLET_SHAPE * (speed.ravel()[pixels] + floor))
                    rows.add(np.column_stack([here, beside]), weight[:, None] * np.array([1.0, -1.0]))
            rows.add(np.array([[speed_at]]), np.array([[1.0 / ASSUMED_SPEED]]))
            if opening.kind == "outlet":
                columns = np.column_stack([self.place[pixels + 2 * self.pixels], np.full(len(pixels), pressure_at)])
                rows.add(columns, np.array([[1.0, -1.0]]) / (OUTLET_EVEN * self.largest))
            rows.add(np.array([[pressure_at]]), np.array([[1.0 / (ASSUMED_PRESSURE * self.largest)]]))
        return rows.matrix()

    def _smoothness(self, rows: _Rows, speed: Floats, floor: float) -> None:
        """Second differences along rows and columns, where three pixels in a line are fluid."""
        per_speed = 12.0 / self.channel**2
        gradient = np.minimum(np.hypot(*np.gradient(self.case.pressure)), 6.0 * per_speed * speed) + per_speed * floor
        for axis, step in enumerate((self.width, 1)):
            middle = np.zeros_like(self.fluid)
            inner = np.moveaxis(self.fluid, axis, 0)
            np.moveaxis(middle, axis, 0)[1:-1] = inner[:-2] & inner[1:-1] & inner[2:]
            at = np.flatnonzero(middle)
            for channel, scale in enumerate((speed + floor, speed + floor, gradient)):
                columns = self.place[at[:, None] + np.array([-step, 0, step]) + channel * self.pixels]
                rows.add(columns, np.array([1.0, -2.0, 1.0]) / (ROUGHNESS * scale.ravel()[at, None]))

    def _local_rms(self, velocity: Floats) -> Floats:
        """(h, w) root mean square of the speed of (h, w, 2) around each pixel, without pixels at walls."""
        free = (self.fluid & ~self.case.walled).astype(np.float64)
        square = scipy.ndimage.uniform_filter((velocity**2).sum(axis=-1) * free, 5, mode="constant")
        return np.asarray(
            np.sqrt(np.maximum(square, 0.0) / np.maximum(scipy.ndimage.uniform_filter(free, 5, mode="constant"), 0.04))
        )

    def _residual(self, full: Floats) -> Floats:
        """(3, h, w) of velocities and pressures (3 h w,)."""
        image = _tensor(full.reshape(3, *self.fluid.shape))
        return np.asarray(self.physics.residuals(image[:, :2], image[:, 2:])[0].numpy(), np.float64)


def _tensor(array: NDArray[Any]) -> torch.Tensor:
    """(1, ...) in double precision: residuals are small differences."""
    return torch.from_numpy(np.array(array, np.float64))[None]
