"""Tracking by a learned appearance: objects that are no dark discs, and one of many that look the same.

Candidates are maxima of the foreground's energy (foreground.py), so an object is one whatever it shows. Each is
compared with the learned views: the first look, a slow mean of the recent looks, and up to six earlier looks that
differ. assignment.py chooses the robot among them.

The position is the centroid of the foreground, which knows no drift. Of a round object a registration with the views is
more precise; its views are centred by their own centroid, so that does not drift either.

Ablation with `flowrec bench track --movies` (RMSE in px): without merged images two that cross 0.18 -> 0.36; without
neighbours the same; without later views a Janus particle is lost in half of the images; with the recent one only
0.21 -> 0.38; without neighbours that are remembered one of 88 recorded beads jumps by 6.7 px instead of 3.4; without
registration a ring that drifts out of focus 0.04 -> 0.59, but Janus particles 0.49 -> 0.18, recorded beads 0.124 ->
0.116.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from flowrec.core import Appearance, Floats, Floats32, Image, Ints
from flowrec.stages.vision.foreground import (
    WINDOW,
    correlation,
    energy_map,
    most_similar,
    patch_at,
    peaks,
    reduced_foreground,
    register_view,
    silhouette_centroid,
)
from flowrec.stages.vision.walls import Box, Walls

SIGNS = {"dark": -1, "bright": 1, "mixed": 0}
BLUR_PX = 1.0  # an image is larger than the object by about this much
LEAST_RADIUS_PX = 3.2  # of an image: less holds too few pixels
VIEWS = 8  # at most
_UPDATE_NS = 100_000_000  # least time between two updates of a known look
_STEP_RADIUS_PX = 6.0  # least radius in the reduced image
CENTROID_RADII = 1.15  # window of the centroid
LEAST_ENERGY = 3.0  # of a candidate, in units of the noise's variance
_NEAR, _ALL = 12, 64  # candidates that are measured near the robot, and in a whole image
ENERGY_SPREAD = 0.7  # of ln(energy / expected energy)
KNOWN_LOOK = 0.8  # correlation from which on a look is one of the views
RECENT_GAIN = 0.2  # of the recent view, energy and spread


@dataclass(frozen=True, slots=True)
class ReducedScale:
    """Sizes in the reduced image of an object of `radius_px` camera pixels."""

    radius_px: float

    @property
    def step(self) -> int:
        """Camera pixels per block."""
        return max(1, int(self.radius_px / _STEP_RADIUS_PX))

    @property
    def radius(self) -> float:
        """Radius in blocks."""
        return self.radius_px / self.step

    @property
    def background(self) -> int:
        """Half width of the background's window in blocks."""
        return math.ceil(WINDOW * self.radius)

    @property
    def apart(self) -> int:
        """Least distance of candidates in blocks."""
        return max(1, round(0.7 * self.radius))

    @property
    def energy(self) -> int:
        """Half width of the energy's window in blocks."""
        return max(1, round(0.35 * self.radius))

    @property
    def margin_px(self) -> int:
        """Around a searched box, so that objects on its border are whole."""
        return math.ceil(2.0 * self.radius_px)

    @property
    def pad_px(self) -> int:
        """Largest margin around a searched box within which pixels are read."""
        return self.margin_px + self.step * (self.background + 3)

    def window(self) -> Floats32:
        """Weights (n, n) of a view's pixels: 1 within the radius, 0 from 1.5 radii on."""
        return _window(self.radius)


def scale_of(radius_px: float) -> ReducedScale:
    """Scale of an object whose own radius is given."""
    return ReducedScale(max(radius_px + BLUR_PX, LEAST_RADIUS_PX))


@lru_cache(maxsize=16)
def _window(radius: float) -> Floats32:
    half = math.ceil(1.5 * radius)
    axis = np.arange(-half, half + 1)
    rho = np.hypot(axis[None], axis[:, None])
    weights = np.clip((1.5 * radius - rho) / (0.5 * radius), 0.0, 1.0).astype(np.float32)
    weights.flags.writeable = False
    return weights


