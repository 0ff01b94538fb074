"""A wrong mask: all walls lie the same distance inside or outside those that a chip was drawn with.

A threshold that is too high or too low gives such a mask. To first order the flow changes by the offset times a mode,
the difference of the flows in walls half a pixel outside and inside, at the same flow rates. In a channel of five
pixels the first order holds over half a pixel, so offsets are compared first, and the assimilation repeats in walls
near those that it found.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace

import numpy as np

from flowrec.core import Floats, FlowError
from flowrec.physics import Chip, FlowSolver, chip_key, compute_cached, with_wall_offset
from flowrec.stages.refine.causes import WALL_BIAS, WALL_BIAS_NAME, Observed
from flowrec.stages.refine.evidence import gains_of_trials
from flowrec.stages.refine.hypothesis import State, Steps, begin, doubtful, first_evidence
from flowrec.stages.refine.noise import Robust, averages, outlying, robust_noise

STEP_PX = 0.5  # of the offsets at which flows are computed: the walls of pixels can lie at multiples of it
OFFSETS_PX = (-1.0, -0.5, 0.0, 0.5, 1.0)  # that are compared at first
MOST_PX = 2.0  # offset that is tried
WORTH_TRYING = 0.5  # gain in ln evidence to first order


def wall_mode(chip: Chip, solver: FlowSolver) -> Floats:
    """(n, 2) um/s per px by which all walls lie outside those of the chip, on its own fluid pixels.

    0 where neither narrower nor wider walls carry a flow.
    """

    def compute() -> Floats:
        flows = {0.0: solver.solve(chip).velocity_um_s}
        for offset in (-STEP_PX, STEP_PX):
            with suppress(FlowError):
                flows[offset] = solver.solve(with_wall_offset(chip, offset)).velocity_um_s
        low, high = min(flows), max(flows)
        return np.asarray((flows[high] - flows[low])[chip.mask] / max(high - low, STEP_PX), np.float64)

    mode: Floats = compute_cached(("wall mode", solver, chip_key(chip)), compute)
    return mode


def coarser(solver: FlowSolver) -> FlowSolver:
    """The solver whose grid is that of the pixels, by which chips are compared at first."""
    return replace(solver, k=1)


def nearest_offset(found_px: float) -> float:
    """The offset nearest to one that was found, of those at which flows are computed."""
    return float(np.clip(STEP_PX * np.round(found_px / STEP_PX), -MOST_PX, MOST_PX))


def gain_by_bias(state: State, robust: Robust, wall_mode: Floats) -> float:
    """Gain in ln evidence, to first order, by walls that are all off by the same distance; `wall_mode` (n, 2)."""
    here, evidence = state.observed.operator, state.evidence
    column = averages(robust, here) @ here.predict(wall_mode).ravel()
    covariance = evidence.covariance(state.sizes.mode)
    trials = [WALL_BIAS[0] * factor for factor in (0.5, 1.0, 2.0)]
    gains = gains_of_trials(column[None, None], covariance, evidence.y, trials)
    return float(gains[0] - np.log(len(trials)))


def wall_bias_px(state: State) -> float:
    """The most probable distance by which all walls lie outside the drawn ones."""
    effects = state.evidence.effects
    first = sum(len(effect.columns) for effect in effects[: [effect.name for effect in effects].index(WALL_BIAS_NAME)])
    return float(state.evidence.most_probable(state.sizes)[first])


def _with_fewer_outliers(usual: Robust, observed: Observed) -> Robust:
    """Noise in other walls: what was an outlier may be explained there, but what was none does not become one."""
    noise = robust_noise(observed)
    return noise if noise.inlier.sum() >= usual.inlier.sum() else usual


def in_biased_walls(
    chip: Chip,
    solver: FlowSolver,
    usual: State,
    robust: Robust,
    observe: Callable[..., Observed],
    steps: Steps,
) -> tuple[Robust, State] | None:
    """The state of a chip whose walls are all off by the same distance, around that distance; None: nothing asks.

    `usual` and `robust` are those of walls that are off by chance only; `observe(chip=, solver=)` gives the
    observations in other walls.
    """
    doubted = doubtful(usual.evidence, usual.sizes)
    if not doubted and gain_by_bias(usual, robust, wall_mode(chip, solver)) < WORTH_TRYING:
        return None
    coarse, seen = coarser(solver), {}
    for offset_px in OFFSETS_PX:
        with suppress(FlowError):  # channels that are closed
            observed = observe(with_wall_offset(chip, offset_px), solver=coarse)
            noise = _with_fewer_outliers(robust, observed)
            seen[offset_px] = first_evidence(observed, noise) - outlying(noise)
    best: tuple[Robust, State] | None = None
    # Openings can be too narrow for the coarse grid in all of these walls.
    offset_px, tried = max(seen, key=seen.__getitem__, default=0.0), set[float]()
    while offset_px not in tried:
        tried.add(offset_px)
        try:
            moved = with_wall_offset(chip, offset_px)
            observed = observe(moved, solver=solver)
        except FlowError:
            break
        observed = replace(observed, wall_mode=wall_mode(moved, solver))
        noise = _with_fewer_outliers(robust, observed)
        state = begin(observed, noise, steps)
        if best and state.sizes.evidence - outlying(noise) <= best[1].sizes.evidence - outlying(best[0]):
            break
        best = noise, state
        offset_px = nearest_offset(wall_bias_px(state))
    return best
