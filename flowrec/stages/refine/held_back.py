"""Predictive test of a refined flow on observations that were held back, against the flow in use before it.

The observations are cut into blocks that are contiguous along the robot's way, because the errors of neighbours
correlate. Under a linear-Gaussian model of the observations, y ~ N(0, C), the density of a block given all others
follows from the inverse of C without another fit (leave-block-out; Rasmussen and Williams 2006, section 5.4.2):

    ln p(y_b | y_-b) = -1/2 a_b' P^-1 a_b + 1/2 ln det P - n/2 ln 2 pi,   P = (C^-1)_bb,   a = C^-1 y

C holds the effects at the sizes that were found with all observations, and the linearisation, the outliers, a line and
the registration are likewise those of the whole fit: few numbers, which a block alone hardly moves, but the score is a
little better than that of a fit without the block. It is that of the likeliest hypothesis, the map a mean over several.

Under the flow in use, C holds the same effects of robot, registration, pump and noise with the same sizes, and none of
the flow: these are learned from the other blocks as well, but the flow stays as it is. A flow that was refined before
is scored on observations that were made after it, because it has seen the others.

What is in all observations alike, such as the motion of a robot whose coils have no log, no block can tell from a flow.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from flowrec.core import Floats, FlowField, seconds
from flowrec.physics import on_chip
from flowrec.stages.refine.hypothesis import HypothesisFit
from flowrec.stages.refine.noise import averages, groups
from flowrec.stages.refine.observation_operator import ObservationOperator

Indices = NDArray[np.intp]

BLOCKS = 8  # of which the scatter of the differences is known to a quarter
FEWEST = 8  # observations, in blocks of at least
LEAST = 2  # observations each
DEVIATIONS = 2.0  # standard errors by which a map has to be worse to be refused


@dataclass(frozen=True, slots=True, eq=False)
class Scores:
    """Ln density per observation of each block (blocks,), under a new flow and under the one before it."""

    new: Floats
    before: Floats

    def on(self, field: FlowField) -> FlowField:
        """The field with these scores."""
        change = self.new - self.before
        error = float(change.std(ddof=1)) / float(np.sqrt(len(change)))
        means = float(self.new.mean()), float(self.before.mean())
        return replace(field, log_score=means[0], log_score_before=means[1], log_score_error=error)


def worse(field: FlowField) -> bool:
    """True if a field predicts what was held back worse than the one before, by more than chance."""
    if field.log_score is None or field.log_score_before is None or field.log_score_error is None:
        return False
    return field.log_score - field.log_score_before < -DEVIATIONS * field.log_score_error


def blocks(which: Indices) -> list[Indices]:
    """Indices of observations in order of time, in contiguous blocks; none for too few observations."""
    if len(which) < FEWEST:
        return []
    return np.array_split(which, min(BLOCKS, len(which) // LEAST))


def block_scores(covariance: Floats, y: Floats, held: list[Indices]) -> Floats:
    """(blocks,) ln density per observation of each block given all others; y (2 n,) has x and y of each in turn."""
    inverse = np.linalg.inv(covariance)
    solved = inverse @ y
    scores = []
    for block in held:
        rows = pairs(block)
        precision = inverse[np.ix_(rows, rows)]
        misfit = float(solved[rows] @ np.linalg.solve(precision, solved[rows]))
        ln_det = float(np.linalg.slogdet(precision)[1])
        scores.append((-0.5 * misfit + 0.5 * ln_det - 0.5 * len(rows) * np.log(2.0 * np.pi)) / len(block))
    return np.array(scores)


def scores_of(best: HypothesisFit, assumed: FlowField, before: FlowField | None) -> Scores | None:
    """Scores of the likeliest hypothesis, and of the flow before it; None for too few observations.

    `before` is the refined flow in use; None: it is the assumed one.
    """
    operator, group = best.observed.stated, groups(best.observed.stated)
    which = np.arange(int(group[-1]) + 1)
    if before is not None:
        which = which[np.bincount(group, ~made_after(operator, before)) == 0]
    held = blocks(which)
    if not held:
        return None
    left = operator.flow_um_s - predicted_in(operator, assumed if before is None else before)
    null = replace(best.in_assumed_flow(), y=averages(best.robust, operator) @ left.ravel())
    ln_size = {effect.name: mode for effect, mode in zip(best.effects, best.sizes.mode, strict=True)}
    covariance = null.covariance(np.array([ln_size[effect.name] for effect in null.effects]))
    rows = pairs(which)
    return Scores(
        block_scores(best.evidence.covariance(best.sizes.mode), best.evidence.y, held),
        block_scores(covariance[np.ix_(rows, rows)], null.y[rows], blocks(np.arange(len(which)))),
    )


def pairs(which: Indices) -> Indices:
    """(2 n,) indices of x and y of observations (n,), in turn."""
    return np.stack([2 * which, 2 * which + 1], axis=1).ravel()


def made_after(operator: ObservationOperator, field: FlowField) -> NDArray[np.bool_]:
    """(n,) which observations were made after a field was adopted; none where their times are not stated."""
    if operator.time_s is None:
        return np.zeros(operator.count, bool)
    return np.asarray(operator.time_s > seconds(field.stamp_ns))


def predicted_in(operator: ObservationOperator, field: FlowField) -> Floats:
    """(n, 2) what a field predicts, where its registration has the observations."""
    if field.registration is not None:
        points = on_chip(field.registration, operator.points * field.um_per_px) / field.um_per_px
        inside = np.array(field.velocity_um_s.shape[1::-1]) - 1.0
        operator = replace(operator, points=np.clip(points, 0.0, inside))
        operator = operator if field.wall_px is None else operator.with_walls(field.wall_px)
    return operator.predict(field.velocity_um_s.reshape(-1, 2))
