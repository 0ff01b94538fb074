"""The uncertainty of a flow after some observations, for those who plan where to look next."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from flowrec.core import Floats, FlowError
from flowrec.physics import Chip, FlowSolver, FlowUncertainty
from flowrec.stages.refine.assimilate import OBSTACLE_SHARE, Assimilate, Hypotheses
from flowrec.stages.refine.causes import GAIN
from flowrec.stages.refine.doubts import doubted_places
from flowrec.stages.refine.field_variance import field_columns, left_variance, prior_left_variance, prior_of
from flowrec.stages.refine.flow_model import flow_model
from flowrec.stages.refine.noise import NOISE
from flowrec.stages.refine.observation_operator import ObservationOperator


def flow_uncertainty(
    settings: Assimilate, operator: ObservationOperator, chip: Chip, solver: FlowSolver
) -> FlowUncertainty | None:
    """The posterior of the assimilation, on the chip's own walls; the prior without an observation.

    The constant of the robot is the relative error of um per revolution. Hypotheses that differ (the depth of the chip)
    are unknowns, too: the column of each is its difference from the mean. None where there is no prior: the chip is
    assumed to stand still, or its flow can not be computed.
    """
    try:
        if operator.count == 0:
            model = flow_model(settings, settings.model, chip, solver)
            columns, covariance = prior_of(model)
            rolled = np.ones((1, len(model.base)))
            left = _error_std(prior_left_variance(model))
            return FlowUncertainty(
                model.base, columns, rolled, _block_diagonal(covariance, np.diag([GAIN[0] ** 2])), left
            )
        chip, operator = settings.as_observed(operator, chip, solver)
        every = settings.hypotheses(operator, chip, solver)
    except FlowError:
        return None
    best = every.best
    doubts = doubted_places(best.observed, best.robust, solver, OBSTACLE_SHARE)
    changes = [best.on_pixels_of(chip.mask, change) for change in doubts.changes_um_s]
    if changes:
        doubts = replace(doubts, changes_um_s=np.stack(changes))
    return replace(_of(every), doubts=doubts)


def _of(every: Hypotheses) -> FlowUncertainty:
    best, mean, flows = every.best, every.flow, every.flows
    columns = np.stack([best.on_pixels_of(every.mask, column) for column in field_columns(best)])
    count = len(columns)
    gain = _gain_index(every)
    index = [*range(count), *([] if gain is None else [gain])]
    covariance = best.posterior.covariance[np.ix_(index, index)]
    apart = [np.sqrt(weight) * (flow - mean) for flow, weight in zip(flows, every.weights, strict=True)]
    if len(apart) > 1:
        columns = np.concatenate([columns, np.stack(apart)])
        moved = np.zeros((len(covariance) + len(apart),) * 2)
        old = np.r_[0:count, count + len(apart) : len(moved)]
        moved[np.ix_(old, old)] = covariance
        new = np.arange(count, count + len(apart))
        moved[new, new] = 1.0
        covariance = moved
    rolled = np.ones((0 if gain is None else 1, len(mean)))
    factor = best.robust.factor * best.size(NOISE[0])
    left = _error_std(best.on_pixels_of(every.mask, left_variance(best)))
    return FlowUncertainty(mean, columns, rolled, covariance, left, factor, registration=best.registration)


def _error_std(variance: Floats) -> Floats:
    """(n,) root mean square of the components of (n, 2)."""
    return np.asarray(np.sqrt(0.5 * variance.sum(axis=1)))


def _gain_index(every: Hypotheses) -> int | None:
    """Place of the unknown that is the error of um per revolution; None where the robot's motion is not stated."""
    first = 0
    for effect in every.best.effects:
        if effect.name == "gain":
            return first
        first += len(effect.columns)
    return None


def _block_diagonal(one: Floats, two: Floats) -> Floats:
    """The block-diagonal matrix of two."""
    joined = np.zeros((len(one) + len(two),) * 2)
    joined[: len(one), : len(one)], joined[len(one) :, len(one) :] = one, two
    return joined
