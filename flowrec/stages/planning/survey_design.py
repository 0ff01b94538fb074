"""The expected value of observations along a way: how far they lower the error of a flow (linear and Gaussian).

The covariance of the unknowns after an observation does not depend on what is observed. So the gain of a way is known
before it is travelled: with the information H = sum of A^T A / variance of its observations, the covariance C becomes
(C^-1 + H)^-1, and the squared error of the flow where it is needed is the trace of C with a matrix. This is the
A-optimal design of Bayesian experiments (Chaloner and Verdinelli, 1995), weighted by the need.

What may be wrong in one place are hypotheses j with probabilities w_j and changes D_j of the flow, of which one is
true. The squared error that they add is the sum over pairs of w_j w_k |D_j - D_k|^2. The density of observations y is
at least twice the geometric mean of two of its parts. So where d_jk standard deviations part two hypotheses, y leaves

    E[w_j w_k | y] <= min(w_j w_k, sqrt(w_j w_k) exp(-d_jk^2 / 8) / 2)

(the bound of Bhattacharyya on the error of a decision; Kailath, 1967).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from flowrec.core import Floats, FlowField, Ints, Observations, Route, nearest_pixels
from flowrec.physics import Chip, FlowUncertainty, Robot


@dataclass(frozen=True, slots=True)
class Sampling:
    """The observations that a robot takes on its way.

    Attributes
    ----------
    spacing_um, interval_s : least distance and least time between two.
    noise_um_s : standard deviation of a component.
    rolling_share : the same in addition, as a ratio to the robot's own speed.
    """

    spacing_um: float
    interval_s: float
    noise_um_s: float
    rolling_share: float = 0.0


@dataclass(frozen=True, slots=True, eq=False)
class SurveyOrder:
    """Input of a survey method."""

    field: FlowField  # the best flow known
    start_um: Floats  # (2,) where the next stretch begins: the end of `present`, or the robot
    chip: Chip
    robot: Robot
    goal_um: Floats | None = None  # (2,) that must stay within reach; None: only for methods that do not ask for it
    uncertainty: FlowUncertainty | None = None  # of the flow after the observations so far; None: not known
    sampling: Sampling | None = None
    observations: Observations | None = None  # so far
    present: Route | None = None  # the way that the robot is still on; None: it waits at the start
    progress_s: float = 0.0  # time along `present`, of which the observations up to there have been made
    left_s: float = math.inf  # of the time limit, from the start of the next stretch on
    least_s: float = 0.0  # a stretch counts as if it took so long, because the next one has to be found meanwhile


@dataclass(frozen=True, slots=True, eq=False)
class Need:
    """A squared relative error of the flow as a function of the covariance of its unknowns."""

    matrix: Floats  # (q, q), of which the trace with the covariance is the error that observations can remove
    rest: float  # what no unknown explains
    apart: Floats  # (k + 1, k + 1) squared difference of the flow between doubts; the last is that nothing is wrong
    pairs: Floats  # (k + 1, k + 1) half of the product of their probabilities

    @classmethod
    def of(cls, uncertainty: FlowUncertainty, *weights: tuple[float, Floats]) -> Need:
        """The sum of shares of relative errors, each with its weights (n,) of the fluid pixels."""
        columns, unknowns = uncertainty.columns_um_s, len(uncertainty.covariance)
        matrix, rest = np.zeros((unknowns, unknowns)), 0.0
        doubts = uncertainty.doubts
        gram = np.zeros((len(doubts.probability) + 1,) * 2)
        for share, weight in weights:
            size = share / max(float((weight * (uncertainty.mean_um_s**2).sum(axis=1)).sum()), 1e-300)
            flat = (columns * np.sqrt(size * weight)[:, None]).reshape(len(columns), -1)
            matrix[: len(columns), : len(columns)] += flat @ flat.T
            rest += size * float((2.0 * weight * uncertainty.error_um_s**2).sum())
            if len(gram) > 1:
                change = np.asarray(doubts.changes_um_s, np.float64) * np.sqrt(size * weight)[:, None]
                flat = change.reshape(len(gram) - 1, -1)
                gram[:-1, :-1] += flat @ flat.T
        probability = np.append(doubts.probability, max(1.0 - float(doubts.probability.sum()), 0.0))
        return cls(matrix, rest, _distances(gram), 0.5 * np.outer(probability, probability))

    def error(self, covariance: Floats, information: Floats | None = None) -> float:
        """The relative error that a covariance (q, q) states.

        With `information` (q + k, q + k), see `Looks.information`: after observations that have led to the covariance.
        """
        left = self.pairs
        if information is not None and len(left) > 1:
            known = len(covariance)
            across = information[:known, known:]
            gram = np.zeros_like(left)
            gram[:-1, :-1] = information[known:, known:] - across.T @ covariance @ across
            left = np.minimum(left, np.sqrt(left / 8.0) * np.exp(-_distances(gram) / 8.0))
        square = float((covariance * self.matrix).sum()) + float((left * self.apart).sum())
        return math.sqrt(max(square, 0.0) + self.rest)


def _distances(gram: Floats) -> Floats:
    """(k, k) squared distances of vectors whose inner products are (k, k)."""
    square = np.diag(gram)
    return np.maximum(square[:, None] + square - 2.0 * gram, 0.0)


@dataclass(frozen=True, slots=True, eq=False)
class Looks:
    """Observations as one design weighs them: noise of their own, and an error that neighbours share.

    What no unknown explains is the same for all looks at a patch, a square as wide as a channel. With b ~ N(0, e^2) of
    a patch and the weights w = 1 / variance of its looks, their information is

        sum w A^T A - (sum w A)^T (sum w A) / (1 / e^2 + sum w):

    to look again at the same place tells nothing more of the flow, but it tells of the robot's constants if the robot
    moves otherwise.
    """

    uncertainty: FlowUncertainty
    sampling: Sampling
    chip: Chip
    patch_px: float  # side of a patch
    share: float  # of the speed of the flow, one standard deviation of the error that looks at a patch share
    pixel: Ints  # (h, w) index of each fluid pixel among those of the uncertainty
    sums: Floats  # (patches, 2, q + k) sum of w A so far
    weights: Floats  # (patches,) sum of w so far

    @classmethod
    def none(cls, uncertainty: FlowUncertainty, sampling: Sampling, chip: Chip, patch_px: float, share: float) -> Looks:
        """No look so far."""
        patches = int(np.prod(np.ceil(np.array(chip.mask.shape) / patch_px)))
        unknowns = len(uncertainty.covariance) + len(uncertainty.doubts.probability)
        sums = np.zeros((patches, 2, unknowns))
        pixel = np.cumsum(chip.mask.ravel()).reshape(chip.mask.shape) - 1
        return cls(uncertainty, sampling, chip, patch_px, share, pixel, sums, np.zeros(patches))

    def after_places(self, places_um: Floats, own_um_s: Floats) -> Looks:
        """And one look each at places (m, 2), where the robot's own velocity was (m, 2)."""
        looks = self._looks(places_um, own_um_s, np.ones(len(places_um)))
        return self._after(*looks[:3])

    def after_way(self, waypoints_um: Floats, arrival_s: Floats) -> Looks:
        """And the looks on a way through points (m, 2) that are passed at times (m,)."""
        return self._after(*self._on_way(waypoints_um, arrival_s)[:3])

    def information(self, waypoints_um: Floats, arrival_s: Floats) -> Floats:
        """(q + k, q + k) what the looks on a way add, about the unknowns and then the doubts.

        Each part of the way has as many looks, also less than one, as its length and its duration allow.
        """
        which, weight, effect, error = self._on_way(waypoints_um, arrival_s)
        unknowns = effect.shape[2]
        scaled = (effect * np.sqrt(weight)[:, None, None]).reshape(-1, unknowns)
        patches, index = np.unique(which, return_inverse=True)
        in_patch = np.zeros((len(patches), len(index)))
        in_patch[index, np.arange(len(index))] = weight
        added_weights = in_patch.sum(axis=1)
        least = added_weights / np.maximum(in_patch @ error**2, 1e-300)
        before, weights = self.sums[patches].reshape(len(patches), 2 * unknowns), self.weights[patches]
        after = before + in_patch @ effect.reshape(len(index), 2 * unknowns)
        shared = [
            (sums / np.sqrt(least + total)[:, None]).reshape(-1, unknowns)
            for sums, total in ((after, weights + added_weights), (before, weights))
        ]
        return scaled.T @ scaled - shared[0].T @ shared[0] + shared[1].T @ shared[1]

    def _after(self, which: Ints, weight: Floats, effect: Floats) -> Looks:
        sums, weights = self.sums.copy(), self.weights.copy()
        np.add.at(sums, which, effect * weight[:, None, None])
        np.add.at(weights, which, weight)
        return replace(self, sums=sums, weights=weights)

    def _on_way(self, waypoints_um: Floats, arrival_s: Floats) -> tuple[Ints, Floats, Floats, Floats]:
        legs, duration = np.diff(waypoints_um, axis=0), np.maximum(np.diff(arrival_s), 1e-9)
        middle = 0.5 * (waypoints_um[1:] + waypoints_um[:-1])
        sampling = self.sampling
        length = np.hypot(legs[:, 0], legs[:, 1])
        count = np.minimum(length / sampling.spacing_um, duration / max(sampling.interval_s, 1e-9))
        return self._looks(middle, legs / duration[:, None], count, over_ground=True)

    def _looks(
        self, places_um: Floats, velocity_um_s: Floats, count: Floats, over_ground: bool = False
    ) -> tuple[Ints, Floats, Floats, Floats]:
        """Patch (m,), weight (m,), effect (m, 2, q + k) and shared error (m,) of the looks in fluid."""
        shape, mean = self.chip.mask.shape, self.uncertainty.mean_um_s
        rows, columns = nearest_pixels(places_um.reshape(-1, 2) / self.chip.um_per_px, shape)
        fluid = self.chip.mask[rows, columns]
        rows, columns, count, velocity = rows[fluid], columns[fluid], count[fluid], velocity_um_s[fluid]
        pixel = self.pixel[rows, columns]
        own = velocity - mean[pixel] if over_ground else velocity
        across = math.ceil(shape[1] / self.patch_px)
        patch = (rows // self.patch_px).astype(np.intp) * across + (columns // self.patch_px).astype(np.intp)
        error = np.hypot(self.uncertainty.error_um_s[pixel], self.share * np.hypot(*mean[pixel].T))
        variance = self.sampling.noise_um_s**2 + self.sampling.rolling_share**2 * (own**2).sum(axis=1)
        variance = self.uncertainty.noise_factor**2 * variance
        weight = count / np.maximum(variance, 1e-12)
        return patch, weight, self.uncertainty.effect(pixel, own), error


def covariance_after(covariance: Floats, information: Floats) -> Floats:
    """(q, q) covariance after observations of an information (q, q), or (q + k, q + k) with doubts."""
    information = information[: len(covariance), : len(covariance)]
    return np.asarray(np.linalg.solve(np.eye(len(covariance)) + covariance @ information, covariance))