@dataclass(frozen=True, slots=True)
class ForegroundRegion:
    """The foreground of a part of an image, in blocks; block (0, 0) is centred at `x0`, `y0` in camera px."""

    c: Floats32
    x0: float
    y0: float
    scale: ReducedScale

    def to_px(self, blocks: Floats) -> Floats:
        """Points (..., 2) in blocks to camera pixels."""
        return blocks * self.scale.step + np.array([self.x0, self.y0])

    def to_blocks(self, points_px: Floats) -> Floats:
        """Points (..., 2) in camera pixels to blocks."""
        return (points_px - np.array([self.x0, self.y0])) / self.scale.step


@dataclass(frozen=True, slots=True)
class View:
    """An image with the walls in it."""

    image: Image
    walls: Walls
    radius_px: float  # of the robot
    solid_px: float  # distance to the mask's walls (negative: depth in the solid) from which on a pixel may show fluid

    def around(self, box: Box, scale: ReducedScale) -> ForegroundRegion:
        """The foreground of a box and a margin, in which objects on its border are whole."""
        m = scale.margin_px
        return self._region((box[0] - m, box[1] - m, box[2] + m, box[3] + m), scale)

    def whole(self, scale: ReducedScale) -> ForegroundRegion:
        """The foreground of the whole image."""
        height, width = self.image.shape
        return self._region((0, 0, width, height), scale)

    def _region(self, box: Box, scale: ReducedScale) -> ForegroundRegion:
        x0, y0, x1, y1 = box
        step, distance_px = scale.step, self.walls.distance_px
        columns, rows = -(-(x1 - x0) // step), -(-(y1 - y0) // step)
        c = reduced_foreground(self.image, distance_px, x0, y0, columns, rows, step, scale.background, self.solid_px)
        return ForegroundRegion(c, x0 + 0.5 * (step - 1), y0 + 0.5 * (step - 1), scale)


@dataclass(frozen=True, slots=True)
class Candidates:
    """Objects of a region.

    Attributes
    ----------
    blocks, px : (n, 2) centroids in blocks and camera pixels.
    energy : (n,) mean squared foreground in units of the noise's variance.
    view : (n,) most similar view, and `similarity` (n,) its correlation, at `start` (n, 2), in blocks.
    """

    blocks: Floats
    px: Floats
    energy: Floats
    view: Ints
    similarity: Floats
    start: Floats


def candidates(
    view: View, appearance: Appearance, box: Box, least_energy: float, near_px: Floats | None
) -> tuple[ForegroundRegion, Candidates]:
    """The foreground of a box, and the objects centred there in the fluid.

    They are those nearest to a point, or without one those of most energy.
    """
    scale, distance_px = ReducedScale(appearance.radius_px), view.walls.distance_px
    region = view.around(box, scale)
    sign, noise = SIGNS[appearance.polarity], appearance.foreground_noise
    energy = energy_map(region.c, noise, sign, scale.energy)
    found = peaks(energy, max(least_energy, LEAST_ENERGY), scale.apart, 4 * _ALL)
    if near_px is not None:
        distance = np.hypot(*(found[:, :2] - region.to_blocks(near_px)).T)
        found = found[np.argsort(distance, kind="stable")[:_NEAR]]
    window = scale.window()
    height, width = distance_px.shape
    measured: list[tuple[float, float, float, int, float, float, float]] = []
    for column, row, _ in found[:_ALL].tolist():
        x, y, e, _ = silhouette_centroid(region.c, noise, sign, column, row, CENTROID_RADII * scale.radius, 6)
        px, py = (region.x0 + scale.step * x, region.y0 + scale.step * y)
        if not (box[0] - 0.5 <= px < box[2] + 0.5 and box[1] - 0.5 <= py < box[3] + 0.5) or e <= 0.0:
            continue
        i, j = min(max(round(px), 0), width - 1), min(max(round(py), 0), height - 1)
        if distance_px[j, i] < 0.0:
            continue
        if any(math.hypot(x - other[0], y - other[1]) < 0.7 * scale.radius for other in measured):
            continue
        number, similarity, di, dj = most_similar(region.c, x, y, appearance.views, window, 1)
        measured.append((x, y, e, number, similarity, round(x) + di, round(y) + dj))
    table = np.array(measured, np.float64).reshape(-1, 7)
    blocks = table[:, :2]
    numbers = table[:, 3].astype(np.intp)
    return region, Candidates(blocks, region.to_px(blocks), table[:, 2], numbers, table[:, 4], table[:, 5:])


def alone(found: Candidates, energy: float, least_score: float) -> int | None:
    """The candidate of a whole image that is the robot; None if none is like it, or two are."""
    if not len(found.energy):
        return None
    changed = np.log(found.energy / max(energy, 1e-6)) / ENERGY_SPREAD
    score = found.similarity * np.exp(-0.125 * changed**2)
    order = np.argsort(-score, kind="stable")
    best = int(order[0])
    if score[best] < least_score or (len(order) > 1 and score[order[1]] > score[best] - 0.1):
        return None
    return best


def locate_robot(
    region: ForegroundRegion, found: Candidates, which: int, appearance: Appearance
) -> tuple[Floats, float]:
    """Position (2,) of a candidate in blocks, and its similarity."""
    window, view = region.scale.window(), appearance.views[found.view[which]]
    centroid, similarity = found.blocks[which], float(found.similarity[which])
    start_x, start_y = found.start[which].tolist()
    x, y, correlated = register_view(region.c, start_x, start_y, view, window, 1.5)
    half = view.shape[0] // 2
    ax, ay, _, _ = centroid_of(view, appearance, 6)
    registration = np.array([x + ax - half, y + ay - half])
    # A registration with another look of an object that is not round slides along it.
    round_share = min(max((correlation(view, np.ascontiguousarray(view.T[::-1]), window) - 0.6) / 0.3, 0.0), 1.0)
    weight = round_share * min(max((correlated - 0.7) / 0.2, 0.0), 1.0)
    if math.dist(registration, centroid) > 0.7 * region.scale.radius:
        weight = 0.0
    return weight * registration + (1.0 - weight) * centroid, max(similarity, correlated)


def centroid_of(view: Floats32, appearance: Appearance, moves: int) -> tuple[float, float, float, float]:
    """The `silhouette_centroid` of a view, which follows it from the middle of the view on."""
    middle, radius = float(view.shape[0] // 2), ReducedScale(appearance.radius_px).radius
    sign, noise = SIGNS[appearance.polarity], appearance.foreground_noise
    return silhouette_centroid(view, noise, sign, middle, middle, CENTROID_RADII * radius, moves)


def updated_look(
    region: ForegroundRegion, place: Floats, appearance: Appearance, similarity: float, isolated: bool, stamp_ns: int
) -> Appearance:
    """The appearance with the present look in it; itself if it stays."""
    views, half = appearance.views, appearance.views.shape[1] // 2
    known = similarity >= KNOWN_LOOK
    if (not isolated and similarity < 0.9) or (known and stamp_ns - appearance.stamp_ns < _UPDATE_NS):
        return appearance
    x, y = place.tolist()
    patch = patch_at(region.c, x, y, half)
    if len(views) == 1:
        views = np.stack([views[0], patch])
    elif known:
        recent = views[1] + np.float32(RECENT_GAIN) * (patch - views[1])
        views = np.concatenate([views[:1], recent[None], views[2:]])
    else:
        older = views[1:] if len(views) < VIEWS else np.concatenate([views[1:2], views[3:]])
        views = np.concatenate([views[:1], patch[None], older])
    return replace(appearance, stamp_ns=stamp_ns, views=views)
