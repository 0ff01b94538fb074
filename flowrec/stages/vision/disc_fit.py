"""The robot's image in bright field, and its fit by robust least squares, to a small fraction of a pixel.

The robot is a dark disc within a bright rim, both softened by defocus. With rho the distance to the centre (x, y) and
s = (rho - r) / e:
    I = b + gx dx + gy dy - A disc(s) + C rim(s)
Of the nine parameters x, y, r and e are nonlinear, the others linear. The fit is Levenberg-Marquardt with Cauchy
weights, so that a passing particle or a fringe of a wall has little weight, and with weak priors on r, e and C, so that
a robot of which only a few pixels are visible still has a size.
"""

from __future__ import annotations

import math

import numpy as np

from flowrec.core import Floats, Floats32, Image, compiled

RIM_RATIO = 0.35  # brightness of the rim relative to the disc's darkness, where nothing better is known
STEEPNESS = 2.2  # of the outline
RIM_POSITION, RIM_WIDTH = 2.0, 1.1  # in edge widths outside the outline
_X, _Y, _RADIUS, _EDGE, _LEVEL, _SLOPE_X, _SLOPE_Y, _DARKNESS, _RIM = range(9)
_PARAMETERS = 9  # those above
_ITERATIONS = 10  # at most, of the damped Gauss-Newton
_NEAR_PX, _CONVERGED_PX = 0.1, 4e-3  # lengths of a step
# The square of Cauchy's constant in variances of the residuals: 2.385^2 for normal ones.
_CAUCHY = 6.0
_LARGE = 1e200  # before the product of many factors overflows, its logarithm is taken


@compiled
def profile(s: float) -> tuple[float, float, float, float]:
    """Disc (1 inside, 0 outside) and rim at s edge widths outside the outline, and their derivatives in s."""
    disc = 1.0 / (1.0 + math.exp(min(max(STEEPNESS * s, -40.0), 40.0)))
    off = (s - RIM_POSITION) / RIM_WIDTH
    rim = math.exp(-off * off)
    return disc, rim, -STEEPNESS * disc * (1.0 - disc), -2.0 * off / RIM_WIDTH * rim


def initial_edge_px(radius_px: float) -> float:
    """Initial softness of the outline: that of the optics and a fraction of the size, camera px."""
    return math.hypot(0.9, 0.06 * radius_px)


def fit_disc(
    image: Image | Floats32,
    distance_px: Floats32,
    margin_px: float,
    x: float,
    y: float,
    radius_px: float,
    edge_px: float,
    step: int,
) -> tuple[float, float, float, float, float]:
    """Fit a disc near (x, y), in camera px, to means over blocks of step x step pixels.

    Pixels nearer to a wall than the margin are ignored. Returns x, y, the radius, the darkness in grey levels, and the
    likeness sqrt(1 - residual / variance around the background), 0 to 1; 0 if there are too few pixels.
    """
    limit = fit_radius(radius_px, edge_px)
    means = block_means(image, distance_px, margin_px, x, y, limit, step)
    return _fit(*means, x, y, radius_px, edge_px, step)  # of its own: it takes seconds to compile for a kind of image


