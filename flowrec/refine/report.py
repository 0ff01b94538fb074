"""What an assimilation says of itself, for people: what it used, what it could not see, what it doubts."""

from __future__ import annotations

import numpy as np

from flowrec.chip.chip import Chip
from flowrec.refine.mixture_regression import Fit
from flowrec.refine.observation_operator import Floats, Sight
from flowrec.refine.prior import Prior

UNSEEN = 0.9  # share of the prior std above which an opening counts as not seen
WEAK = 0.6  # share above which it is asked whether it is seen together with others
SEEN_TOGETHER = 0.4  # share below which they are seen together
FAR = 3.0  # prior standard deviations from what was assumed
DISTRUSTED = 0.5  # probability of being right below which an observation counts as an outlier
ALIKE = 3.0  # observations in a row that say the same wrong thing
NOISIER = 1.3  # times the stated noise


def statement(chip: Chip, sight: Sight, found: Fit, prior: Prior, walls: str) -> str:
    """One line; `walls` says what is wrong with the mask, if anything."""
    used = sight.count - int((found.trust < DISTRUSTED).sum())
    parts = [f"assimilated {used} observations" if used != 1 else "assimilated 1 observation"]
    if sight.count > used:
        parts.append(f"{sight.count - used} more distrusted as outliers")
    if sight.ignored:
        parts.append(f"ignored {sight.ignored}")
    if walls:
        parts.append(f"the mask seems wrong: {walls}")
    if found.noise_factor > NOISIER:
        parts.append(f"they scatter {found.noise_factor:.1f} times more than their std says, error bars widened")
    if found.copies > ALIKE:
        parts.append("neighbours miss alike: something here is not in the model")
    far = [
        f"{_name(chip, index)} ({abs(found.mean[index]):.0f} prior std off)"
        for index in range(len(chip.openings))
        if abs(found.mean[index]) > FAR
    ]
    if far:
        parts.append(f"far from what was assumed: {', '.join(far)}")
    unseen = _unseen(chip, found, prior)
    if unseen:
        parts.append(unseen)
    return "; ".join(parts)


def _unseen(chip: Chip, found: Fit, prior: Prior) -> str:
    """Which openings the observations did not determine, alone or only together."""
    parts, hidden = [], []
    for kind, what in (("inlet", "flow"), ("outlet", "pressure")):
        those = [index for index, opening in enumerate(chip.openings) if opening.kind == kind]
        if not those:
            continue
        count = len(those)
        width = np.diag(prior.spread)[those]  # um/s or Pa per prior std
        if kind == "inlet":
            see = np.diag(width * [chip.openings[index].width_px for index in those])  # what flows in
        else:
            # Only differences move anything: each pressure beside the mean of all.
            see = np.diag(width) @ (np.eye(count) - 1.0 / count)
        covariance = found.covariance[np.ix_(those, those)]
        ratio = _ratio(see, covariance)
        weak = np.flatnonzero(ratio > WEAK)
        together = see[:, weak].sum(axis=1, keepdims=True)
        if 1 < len(weak) < count + (kind == "inlet") and _ratio(together, covariance)[0] < SEEN_TOGETHER:
            parts.append(f"of {_and(chip, [those[index] for index in weak])} they see only the {what} together")
            weak = weak[:0]
        hidden += [those[index] for index in weak if ratio[index] > UNSEEN]
    if hidden:
        parts.append(f"they say nothing about {', '.join(_name(chip, index) for index in sorted(hidden))}")
    return "; ".join(parts)


def _ratio(directions: Floats, covariance: Floats) -> Floats:
    """Posterior over prior std along each column; 0 where there is nothing to see."""
    before = (directions**2).sum(axis=0)
    after = np.einsum("ik,ij,jk->k", directions, covariance, directions)
    return np.asarray(np.sqrt(np.divide(after, before, out=np.zeros_like(after), where=before > 1e-12 * before.max())))


def _name(chip: Chip, index: int) -> str:
    return f"{chip.openings[index].kind} {index} ({chip.openings[index].side})"


def _and(chip: Chip, those: list[int]) -> str:
    names = [_name(chip, index) for index in those]
    return f"{', '.join(names[:-1])} and {names[-1]}"
