"""Human-readable summary of an assimilation: observations used, unobservable openings, warnings."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from flowrec.core import Floats
from flowrec.physics import Chip
from flowrec.stages.refine.hypothesis import HypothesisFit
from flowrec.stages.refine.misstated_inflow import REACHED
from flowrec.stages.refine.noise import NOISE, NOISIER
from flowrec.stages.refine.observation_operator import ObservationOperator
from flowrec.stages.refine.prior import Prior

UNOBSERVED = 0.9  # posterior over prior std above which an opening counts as not observed
WEAK = 0.6  # ratio above which it is tested whether openings are observed together
OBSERVED_TOGETHER = 0.4  # ratio of their sum below which they are
UNLIKELY = 3.0  # prior standard deviations from the assumed value
OUTLIER = 0.5  # inlier probability below which an observation counts as an outlier
LEAST_GAIN = 1.0  # in ln evidence over the assumed flow


def report(chip: Chip, operator: ObservationOperator, best: HypothesisFit, causes: Sequence[str], moved: float) -> str:
    """One line on the most probable hypothesis.

    `causes` are what it found besides the boundary values, in words; `moved` is the distance of the map from the
    assumed flow over the map's stated error.
    """
    used = operator.count - int((best.robust.inlier < OUTLIER).sum())
    parts = [f"assimilated {used} observations" if used != 1 else "assimilated 1 observation"]
    if operator.count > used:
        parts.append(f"{operator.count - used} more distrusted as outliers")
    if operator.ignored:
        parts.append(f"ignored {operator.ignored}")
    parts += causes
    noisier = best.robust.factor * best.size(NOISE[0])
    if noisier > NOISIER:
        parts.append(f"they scatter {noisier:.1f} times more than their std says, error bars widened")
    mean, covariance = best.unknowns("boundary")
    times = _times(chip, best)
    if times > REACHED[1]:
        parts.append(f"the flow is {times:.1f} times the assumed one: check the inlet speed and its unit")
    elif times < 0.0:
        parts.append(
            f"the flow is {-times:.1f} times the assumed one in the other direction: exchange inlet and outlet"
        )
    far = [
        f"{_name(chip, index)} ({abs(mean[index]):.0f} prior std {'higher' if mean[index] > 0.0 else 'lower'})"
        for index in range(len(chip.openings))
        if abs(mean[index]) > UNLIKELY
    ]
    if far:
        parts.append(f"far from what was assumed: {', '.join(far)}")
    if moved < 1.0 and best.gain() < LEAST_GAIN:
        parts.append("they do not ask for another flow than the assumed one")
    return "; ".join([*parts, *_unobserved_openings(chip, covariance, best.observed.model.prior)])


def _times(chip: Chip, best: HypothesisFit) -> float:
    """The boundary values that were found over those of a chip, where all are off by one factor; else 1."""
    own = best.observed.model
    largest = int(np.abs(chip.boundary_values).argmax())
    if own.chip.boundary_values[largest] == chip.boundary_values[largest]:
        return 1.0
    fitted = own.prior.chip(own.chip, best.posterior.mean).boundary_values
    return float(fitted[largest] / chip.boundary_values[largest])


def over_error(change: NDArray[np.floating], std: NDArray[np.floating]) -> float:
    """The size of a change of a field over that of its standard deviation, of the same shape."""
    return float(np.linalg.norm(change)) / max(float(np.linalg.norm(std)), 1e-12)


def _unobserved_openings(chip: Chip, posterior: Floats, prior: Prior) -> list[str]:
    """Sentences on openings that the observations did not determine, alone or only together."""
    parts, hidden = [], []
    for kind, quantity in (("inlet", "flow"), ("outlet", "pressure")):
        group = [index for index, opening in enumerate(chip.openings) if opening.kind == kind]
        if not group:
            continue
        count = len(group)
        std = np.diag(prior.effect)[group]  # um/s or Pa per prior std
        if kind == "inlet":
            directions = np.diag(std * [chip.openings[index].width_px for index in group])  # the inflow of each
        else:
            # Only pressure differences drive a flow: each pressure relative to the mean of all.
            directions = np.diag(std) @ (np.eye(count) - 1.0 / count)
        covariance = posterior[np.ix_(group, group)]
        ratio = _std_ratio(directions, covariance)
        weak = np.flatnonzero(ratio > WEAK)
        together = directions[:, weak].sum(axis=1, keepdims=True)
        if 1 < len(weak) < count + (kind == "inlet") and _std_ratio(together, covariance)[0] < OBSERVED_TOGETHER:
            names = [_name(chip, group[index]) for index in weak]
            parts.append(f"of {', '.join(names[:-1])} and {names[-1]} they see only the {quantity} together")
            weak = weak[:0]
        hidden += [group[index] for index in weak if ratio[index] > UNOBSERVED]
    if hidden:
        parts.append(f"they say nothing about {', '.join(_name(chip, index) for index in sorted(hidden))}")
    return parts


def _std_ratio(directions: Floats, covariance: Floats) -> Floats:
    """Posterior over prior std along each column; 0 where the prior std is 0."""
    before = (directions**2).sum(axis=0)
    after = np.einsum("ik,ij,jk->k", directions, covariance, directions)
    return np.asarray(np.sqrt(np.divide(after, before, out=np.zeros_like(after), where=before > 1e-12 * before.max())))


def _name(chip: Chip, index: int) -> str:
    return f"{chip.openings[index].kind} {index} ({chip.openings[index].side})"
