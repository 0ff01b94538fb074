"""Several robots that touch or hide each other in an image: all of them are fitted at once.

The light that passes is the product of what each robot lets through,

    I = b prod_k (1 - a_k disc(s_k) + 0.35 a_k rim(s_k)),    s_k = (|p - x_k| - r_k) / e_k,

with disc and rim of disc_fit.py; radius r and darkness a of each are known from when it was alone. The places x are
those of largest posterior probability, from where each robot is expected with a variance. Where one hides another, a
small error of the model decides how far they seem apart; so their distance is kept as expected, and they are moved as
one, unless the image contradicts that. Among all ways to exchange the robots that is kept whose cost is least, so that
their looks tell them apart where their ways do not.
"""

from __future__ import annotations

import itertools
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from flowrec.core import Floats
from flowrec.stages.vision.disc_fit import RIM_POSITION, RIM_RATIO, RIM_WIDTH, STEEPNESS, initial_edge_px
from flowrec.stages.vision.walls import Walls

_ITERATIONS = 6  # of the Gauss-Newton steps
_PERMUTED = 3  # robots at most whose exchange is tried: six ways
_HIDDEN = 0.5  # of the sum of two radii: nearer robots hide each other
_CONTRADICTS = 2.0  # times the cost at another distance: robots that hide each other are not where they are expected
_MISFIT = 0.1  # of the background: standard deviation of a pixel about the model, whose neighbours err alike
_ALIKE_PX = 9.0  # pixels that err alike
_BOX_RADII = 1.8  # around the robots
_LEVEL = 0.8  # quantile of the grey levels around robots: the background
_LEAST_PIXELS = 4  # a robot
_SHARES = (0.05, 0.98)  # least and most light that a robot takes
_LEAST_VARIANCE_PX2 = 1e-6  # of an expected place
_FINE_RADIUS_PX = 6.0  # of the robot in pixels that are looked at, unless it is smaller
_LEAST_LIKENESS = 0.6  # sqrt(1 - residual / variance), below which the image does not show these robots


class Body(NamedTuple):
    """A robot that is expected in an image, in camera px and grey levels."""

    expected_px: Floats  # (2,)
    variance_px2: float  # of that, per component
    radius_px: float
    darkness: float


class _Image(NamedTuple):
    """Pixels of an image around robots, in the fluid."""

    pixels: Floats  # (m, 2) column and row
    grey: Floats  # (m,)
    level: float  # of the background
    weight: float  # of the square of a grey level


def fit_jointly(image: NDArray[np.generic], walls: Walls, margin_px: float, bodies: list[Body]) -> Floats | None:
    """Places (n, 2) in px of robots that touch each other; None if the image does not show them."""
    expected, radii = np.array([body.expected_px for body in bodies]), np.array([body.radius_px for body in bodies])
    part = _part_of(image, walls, margin_px, expected, radii)
    if part is None or len(part.grey) < _LEAST_PIXELS * len(bodies):
        return None
    share = np.clip([body.darkness / part.level for body in bodies], *_SHARES)
    precision = np.array([1.0 / max(body.variance_px2, _LEAST_VARIANCE_PX2) for body in bodies])
    as_one = bool((distances(expected, radii)[np.triu_indices(len(bodies), 1)] < _HIDDEN).any())
    known = _Prior(expected, precision, radii, share)
    one_by_one = np.eye(2 * len(bodies))
    if as_one:
        best = _solve_places(part, known, expected, np.tile(np.eye(2), (len(bodies), 1)))
        freely = _solve_places(part, known, best.places, one_by_one)
        best = freely if best.cost > _CONTRADICTS * freely.cost else best
    else:
        count = len(bodies)
        orders = itertools.permutations(range(count)) if count <= _PERMUTED else [tuple(range(count))]
        fits = [_solve_places(part, known, expected[list(order)], one_by_one) for order in orders]
        best = min(fits, key=lambda fit: fit.cost)
    variance = float(((part.grey - part.level) ** 2).sum())
    shown = best.residual <= (1.0 - _LEAST_LIKENESS**2) * variance
    return best.places if shown and np.isfinite(best.places).all() else None


