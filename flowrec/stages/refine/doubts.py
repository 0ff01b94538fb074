"""Places where a channel may be partly blocked, for the planner of the next survey stretch.

Each candidate is a deposit that fills half of a channel from one wall, at one place. The change q' that it makes in the
flow is taken to first order in its friction, up to the flow that it stops (obstacles.py); its probability follows from
the observations so far. The candidates exclude each other.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import scipy  # its linalg loads at first use, not at start-up
from numpy.typing import NDArray

from flowrec.physics import Doubts, FlowSolver, chip_key, compute_cached
from flowrec.stages.refine.causes import Observed
from flowrec.stages.refine.flow_model import FlowModel
from flowrec.stages.refine.noise import Robust
from flowrec.stages.refine.obstacles import BATCH, BLOCKED, DEPOSIT, Likelihood, pieces_of, saturating_modes

HEIGHT = 1.0  # of a deposit, in half widths
PARTS = (0.4, 0.7, 1.0)  # of the change by such a deposit: smaller and larger ones
KEPT = 40  # candidates: by then the squared error that they may cause is 95 % of that of all of them, or hardly any
LARGEST_PX = 30_000  # fluid pixels of a chip for which they are computed

Changes = NDArray[np.float32]


def doubted_places(observed: Observed, robust: Robust, solver: FlowSolver, blocked_share: float) -> Doubts:
    """The candidates that may make the largest error, and what each does to the flow.

    `blocked_share` is the probability, before any observation, that some channel is partly blocked.
    """
    model = observed.model
    none = Doubts.none(len(model.base))
    if model.chip.law is not None or len(model.base) > LARGEST_PX or not observed.operator.count:
        return none
    changes = deposits_um_s(model, solver)
    if not len(changes):
        return none
    likelihood = Likelihood.of(observed, robust)
    at = observed.operator.predict(changes)
    gains = likelihood.gains(at, np.tile(PARTS, (len(at), 1)), shape=True)
    best = np.array(PARTS)[gains.argmax(axis=1)]
    ln_weight = np.log(blocked_share / len(at)) + scipy.special.logsumexp(gains, axis=1) - np.log(len(PARTS))
    ln_free = float(np.log1p(-blocked_share))
    probability = np.exp(ln_weight - scipy.special.logsumexp([*ln_weight, ln_free]))
    square = np.einsum("knc,knc->k", changes, changes) * best**2
    kept = np.argsort(-probability * square, kind="stable")[:KEPT]
    return Doubts(changes[kept] * best[kept, None, None], probability[kept])


def deposits_um_s(model: FlowModel, solver: FlowSolver) -> Changes:
    """(k, n, 2) um/s what a deposit on either wall of each piece of the channels does, from the cache if possible."""
    chip, expansion = model.chip, model.expansion

    def compute() -> Changes:
        deposits = [
            replace(piece, side=side, height=HEIGHT, reach=DEPOSIT, ratio=2.0)
            for piece in pieces_of(chip, expansion.base)
            for side in (-1, 1)
        ]
        found = np.empty((len(deposits), len(model.base), 2), np.float32)
        for first in range(0, len(deposits), BATCH):
            batch = deposits[first : first + BATCH]
            modes, back = saturating_modes(batch, chip, expansion)
            change = (BLOCKED - 1.0) / (1.0 + back * (BLOCKED - 1.0))
            found[first : first + len(batch)] = change[:, None, None] * modes
        return found

    changes: Changes = compute_cached(("doubts", solver, chip_key(chip)), compute)
    return changes
