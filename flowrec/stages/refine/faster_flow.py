"""A flow many times as fast as the assumed one: a pump in another unit, an inlet speed left at its default.

The prior of an inlet's speed is a Gaussian a quarter of it wide (prior.py). Under it observations of a flow ten times
as fast are outliers, and what is left of them is explained by whatever else is free. That the assumed speeds are wrong
by a power of two is a hypothesis of its own, of small probability; between two powers the Gaussian reaches.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from flowrec.physics import Chip
from flowrec.stages.refine.causes import Observed
from flowrec.stages.refine.hypothesis import first_evidence
from flowrec.stages.refine.noise import outlying, robust_noise

FAST = (2.0, 100.0)  # times the assumed flow: from four standard deviations of an inlet's speed to another unit
FASTER_SHARE = 1e-4  # prior probability of that: one observation, which may be wrong, gains 7 nats, two gain 14
_SLOW = 0.1  # of the fastest predicted flow: slower places say little of the ratio


def at_observed_speed(chip: Chip, observe: Callable[[Chip], Observed]) -> tuple[Chip, Observed]:
    """The chip with all boundary values times a power of two where the observations ask for it, else as it is.

    With them the observations in its flow, as `observe` gives them.
    """
    stated = observe(chip)
    times = _times(stated)
    if not FAST[0] < times < FAST[1]:
        return chip, stated
    faster = chip.with_boundary(2.0 ** np.round(np.log2(times)) * chip.boundary_values)
    observed = observe(faster)
    return (faster, observed) if _evidence(observed) - _evidence(stated) > -np.log(FASTER_SHARE) else (chip, stated)


def _times(observed: Observed) -> float:
    """Median ratio of what was observed to the assumed flow, along that."""
    predicted = observed.operator.predict(observed.model.base)
    square = (predicted**2).sum(axis=1)
    moves = square > _SLOW**2 * square.max()
    along = (observed.operator.flow_um_s * predicted).sum(axis=1)
    return float(np.median(along[moves] / square[moves])) if moves.any() else 0.0


def _evidence(observed: Observed) -> float:
    robust = robust_noise(observed)
    return first_evidence(observed, robust) - outlying(robust)
