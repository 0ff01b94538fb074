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
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.stats import t as student

from flowrec.measure.motion_search import Turns
from flowrec.stages import FREEDOM, Flags, Floats, NoiseModel, whiten

Complex = NDArray[np.complex128]

_STEPS = 15  # of the least squares, at most
_REWEIGHTINGS = 3  # for each of them
_LARGEST_STEP_S = 0.1
_CONVERGED_S = 1e-5
_DIFFERENCE_S = 2e-3  # of the central difference of the turns
_BLOCK_S = 3.0
_LEAST_BLOCKS, _MOST_BLOCKS = 8, 200
_SINGULAR = 1e-9  # relative to the whole information
_Z95 = 1.959964
_OFFSET, _RATE, _GAIN, _TURNED, _FLOW = range(5)


@dataclass(frozen=True, slots=True)
class TrackData:
    """Data of the fit. `carried_um` (n, 2): displacement by a known flow until each frame; None: not known."""

    time_s: Floats  # (n,) of the frames in which the robot was seen
    positions_um: Floats  # (n, 2)
    turns: Turns
    carried_um: Floats | None = None

    @property
    def middle_s(self) -> float:
        """Middle of the movie: there the errors of offset and rate are nearly independent."""
        return 0.5 * float(self.time_s[0] + self.time_s[-1])


class Place(NamedTuple):
    """Position of a movie in the log: the time of the log in the middle of the movie is middle_s + offset_s."""

    offset_s: float
    rate: float
    mirrored: bool


@dataclass(frozen=True, slots=True)
class MotionRegression:
    """The parameters at the optimum, and what they leave."""

    place: Place
    gain: complex
    flow_scale: float
    cost: float  # negative logarithm of the likelihood
    white: Floats  # (n, 2) whitened motion
    left: Floats  # (n, 2) what of it is left
    jacobian: Floats  # (2 n, 5) of the whitened motion
    weight: Floats  # (n,)

    @property
    def r2(self) -> float:
        """Fraction of the whitened motion that the log and the known flow explain."""
        return 1.0 - float((self.left**2).sum()) / max(float((self.white**2).sum()), 1e-300)


def regress(
    data: TrackData, start: Place, flags: Flags, noise: NoiseModel, free: tuple[bool, bool]
) -> MotionRegression:
    """The parameters from a place on by Gauss-Newton with damping; `free`: whether offset and rate may change."""
    lever = data.time_s - data.middle_s
    span_s = float(np.abs(lever).max())
    fitted = _Whitened(data, start.mirrored, flags, noise)
    now = fitted.at(start)
    active = [column for column, may in ((_OFFSET, free[0]), (_RATE, free[1])) if may]
    columns = [*active, _GAIN, _TURNED, *([_FLOW] if data.carried_um is not None else [])]
    damping = 1e-3
    for _ in range(_STEPS if active else 0):
        J, W = now.jacobian[:, columns], np.repeat(now.weight, 2)
        H, g = J.T @ (W[:, None] * J), J.T @ (W * now.left.ravel())
        scale = np.diag(H)
        if not (scale > 0.0).all():
            break
        step = np.zeros(2)
        step[active] = np.linalg.lstsq(H + damping * np.diag(scale), g, rcond=None)[0][: len(active)]
        most = max(abs(float(step[0])), abs(float(step[1])) * span_s, 1e-12)
        step *= min(1.0, _LARGEST_STEP_S / most)
        new = fitted.at(Place(now.place.offset_s + float(step[0]), now.place.rate + float(step[1]), start.mirrored))
        if new.cost <= now.cost:
            now, damping = new, max(0.1 * damping, 1e-9)
            if most < _CONVERGED_S:
                break
        else:
            damping *= 10.0
    return now


