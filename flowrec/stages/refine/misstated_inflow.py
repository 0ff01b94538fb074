"""An inflow that is stated far from what it is: a pump set in another unit, a default left, inlet and outlet exchanged.

The prior of an inlet's speed is a Gaussian a quarter of it wide (prior.py). Under it observations of a flow ten times
as fast are outliers, and what is left of them is explained by whatever else is free. That all boundary values are off
by a power of two, in this or the other direction, is a hypothesis of its own, of small probability; between two powers
the Gaussian reaches.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress

import numpy as np

from flowrec.core import Bools, Floats, FlowError
from flowrec.physics import Chip
from flowrec.stages.refine.causes import Observed
from flowrec.stages.refine.hypothesis import first_evidence
from flowrec.stages.refine.noise import outlying, robust_noise

REACHED = (-0.25, 2.0)  # ratios to the stated inflow that the Gaussian reaches: five standard deviations down, four up
OTHER_UNIT = 100.0  # ratio from which on it is not the pump that is wrong, but the unit of the observations
SHARE = 5e-4  # prior probability of that: one observation, which may be wrong, gains up to 7.1 nats, two gain 14
_SLOW = 0.1  # of the fastest predicted flow


def at_observed_inflow(chip: Chip, observe: Callable[[Chip], Observed]) -> tuple[Chip, Observed]:
    """The chip with other boundary values, all by one factor, where the observations ask for it; else as it is.

    With them the observations in its flow, as `observe` gives them.
    """
    stated = observe(chip)
    ratios, _ = ratios_along(stated.operator.flow_um_s, stated.operator.predict(stated.model.base))
    ratio = float(np.median(ratios)) if len(ratios) else 1.0
    if REACHED[0] < ratio < REACHED[1] or abs(ratio) > OTHER_UNIT:
        return chip, stated
    other = chip.with_boundary(np.copysign(2.0 ** np.round(np.log2(abs(ratio))), ratio) * chip.boundary_values)
    with suppress(FlowError):  # a flow so fast that it can not be computed
        observed = observe(other)
        if _evidence(observed) - _evidence(stated) > -np.log(SHARE):
            return other, observed
    return chip, stated


def ratios_along(flow_um_s: Floats, predicted_um_s: Floats) -> tuple[Floats, Bools]:
    """Ratios (k,) of flows (n, 2) to predicted ones (n, 2), along these, and (n,) where: slow places say little."""
    square = (predicted_um_s**2).sum(axis=1)
    moves = square > _SLOW**2 * square.max(initial=0.0)
    return (flow_um_s * predicted_um_s).sum(axis=1)[moves] / square[moves], moves


def _evidence(observed: Observed) -> float:
    robust = robust_noise(observed)
    return first_evidence(observed, robust) - outlying(robust)
