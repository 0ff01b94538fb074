"""Assimilation: the boundary values that explain the observations best, and how sure that makes the field.

The parameters are the boundary values and the fluid's viscosity and density, with a Gaussian prior around the assumed
ones. Without inertia the field is linear in inlet speeds and p_out / mu; what inertia adds is followed by a few steps
of the full equations with frozen factors. The curvature gives the posterior covariance (science.md, section 2).
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass, field, replace
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from flowrec.chip.chip import Chip
from flowrec.errors import FlowError
from flowrec.flow import FlowSolver
from flowrec.flow.linear_solver import cached, cell_count, chip_key
from flowrec.flow.sampling import fluid_image
from flowrec.flow.sensitivities import Remainder, Sensitivities
from flowrec.messages import FlowField
from flowrec.ranges import Range
from flowrec.refine.discretisation_error import ModelError
from flowrec.refine.mask_variants import other_walls
from flowrec.refine.mixture_regression import Fit, fit
from flowrec.refine.observation_operator import Floats, Sight
from flowrec.refine.prior import Prior, Widths
from flowrec.refine.report import statement

SURPRISED = 1.5  # standard deviations of chi squared above which the walls are doubted
GAIN = 4.0  # in ln probability before other walls than the chip's are believed
WIDE = 3.0  # size of an outlier's components, in units of the observations' typical component
MOST_PX = 30_000  # fluid pixels of a chip whose walls are doubted: each variant is a geometry of its own
SHARPEST = 1e-3  # of the observations' typical speed: no observation is known better
CROWD_PX = 4  # observations in a square of this size share the model's error


@dataclass(frozen=True, slots=True)
class Assimilate:
    """Settings of the assimilation. Prior widths are one standard deviation."""

    inlet_std_share: Annotated[float, Range(1e-4, 10.0)] = 0.25  # of the assumed inlet speed
    pump_std_share: Annotated[float, Range(0.0, 10.0)] = 0.0  # the same, common to all inlets
    outlet_std_share: Annotated[float, Range(1e-4, 10.0)] = 0.10  # of the largest assumed |pressure|
    viscosity_std_share: Annotated[float, Range(1e-4, 10.0)] = 0.30  # of the assumed viscosity
    density_std_share: Annotated[float, Range(1e-4, 10.0)] = 0.10  # of the assumed density
    depth_std_share: Annotated[float, Range(0.0, 10.0)] = 0.0  # of the chip's depth, where it has one
    # skew and flatness of the inlets' profiles, of the inlet speed
    inlet_shape_std: Annotated[float, Range(0.0, 10.0)] = 0.0
    model: ModelError = field(default_factory=ModelError)
    doubt_walls: bool = True  # try walls a pixel off where the observations contradict the chip's
    max_steps: Annotated[int, Range(1, 1_000)] = 8  # of the full equations with frozen factors
    tolerance: Annotated[float, Range(1e-12, 1.0)] = 2e-3  # last such step over the fastest speed

    def fit(self, assumed: FlowField, sight: Sight, chip: Chip, solver: FlowSolver) -> FlowField:
        """Posterior mean field with its standard deviation, boundary values and viscosity.

        Raises
        ------
        FlowError
            If the flow of the fitted parameters can not be computed.
        """
        best = self._explain(sight, chip, solver)
        words = ""
        if self.doubt_walls and best.surprise > SURPRISED and np.count_nonzero(chip.mask) <= MOST_PX:
            words, other = self._better_walls(sight, chip, replace(solver, k=1))
            if words:
                moved = self._explain(sight, other, solver)
                # The coarse grid proposes, the fine one decides.
                best, words = (moved, words) if moved.adequate and moved.evidence > best.evidence + GAIN else (best, "")
        return self._field(best, words, assumed, sight, chip)

    def unobserved(self, assumed: FlowField, chip: Chip, solver: FlowSolver) -> FlowField:
        """The assumed field with the standard deviation of the prior; without one where there is no prior."""
        try:
            ready = self._ready(chip, solver)
        except FlowError:
            return assumed
        std = np.sqrt((ready.columns**2).sum(axis=0) + ready.left_std**2)
        return replace(assumed, std_um_s=fluid_image(chip.mask, std.astype(np.float32)))

    def _better_walls(self, sight: Sight, chip: Chip, solver: FlowSolver) -> tuple[str, Chip]:
        """The mask that the observations call far more probable than the chip's, and what is wrong with that."""
        own = self._explain(sight, chip, solver).evidence
        gains = []
        for words, other in other_walls(chip):
            # A mask that carries no flow is none.
            with suppress(FlowError):
                gains.append((self._explain(sight, other, solver).evidence - own, words, other))
        gain, words, other = max(gains, key=lambda entry: entry[0], default=(0.0, "", chip))
        return (words, other) if gain > GAIN else ("", chip)

    def _explain(self, sight: Sight, chip: Chip, solver: FlowSolver) -> _Explained:
        """The most probable flow of a chip; what is observed in its solid is predicted to stand still."""
        ready = self._ready(chip, solver)
        response, prior = ready.response, ready.prior
        seen = _Seen.of_mask(sight, chip.mask)
        design = seen.of(ready.columns)
        misfit = sight.flow_um_s - seen.of(ready.base)
        variance = _variance(sight, seen.of(ready.left_std)[:, 0])
        state, beyond = response.start(), np.zeros_like(ready.base)
        # The same for all walls, or their probabilities could not be compared.
        wide = (
            WIDE**2 * 0.5 * float(np.median((sight.flow_um_s**2).sum(axis=1))) + float(sight.std_um_s.max()) ** 2 + 1e-9
        )
        found = fit(design, misfit, variance, wide)
        bent = False
        for _ in range(self.max_steps):
            state = response.approach(prior.offset(found.mean), state)
            beyond = response.pixels(state.flux)
            if state.step <= self.tolerance:
                break
            # Only the amplitudes follow; whom to trust is asked again at the end.
            found = found.moved(design, misfit - seen.of(beyond), variance)
            bent = True
        if bent:
            found = fit(design, misfit - seen.of(beyond), variance, wide)
        left = misfit - seen.of(beyond) - np.tensordot(found.mean, design, axes=1)
        return _Explained(chip, ready, found, state, beyond, (left**2).sum(axis=1) / variance)

    def _field(self, best: _Explained, words: str, assumed: FlowField, sight: Sight, chip: Chip) -> FlowField:
        ready, found = best.ready, best.found
        response, prior = ready.response, ready.prior
        offset = prior.offset(found.mean)
        velocity = ready.base + np.tensordot(found.mean, ready.columns, axes=1) + best.beyond
        spread = np.linalg.cholesky(found.covariance)
        std = np.sqrt((np.tensordot(spread.T, ready.columns, axes=1) ** 2).sum(axis=0) + ready.left_std**2)
        fitted = prior.chip(best.chip, found.mean)
        pressure = response.pressure(offset, best.state) * fitted.viscosity_mpa_s / chip.viscosity_mpa_s
        velocity_um_s, std_um_s, pressure_pa = (
            np.where(
                chip.mask.reshape(chip.mask.shape + (1,) * (values.ndim - 1)),
                fluid_image(best.chip.mask, values.astype(np.float32)),
                np.float32(0.0),
            )
            for values in (velocity, std, pressure)
        )
        # The speed through the opening as the chip has it carries the same fluid.
        widths = [
            (other.width_px / opening.width_px if opening.kind == "inlet" else 1.0)
            for other, opening in zip(best.chip.openings, chip.openings, strict=True)
        ]
        return FlowField(
            stamp_ns=assumed.stamp_ns,
            request=assumed.request,
            method="assimilate",
            um_per_px=chip.um_per_px,
            velocity_um_s=velocity_um_s,
            pressure_pa=pressure_pa,
            std_um_s=std_um_s,
            boundary_values=fitted.boundary_values * widths,
            viscosity_mpa_s=fitted.viscosity_mpa_s,
            density_kg_m3=fitted.density_kg_m3,
            note=statement(chip, sight, found, prior, words),
        )

    def _ready(self, chip: Chip, solver: FlowSolver) -> _Ready:
        """All that does not depend on the observations; kept."""

        def make() -> _Ready:
            widths = Widths(
                self.inlet_std_share,
                self.pump_std_share,
                self.outlet_std_share,
                self.viscosity_std_share,
                self.density_std_share,
                self.depth_std_share,
                self.inlet_shape_std,
            )
            response = solver.sensitivities(chip, self.depth_std_share > 0.0, self.inlet_shape_std > 0.0)
            pressure = response.pressure(np.zeros(response.modes.shape[0]), response.start())
            prior = Prior.of(widths, chip, float(np.ptp(pressure)))
            grid = self.model.of(chip, solver, response)
            modes = response.modes.copy()
            modes[: len(grid.modes)] += grid.share * grid.modes
            # Parameters in prior standard deviations, and last how far the grid is off.
            columns = np.concatenate([np.tensordot(prior.spread, modes, axes=1), grid.share_std * grid.base[None]])
            base = response.base + grid.share * grid.base
            # Nothing is known better than to rounding, also where an observation has a std of 0.
            left = np.maximum(grid.left_std, 1e-3 * grid.left_std.max() + 1e-9)
            return _Ready(response, prior, columns, base, np.repeat(left[:, None], 2, axis=1))

        made: _Ready = cached((self, solver, chip_key(chip)), cell_count(chip, solver.k) // 10, make)
        return made


@dataclass(frozen=True, slots=True, eq=False)
class _Ready:
    """The linear model of a chip: velocity = base + z columns, and its error; compact (..., n, 2) um/s."""

    response: Sensitivities
    prior: Prior
    columns: Floats  # (beliefs + 1, n, 2)
    base: Floats  # (n, 2)
    left_std: Floats  # (n, 2)


@dataclass(frozen=True, slots=True, eq=False)
class _Explained:
    """A chip's most probable flow."""

    chip: Chip
    ready: _Ready
    found: Fit
    state: Remainder
    beyond: Floats  # (n, 2) um/s what inertia adds to the linear model
    chi_squared: Floats  # (m,) of each observation, with two degrees of freedom

    @property
    def surprise(self) -> float:
        """By how many of its standard deviations chi squared of the observations is too large."""
        free = max(2.0 * len(self.chi_squared) - float((1.0 - np.diag(self.found.covariance)).sum()), 1.0)
        return (float(self.chi_squared.sum()) - free) / float(np.sqrt(2.0 * free))

    @property
    def adequate(self) -> bool:
        """Whether it explains most observations, with parameters that somebody could have believed."""
        openings = len(self.chip.openings)
        return (
            self.found.noise_factor < 1.5
            and float(self.found.trust.mean()) > 0.6
            and float(np.abs(self.found.mean[:openings]).max()) < 3.0
        )

    @property
    def evidence(self) -> float:
        """The ln of the probability of the observations (Laplace), but for a constant."""
        return 0.5 * float(np.linalg.slogdet(self.found.covariance)[1]) - self.found.energy


@dataclass(frozen=True, slots=True, eq=False)
class _Seen:
    """A Sight on compact fields (..., n, 2)."""

    index: NDArray[np.intp]  # (m, 4) of the fluid pixels
    weights: Floats  # (m, 4), 0 in solid

    @classmethod
    def of_mask(cls, sight: Sight, mask: NDArray[np.bool_]) -> _Seen:
        """On the fluid of a mask; solid is seen to stand still."""
        number = np.full(mask.shape, -1, np.intp)
        number[mask] = np.arange(np.count_nonzero(mask))
        index = number[sight.rows, sight.columns]
        return cls(np.maximum(index, 0), np.where(index >= 0, sight.weights, 0.0))

    def of(self, values: Floats) -> Floats:
        """(..., n, 2) as observed: (..., m, 2)."""
        return np.asarray(np.einsum("...mkc,mk->...mc", values[..., self.index, :], self.weights))


def _variance(sight: Sight, left_std: Floats) -> Floats:
    """(m,) of each component: noise, and what the model leaves there.

    Neighbours share what the model leaves, so that the mean of many is not better for it; and an observation that
    was handed in several times counts once.
    """
    _, cell, crowd = np.unique(
        np.stack([sight.rows[:, 0] // CROWD_PX, sight.columns[:, 0] // CROWD_PX]),
        axis=1,
        return_inverse=True,
        return_counts=True,
    )
    same = np.concatenate([sight.rows[:, :1], sight.columns[:, :1], sight.weights, sight.flow_um_s], axis=1)
    _, twin, times = np.unique(same, axis=0, return_inverse=True, return_counts=True)
    # A std of 0 in solid would be a contradiction that no noise explains.
    least = (SHARPEST**2) * float(np.median((sight.flow_um_s**2).sum(axis=1))) + 1e-12
    return np.asarray(times[twin.ravel()] * sight.std_um_s**2 + crowd[cell.ravel()] * left_std**2 + least)
