"""A defocused disc fitted to an image by robust least squares: where its centre is, to a small part of a pixel.

Model, with rho the distance to the centre (x, y) and s = (rho - r) / e:
    I = b + gx dx + gy dy - A disc(s) + C rim(s)
nine parameters: x, y, r, e enter nonlinearly, the rest linearly. Levenberg-Marquardt with Cauchy weights, so that a
particle passing by or a fringe of a wall weighs little, and with weak priors on r, e and C, so that a robot of which
only a few pixels are seen still has a size.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

X, Y, RADIUS, EDGE, LEVEL, SLOPE_X, SLOPE_Y, DARKNESS, RIM = range(9)
PARAMETERS = 9
RIM_AT, RIM_WIDTH = 2.0, 1.1  # in edge widths outside the outline

_ITERATIONS = 10
_DONE_PX = 2e-3


def disc(s: NDArray[np.float64]) -> NDArray[np.float64]:
    """1 inside, 0 outside, a soft step of unit width at s = 0."""
    return np.asarray(1.0 / (1.0 + np.exp(np.clip(2.2 * s, -40.0, 40.0))))


def rim(s: NDArray[np.float64]) -> NDArray[np.float64]:
    """The bright ring that defocus puts around the outline."""
    return np.asarray(np.exp(-(((s - RIM_AT) / RIM_WIDTH) ** 2)))


@njit(cache=True)
def fit_disc(
    image: NDArray[np.float32],
    weight: NDArray[np.float32],
    start: NDArray[np.float64],
    radius_prior: float,
    edge_prior: float,
    reach: float,
) -> tuple[NDArray[np.float64], float]:
    """Fit the nine parameters to an image (h, w), starting at `start` (9,).

    Only pixels of positive weight within `reach` of the starting centre count. Returns the parameters and the
    likeness: sqrt(1 - residual / variation about the background), 0 to 1; 0 when the fit ran away.
    """
    height, width = image.shape
    cx, cy = start[X], start[Y]
    x0, x1 = max(math.floor(cx - reach), 0), min(math.ceil(cx + reach) + 1, width)
    y0, y1 = max(math.floor(cy - reach), 0), min(math.ceil(cy + reach) + 1, height)
    p = start.copy()
    trial = start.copy()
    best = start.copy()
    normal = np.zeros((PARAMETERS, PARAMETERS))
    kept = np.zeros((PARAMETERS, PARAMETERS))
    slope = np.zeros(PARAMETERS)
    kept_slope = np.zeros(PARAMETERS)
    row = np.zeros(PARAMETERS)
    damping = 1e-3
    best_cost = math.inf
    scale2 = math.inf  # of the residuals; the first pass is not robust and finds it
    best_variance = 0.0
    likeness = 0.0
    for iteration in range(_ITERATIONS):
        normal[:] = 0.0
        slope[:] = 0.0
        cost, squares, variation, count, trusted, trusted_squares = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        for j in range(y0, y1):
            for i in range(x0, x1):
                if weight[j, i] <= 0 or (i - cx) ** 2 + (j - cy) ** 2 > reach * reach:
                    continue
                dx, dy = i - trial[X], j - trial[Y]
                rho = math.sqrt(dx * dx + dy * dy) + 1e-9
                s = (rho - trial[RADIUS]) / trial[EDGE]
                inside = 1.0 / (1.0 + math.exp(min(max(2.2 * s, -40.0), 40.0)))
                q = (s - 2.0) / 1.1
                bright = math.exp(-q * q)
                ground = trial[LEVEL] + trial[SLOPE_X] * (i - cx) + trial[SLOPE_Y] * (j - cy)
                model = ground - trial[DARKNESS] * inside + trial[RIM] * bright
                residual = image[j, i] - model
                w = weight[j, i]
                count += w
                squares += w * residual * residual
                variation += w * (image[j, i] - ground) ** 2
                if scale2 < math.inf:
                    ratio = residual * residual / scale2
                    cost += w * scale2 * math.log1p(ratio)
                    w /= 1.0 + ratio
                trusted += w
                trusted_squares += w * residual * residual
                # d model / d s, by which the four nonlinear parameters act
                ds = trial[DARKNESS] * 2.2 * inside * (1.0 - inside) - trial[RIM] * bright * 2.0 * q / 1.1
                ds /= trial[EDGE]
                row[X] = -ds * dx / rho
                row[Y] = -ds * dy / rho
                row[RADIUS] = -ds
                row[EDGE] = -ds * s
                row[LEVEL] = 1.0
                row[SLOPE_X] = i - cx
                row[SLOPE_Y] = j - cy
                row[DARKNESS] = -inside
                row[RIM] = bright
                for a in range(PARAMETERS):
                    wa = w * row[a]
                    slope[a] += wa * residual
                    for b in range(a + 1):
                        normal[a, b] += wa * row[b]
        if count < 2 * PARAMETERS:
            return best, 0.0
        variance = trusted_squares / trusted
        first = scale2 == math.inf
        # Priors in units of the residuals' variance: r +- 15 %, e +- 40 %, C/A = 0.35 +- 0.5.
        unit = max(variance, 1.0) if first else max(scale2 / 6.0, 1.0)
        for k in range(3):
            which = (RADIUS, EDGE, RIM)[k]
            centre = (radius_prior, edge_prior, 0.35 * trial[DARKNESS])[k]
            sigma = (0.15 * radius_prior, 0.4 * edge_prior, 0.5 * abs(trial[DARKNESS]) + 1.0)[k]
            miss = centre - trial[which]
            normal[which, which] += unit / (sigma * sigma)
            slope[which] += unit * miss / (sigma * sigma)
            cost += unit * miss * miss / (sigma * sigma)
        if first:
            cost = math.inf
        if cost <= best_cost:
            done = best_cost < math.inf and abs(trial[X] - best[X]) + abs(trial[Y] - best[Y]) < _DONE_PX
            best[:] = trial
            best_cost = cost
            kept[:] = normal
            kept_slope[:] = slope
            best_variance = variance
            likeness = math.sqrt(max(0.0, 1.0 - squares / max(variation, 1e-9)))
            if done:
                break
            damping = max(0.2 * damping, 1e-6)
        else:
            damping = min(10.0 * damping, 1e3)
        # Cholesky of the damped normal equations, in place in the lower triangle.
        normal[:] = kept
        p[:] = kept_slope
        for a in range(PARAMETERS):
            normal[a, a] = normal[a, a] * (1.0 + damping) + 1e-9
        for a in range(PARAMETERS):
            for b in range(a + 1):
                total = normal[a, b]
                for k in range(b):
                    total -= normal[a, k] * normal[b, k]
                if a == b:
                    normal[a, a] = math.sqrt(max(total, 1e-12))
                else:
                    normal[a, b] = total / normal[b, b]
        for a in range(PARAMETERS):
            for k in range(a):
                p[a] -= normal[a, k] * p[k]
            p[a] /= normal[a, a]
        for a in range(PARAMETERS - 1, -1, -1):
            for k in range(a + 1, PARAMETERS):
                p[a] -= normal[k, a] * p[k]
            p[a] /= normal[a, a]
        longest = 0.5 * radius_prior
        step = math.sqrt(p[X] ** 2 + p[Y] ** 2)
        shrink = longest / step if step > longest else 1.0
        for a in range(PARAMETERS):
            trial[a] = best[a] + shrink * p[a]
        trial[RADIUS] = min(max(trial[RADIUS], 0.3 * radius_prior), 2.5 * radius_prior)
        trial[EDGE] = min(max(trial[EDGE], 0.35), 1.5 * radius_prior)
        if iteration in (0, 3):
            # Robust from the second pass on, and stricter once the disc fits: Cauchy's constant is 2.385 for
            # normal residuals. Costs before and after do not compare.
            scale2 = 6.0 * max(best_variance, 1.0)
            best_cost = math.inf
    return best, likeness
