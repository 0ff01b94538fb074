"""Generalised least squares of a track on the turns of the field: time of the log, um per revolution and heading.

position(t) = g n(middle + offset + rate (t - middle)) + c F(t) + flow and noise, in complex numbers x + iy: g holds um
per revolution and the heading offset; of a mirrored log n is conjugated. F is what a known flow carries the robot, if
one is given; c is its scale.

Weights are those of Student's t distribution. The errors are those of a jackknife over blocks of time, because what is
left is correlated: speed and heading of the robot wander, and walls and step-out act for a while. A block without which
a parameter is not determined makes its error infinite.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import stdtrit  # quantile of Student's t; scipy.stats takes 0.3 s to load

from flowrec.core import Z95, Floats
from flowrec.stages import FREEDOM, Flags, NoiseModel, whiten

Complex = NDArray[np.complex128]
# (n,) times of the log in s to (n, 2) revolutions along x and y since its first row.
Turns = Callable[[Floats], Floats]

_STEPS = 15  # of the least squares, at most
_REWEIGHTINGS = 3  # for each of them
_LARGEST_STEP_S = 0.1  # of the offset, in one step of Gauss-Newton
_CONVERGED_S = 1e-5  # a shorter step ends the least squares: no log is known better
_DIFFERENCE_S = 2e-3  # of the central difference of the turns
_BLOCK_S = 3.0  # length of a block of the jackknife
_LEAST_BLOCKS, _MOST_BLOCKS = 8, 200  # of the jackknife: fewer tell no variance, more take time
_SINGULAR = 1e-9  # relative to the whole information
_OFFSET, _RATE, _GAIN, _TURNED, _FLOW = range(5)


class Place(NamedTuple):
    """Position of a movie in the log: the time of the log in the middle of the movie is middle_s + offset_s."""

    offset_s: float
    rate: float
    mirrored: bool


class MotionRegression(NamedTuple):
    """The parameters at the optimum, and what they leave."""

    place: Place
    gain: complex
    flow_scale: float
    cost: float  # negative logarithm of the likelihood
    left: Floats  # (n, 2) what of the whitened motion is left
    jacobian: Floats  # (2 n, 5) of the whitened motion
    weight: Floats  # (n,)


@dataclass(frozen=True, eq=False)
class TrackRegression:
    """A track, the log that it is compared with, and how.

    Attributes
    ----------
    time_s, positions_um, flags : (n,), (n, 2) and (n,) of the frames in which the robot was seen.
    carried_um : (n, 2) displacement by a known flow until each frame; None: not known.
    free : whether offset and rate may change.
    """

    time_s: Floats
    positions_um: Floats
    flags: Flags
    noise: NoiseModel
    turns: Turns
    free: tuple[bool, bool]
    carried_um: Floats | None = None

    @property
    def middle_s(self) -> float:
        """Middle of the movie: there the errors of offset and rate are nearly independent."""
        return 0.5 * float(self.time_s[0] + self.time_s[-1])

    @property
    def duration_s(self) -> float:
        """From the first frame to the last."""
        return float(self.time_s[-1] - self.time_s[0])

    def whiten(self, columns: Floats) -> Floats:
        """(n, m) columns of the frames, whitened."""
        return whiten(self.time_s, columns, self.flags, self.noise)

    @cached_property
    def _white(self) -> Floats:
        return self.whiten(self.positions_um)

    @cached_property
    def _carried(self) -> list[Floats]:
        return [] if self.carried_um is None else [self.whiten(self.carried_um).ravel()]

    @property
    def _active(self) -> list[int]:
        return [column for column, may in zip((_OFFSET, _RATE), self.free, strict=True) if may]

    @property
    def _columns(self) -> list[int]:
        """Those of the jacobian whose parameters are fitted."""
        return [*self._active, _GAIN, _TURNED, *([_FLOW] if self.carried_um is not None else [])]

    def log_times_s(self, place: Place) -> Floats:
        """(n,) times of the log at the frames."""
        return self.middle_s + place.offset_s + place.rate * (self.time_s - self.middle_s)

    def fit(self, start: Place) -> MotionRegression:
        """The parameters from a place on by Gauss-Newton with damping."""
        span_s = float(np.abs(self.time_s - self.middle_s).max())
        now, active, damping = self._at(start), self._active, 1e-3
        for _ in range(_STEPS if active else 0):
            J, W = now.jacobian[:, self._columns], np.repeat(now.weight, 2)
            H, g = J.T @ (W[:, None] * J), J.T @ (W * now.left.ravel())
            scale = np.diag(H)
            if not (scale > 0.0).all():
                break
            step = np.zeros(2)
            step[active] = np.linalg.lstsq(H + damping * np.diag(scale), g, rcond=None)[0][: len(active)]
            most = max(abs(float(step[0])), abs(float(step[1])) * span_s, 1e-12)
            step *= min(1.0, _LARGEST_STEP_S / most)
            new = self._at(Place(now.place.offset_s + float(step[0]), now.place.rate + float(step[1]), start.mirrored))
            if new.cost <= now.cost:
                now, damping = new, max(0.1 * damping, 1e-9)
                if most < _CONVERGED_S:
                    break
            else:
                damping *= 10.0
        return now

    def _at(self, place: Place) -> MotionRegression:
        """The regression on the log at a place."""
        at, lever = self.log_times_s(place), (self.time_s - self.middle_s)[:, None]
        speed = (self.turns(at + _DIFFERENCE_S) - self.turns(at - _DIFFERENCE_S)) / (2.0 * _DIFFERENCE_S)
        flow = self.whiten(np.concatenate([self.turns(at), speed, speed * lever], axis=1))
        rolled, by_offset, by_rate = (_as_complex(flow[:, n : n + 2], place) for n in (0, 2, 4))
        X = np.stack([_real(rolled), _real(1j * rolled), *self._carried], -1)
        y = self._white.ravel()
        used = np.any(self._white != 0.0, axis=1).astype(np.float64)
        weight = used
        for _ in range(_REWEIGHTINGS):
            W = np.repeat(weight, 2)[:, None]
            beta = np.linalg.lstsq(X.T @ (W * X), X.T @ (W[:, 0] * y), rcond=None)[0]
            left = y - X @ beta
            square = (left.reshape(-1, 2) ** 2).sum(1)
            weight = used * (FREEDOM + 2.0) / (FREEDOM + square)
        gain = complex(beta[0], beta[1])
        cost = 0.5 * (FREEDOM + 2.0) * float((used * np.log1p(square / FREEDOM)).sum())
        jacobian = np.zeros((len(y), 5))
        jacobian[:, _OFFSET], jacobian[:, _RATE] = _real(gain * by_offset), _real(gain * by_rate)
        jacobian[:, _GAIN : _GAIN + X.shape[1]] = X
        scale = float(beta[2]) if self._carried else 0.0
        return MotionRegression(place, gain, scale, cost, left.reshape(-1, 2), jacobian, weight)

    def remainder(self, fit: MotionRegression) -> Floats:
        """Positions (n, 2) less what log and known flow explain, um."""
        rolled = fit.gain * _as_complex(self.turns(self.log_times_s(fit.place)), fit.place)
        rest = self.positions_um - np.column_stack([rolled.real, rolled.imag])
        return rest if self.carried_um is None else rest - fit.flow_scale * self.carried_um

    def covariance(self, fit: MotionRegression) -> Floats:
        """(4, 4) of offset, rate and the real and imaginary part of the gain; inf where they are not determined.

        Jackknife over blocks to the first order: without block b the estimate changes by (H - H_b)^-1 s_b, with its
        information H_b and score s_b. It is at least that of independent noise.
        """
        J, W, left = fit.jacobian[:, self._columns], np.repeat(fit.weight, 2), fit.left.ravel()
        scale = np.sqrt((W[:, None] * J**2).sum(0))
        unknown = np.full((4, 4), np.inf)
        if not (scale > 0.0).all():
            return unknown
        J = J / scale
        H = J.T @ (W[:, None] * J)
        if np.linalg.eigvalsh(H)[0] < _SINGULAR:
            return unknown
        count = int(np.clip(self.duration_s / _BLOCK_S, _LEAST_BLOCKS, _MOST_BLOCKS))
        edges = np.searchsorted(self.time_s, self.time_s[0] + self.duration_s / count * np.arange(1, count))
        changes = []
        for rows in np.split(np.arange(len(left)), 2 * edges):
            mine, w = J[rows], W[rows]
            values, vectors = np.linalg.eigh(H - mine.T @ (w[:, None] * mine))
            if values[0] < _SINGULAR:
                return unknown
            changes.append(vectors @ (vectors.T @ (mine.T @ (w * left[rows])) / values))
        D = np.array(changes)
        jackknife = D.T @ D * (count - 1.0) / count
        # If few blocks matter: the quantile of Student's t with the degrees of freedom that they leave (Satterthwaite).
        freedom = np.maximum((D**2).sum(0) ** 2 / np.maximum((D**4).sum(0), 1e-300), 1.0)
        wider = stdtrit(freedom, 0.975) / Z95
        jackknife *= np.outer(wider, wider)
        # Weighted residuals have the variance of their scores; for the t distribution this is the plain estimate.
        plain = np.linalg.inv(H) * float(((W * left) ** 2).sum() / max(W.sum(), 1e-300))
        grow = np.sqrt(np.maximum(np.diag(plain) / np.maximum(np.diag(jackknife), 1e-300), 1.0))
        full = np.zeros((5, 5))
        full[np.ix_(self._columns, self._columns)] = jackknife * np.outer(grow, grow) / np.outer(scale, scale)
        return full[:4, :4]


def _as_complex(columns: Floats, place: Place) -> Complex:
    """(n,) columns (n, 2) of the log as x + iy, in the axes of a place."""
    return columns[:, 0] + (-1j if place.mirrored else 1j) * columns[:, 1]


def _real(values: Complex) -> Floats:
    """(2 n,) real and imaginary parts in turns."""
    return np.stack([values.real, values.imag], -1).ravel()


def heading_and_size(gain: complex, matrix: Floats) -> tuple[float, float, float, float]:
    """Size and angle of a complex gain, and their standard errors from its covariance (2, 2)."""
    size = abs(gain)
    if size == 0.0 or not np.isfinite(matrix).all():
        return size, 0.0, math.inf, math.inf
    along = np.array([gain.real, gain.imag]) / size
    across = np.array([-along[1], along[0]])
    size_std, angle_std = math.sqrt(along @ matrix @ along), math.sqrt(across @ matrix @ across) / size
    return size, math.atan2(gain.imag, gain.real), size_std, angle_std
