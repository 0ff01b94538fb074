"""Assimilation: the boundary values that explain the observations best, and the uncertainty of the resulting field.

The parameters are the boundary values and the fluid's viscosity and density, with a Gaussian prior around the assumed
ones. Without inertia the field is linear in inlet speeds and p_out / mu; with inertia a few steps of the full equations
with frozen factors add the nonlinear remainder. The curvature of the posterior gives the covariance. Where the
observations contradict the walls, masks a pixel off are compared by their evidence.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, field, replace
from typing import Annotated

import numpy as np
import scipy  # its ndimage loads at first use, not at start-up

from flowrec.chip.chip import Chip
from flowrec.chip.openings import border, run_around
from flowrec.errors import FlowError
from flowrec.flow import FlowSolver
from flowrec.flow.linear_solver import cached, cell_count, chip_key
from flowrec.flow.sampling import fluid_image
from flowrec.flow.sensitivities import Remainder, Sensitivities
from flowrec.messages import FlowField
from flowrec.ranges import Range
from flowrec.refine.discretisation_error import ModelError
from flowrec.refine.method import Problem
from flowrec.refine.mixture_regression import Model, Regression
from flowrec.refine.observation_operator import Floats, ObservationOperator
from flowrec.refine.prior import Prior, PriorSettings
from flowrec.refine.report import report

SURPRISE = 1.5  # standard deviations of chi squared above which other walls are tried
LEAST_GAIN = 4.0  # in ln evidence, before other walls than the chip's are taken
OUTLIER_SCALE = 3.0  # size of an outlier's components over the typical component of the observations
LARGEST_PX = 30_000  # fluid pixels of a chip for which other walls are tried: each variant is a geometry of its own
LEAST_STD = 1e-3  # of the typical observed speed: no observation is more accurate
CLUSTER_PX = 4  # observations in a square of this size share the model's error


@dataclass(frozen=True, slots=True)
class Assimilate(PriorSettings):
    """Settings of the assimilation. Prior widths are one standard deviation."""

    model: ModelError = field(default_factory=ModelError)
    doubt_walls: bool = True  # try walls a pixel off where the observations contradict the chip's
    max_steps: Annotated[int, Range(1, 1_000)] = 8  # of the full equations with frozen factors
    tolerance: Annotated[float, Range(1e-12, 1.0)] = 2e-3  # last such step over the fastest speed

    def fit(self, problem: Problem) -> FlowField:
        """Posterior mean field with its standard deviation, boundary values and viscosity.

        Raises
        ------
        FlowError
            If the flow of the fitted parameters can not be computed.
        """
        operator, chip, solver = problem.operator, problem.chip, problem.solver
        best = self._posterior(operator, chip, solver)
        wrong = ""
        if self.doubt_walls and best.surprise > SURPRISE and np.count_nonzero(chip.mask) <= LARGEST_PX:
            wrong, other = self._better_mask(operator, chip, replace(solver, k=1))
            if wrong:
                # The coarse grid proposes, the fine one decides.
                moved = self._posterior(operator, other, solver)
                if moved.adequate and moved.evidence > best.evidence + LEAST_GAIN:
                    best = moved
                else:
                    wrong = ""
        return self._field(best, wrong, problem)

    def unobserved(self, assumed: FlowField, chip: Chip, solver: FlowSolver) -> FlowField:
        """The assumed field with the standard deviation of the prior, or without one where there is no prior."""
        try:
            model = self._linear_model(chip, solver)
        except FlowError:
            return assumed
        std = np.sqrt((model.columns**2).sum(axis=0) + model.error_std**2)
        return replace(assumed, std_um_s=fluid_image(chip.mask, std.astype(np.float32)))

    def _better_mask(self, operator: ObservationOperator, chip: Chip, solver: FlowSolver) -> tuple[str, Chip]:
        """What is wrong with the mask, and the chip with a mask of far higher evidence; '' where there is none."""
        own = self._posterior(operator, chip, solver).evidence
        gains = []
        for words, other in mask_variants(chip):
            with suppress(FlowError):  # a variant that carries no flow is left out
                gains.append((self._posterior(operator, other, solver).evidence - own, words, other))
        gain, words, other = max(gains, key=lambda entry: entry[0], default=(0.0, "", chip))
        return (words, other) if gain > LEAST_GAIN else ("", chip)

    def _posterior(self, operator: ObservationOperator, chip: Chip, solver: FlowSolver) -> _Posterior:
        """The most probable flow of a chip. Observations in its solid are predicted to be at rest."""
        model = self._linear_model(chip, solver)
        expansion, prior = model.expansion, model.prior
        here = operator.with_walls(expansion.wall_px).on_fluid(chip.mask)
        design = here.predict(model.columns)
        misfit = operator.flow_um_s - here.predict(model.base)
        variance = _variance(operator, here.predict(model.error_std)[:, 0])
        remainder, nonlinear = expansion.start(), np.zeros_like(model.base)
        # The same for all walls, so that their evidence can be compared.
        outlier_variance = (
            OUTLIER_SCALE**2 * 0.5 * float(np.median((operator.flow_um_s**2).sum(axis=1)))
            + float(operator.std_um_s.max()) ** 2
            + 1e-9
        )
        linear = Model(design, misfit, variance, outlier_variance)
        found, moved = linear.fit(), False
        for _ in range(self.max_steps):
            remainder = expansion.approach(prior.offset(found.mean), remainder)
            nonlinear = expansion.pixels(remainder.flux)
            linear = replace(linear, misfit=misfit - here.predict(nonlinear))
            if remainder.step <= self.tolerance:
                break
            # The inlier probabilities are found again at the end only.
            found, moved = linear.refit(found), True
        found = linear.fit() if moved else found
        residual = linear.residual(found.mean)
        return _Posterior(chip, model, found, remainder, nonlinear, (residual**2).sum(axis=1) / variance)

    def _field(self, best: _Posterior, wrong_mask: str, problem: Problem) -> FlowField:
        """The posterior as a field on the chip's own mask."""
        model, found, chip = best.model, best.found, problem.chip
        velocity = model.base + np.tensordot(found.mean, model.columns, axes=1) + best.nonlinear
        root = np.linalg.cholesky(found.covariance)
        std = np.sqrt((np.tensordot(root.T, model.columns, axes=1) ** 2).sum(axis=0) + model.error_std**2)
        fitted = model.prior.chip(best.chip, found.mean)
        pressure = model.expansion.pressure(model.prior.offset(found.mean), best.remainder)
        pressure = pressure * fitted.viscosity_mpa_s / chip.viscosity_mpa_s
        velocity_um_s, std_um_s, pressure_pa = (
            np.where(
                chip.mask.reshape(chip.mask.shape + (1,) * (values.ndim - 1)),
                fluid_image(best.chip.mask, values.astype(np.float32)),
                np.float32(0.0),
            )
            for values in (velocity, std, pressure)
        )
        # The mean speed is that through the opening as the chip has it, at the same flow rate.
        widths = [
            (other.width_px / opening.width_px if opening.kind == "inlet" else 1.0)
            for other, opening in zip(best.chip.openings, chip.openings, strict=True)
        ]
        return replace(
            problem.assumed,
            method="assimilate",
            um_per_px=chip.um_per_px,
            velocity_um_s=velocity_um_s,
            pressure_pa=pressure_pa,
            std_um_s=std_um_s,
            boundary_values=fitted.boundary_values * widths,
            viscosity_mpa_s=fitted.viscosity_mpa_s,
            density_kg_m3=fitted.density_kg_m3,
            note=report(chip, problem.operator, found, model.prior, wrong_mask),
        )

    def _linear_model(self, chip: Chip, solver: FlowSolver) -> _LinearModel:
        """All that does not depend on the observations, from the cache if possible."""

        def compute() -> _LinearModel:
            expansion = solver.sensitivities(chip, self.depth_std_share > 0.0, self.inlet_shape_std > 0.0)
            pressure = expansion.pressure(np.zeros(len(expansion.modes)), expansion.start())
            prior = Prior.of(self, chip, float(np.ptp(pressure)))
            grid = self.model.of(chip, solver, expansion)
            modes = expansion.modes.copy()
            modes[: len(grid.modes)] += grid.fraction * grid.modes
            # Per prior standard deviation of each unknown; the last unknown is the fraction of the grid's error.
            columns = np.concatenate([np.tensordot(prior.effect, modes, axes=1), grid.fraction_std * grid.base[None]])
            base = expansion.base + grid.fraction * grid.base
            # Above rounding errors, also where an observation has a std of 0.
            std = np.maximum(grid.local_std, 1e-3 * grid.local_std.max() + 1e-9)
            return _LinearModel(expansion, prior, columns, base, np.repeat(std[:, None], 2, axis=1))

        model: _LinearModel = cached((self, solver, chip_key(chip)), cell_count(chip, solver.k) // 10, compute)
        return model


@dataclass(frozen=True, slots=True, eq=False)
class _LinearModel:
    """The linear model of a chip: velocity = base + z columns, and its error; compact (..., n, 2) um/s."""

    expansion: Sensitivities
    prior: Prior
    columns: Floats  # (unknowns + 1, n, 2)
    base: Floats  # (n, 2)
    error_std: Floats  # (n, 2)


@dataclass(frozen=True, slots=True, eq=False)
class _Posterior:
    """A chip's most probable flow."""

    chip: Chip
    model: _LinearModel
    found: Regression
    remainder: Remainder
    nonlinear: Floats  # (n, 2) um/s what inertia adds to the linear model
    chi2: Floats  # (observations,) squared residuals over their variance

    @property
    def evidence(self) -> float:
        """Logarithm of the evidence of the observations (Laplace approximation), up to a constant."""
        return 0.5 * float(np.linalg.slogdet(self.found.covariance)[1]) - self.found.energy

    @property
    def surprise(self) -> float:
        """By how many of its standard deviations chi squared of the observations is too large."""
        free = max(2.0 * len(self.chi2) - float((1.0 - np.diag(self.found.covariance)).sum()), 1.0)
        return (float(self.chi2.sum()) - free) / float(np.sqrt(2.0 * free))

    @property
    def adequate(self) -> bool:
        """Whether the flow explains most observations, with boundary values that are plausible beforehand."""
        return (
            self.found.noise_factor < 1.5
            and float(self.found.inlier.mean()) > 0.6
            and float(np.abs(self.found.mean[: len(self.chip.openings)]).max()) < 3.0
        )


def _variance(operator: ObservationOperator, error_std: Floats) -> Floats:
    """(n,) variance of each component: noise of the observation, and the model's error there.

    Neighbours share the model's error, so their mean is not more accurate. An observation that was given several times
    counts once.
    """
    cell = np.floor(operator.points.T).astype(np.int64) // CLUSTER_PX
    _, cluster, neighbours = np.unique(cell, axis=1, return_inverse=True, return_counts=True)
    identity = np.concatenate([operator.points, operator.flow_um_s], axis=1)
    _, copy, copies = np.unique(identity, axis=0, return_inverse=True, return_counts=True)
    # A std of 0 in solid would be a contradiction that no noise explains.
    least = (LEAST_STD**2) * float(np.median((operator.flow_um_s**2).sum(axis=1))) + 1e-12
    noise = copies[copy.ravel()] * operator.std_um_s**2
    return np.asarray(noise + neighbours[cluster.ravel()] * error_std**2 + least)


def mask_variants(chip: Chip) -> Iterator[tuple[str, Chip]]:
    """What would be wrong with the mask, in words, and the chip with the mask corrected and its openings moved.

    A variant in which an opening vanishes or meets another is left out.
    """
    mask = chip.mask
    edge = np.pad(mask, 1, mode="edge")
    variants = (
        (
            "its channels are drawn a pixel too wide on each side",
            scipy.ndimage.binary_erosion(mask, border_value=1),
            (0, 0),
        ),
        ("its channels are drawn a pixel too narrow on each side", scipy.ndimage.binary_dilation(mask), (0, 0)),
        ("it lies a pixel too far left", edge[1:-1, :-2], (1, 0)),
        ("it lies a pixel too far right", edge[1:-1, 2:], (-1, 0)),
        ("it lies a pixel too high", edge[:-2, 1:-1], (0, 1)),
        ("it lies a pixel too low", edge[2:, 1:-1], (0, -1)),
    )
    for words, other, (right, down) in variants:
        runs = [
            run_around(
                border(other, o.side), (o.first + o.last) // 2 + (down if o.side in ("left", "right") else right)
            )
            for o in chip.openings
        ]
        openings = tuple(
            replace(o, first=run[0], last=run[1]) for o, run in zip(chip.openings, runs, strict=True) if run
        )
        if len({(o.side, o.first) for o in openings}) == len(runs):
            yield words, replace(chip, mask=np.ascontiguousarray(other), openings=openings)
