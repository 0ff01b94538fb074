"""Positions of a track with noise of unknown colour: their innovations, which are white, and the noise by likelihood.

Each axis is modelled as x' = v + white noise (variance `drift` per time), v' = white noise (variance `agility` per
time: the flow that carries the robot changes slowly) and is measured with a white error (variance `error`). The
Kalman filter of this model is linear in the positions and its gains do not depend on them. So any regressor may be
passed through the same filter, and least squares of the innovations is generalised least squares of the positions.
Frames may be missing, and spaced unevenly.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import scipy  # its optimize loads at first use, not at start-up
from numpy.typing import NDArray

from flowrec.core import Floats, compiled

Flags = NDArray[np.int8]

USED, SKIPPED, RESTART = 0, 1, 2  # of a frame: measured, not to be trusted, first frame of another stretch
_UNKNOWN_UM2_S2 = 1e10  # variance of the velocity before the second frame of a stretch
FREEDOM = 4.0  # degrees of freedom of the t distribution: a few large innovations do not change the noise much
_PATIENCE = 3  # frames
_EVALUATIONS = 250  # of the likelihood; it is flat near its maximum, and a tenth of a decade is enough


@dataclass(frozen=True, slots=True)
class NoiseModel:
    """Variances of the process above."""

    error_um2: float  # of a measured position
    drift_um2_s: float  # of a random walk of the position, per time
    agility_um2_s3: float  # of a random walk of the velocity, per time


@compiled
def _innovations(
    time_s: Floats, columns: Floats, flags: Flags, error: float, drift: float, agility: float
) -> tuple[Floats, Floats]:
    """Innovations (n, m) divided by their standard deviation, and the logarithm (n,) of that; 0 where none is due."""
    n, m = columns.shape
    white = np.zeros((n, m))
    log_std = np.zeros(n)
    position = np.zeros(m)
    velocity = np.zeros(m)
    pxx, pxv, pvv = 0.0, 0.0, 0.0
    before = -1  # the frame of the state
    seen = 0
    for i in range(n):
        if flags[i] == SKIPPED:
            continue
        if before < 0 or flags[i] == RESTART:
            for j in range(m):
                position[j] = columns[i, j]
                velocity[j] = 0.0
            pxx, pxv, pvv = error, 0.0, _UNKNOWN_UM2_S2
            before = i
            seen = 1
            continue
        dt = time_s[i] - time_s[before]
        pxx += dt * (2.0 * pxv + dt * pvv) + drift * dt + agility * dt**3 / 3.0
        pxv += dt * pvv + agility * dt**2 / 2.0
        pvv += agility * dt
        total = pxx + error
        std = math.sqrt(total)
        kx, kv = pxx / total, pxv / total
        for j in range(m):
            ahead = position[j] + dt * velocity[j]
            innovation = columns[i, j] - ahead
            if seen >= 2:
                white[i, j] = innovation / std
            position[j] = ahead + kx * innovation
            velocity[j] += kv * innovation
        if seen >= 2:
            log_std[i] = math.log(std)
        pvv -= kv * pxv
        pxv -= kx * pxv
        pxx -= kx * pxx
        seen += 1
        before = i
    return white, log_std


def whiten(time_s: Floats, columns: Floats, flags: Flags, noise: NoiseModel) -> Floats:
    """Innovations of columns (n, m) at times (n,), divided by their standard deviations; (n, m).

    They are 0 at skipped frames and at the first two of each stretch.
    """
    columns = np.ascontiguousarray(columns, np.float64)
    return _innovations(time_s, columns, flags, noise.error_um2, noise.drift_um2_s, noise.agility_um2_s3)[0]


def fit_noise(time_s: Floats, positions_um: Floats, flags: Flags, start: NoiseModel | None = None) -> NoiseModel:
    """The noise that makes positions (n, 2) most likely, with innovations of Student's t distribution.

    `start`: where to begin; None: from two ends, a coarse camera and a fast flow.
    """
    positions = np.ascontiguousarray(positions_um, np.float64)
    axes = positions.shape[1]
    dt = float(np.median(np.diff(time_s)))

    def cost(logs: Floats) -> float:
        error, drift, agility = np.exp(np.clip(logs, -60.0, 60.0)).tolist()
        white, log_std = _innovations(time_s, positions, flags, error, error * drift, error * agility)
        square = (white**2).sum(1)
        return float(axes * log_std.sum() + 0.5 * (FREEDOM + axes) * np.log1p(square / FREEDOM).sum())

    if start is not None:
        starts = [
            np.log([start.error_um2, start.drift_um2_s / start.error_um2, start.agility_um2_s3 / start.error_um2])
        ]
    else:
        starts = [np.log([1.0, 0.1 / dt, 1.0 / dt**3]), np.log([1.0, 3.0 / dt, 0.03 / dt**3])]
    options = {"xatol": 0.05, "fatol": 0.1, "maxfev": _EVALUATIONS}
    found = min(
        (scipy.optimize.minimize(cost, each, method="Nelder-Mead", options=options) for each in starts),
        key=lambda r: r.fun,
    )
    error, drift, agility = np.exp(np.clip(found.x, -60.0, 60.0)).tolist()
    return NoiseModel(error, error * drift, error * agility)


@compiled
def _gate(
    time_s: Floats,
    positions: Floats,
    flags: Flags,
    error: float,
    drift: float,
    agility: float,
    gate: float,
) -> Flags:
    """See `without_jumps`."""
    n = positions.shape[0]
    out = flags.copy()
    x, y, vx, vy = 0.0, 0.0, 0.0, 0.0
    pxx, pxv, pvv = 0.0, 0.0, 0.0
    before, refused, seen = -1, 0, 0
    i = 0
    while i < n:
        if flags[i] == SKIPPED:
            i += 1
            continue
        if before < 0 or out[i] == RESTART:
            x, y, vx, vy = positions[i, 0], positions[i, 1], 0.0, 0.0
            pxx, pxv, pvv = error, 0.0, _UNKNOWN_UM2_S2
            before, refused, seen = i, 0, 1
            i += 1
            continue
        dt = time_s[i] - time_s[before]
        axx = pxx + dt * (2.0 * pxv + dt * pvv) + drift * dt + agility * dt**3 / 3.0
        axv = pxv + dt * pvv + agility * dt**2 / 2.0
        avv = pvv + agility * dt
        total = axx + error
        ex, ey = positions[i, 0] - x - dt * vx, positions[i, 1] - y - dt * vy
        if seen >= 2 and ex**2 + ey**2 > gate**2 * total:
            out[i] = SKIPPED
            refused += 1
            if refused >= _PATIENCE:  # it stays there: another stretch begins where it began to differ
                back = i
                while refused > 1:
                    back -= 1
                    if flags[back] != SKIPPED:
                        refused -= 1
                for j in range(back, i + 1):
                    out[j] = flags[j]
                out[back] = RESTART
                i = back
                continue
            i += 1
            continue
        kx, kv = axx / total, axv / total
        x, y, vx, vy = x + dt * vx + kx * ex, y + dt * vy + kx * ey, vx + kv * ex, vy + kv * ey
        pxx, pxv, pvv = axx - kx * axx, axv - kx * axv, avv - kv * axv
        seen += 1
        before, refused = i, 0
        i += 1
    return out


def without_jumps(time_s: Floats, positions_um: Floats, flags: Flags, noise: NoiseModel, gate: float) -> Flags:
    """Flags (n,) that skip positions (n, 2) more than `gate` standard deviations from the prediction.

    After `_PATIENCE` of them in a row the position is believed: the robot was lost and something else is followed, or
    it did what the model does not know. Another stretch begins there.
    """
    positions = np.ascontiguousarray(positions_um, np.float64)
    return _gate(time_s, positions, flags, noise.error_um2, noise.drift_um2_s, noise.agility_um2_s3, gate)
