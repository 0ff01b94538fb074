"""What an assimilation says of itself, for people."""

from __future__ import annotations

import numpy as np

from flowrec.chip.chip import Chip
from flowrec.refine.prior import Prior
from flowrec.refine.robust import Fit
from flowrec.refine.sight import Sight

UNSEEN = 0.9


def statement(chip: Chip, sight: Sight, found: Fit, prior: Prior, walls: str) -> str:
    alone = sum(opening.kind == "outlet" for opening in chip.openings) == 1
    std = np.sqrt(np.diag(found.covariance))
    unseen = [
        f"{opening.kind} {index} ({opening.side})"
        for index, opening in enumerate(chip.openings)
        if std[index] > UNSEEN and not (alone and opening.kind == "outlet")
    ]
    text = f"assimilated {sight.count} observations"
    if walls:
        text = f"{text}; the mask seems wrong: {walls}"
    return f"{text}; they say nothing about {', '.join(unseen)}" if unseen else text