@compiled
def _fit(
    across: Floats, down: Floats, grey: Floats, x: float, y: float, radius_px: float, edge_px: float, step: int
) -> tuple[float, float, float, float, float]:
    """`fit_disc` for the means of blocks, each (n,), at (x + across, y + down)."""
    trial = _initial(across, down, grey, radius_px, edge_px)
    if trial[_DARKNESS] <= 0.0 or len(grey) < 2 * _PARAMETERS:
        return x, y, radius_px, 0.0, 0.0
    best, move = trial.copy(), np.zeros(_PARAMETERS)
    normal, best_normal = np.zeros((_PARAMETERS, _PARAMETERS)), np.zeros((_PARAMETERS, _PARAMETERS))
    slope, best_slope = np.zeros(_PARAMETERS), np.zeros(_PARAMETERS)
    damping, best_cost, best_variance, likeness = 1e-3, math.inf, 0.0, 0.0
    scale2 = math.inf  # of the residuals, estimated by the first iteration, which is not robust
    strict = False
    for iteration in range(_ITERATIONS):
        cost, variance, candidate_likeness = _equations(across, down, grey, trial, scale2, normal, slope)
        # Priors in units of the residuals' variance: r +- 15 %, e +- 40 %, C / A = 0.35 +- 0.5.
        unit = max(variance if iteration == 0 else scale2 / _CAUCHY, 1.0)
        cost += _prior(normal, slope, _RADIUS, radius_px - trial[_RADIUS], 0.15 * radius_px, unit)
        cost += _prior(normal, slope, _EDGE, edge_px - trial[_EDGE], 0.4 * edge_px, unit)
        rim_std = 0.5 * abs(trial[_DARKNESS]) + 1.0
        cost += _prior(normal, slope, _RIM, RIM_RATIO * trial[_DARKNESS] - trial[_RIM], rim_std, unit)
        if cost <= best_cost:
            for a in range(_PARAMETERS):
                best[a], best_slope[a] = trial[a], slope[a]
                for b in range(_PARAMETERS):
                    best_normal[a, b] = normal[a, b]
            best_cost, best_variance, likeness = cost, variance, candidate_likeness
            damping = max(0.2 * damping, 1e-6)
        else:
            damping = min(10.0 * damping, 1e3)
        for a in range(_PARAMETERS):
            move[a] = best_slope[a]
            for b in range(_PARAMETERS):
                normal[a, b] = best_normal[a, b]
        _solve(normal, move, damping)
        length = math.hypot(move[_X], move[_Y])
        shrink = min(1.0, 0.5 * radius_px / max(length, 1e-9))
        for a in range(_PARAMETERS):
            trial[a] = best[a] + shrink * move[a]
        trial[_RADIUS] = min(max(trial[_RADIUS], 0.3 * radius_px), 2.5 * radius_px)
        trial[_EDGE] = min(max(trial[_EDGE], 0.35 * step), 1.5 * radius_px)
        if iteration == 0 or (not strict and (iteration >= 3 or length < _NEAR_PX * step)):
            # Robust from the second iteration on, with a smaller scale once the disc fits. Costs before and after a
            # change of scale are not comparable.
            strict = iteration > 0
            scale2 = _CAUCHY * max(best_variance, 1.0)
            best_cost = math.inf
        elif strict and length < _CONVERGED_PX * step:
            for a in range(_PARAMETERS):
                best[a] = trial[a]
            break
    return best[_X] + x, best[_Y] + y, best[_RADIUS], best[_DARKNESS], likeness


@compiled
def fit_radius(radius_px: float, edge_px: float) -> float:
    """Distance from the initial position up to which pixels take part in the fit."""
    return 1.25 * radius_px + 3.5 * edge_px