def distances(places: Floats, radii: Floats) -> Floats:
    """(n, n) between bodies at places (n, 2), over the sum of their radii (n,)."""
    return np.hypot(*(places[:, None] - places).transpose(2, 0, 1)) / (radii[:, None] + radii)


class _Prior(NamedTuple):
    """Places and looks of n robots as they are expected before the image."""

    px: Floats  # (n, 2)
    precision: Floats  # (n,) of that
    radii: Floats
    share: Floats  # of the light that each takes


class _Solution(NamedTuple):
    places: Floats  # (n, 2)
    cost: float  # twice the negative logarithm of the posterior
    residual: float  # sum of squares in grey levels


def _solve_places(part: _Image, known: _Prior, start: Floats, moves: Floats) -> _Solution:
    """Gauss-Newton from a start (n, 2), by moves that are the columns of (2n, m)."""
    places = start.copy()
    for _ in range(_ITERATIONS):
        model, slopes = _light(part.pixels, places, known.radii, known.share)
        off = part.grey - part.level * model
        jacobian = part.level * slopes.reshape(len(off), -1)
        normal = part.weight * jacobian.T @ jacobian + np.diag(np.repeat(known.precision, 2))
        slope = part.weight * jacobian.T @ off - (known.precision[:, None] * (places - known.px)).ravel()
        move = (moves @ np.linalg.solve(moves.T @ normal @ moves, moves.T @ slope)).reshape(-1, 2)
        longest = np.hypot(*move.T) / (0.5 * known.radii)  # a step is half a radius at most
        places += move / np.maximum(longest, 1.0)[:, None]
    model = _light(part.pixels, places, known.radii, known.share)[0]
    left = float(((part.grey - part.level * model) ** 2).sum())
    cost = part.weight * left + float((known.precision[:, None] * (places - known.px) ** 2).sum())
    return _Solution(places, cost, left)


def _part_of(
    image: NDArray[np.generic], walls: Walls, margin_px: float, expected: Floats, radii: Floats
) -> _Image | None:
    """The part of an image around robots; None where it is too small."""
    x0, y0 = np.floor((expected - _BOX_RADII * radii[:, None]).min(axis=0)).astype(int)
    x1, y1 = np.ceil((expected + _BOX_RADII * radii[:, None]).max(axis=0)).astype(int) + 1
    (left, top), (right, bottom) = np.maximum((x0, y0), 0), np.minimum((x1, y1), image.shape[::-1])
    if right <= left or bottom <= top:
        return None
    step = max(1, int(radii.min() / _FINE_RADIUS_PX))
    rows, columns = np.mgrid[top:bottom:step, left:right:step]
    free = walls.distance_px[rows, columns] > margin_px
    if not free.any():
        return None
    pixels = np.column_stack((columns[free], rows[free])).astype(np.float64)
    grey = image[rows[free], columns[free]].astype(np.float64)
    level = max(float(np.quantile(grey, _LEVEL)), 1.0)
    return _Image(pixels, grey, level, step**2 / (_ALIKE_PX * (_MISFIT * level) ** 2))


def _light(pixels: Floats, places: Floats, radii: Floats, share: Floats) -> tuple[Floats, Floats]:
    """Light (m,) that passes, of the background's, and its derivatives (m, n, 2) in the places (n, 2)."""
    away = pixels[:, None] - places
    rho = np.maximum(np.hypot(away[..., 0], away[..., 1]), 1e-6)
    edges = np.array([initial_edge_px(float(radius)) for radius in radii])
    s = (rho - radii) / edges
    disc = 1.0 / (1.0 + np.exp(np.clip(STEEPNESS * s, -40.0, 40.0)))
    off = (s - RIM_POSITION) / RIM_WIDTH
    rim = RIM_RATIO * np.exp(-(off**2))
    passed = 1.0 - share * (disc - rim)
    by_s = share * (STEEPNESS * disc * (1.0 - disc) - 2.0 * off / RIM_WIDTH * rim)
    light = passed.prod(axis=1)
    # s falls as the robot comes nearer: ds / dx = -away / (rho e).
    slopes = (light[:, None] / passed * by_s / (rho * edges))[..., None] * -away
    return light, slopes
