"""`gain`, the null model: the whole assumed field times the one factor that explains the observations best.

The observations are c v_i + e_i, where v_i is the assumed flow there and e_i has the variance sigma_i^2 + (s |v_i|)^2
per component: the stated noise, and a spread s of the flow around c v in proportion to the speed. c is the least
squares solution, s the value at which the mean of chi squared is that of noise. Any method that states more about a
flow than one number has to be better than this one, in its errors and in its error bars.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from flowrec.core import Floats, FlowField
from flowrec.stages.refine.held_back import Scores, blocks, made_after, predicted_in
from flowrec.stages.refine.method import RefinementProblem

_FACTOR_STD = 1.0  # prior of the factor around 1: far wider than what any observation leaves
_AT_REST = 0.05  # of the root mean square speed that was predicted: slower places say nothing of the spread
_BISECTIONS = 40  # of ln s between 1e-4 and 1e4: to 1e-11 of their ratio


@dataclass(frozen=True, slots=True)
class Gain:
    """Has no options."""

    def fit(self, problem: RefinementProblem) -> FlowField:
        """The scaled field; its standard deviation is that of the factor and the spread of the observations."""
        operator, assumed = problem.operator, problem.assumed
        predicted = operator.predict(assumed.velocity_um_s.reshape(-1, 2))
        variance = operator.std_um_s**2 + 1e-12 * max(float((predicted**2).max()), 1e-12)
        spread = _spread(predicted, operator.flow_um_s, variance)
        factor, factor_std = _factor(predicted, operator.flow_um_s, variance, spread)
        speed = np.linalg.norm(assumed.velocity_um_s, axis=-1, keepdims=True)
        std = np.hypot(factor_std * assumed.velocity_um_s, spread * speed)
        scores = _scores(problem, predicted, variance, spread) if problem.hold_back else None
        power = float((assumed.velocity_um_s.astype(np.float64) ** 2).sum())
        field = replace(
            assumed,
            method="gain",
            velocity_um_s=(factor * assumed.velocity_um_s).astype(np.float32),
            pressure_pa=(factor * assumed.pressure_pa).astype(np.float32),
            std_um_s=std.astype(np.float32),
            boundary_values=factor * assumed.boundary_values,
            note=f"the assumed flow times {factor:.3f} +- {factor_std:.3f}; the observations scatter around it by "
            f"{100.0 * spread / max(abs(factor), 1e-9):.0f} % of the speed",
            error_share=float(np.sqrt((std.astype(np.float64) ** 2).sum() / max(factor**2 * power, 1e-300))),
            parameter_names="flow_factor",
            parameters=np.array([factor]),
            parameter_std=np.array([factor_std]),
        )
        return field if scores is None else scores.on(field)


def _scores(problem: RefinementProblem, predicted: Floats, variance: Floats, spread: float) -> Scores | None:
    """Scores of the factor by the other observations, and of the flow before with a spread of its own around it."""
    operator = problem.operator
    which, there = np.arange(operator.count), predicted
    if problem.before is not None:
        which, there = which[made_after(operator, problem.before)], predicted_in(operator, problem.before)
    held = blocks(which)
    if not held:
        return None
    measured = operator.flow_um_s
    before = _spread(there[which], measured[which], variance[which], 1.0)
    new, old = [], []
    for block in held:
        rest = np.setdiff1d(np.arange(operator.count), block)
        factor = _factor(predicted[rest], measured[rest], variance[rest], spread)
        new.append(_block_score(predicted[block], measured[block], variance[block], spread, *factor))
        old.append(_block_score(there[block], measured[block], variance[block], before, 1.0, 0.0))
    return Scores(np.array(new), np.array(old))


def _block_score(
    predicted: Floats, measured: Floats, variance: Floats, spread: float, factor: float, factor_std: float
) -> float:
    """Ln density per observation of flows (n, 2), with noise of variance (n,), a spread and a factor that all share."""
    noise = np.repeat(variance + spread**2 * (predicted**2).sum(axis=1), 2)
    own = predicted.ravel()
    left, shared = measured.ravel() - factor * own, factor_std * own
    inner = 1.0 + float((shared**2 / noise).sum())
    misfit = float((left**2 / noise).sum()) - float((shared * left / noise).sum()) ** 2 / inner
    return -0.5 * (misfit + float(np.log(2.0 * np.pi * noise).sum()) + float(np.log(inner))) / len(measured)


def _factor(predicted: Floats, measured: Floats, variance: Floats, spread: float) -> tuple[float, float]:
    """Least squares factor and its standard deviation, of flows (n, 2) with noise of variance (n,) and a spread.

    The weights are those of the noise alone: with the spread in them, places that are nearly at rest would decide.
    """
    square = (predicted**2).sum(axis=1)
    weight = 1.0 / variance
    precision = float((weight * square).sum()) + 1.0 / _FACTOR_STD**2
    factor = (float((weight * (predicted * measured).sum(axis=1)).sum()) + 1.0 / _FACTOR_STD**2) / precision
    scatter = float((weight**2 * square * (variance + spread**2 * square)).sum()) + 1.0 / _FACTOR_STD**2
    return factor, float(np.sqrt(scatter)) / precision


def _spread(predicted: Floats, measured: Floats, variance: Floats, known: float | None = None) -> float:
    """The spread (of the speed, per component) at which chi squared is its number of degrees of freedom; 0 or more.

    It is that around a factor that is `known`, or else around the one that fits best.
    """
    square = (predicted**2).sum(axis=1)
    # Beside or beyond a wall no spread in proportion to the speed explains what was observed.
    flows = square >= _AT_REST**2 * square.mean()
    freedom = 2.0 * np.count_nonzero(flows) - (1.0 if known is None else 0.0)

    def excess(spread: float) -> float:
        factor = _factor(predicted, measured, variance, spread)[0] if known is None else known
        left = ((measured - factor * predicted) ** 2).sum(axis=1)
        return float((left / (variance + spread**2 * square))[flows].sum()) - freedom

    low, high = np.log(1e-4), np.log(1e4)
    if excess(0.0) <= 0.0:
        return 0.0
    for _ in range(_BISECTIONS):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if excess(float(np.exp(middle))) > 0.0 else (low, middle)
    return float(np.exp(0.5 * (low + high)))