@compiled
def block_means(
    image: Image | Floats32,
    distance_px: Floats32,
    margin_px: float,
    x: float,
    y: float,
    limit: float,
    step: int,
) -> tuple[Floats, Floats, Floats]:
    """Offsets in x and y from (x, y), and mean grey level, of each block without wall within the limit, each (n,)."""
    height, width = image.shape
    x0, x1 = max(math.floor(x - limit), 0), min(math.ceil(x + limit) + 1, width)
    y0, y1 = max(math.floor(y - limit), 0), min(math.ceil(y + limit) + 1, height)
    most = max(0, (x1 - x0) // step) * max(0, (y1 - y0) // step)
    across, down, grey = np.empty(most), np.empty(most), np.empty(most)
    middle = 0.5 * (step - 1)
    n = 0
    for top in range(y0, y1 - step + 1, step):
        for left in range(x0, x1 - step + 1, step):
            dx, dy = left + middle - x, top + middle - y
            if dx * dx + dy * dy > limit * limit:
                continue
            total, open_fluid = 0.0, True
            for j in range(top, top + step):
                for i in range(left, left + step):
                    total += image[j, i]
                    open_fluid &= distance_px[j, i] > margin_px
            if open_fluid:
                across[n], down[n], grey[n] = dx, dy, total / (step * step)
                n += 1
    return across[:n], down[:n], grey[:n]


@compiled
def _initial(across: Floats, down: Floats, grey: Floats, radius_px: float, edge_px: float) -> Floats:
    """Initial parameters (9,): the darkness is the difference between the outermost part and the middle."""
    inner, inner_count, outer, outer_count = 0.0, 1e-9, 0.0, 1e-9
    for n in range(len(grey)):
        rho = math.hypot(across[n], down[n])
        if rho < max(0.7 * radius_px, 1.0):
            inner += grey[n]
            inner_count += 1.0
        elif rho > radius_px + 2.5 * edge_px:
            outer += grey[n]
            outer_count += 1.0
    start = np.zeros(_PARAMETERS)
    start[_RADIUS], start[_EDGE] = radius_px, edge_px
    start[_LEVEL] = outer / outer_count
    start[_DARKNESS] = start[_LEVEL] - inner / inner_count
    start[_RIM] = RIM_RATIO * start[_DARKNESS]
    return start


@compiled
def _equations(
    across: Floats,
    down: Floats,
    grey: Floats,
    trial: Floats,
    scale2: float,
    normal: Floats,
    slope: Floats,
) -> tuple[float, float, float]:
    """Fill the normal equations at `trial`; return the cost, the robust variance of the residuals and the likeness."""
    for k in range(_PARAMETERS):
        slope[k] = 0.0
        for m in range(_PARAMETERS):
            normal[k, m] = 0.0
    cost, squares, variation, total_weight, weighted_squares = 0.0, 0.0, 0.0, 0.0, 0.0
    row = np.empty(_PARAMETERS)
    cx, cy, radius, edge = trial[_X], trial[_Y], trial[_RADIUS], trial[_EDGE]
    level, slope_x, slope_y = trial[_LEVEL], trial[_SLOPE_X], trial[_SLOPE_Y]
    darkness, rim = trial[_DARKNESS], trial[_RIM]
    product = 1.0
    for n in range(len(grey)):
        dx, dy = across[n] - cx, down[n] - cy
        rho = math.sqrt(dx * dx + dy * dy) + 1e-9
        s = (rho - radius) / edge
        inside, bright, inside_ds, bright_ds = profile(s)
        background = level + slope_x * across[n] + slope_y * down[n]
        residual = grey[n] - background + darkness * inside - rim * bright
        squares += residual * residual
        variation += (grey[n] - background) ** 2
        ratio = 1.0 + residual * residual / scale2
        # The cost is the sum of their logarithms; one logarithm of their product is faster.
        product *= ratio
        if product > _LARGE:
            cost += math.log(product)
            product = 1.0
        w = 1.0 / ratio
        total_weight += w
        weighted_squares += w * residual * residual
        # d model / d s, the common factor of the nonlinear parameters
        ds = (rim * bright_ds - darkness * inside_ds) / edge
        row[_X], row[_Y], row[_RADIUS], row[_EDGE] = -ds * dx / rho, -ds * dy / rho, -ds, -ds * s
        row[_LEVEL], row[_SLOPE_X], row[_SLOPE_Y] = 1.0, across[n], down[n]
        row[_DARKNESS], row[_RIM] = -inside, bright
        for a in range(_PARAMETERS):
            wa = w * row[a]
            slope[a] += wa * residual
            # The full square rather than a triangle: loops of constant length are vectorised.
            for b in range(_PARAMETERS):
                normal[a, b] += wa * row[b]
    cost = scale2 * (cost + math.log(product)) if scale2 < math.inf else squares
    likeness = math.sqrt(max(0.0, 1.0 - squares / max(variation, 1e-9)))
    return cost, weighted_squares / max(total_weight, 1e-9), likeness


@compiled
def _prior(normal: Floats, slope: Floats, which: int, miss: float, sigma: float, unit: float) -> float:
    """Add a normal prior to one parameter; return its cost."""
    normal[which, which] += unit / (sigma * sigma)
    slope[which] += unit * miss / (sigma * sigma)
    return unit * miss * miss / (sigma * sigma)


@compiled
def _solve(normal: Floats, right: Floats, damping: float) -> None:
    """Solve the damped normal equations in place, by the Cholesky factor in the lower triangle."""
    for a in range(_PARAMETERS):
        normal[a, a] = normal[a, a] * (1.0 + damping) + 1e-9
    for a in range(_PARAMETERS):
        for b in range(a + 1):
            total = normal[a, b]
            for k in range(b):
                total -= normal[a, k] * normal[b, k]
            normal[a, b] = math.sqrt(max(total, 1e-12)) if a == b else total / normal[b, b]
    for a in range(_PARAMETERS):
        for k in range(a):
            right[a] -= normal[a, k] * right[k]
        right[a] /= normal[a, a]
    for a in range(_PARAMETERS - 1, -1, -1):
        for k in range(a + 1, _PARAMETERS):
            right[a] -= normal[k, a] * right[k]
        right[a] /= normal[a, a]
