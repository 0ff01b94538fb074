"""Assimilation: what differs from the assumed world, found from the observations, and the uncertainty of the flow.

Unknown are the boundary values and the fluid (prior.py), errors of the map along the channels (channel_cells.py), what
the robot, the pump and the registration add to the observations (causes.py), and the sizes of all these effects
(evidence.py). Without inertia the field is linear in inlet speeds and p_out / mu; with inertia a few steps of the full
equations with frozen factors add the nonlinear remainder. The depth of a chip that states none is taken from a small
grid. That walls, robot and registration are as stated is a hypothesis of its own. Masks a pixel off are tried where the
observations contradict the walls. The field is the mean over these hypotheses, weighted by their evidence.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Annotated

import numpy as np

from flowrec.core import Bools, Floats, FlowError, FlowField, Range
from flowrec.physics import Chip, FlowSolver, fluid_image, law_text, median_width_um, with_wall_offset
from flowrec.stages.refine.causes import AS_STATED, Observed
from flowrec.stages.refine.discretisation_error import ModelError
from flowrec.stages.refine.disturbances import held_back
from flowrec.stages.refine.doubts import deposits_um_s
from flowrec.stages.refine.field_variance import expected_error, field_variance, prior_variance
from flowrec.stages.refine.findings import explained_by_pump, findings, wanders, with_departure, with_obstacle
from flowrec.stages.refine.flow_model import FlowModel, flow_model
from flowrec.stages.refine.held_back import scores_of
from flowrec.stages.refine.hypothesis import (
    HypothesisFit,
    State,
    Steps,
    begin,
    complete,
    first_evidence,
    of_the_field,
    shaking_stage,
)
from flowrec.stages.refine.method import RefinementProblem
from flowrec.stages.refine.misstated_inflow import at_observed_inflow
from flowrec.stages.refine.noise import Robust, outlying, robust_noise
from flowrec.stages.refine.observation_operator import ObservationOperator
from flowrec.stages.refine.obstacles import PLACES, Obstacle, likely_obstacles, with_shape_error
from flowrec.stages.refine.predictive_check import find_departure
from flowrec.stages.refine.prior import PriorSettings
from flowrec.stages.refine.report import over_error, report
from flowrec.stages.refine.wall_bias import OFFSETS_PX, coarser, in_biased_walls, wall_mode

LARGEST_PX = 30_000  # fluid pixels of a chip for which depths and walls are tried: each is a geometry of its own
DEPTHS_WIDTHS = (0.4, 0.8, 1.6, 3.2)  # grid of depths of a chip that states none, in median channel widths
DEPTH_STD_SHARE = 0.3  # standard deviation around each of them: half of their spacing in ln depth
BIASED_SHARE = 0.3  # odds that all walls are off by the same distance, before any observation
UNSTATED_SHARE = 0.8  # prior probability that the depth of such a chip does not matter
# Power of the likelihood ratio of chips, of other depths and with obstacles (a coarsened posterior, Miller and Dunson
# 2019): what no hypothesis explains (uneven rolling, optics, walls, contacts) favours one of them by chance. Where the
# depth does not matter, a wrong one was likelier by up to 4 nats in 30 surveys (error 4 to 36 %); a true one of half a
# width by 15 to 20, of 0.8 by 0 to 8. In 42 surveys (half of them in worlds with a blocked branch) an obstacle whose
# flow was worse than that without it was likelier by up to 9 nats, one whose flow was better by 29, 42, 43 and 128.
CHIP_POWER = 0.5
# Prior probability that walls, robot and registration are as stated: an assumption. After the observations of 8
# simulated flights in the world `kind` it was 60 to 90 %, of 16 in `moderate` and `hard` under 2 %.
AS_STATED_SHARE = 0.3
OBSTACLE_SHARE = 0.2  # prior probability that some channel is partly blocked, at any one of the tried places
HELD_SHARE = 0.2  # prior probability that something held the robot for a moment; it may be any one of the
STRETCH = 4.0  # observations of a moment
LEAST_WEIGHT = 0.02  # of a hypothesis that is computed to the end
# In ln evidence: what is farther behind at first sight is not begun. Registration, lines and inertia have then added up
# to 3.6 more to a depth than to the chip as it is stated (surveys of procedural vessels).
BEHIND = 5.0


def _is_small(chip: Chip) -> bool:
    return bool(np.count_nonzero(chip.mask) <= LARGEST_PX)


@dataclass(frozen=True, slots=True, eq=False)
class Hypotheses:
    """The flows of the plausible hypotheses, on the fluid pixels of the chip's mask, and their probabilities.

    The chip as it is stated stands until another depth is likelier after the observations than before: the mean gives
    others the weight by which their evidence exceeds that of the stated one. The variance around it counts all by their
    probabilities, so that what the observations can not tell is within the error bars.
    """

    found: list[HypothesisFit]
    weights: Floats  # probabilities
    shares: Floats  # of the mean
    mask: Bools  # (h, w) of the chip
    obstacles: tuple[Obstacle, ...] = ()  # of the last hypotheses, one each

    @property
    def obstacle(self) -> tuple[Obstacle, float] | None:
        """The likeliest obstacle, and the probability that there is one; None where none was tried."""
        if not self.obstacles:
            return None
        weights = self.weights[-len(self.obstacles) :]
        return self.obstacles[int(np.argmax(weights))], float(weights.sum())

    @property
    def best(self) -> HypothesisFit:
        """The most probable one."""
        return self.found[int(np.argmax(self.shares))]

    @property
    def flows(self) -> Floats:
        """(hypotheses, n, 2) the flow of each."""
        return np.stack([one.on_pixels_of(self.mask, one.flow) for one in self.found])

    @property
    def flow(self) -> Floats:
        """(n, 2) the mean."""
        return np.asarray(np.tensordot(self.shares, self.flows, axes=1))


@dataclass(frozen=True, slots=True)
class Assimilate(PriorSettings):
    """Settings of the assimilation. Prior widths are one standard deviation."""

    model: ModelError = field(default_factory=ModelError)
    # all walls may lie the same distance off, unless an image has shown them
    doubt_walls: bool = True
    doubt_depth: bool = True  # try depths where the chip states none
    max_steps: Annotated[int, Range(1, 1_000)] = 8  # largest number of steps of the full equations with frozen factors
    tolerance: Annotated[float, Range(1e-12, 1.0)] = 2e-3  # last such step over the fastest speed

    def fit(self, problem: RefinementProblem) -> FlowField:
        """Posterior mean field with its standard deviation, boundary values, viscosity and what else was found.

        Raises
        ------
        FlowError
            If the flow of the fitted parameters can not be computed.
        """
        return self.fit_with_observations(problem)[0]

    def fit_with_observations(
        self, problem: RefinementProblem, obstacles: bool = False
    ) -> tuple[FlowField, ObservationOperator]:
        """Fit, and return the observations less the effects of robot, registration and pump, too.

        `obstacles`: channels that are partly blocked are tried as well.

        Raises
        ------
        FlowError
            If the flow of the fitted parameters can not be computed.
        """
        chip, operator = self.as_observed(problem.operator.distinct(), problem.chip, problem.solver)
        problem = replace(problem, operator=operator)
        every = self.hypotheses(operator, chip, problem.solver)
        if obstacles and problem.chip.law is None and _is_small(problem.chip):
            every = self._with_obstacles(every, problem)
        flow_um_s, std_um_s = of_the_field(every.best)
        return self._field(every, problem), replace(problem.operator, flow_um_s=flow_um_s, std_um_s=std_um_s)

    def prior_field(self, assumed: FlowField, chip: Chip, solver: FlowSolver) -> FlowField:
        """The assumed field with the standard deviation of the prior, or without one where there is no prior."""
        try:
            model = flow_model(self, self.model, chip, solver)
        except FlowError:
            return assumed
        variance = prior_variance(model)
        std = fluid_image(chip.mask, np.sqrt(variance).astype(np.float32))
        return replace(assumed, std_um_s=std, error_share=expected_error(model.base, variance))

    def prior_error_share(self, chip: Chip, solver: FlowSolver) -> float | None:
        """Expected relative RMSE of the assumed flow; None where there is no prior."""
        try:
            model = flow_model(self, self.model, chip, solver)
        except FlowError:
            return None
        return expected_error(model.base, prior_variance(model))

    def as_observed(
        self, operator: ObservationOperator, chip: Chip, solver: FlowSolver
    ) -> tuple[Chip, ObservationOperator]:
        """The chip with another inflow, and the observations with a shaking of the stage, where these show one."""
        chip, own = at_observed_inflow(chip, partial(self._observe, stated=chip, operator=operator, solver=solver))
        found = shaking_stage(own, robust_noise(own))
        return chip, operator if found is None else replace(operator, disturbances=(*operator.disturbances, found))

    def hypotheses(self, operator: ObservationOperator, chip: Chip, solver: FlowSolver) -> Hypotheses:
        """The flows of the plausible hypotheses.

        Raises
        ------
        FlowError
            If the chip's own flow can not be computed, or is at rest.
        """
        steps = Steps(self.max_steps, self.tolerance)
        chips, prior = [chip], [1.0]
        if depths := self._depths(chip):
            chips += depths
            prior = [UNSTATED_SHARE, *[(1.0 - UNSTATED_SHARE) / len(depths)] * len(depths)]
        own = self._observe(chip, chip, operator, solver)
        robust = robust_noise(own)
        if len(chips) > 1:
            # The coarse grid proposes: most depths are out of the question, and a factorisation is dear.
            chips, prior = self._plausible(chips, prior, operator, coarser(solver), robust)
        # Of the chip as it is stated, walls, robot and registration are so too, or their errors are as usual.
        cases = [(chip, AS_STATED, prior[0] * AS_STATED_SHARE)]
        prior[0] *= 1.0 - AS_STATED_SHARE
        cases += [(other, 1.0, share) for other, share in zip(chips, prior, strict=True)]
        begun: list[tuple[Robust, State, float]] = []
        for other, usual, share in cases:
            with suppress(FlowError):  # a depth whose flow can not be computed
                observed = own if other is chip else self._observe(other, chip, operator, solver)
                begun.append((robust, begin(replace(observed, usual=usual), robust, steps), float(np.log(share))))
        if self._doubts_walls(chip):
            noise, state, ln_share = begun[1]  # walls that are off by chance only
            observe = partial(self._observe, stated=chip, operator=operator)
            biased = in_biased_walls(chip, solver, state, noise, observe, steps)
            if biased is not None:
                begun.append((*biased, ln_share + float(np.log(BIASED_SHARE))))

        def ln_weights(evidence: list[float], which: Sequence[int]) -> tuple[Floats, Floats]:
            """Ln of the posterior probabilities, and of the likelihood ratios to the chip as it is drawn."""
            drawn = [begun[index][1].observed for index in which]
            stated = np.array([one.wall_mode is None and one.model.chip.depth_um == chip.depth_um for one in drawn])
            gains = np.array(evidence) - max(np.array(evidence)[stated] if stated.any() else evidence)
            power = np.array([CHIP_POWER if one.wall_mode is None else 1.0 for one in drawn])
            ln_prior = np.array([begun[index][2] for index in which])
            return power * gains + ln_prior, np.where(stated | ~stated.any(), np.inf, power * gains)

        # What was an outlier in one hypothesis may be explained by another.
        every = range(len(begun))
        first, _ = ln_weights([state.sizes.evidence - outlying(noise) for noise, state, _ in begun], every)
        plausible = [index for index in every if first[index] > first.max() + np.log(LEAST_WEIGHT)]
        found = [complete(*begun[index][:2], steps) for index in plausible]
        ln_weight, ln_ratio = ln_weights([one.posterior.evidence - outlying(one.robust) for one in found], plausible)
        weights = np.exp(ln_weight - ln_weight.max())
        # weight - prior x evidence of the stated chip: of what is not likelier than that, nothing is left.
        shares = weights * -np.expm1(np.minimum(-ln_ratio, 0.0))
        return Hypotheses(found, weights / weights.sum(), shares / shares.sum(), chip.mask)

    def preparations(self, chip: Chip, solver: FlowSolver) -> Iterator[Callable[[], object]]:
        """The parts of a fit that depend on the chip alone, each of which leaves its result in the cache.

        A part raises FlowError where the flow in it can not be computed.
        """
        yield partial(flow_model, self, self.model, chip, solver)
        for other in self._depths(chip):
            yield partial(self._model, other, chip, coarser(solver))
        if _is_small(chip):
            yield lambda: deposits_um_s(flow_model(self, self.model, chip, solver), solver)
        if self._doubts_walls(chip):
            yield partial(wall_mode, chip, solver)
            yield from (partial(self._in_moved_walls, offset_px, chip, solver) for offset_px in OFFSETS_PX)

    def _doubts_walls(self, chip: Chip) -> bool:
        """True where all walls may be off alike. An image tells it to a fifth of a pixel, a robot near walls does not.

        Of thirteen simulated flights with walls from the image, two had walls half a pixel too far inside that fitted
        the observations better (error 8 % instead of 2): a robot beside a wall lags by more than its model.
        """
        return self.doubt_walls and _is_small(chip) and chip.walls != "grey"

    def _in_moved_walls(self, offset_px: float, chip: Chip, solver: FlowSolver) -> FlowModel:
        return self._model(with_wall_offset(chip, offset_px), chip, coarser(solver))

    def _depths(self, chip: Chip) -> list[Chip]:
        """The chip with each depth that is tried, where it states none."""
        if not (self.doubt_depth and chip.depth_um is None and _is_small(chip)):
            return []
        width_um = median_width_um(chip)
        return [replace(chip, depth_um=share * width_um) for share in DEPTHS_WIDTHS]

    def _plausible(
        self, chips: list[Chip], prior: list[float], operator: ObservationOperator, solver: FlowSolver, robust: Robust
    ) -> tuple[list[Chip], list[float]]:
        """The first chip, and those that are not far less likely than the likeliest at first sight."""
        ln_weight = np.full(len(chips), -np.inf)
        for index, (other, share) in enumerate(zip(chips, prior, strict=True)):
            with suppress(FlowError):
                observed = self._observe(other, chips[0], operator, solver)
                ln_weight[index] = first_evidence(observed, robust) + np.log(share)
        kept = ln_weight > ln_weight.max() + np.log(LEAST_WEIGHT) - BEHIND
        kept[0] = True
        which = np.flatnonzero(kept)
        return [chips[index] for index in which], [prior[index] for index in which]

    def _with_obstacles(self, every: Hypotheses, problem: RefinementProblem) -> Hypotheses:
        """Add the chip of the most probable hypothesis with each likely obstacle."""
        best = every.best
        chip, solver = best.observed.model.chip, problem.solver
        steps, tried = Steps(self.max_steps, self.tolerance), []
        for obstacle in likely_obstacles(best, solver):
            with suppress(FlowError):  # a channel that is closed
                observed = self._observe(obstacle.on(chip), problem.chip, problem.operator, solver)
                observed = replace(observed, model=with_shape_error(observed.model, best.observed.model))
                robust = robust_noise(observed)  # what was an outlier may be explained now
                tried.append((obstacle, robust, begin(observed, robust, steps)))
        if not tried:
            return every
        ln_odds = float(np.log(OBSTACLE_SHARE / (1.0 - OBSTACLE_SHARE) / PLACES))
        least = begin(best.observed, best.robust, steps).sizes.evidence - outlying(best.robust)
        least += (np.log(LEAST_WEIGHT) - ln_odds) / CHIP_POWER
        tried = [entry for entry in tried if entry[2].sizes.evidence - outlying(entry[1]) > least]
        if not tried:
            return every
        found = [complete(robust, state, steps) for _, robust, state in tried]
        ln_odds_each = [ln_odds] * len(tried)
        likeliest = tried[int(np.argmax([one.posterior.evidence - outlying(one.robust) for one in found]))][0]
        held = self._held_back(best, likeliest, problem, steps)
        if held is not None:
            found.insert(0, held)
            ln_odds_each.insert(0, float(np.log(HELD_SHARE * STRETCH / max(problem.operator.count, STRETCH))))
        ln_ratio = np.array([one.posterior.evidence - best.posterior.evidence for one in found])
        ln_ratio -= [outlying(one.robust) - outlying(best.robust) for one in found]
        ln_ratio *= CHIP_POWER
        weight = every.weights.max() * np.exp(np.minimum(ln_ratio + ln_odds_each, 500.0))
        weights = np.concatenate([every.weights, weight])
        # As for depths: of what is not likelier than the chip without it, nothing is left.
        shares = np.concatenate([every.shares, weight * -np.expm1(np.minimum(-ln_ratio, 0.0))])
        return Hypotheses(
            every.found + found,
            weights / weights.sum(),
            shares / shares.sum(),
            every.mask,
            tuple(obstacle for obstacle, *_ in tried),
        )

    def _held_back(
        self, best: HypothesisFit, obstacle: Obstacle, problem: RefinementProblem, steps: Steps
    ) -> HypothesisFit | None:
        """The chip without an obstacle, by a robot that was held where it is; None where no observation was near."""
        time_s = problem.operator.time_s
        if time_s is None:
            return None
        away = best.observed.operator.points - np.array([obstacle.column, obstacle.row])
        held = held_back(np.hypot(*away.T) <= 2.0 * obstacle.half_width_px, time_s)
        if held is None:
            return None
        operator = replace(problem.operator, disturbances=(*problem.operator.disturbances, held))
        observed = self._observe(best.observed.model.chip, problem.chip, operator, problem.solver)
        robust = robust_noise(observed)
        return complete(robust, begin(observed, robust, steps), steps)

    def _observe(self, chip: Chip, stated: Chip, operator: ObservationOperator, solver: FlowSolver) -> Observed:
        """The observations in the model of a chip."""
        return Observed.of(self._model(chip, stated, solver), operator)

    def _model(self, chip: Chip, stated: Chip, solver: FlowSolver) -> FlowModel:
        """The model of a chip. A depth that is not stated is known to the spacing of the grid."""
        settings = replace(self, depth_std_share=DEPTH_STD_SHARE) if chip.depth_um != stated.depth_um else self
        return flow_model(settings, self.model, chip, solver)

    def _field(self, every: Hypotheses, problem: RefinementProblem) -> FlowField:
        """The mean over the hypotheses as a field on the chip's own mask."""
        chip, best = problem.chip, every.best
        mean = every.flow
        variance = np.zeros_like(mean)
        for one, flow, weight in zip(every.found, every.flows, every.weights, strict=True):
            variance += weight * (one.on_pixels_of(chip.mask, field_variance(one)) + (flow - mean) ** 2)
        also = with_obstacle(findings(every.found, every.weights), chip, every.obstacle)
        departure = find_departure(best)
        if departure is not None and not explained_by_pump(also, departure):
            points = np.argwhere(chip.mask)[:, ::-1].astype(np.float64)
            if not (departure.in_time and wanders(also)):  # the bars have grown by the wander already
                variance = np.maximum(variance, departure.least_variance(points, mean))
            also = with_departure(also, departure, chip.um_per_px)
        model = best.observed.model
        z = best.posterior.mean
        fitted = model.prior.chip(model.chip, z)
        pressure = model.expansion.pressure(model.prior.offset(z), best.remainder)
        pressure = best.on_pixels_of(chip.mask, pressure) * (fitted.viscosity_mpa_s / chip.viscosity_mpa_s)
        velocity_um_s, std_um_s, pressure_pa = (
            fluid_image(chip.mask, values.astype(np.float32)) for values in (mean, np.sqrt(variance), pressure)
        )
        # The mean speed is that through the opening as the chip has it, at the same flow rate.
        widths = [
            (other.width_px / opening.width_px if opening.kind == "inlet" else 1.0)
            for other, opening in zip(model.chip.openings, chip.openings, strict=True)
        ]
        moved = over_error((velocity_um_s - problem.assumed.velocity_um_s)[chip.mask], std_um_s[chip.mask])
        note = report(chip, problem.operator, best, also.words, moved)
        scores = scores_of(best, problem.assumed, problem.before) if problem.hold_back else None
        field = replace(
            problem.assumed,
            method="assimilate",
            um_per_px=chip.um_per_px,
            velocity_um_s=velocity_um_s,
            pressure_pa=pressure_pa,
            std_um_s=std_um_s,
            boundary_values=fitted.boundary_values * widths,
            viscosity_mpa_s=fitted.viscosity_mpa_s,
            density_kg_m3=fitted.density_kg_m3,
            note=note,
            error_share=expected_error(mean, variance),
            parameter_names="; ".join(also.names),
            parameters=also.values,
            parameter_std=also.stds,
            viscosity_law=law_text(fitted.law),
            registration=np.tensordot(every.weights, [one.registration.matrix for one in every.found], axes=1),
        )
        return field if scores is None else scores.on(field)
