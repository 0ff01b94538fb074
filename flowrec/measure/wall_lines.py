"""Division of a picture into fluid and solid, of unknown order, by walls that show as lines.

The picture is divided into basins between its ridges; the basins are of two kinds, so that walls separate basins of
different kind and places without a wall basins of the same: a cut of most weight, found greedily. A gap in a wall costs
as much as it is long, no more.
"""

from __future__ import annotations

import heapq
from collections.abc import Iterator

import cv2
import numpy as np
from numpy.typing import NDArray

from flowrec.core import Floats
from flowrec.measure.images import Levels, Mask, blur_image, slopes

_SIGMAS_PX = ((1.2, 2.0), (2.0, 3.5), (3.5, 5.5))  # of lines; each row is a hypothesis
_THRESHOLDS = (0.55, 0.9)  # of a wall, relative to Otsu's threshold between strong and weak ridges
_SMOOTH_PX = 1.5  # standard deviation of the blur that rounds the border of the basins
_REACH_PX = 12.0  # within which the ends of walls attract the border of a basin


def divisions(image: Levels) -> Iterator[tuple[Mask, float]]:
    """Hypotheses: parts (h, w) of two kinds between bright lines, and the share of what looks like a wall that divides.

    The share is weighted by the square of the walls' lengths: long walls are walls, noise has short ones.
    """
    for sigmas_px in _SIGMAS_PX:
        ridge = _ridges(image, sigmas_px)
        crest = (ridge >= cv2.dilate(ridge, np.ones((5, 5), np.uint8))) & (ridge > 0)
        values = ridge[crest].astype(np.float64)
        if len(values) < 16:
            continue
        usual = otsu(values)
        if usual <= 0:
            continue
        for threshold in _THRESHOLDS:
            strength = ridge / np.float32(threshold * usual)
            basins, count = _basins(strength)
            if count < 2:
                continue
            kinds, agreed = _two_kinds(basins, count, strength)
            parts = blur_image(kinds[basins].astype(np.float32), _SMOOTH_PX) > 0.5
            if parts.any() and not parts.all():
                yield parts, agreed


def otsu(values: Floats) -> float:
    """The threshold of most variance between two classes of values. Source: Otsu (1979)."""
    low, high = np.percentile(values, (0.5, 99.5))
    counts, edges = np.histogram(values, 256, (low, max(high, low + 1e-6)))
    middles = 0.5 * (edges[1:] + edges[:-1])
    below, total = np.cumsum(counts), np.cumsum(counts * middles)
    above = below[-1] - below
    mean_low, mean_high = total / np.maximum(below, 1), (total[-1] - total) / np.maximum(above, 1)
    return float(middles[int(np.argmax(below * above * (mean_low - mean_high) ** 2))])


def _ridges(image: Levels, sigmas_px: tuple[float, ...]) -> Levels:
    """Strength (h, w) of bright lines of several widths."""
    best = np.zeros(image.shape, np.float32)
    for sigma in sigmas_px:
        xx, yy, xy = slopes(blur_image(image, sigma), (2, 0), (0, 2), (1, 1), scale=0.25)
        half, root = 0.5 * (xx + yy), np.sqrt(0.25 * (xx - yy) ** 2 + xy * xy)
        across, along = root - half, -half - root
        best = np.maximum(best, np.maximum(sigma**1.5 * (across - np.abs(along)), 0.0))
    return best


def _basins(strength: Levels) -> tuple[NDArray[np.int32], int]:
    """The basins (h, w), from 0, that water drains into between walls, and their number; the ends of a gap attract."""
    away = cv2.distanceTransform((strength < 1.0).astype(np.uint8), cv2.DIST_L2, 5)
    ground = np.clip(strength, 0.0, 2.5) - np.minimum(away, _REACH_PX) / np.float32(_REACH_PX) - 0.01 * away
    ground = blur_image(ground, 1.0)
    height, width = ground.shape
    around = np.pad(ground, 1, constant_values=np.inf)
    index = np.pad(np.arange(height * width, dtype=np.int64).reshape(height, width), 1, constant_values=-1)
    lowest, to = ground.copy(), index[1:-1, 1:-1].copy()
    for down in (0, 1, 2):
        for right in (0, 1, 2):
            there = around[down : down + height, right : right + width]
            lower = there < lowest
            lowest = np.where(lower, there, lowest)
            to = np.where(lower, index[down : down + height, right : right + width], to)
    to = to.ravel()
    while True:
        farther = to[to]
        if np.array_equal(farther, to):
            break
        to = farther
    roots = np.flatnonzero(to == np.arange(len(to)))
    number = np.zeros(len(to), np.int32)
    number[roots] = np.arange(len(roots))
    return number[to].reshape(height, width), len(roots)


def _two_kinds(basins: NDArray[np.int32], count: int, strength: Levels) -> tuple[Mask, float]:
    """The kind (count,) of each basin, and which share of the walls it agrees with.

    Greedy maximum cut: borders of most weight are decided first, by a union of sets with parity; the weights of joined
    basins add up.
    """
    pairs, weights = [], []
    for after, before in ((np.s_[:, 1:], np.s_[:, :-1]), (np.s_[1:], np.s_[:-1])):
        one, other = basins[after].astype(np.int64), basins[before].astype(np.int64)
        differ = one != other
        pairs.append((np.minimum(one, other) * count + np.maximum(one, other))[differ])
        weights.append(np.clip(np.maximum(strength[after], strength[before])[differ], 0.0, 2.0) - 1.0)
    codes, each = np.unique(np.concatenate(pairs), return_inverse=True)
    ends = np.column_stack(np.divmod(codes, count))
    worth = np.bincount(each.ravel(), np.concatenate(weights), len(ends))
    around: list[dict[int, float]] = [{} for _ in range(count)]
    heap: list[tuple[float, int, int]] = []
    for (a, b), value in zip(ends.tolist(), worth.tolist(), strict=True):
        around[a][b] = around[b][a] = value
        heap.append((-abs(value), a, b))
    heapq.heapify(heap)
    members = [[k] for k in range(count)]
    kind = np.zeros(count, np.bool_)
    while heap:
        size, a, b = heapq.heappop(heap)
        value = around[a].get(b)
        if value is None or abs(value) != -size:
            continue  # joined, or another weight by now
        if len(members[a]) < len(members[b]):
            a, b = b, a
        if (value > 0) == bool(kind[members[a][0]] == kind[members[b][0]]):
            kind[members[b]] = ~kind[members[b]]
        # The sets' own weights are stated between their first members.
        sign = -1.0 if value > 0 else 1.0
        del around[a][b], around[b][a]
        for c, more in around[b].items():
            del around[c][b]
            total = around[a].get(c, 0.0) + sign * more
            around[a][c] = around[c][a] = total
            heapq.heappush(heap, (-abs(total), min(a, c), max(a, c)))
        around[b] = {}
        members[a] += members[b]
    cut = kind[ends[:, 0]] != kind[ends[:, 1]]
    walls = np.square(np.maximum(worth, 0.0))  # squared: long borders are what walls have, noise has short ones
    return kind, float(walls[cut].sum()) / max(float(walls.sum()), 1e-9)
