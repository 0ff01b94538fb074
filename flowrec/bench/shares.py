"""What a few dozen runs allow to say: intervals of shares, and of ratios measured in pairs."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import binomtest, wilcoxon

_Z = 1.959963984540054  # of a two-sided 95 %
_DRAWS = 10_000


def wilson(successes: int, count: int) -> tuple[float, float]:
    """The 95 % score interval of a share (Wilson, 1927); 0 to 1 where nothing was counted."""
    if count == 0:
        return 0.0, 1.0
    share, zz = successes / count, _Z * _Z
    middle = (share + zz / (2 * count)) / (1 + zz / count)
    half = _Z * math.sqrt(share * (1 - share) / count + zz / (4 * count * count)) / (1 + zz / count)
    # The ends are exact where all or none succeeded; rounding must not carry them outside.
    return (0.0 if successes == 0 else middle - half), (1.0 if successes == count else middle + half)


def paired(ratios: NDArray[np.float64]) -> dict[str, Any]:
    """Geometric mean of paired ratios (n,) with its bootstrap 95 % interval, and tests of its being 1.

    The sign test and Wilcoxon's signed ranks are two-sided; ties (ratio 1) count for neither side.
    """
    if len(ratios) == 0:
        return {"count": 0}
    logs = np.log(ratios)
    rng = np.random.default_rng(0)
    means = rng.choice(logs, (_DRAWS, len(logs))).mean(axis=1)
    less, more = int((logs < 0).sum()), int((logs > 0).sum())
    return {
        "count": len(ratios),
        "mean": float(np.exp(logs.mean())),
        "interval_95": tuple(float(np.exp(end)) for end in np.percentile(means, (2.5, 97.5))),
        "less": less,
        "more": more,
        "sign_p": float(binomtest(less, less + more).pvalue) if less + more else 1.0,
        "wilcoxon_p": float(wilcoxon(logs).pvalue) if less + more else 1.0,
    }
