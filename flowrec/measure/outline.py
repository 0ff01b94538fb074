"""Sub-pixel walls of a channel in a picture, with their standard errors.

A mask says roughly where walls are. Across the walls the picture has one profile f, nearly the same everywhere, of
which nothing is assumed: a dark line, a bright one, a step, several of these. f is the median of the profiles along the
outline; each point of the outline then moves along its normal to where its own profile agrees with f best, by the mean
of its own shift and those of its neighbours. Both are repeated. At the end the whole outline moves along the normals to
the place in f that is the wall: the middle of the line, or half the height of the step.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Literal

import cv2
import numpy as np
import scipy  # its ndimage and special load at first use, not at start-up
from numpy.typing import NDArray

from flowrec.core import Floats, Ints
from flowrec.measure.images import Levels, Mask, blur_image, draw_curves, fill_curves, gradient, shrink

Walls = Literal["dark", "bright", "step"]
_PAD_PX = 24  # by which a channel goes on straight beyond the picture
_MOST_ROWS = 30_000  # of a map that OpenCV takes at once, which has to have fewer than 32767
_STEP_PX = 0.5  # between two samples of a profile
_LEAST_REACH_PX, _MOST_REACH_PX = 3.0, 14.0  # of a profile, to each side of the wall
_SEARCH_PX = (3.0, 2.0, 1.5, 1.0, 1.0)  # in each round; not beyond half of the reach
_ALONG_PX = 3.0  # over which profiles are averaged along the wall
_LEAST_LIKE = 0.3  # correlation with f below which a point does not move by itself
_LIKE = 0.7  # correlation with f from which on a piece of wall is seen
_FAINT = 0.25  # of the median contrast; less is no wall
_TOP = 0.15  # the middle of a line lies between the points where it has lost this fraction of its height
_ROUNDS = 6  # of the iteration that separates a line from a step of brightness at the same place
_WIDTH_OF_SIGMA = 2.355  # width of a Gaussian at half of its height over its standard deviation
_RIVAL = 0.6  # of the height of a line, from which on another one beside it may be the wall as well
_PARTICLE = 0.5  # area of what is a particle in the channel and no island, relative to the channel's width squared
# Walls nearer than _EDGE_PX to the border of the picture are replaced by the tangent of the _TANGENT_PX points before,
# up to _BEYOND_PX outside.
_EDGE_PX, _TANGENT_PX, _BEYOND_PX = 1.0, 8, 6.0
_FINER = 4  # pixels that are drawn for one of the mask


@dataclass(frozen=True, slots=True, eq=False)
class Outline:
    """The walls of a channel in a picture."""

    curves: tuple[Floats, ...]  # closed polygons (n, 2), x, y in pixels; they go on beyond the picture's border
    size_px: tuple[int, int]  # width and height of the picture
    walls: Walls  # what a wall looks like
    width_px: float  # width of the channel that is exceeded along three quarters of its length
    support: float  # part of the walls at which the picture has the profile of the others, 0 to 1
    gap_px: float  # longest piece of the walls without that profile
    explained: float  # part of the picture's edges that are such walls, less what chance would give; at most 1
    rough_px: float  # root mean square distance by which single pieces of the walls are off the smooth outline
    # how much the wall is what `walls` says, 0 to 1: height of the line or of the step, relative to all of f
    clear: float
    line_px: float  # width of the lines that walls are, at half of their height; 0 of steps
    # distance between the wall and a line of the other brightness beside it, if nearly as strong; else 0
    between_px: float

    def mask(self, finer: float = 1.0) -> Mask:
        """The channel (h, w), True in fluid, at `finer` times the resolution of the picture, over its centre."""
        (width, height), scale = self.size_px, finer * _FINER
        shape = round(height * finer), round(width * finer)
        # A point in the middle of the picture is in the middle of the mask.
        off = 0.5 * (np.array(shape[::-1]) * _FINER - 1) - 0.5 * (np.array(self.size_px) - 1) * scale
        canvas = np.zeros((shape[0] * _FINER, shape[1] * _FINER), np.uint8)
        fill_curves(canvas, (curve * scale + off for curve in self.curves))
        return shrink(canvas, shape[::-1]) >= 128

    def move_walls(self, outwards_px: float) -> Outline:
        """The outline with all walls moved away from the fluid; towards it if negative."""
        level = _level(self.mask())
        curves = (curve - outwards_px * _inward(curve, level) for curve in self.curves)
        return replace(self, curves=tuple(curves), width_px=self.width_px + 2.0 * outwards_px)

    def enlarge(self, size_px: tuple[int, int]) -> Outline:
        """The outline in a picture of another size (width, height)."""
        scale = np.array(size_px) / self.size_px
        bigger = float(np.sqrt(scale[0] * scale[1]))
        return replace(
            self,
            curves=tuple((curve + 0.5) * scale - 0.5 for curve in self.curves),
            size_px=size_px,
            width_px=self.width_px * bigger,
            gap_px=self.gap_px * bigger,
            line_px=self.line_px * bigger,
            rough_px=self.rough_px * bigger,
            between_px=self.between_px * bigger,
        )


def outline_of(image: Levels, mask: Mask, walls: Walls) -> Outline | None:
    """The outline near that of a mask (h, w), fitted to a picture (h, w); None if the mask has none."""
    height, width = image.shape
    wide_px = typical_width_px(mask)
    reach_px = float(np.clip(0.45 * wide_px, _LEAST_REACH_PX, _MOST_REACH_PX))
    level = _level(mask)
    curves = [curve for contour in _contours(mask) if (curve := _smooth(contour, level)) is not None]
    if not curves:
        return None
    sizes = np.cumsum([len(curve) for curve in curves])[:-1]
    smooth = np.asarray(cv2.copyMakeBorder(blur_image(image, 0.6), *(_PAD_PX,) * 4, cv2.BORDER_REPLICATE), np.float32)
    off = np.zeros(0)
    for most_px in _SEARCH_PX:
        points = np.concatenate(curves)
        normals = np.concatenate([_inward(curve, level) for curve in curves])
        seen = np.all((points >= 0) & (points <= (width - 1, height - 1)), axis=1)
        if np.count_nonzero(seen) < 20:
            return None
        search_px = min(most_px, 0.5 * reach_px)
        off = _offsets(_profiles(smooth, points, normals, reach_px + search_px, sizes), seen, reach_px)
        moves = np.split(np.where(seen, off, 0.0), sizes)
        weights = np.split(seen.astype(np.float64), sizes)
        moved = np.concatenate([_along(m * w, 4.0) / np.maximum(_along(w, 4.0), 1e-3)
                                for m, w in zip(moves, weights, strict=True)])  # fmt: skip
        curves = np.split(points + moved[:, None] * normals, sizes)
    points = np.concatenate(curves)
    profiles = _profiles(smooth, points, normals, reach_px, sizes)
    mean = np.median(profiles[seen], axis=0)
    at_px, clear, line_px, between_px = _wall_in(mean, walls)
    alike = _alike(profiles, mean, seen)
    at_walls = np.split(points + at_px * normals, sizes)
    curves = [_straight_on(each, (width, height)) for each in at_walls if _area(each) > _PARTICLE * wide_px**2]
    return Outline(
        curves=tuple(curves),
        size_px=(width, height),
        walls=walls,
        width_px=wide_px,
        support=float(np.mean(alike[seen])),
        gap_px=float(max(_longest(each) for each in np.split(seen & ~alike, sizes))),
        explained=_explained_edges(image, curves, reach_px),
        rough_px=float(np.sqrt(np.mean(np.square(off[seen])))),
        clear=clear,
        line_px=line_px,
        between_px=between_px,
    )


def _straight_on(curve: Floats, size_px: tuple[int, int]) -> Floats:
    """A curve (n, 2) whose walls go straight on where they leave the picture, as they came."""
    outside = np.max(np.maximum(-curve, curve - (np.array(size_px) - 1)), axis=1)
    inner = outside < -_EDGE_PX
    if inner.all() or not inner.any():
        return curve
    start = int(np.argmin(inner))  # not in the middle of a wall
    curve, far = np.roll(curve, -start, axis=0), np.roll(outside, -start) > _PAD_PX - 8
    parts, end = [], 0
    for first, last in [*_runs(np.roll(inner, -start)), (len(curve), len(curve))]:
        between, wall, leaves = curve[end:first], curve[first:last], bool(far[end:first].any())
        parts.append(between[far[end:first]] if leaves else between)
        if leaves and last - first >= _TANGENT_PX:
            parts += [_extrapolate(wall[::-1], size_px)[::-1], wall, _extrapolate(wall, size_px)]
        else:
            parts.append(wall)
        end = last
    return np.concatenate(parts)


def _runs(marked: Mask) -> list[tuple[int, int]]:
    """The first place of each run of marked points (n,), and the one after its last."""
    steps = np.flatnonzero(np.diff(np.concatenate(([False], marked, [False]))))
    return list(zip(steps[::2].tolist(), steps[1::2].tolist(), strict=True))


def _extrapolate(wall: Floats, size_px: tuple[int, int]) -> Floats:
    """Points (0 or 1, 2): where a wall (n, 2) that goes straight on at its end is a little beyond the picture."""
    last = wall[-_TANGENT_PX:]
    way = np.polyfit(np.arange(len(last)), last, 1)[0]
    begin = last.mean(0) + way * (len(last) - 1) / 2
    far, near = np.array(size_px) - 1 + _BEYOND_PX, -_BEYOND_PX
    with np.errstate(divide="ignore"):
        steps = np.where(way > 0, (far - begin) / way, (near - begin) / way)
    count = float(np.min(steps))
    return (begin + count * way)[None] if 0 < count < 200 else np.zeros((0, 2))


def _longest(marked: Mask) -> int:
    """Length of the longest run of marked points of a closed curve."""
    runs = _runs(np.concatenate((marked, marked)))
    return min(max((last - first for first, last in runs), default=0), len(marked))


def _area(curve: Floats) -> float:
    x, y = curve.T
    return 0.5 * abs(float(np.dot(x, np.roll(y, 1)) - np.dot(y, np.roll(x, 1))))


def _pad(mask: Mask) -> NDArray[np.uint8]:
    return np.pad(mask, _PAD_PX, mode="edge").astype(np.uint8)


def _distance(inside: NDArray[np.uint8]) -> Levels:
    return np.asarray(cv2.distanceTransform(inside, cv2.DIST_L2, cv2.DIST_MASK_PRECISE), np.float32)


def typical_width_px(mask: Mask) -> float:
    """Width of the channel that is exceeded along three quarters of its length."""
    if not mask.any() or mask.all():
        return float(max(mask.shape))
    distance = _distance(_pad(mask))
    crest = (distance >= cv2.dilate(distance, np.ones((3, 3), np.uint8))) & (distance > 0.9)
    inner = (slice(_PAD_PX, -_PAD_PX),) * 2
    values = distance[inner][crest[inner]]
    return 2.0 * float(np.percentile(values, 25)) - 1.0 if len(values) else 1.0


def _level(mask: Mask) -> Levels:
    """Smooth signed distance (h, w) in pixels, padded, positive in fluid."""
    padded = _pad(mask)
    return blur_image(np.where(padded > 0, _distance(padded) - 0.5, 0.5 - _distance(1 - padded)), 1.2)


def _contours(mask: Mask) -> list[Floats]:
    contours, _ = cv2.findContours(_pad(mask), cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)
    return [contour[:, 0].astype(np.float64) - _PAD_PX for contour in contours if len(contour) >= 12]


def _smooth(contour: Floats, level: Levels) -> Floats | None:
    """A contour along pixels (n, 2) as points about a pixel apart on the smooth level."""
    curve = _along(contour, 1.5)
    for _ in range(2):
        slope = np.stack([_at(level, curve + step) - _at(level, curve - step) for step in ((0.5, 0), (0, 0.5))], -1)
        move = _at(level, curve)[:, None] * slope / np.maximum(np.sum(slope * slope, -1, keepdims=True), 0.1)
        curve = curve - np.clip(move, -1.0, 1.0)
    closed = np.vstack((curve, curve[:1]))
    length = np.concatenate(([0.0], np.cumsum(np.hypot(*np.diff(closed, axis=0).T))))
    if length[-1] < 12.0:
        return None
    at = np.linspace(0.0, length[-1], round(length[-1]), endpoint=False)
    return np.column_stack([np.interp(at, length, closed[:, k]) for k in (0, 1)])


def _inward(curve: Floats, level: Levels) -> Floats:
    """Unit normals (n, 2) of a curve, from solid to fluid."""
    tangent = _along(np.roll(curve, -1, axis=0) - np.roll(curve, 1, axis=0), 2.0)
    across = np.stack((-tangent[:, 1], tangent[:, 0]), -1)
    across /= np.maximum(np.hypot(*across.T), 1e-9)[:, None]
    turn = _at(level, curve + across) < _at(level, curve - across)
    return np.where(turn[:, None], -across, across)


def _at(padded: Levels, points: Floats) -> Floats:
    """Values (...) of a padded image at points (..., 2)."""
    at = np.asarray(points + _PAD_PX, np.float32)
    blocks = np.split(at.reshape(len(at), -1, 2), range(_MOST_ROWS, len(at), _MOST_ROWS))
    found = [
        cv2.remap(padded, each[..., 0], each[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        for each in blocks
    ]
    return np.concatenate(found).astype(np.float64).reshape(at.shape[:-1])


def _along(values: Floats, sigma_px: float) -> Floats:
    """Values (n, ...) along a closed curve, blurred."""
    return scipy.ndimage.gaussian_filter1d(values, sigma_px, axis=0, mode="wrap")


def _profiles(padded: Levels, points: Floats, normals: Floats, reach_px: float, sizes: Ints) -> Floats:
    """Grey levels (n, samples) across the walls, from solid to fluid, averaged along them."""
    count = round(reach_px / _STEP_PX)
    t = _STEP_PX * np.arange(-count, count + 1)
    values = _at(padded, points[:, None] + t[None, :, None] * normals[:, None])
    return np.concatenate([_along(part, _ALONG_PX) for part in np.split(values, sizes)])


def _offsets(profiles: Floats, seen: Mask, reach_px: float) -> Floats:
    """Shift in px at which each profile (n, samples) agrees best with the median of those that are seen."""
    window = 2 * round(reach_px / _STEP_PX) + 1
    extra = (profiles.shape[1] - window) // 2
    shifted = np.lib.stride_tricks.sliding_window_view(profiles, window, axis=1)  # (n, places, window)
    levelled = shifted - shifted.mean(-1, keepdims=True)
    mean = np.median(levelled[seen, extra], axis=0)
    mean = mean - mean.mean()
    size = np.sqrt(np.sum(levelled**2, -1))
    floor = 0.3 * float(np.median(size[seen, extra])) + 1e-9
    score = levelled @ mean / (np.maximum(size, floor) * max(float(np.sqrt(np.sum(mean**2))), 1e-12))
    best = np.argmax(score, axis=1)
    rows = np.arange(len(best))
    inner = np.clip(best, 1, score.shape[1] - 2)
    a, b, c = score[rows, inner - 1], score[rows, inner], score[rows, inner + 1]
    bend = np.minimum(a - 2 * b + c, -1e-6)
    offset = (inner - extra + np.clip(0.5 * (a - c) / bend, -1.0, 1.0)) * _STEP_PX
    limit_px = extra * _STEP_PX
    return np.where(score[rows, best] > _LEAST_LIKE, np.clip(offset, -limit_px, limit_px), 0.0)


def _alike(profiles: Floats, mean: Floats, seen: Mask) -> Mask:
    """True (n,) where a profile (n, samples) has the form of the median one, and some of its contrast."""
    f = mean - mean.mean()
    levelled = profiles - profiles.mean(-1, keepdims=True)
    size, own, product = np.sqrt(np.sum(f * f)), np.sqrt(np.sum(levelled**2, -1)), levelled @ f
    faint = _FAINT * float(np.median(product[seen]))
    return (product > _LIKE * np.maximum(own * size, 1e-12)) & (product > faint)


def _wall_in(mean: Floats, walls: Walls) -> tuple[float, float, float, float]:
    """Position of the wall in a profile in px, its clarity, width of its line, distance of a line of another kind."""
    fine = np.linspace(0, len(mean) - 1, 8 * (len(mean) - 1) + 1)
    f = np.interp(fine, np.arange(len(mean)), mean)
    t = (fine - (len(mean) - 1) / 2) * _STEP_PX
    g = -f if walls == "dark" else f
    edge = max(len(g) // 8, 1)
    low, high = float(g[:edge].mean()), float(g[-edge:].mean())
    whole = max(float(np.ptp(g)), 1e-12)
    if walls == "step":
        above = g > math.log(0.5 * (math.exp(low) + math.exp(high)))  # half-way in light, not in its logarithm
        crossings = t[:-1][above[1:] != above[:-1]]
        at_px = float(crossings[np.argmin(np.abs(crossings))]) if len(crossings) else 0.0
        return at_px, abs(high - low) / whole, 0.0, 0.0
    middle = slice(edge, -edge)
    top, other = edge + int(np.argmax(g[middle])), edge + int(np.argmin(g[middle]))
    tall, deep = float(g[top]) - max(low, high), min(low, high) - float(g[other])
    between_px = float(abs(t[other] - t[top])) if deep > _RIVAL * tall else 0.0
    # A step of brightness at the same place pulls the top of a line to one side, so it is taken off.
    at_px, line_px = float(t[top]), 2.0
    for _ in range(_ROUNDS):
        step = (high - low) * scipy.special.ndtr((t - at_px) / max(line_px / _WIDTH_OF_SIGMA, 0.5))
        line = g - low - step
        top = edge + int(np.argmax(line[middle]))
        begin, end = _ends(line, t, top, 0.5)
        line_px = end - begin
        at_px = float(np.mean(_ends(line, t, top, _TOP)))
    return at_px, tall / whole, line_px, between_px


def _ends(line: Floats, t: Floats, top: int, lost: float) -> tuple[float, float]:
    """Positions on either side at which a line with its highest sample at `top` has lost this part of its height."""
    less = line < (1.0 - lost) * line[top]
    before, after = np.flatnonzero(less[:top]), np.flatnonzero(less[top:])
    return float(t[before[-1] if len(before) else 0]), float(t[top + after[0] if len(after) else -1])


def _explained_edges(image: Levels, curves: list[Floats], reach_px: float) -> float:
    """Part of the picture's edges that are near the outline, less what chance would give; 1 is all."""
    steep = np.hypot(*gradient(blur_image(image, max(1.5, reach_px / 3.0))))
    near, line = (
        draw_curves(np.zeros(image.shape, np.uint8), curves, width) for width in (2 * round(min(reach_px, 8.0)) + 1, 3)
    )
    if not line.any() or near.all():
        return 0.0
    typical = float(np.percentile(cv2.dilate(steep, np.ones((7, 7), np.uint8))[line > 0], 50))
    edges = steep > 0.5 * typical
    edges[[0, 1, -1, -2]] = edges[:, [0, 1, -1, -2]] = False
    share, chance = float(near[edges].mean()) if edges.any() else 0.0, float(near.mean())
    return (share - chance) / (1.0 - chance)