class _Whitened:
    """Whitened motion, and the regression on the log at a place."""

    def __init__(self, data: TrackData, mirrored: bool, flags: Flags, noise: NoiseModel) -> None:
        self._data, self._mirrored, self._flags, self._noise = data, mirrored, flags, noise
        self._lever = (data.time_s - data.middle_s)[:, None]
        self._white = whiten(data.time_s, data.positions_um, flags, noise)
        self._used = np.any(self._white != 0.0, axis=1).astype(np.float64)
        carried = data.carried_um
        self._carried = None if carried is None else whiten(data.time_s, carried, flags, noise).ravel()

    def at(self, place: Place) -> MotionRegression:
        data = self._data
        at = data.middle_s + place.offset_s + place.rate * self._lever[:, 0]
        ahead, behind = data.turns(at + _DIFFERENCE_S), data.turns(at - _DIFFERENCE_S)
        speed = (ahead - behind) / (2.0 * _DIFFERENCE_S)
        columns = np.concatenate([data.turns(at), speed, speed * self._lever], axis=1)
        flow = whiten(data.time_s, columns, self._flags, self._noise)
        rolled, by_offset, by_rate = (self._complex(flow[:, n : n + 2]) for n in (0, 2, 4))
        linear = [_real(rolled), _real(1j * rolled)] + ([self._carried] if self._carried is not None else [])
        X: Floats = np.stack(linear, -1)
        y: Floats = self._white.ravel()
        square: Floats = np.zeros(len(self._white))
        beta: Floats
        left: Floats
        weight, beta, left = self._used, np.zeros(X.shape[1]), y
        for _ in range(_REWEIGHTINGS):
            W = np.repeat(weight, 2)[:, None]
            beta = np.asarray(np.linalg.lstsq(X.T @ (W * X), X.T @ (W[:, 0] * y), rcond=None)[0], np.float64)
            left = y - X @ beta
            square = (left.reshape(-1, 2) ** 2).sum(1)
            weight = self._used * (FREEDOM + 2.0) / (FREEDOM + square)
        gain = complex(beta[0], beta[1])
        cost = 0.5 * (FREEDOM + 2.0) * float((self._used * np.log1p(square / FREEDOM)).sum())
        jacobian = np.zeros((len(y), 5))
        jacobian[:, _OFFSET], jacobian[:, _RATE] = _real(gain * by_offset), _real(gain * by_rate)
        jacobian[:, _GAIN : _GAIN + X.shape[1]] = X
        scale = float(beta[2]) if len(beta) > 2 else 0.0
        return MotionRegression(place, gain, scale, cost, self._white, left.reshape(-1, 2), jacobian, weight)

    def _complex(self, columns: Floats) -> Complex:
        result: Complex = columns[:, 0] + (-1j if self._mirrored else 1j) * columns[:, 1]
        return result


def _real(values: Complex) -> Floats:
    """(2 n,) real and imaginary parts in turns."""
    return np.stack([values.real, values.imag], -1).ravel()


def remainder(data: TrackData, fit: MotionRegression) -> Floats:
    """Positions (n, 2) less what log and known flow explain, um."""
    place = fit.place
    turns = data.turns(data.middle_s + place.offset_s + place.rate * (data.time_s - data.middle_s))
    rolled = fit.gain * (turns[:, 0] + (-1j if place.mirrored else 1j) * turns[:, 1])
    rest = data.positions_um - np.column_stack([rolled.real, rolled.imag])
    return rest if data.carried_um is None else rest - fit.flow_scale * data.carried_um


def covariance(data: TrackData, fit: MotionRegression, free: tuple[bool, bool]) -> Floats:
    """(4, 4) of offset, rate and the real and imaginary part of the gain; inf where they are not determined.

    Jackknife over blocks to the first order: without block b the estimate changes by (H - H_b)^-1 s_b, with its
    information H_b and score s_b. It is at least that of independent noise.
    """
    fixed = [column for column, may in ((_OFFSET, free[0]), (_RATE, free[1])) if not may]
    columns = [n for n in range(5) if n not in fixed and (n != _FLOW or data.carried_um is not None)]
    J, W, left = fit.jacobian[:, columns], np.repeat(fit.weight, 2), fit.left.ravel()
    scale = np.sqrt((W[:, None] * J**2).sum(0))
    unknown = np.full((4, 4), np.inf)
    if not (scale > 0.0).all():
        return unknown
    J = J / scale
    H = J.T @ (W[:, None] * J)
    if np.linalg.eigvalsh(H)[0] < _SINGULAR:
        return unknown
    duration_s = float(data.time_s[-1] - data.time_s[0])
    count = int(np.clip(duration_s / _BLOCK_S, _LEAST_BLOCKS, _MOST_BLOCKS))
    edges = np.searchsorted(data.time_s, data.time_s[0] + duration_s / count * np.arange(1, count))
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
    wider = student.ppf(0.975, freedom) / _Z95
    jackknife *= np.outer(wider, wider)
    # Weighted residuals have the variance of their scores; for the t distribution this is the plain estimate.
    plain = np.linalg.inv(H) * float(((W * left) ** 2).sum() / max(W.sum(), 1e-300))
    grow = np.sqrt(np.maximum(np.diag(plain) / np.maximum(np.diag(jackknife), 1e-300), 1.0))
    result = jackknife * np.outer(grow, grow) / np.outer(scale, scale)
    full = np.zeros((5, 5))
    full[np.ix_(columns, columns)] = result
    return full[:4, :4]


def heading_and_size(gain: complex, matrix: Floats) -> tuple[float, float, float, float]:
    """Size and angle of a complex gain, and their standard errors from its covariance (2, 2)."""
    size = abs(gain)
    if size == 0.0 or not np.isfinite(matrix).all():
        return size, 0.0, math.inf, math.inf
    along = np.array([gain.real, gain.imag]) / size
    across = np.array([-along[1], along[0]])
    size_std, angle_std = math.sqrt(along @ matrix @ along), math.sqrt(across @ matrix @ across) / size
    return size, math.atan2(gain.imag, gain.real), size_std, angle_std
