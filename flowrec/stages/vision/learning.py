"""The robot's appearance, learned from one image in which its place is known; and the bodies that may be the robot."""

from __future__ import annotations

import math

import numpy as np

from flowrec.core import STD_PER_MAD, Appearance, Floats, Image
from flowrec.stages.vision.foreground import energy_map, patch_at, peaks, silhouette_centroid
from flowrec.stages.vision.learned import (
    CENTROID_RADII,
    ENERGY_SPREAD,
    SIGNS,
    ForegroundRegion,
    View,
    candidates,
    centroid_of,
    scale_of,
)

_QUANTUM = 0.29  # standard deviation of rounding to whole grey levels, 1 / sqrt(12)
_SMOOTHED = 0.375  # noise of a foreground's block relative to that of a block's mean
_CLUTTER = 0.5  # other objects and texture are noise, too: this part of the foreground's usual size
_SAMPLES = 200_000  # pixels from which the noise is taken
_LEAST_ENERGY = 6.0  # of an object, in units of the noise's variance; noise alone has 4 once in 3000 places
_SPOT_ENERGY = 10.0  # the same of a spot that no one has pointed at
_MIDDLE_SHARE = 0.6  # least brightness in the middle of such a spot relative to its greatest
_FOUND_WITHIN = 1.5  # radii of the given point
# Likeness to the robot from which on a body may be it: debris of the simulated worlds reaches 0.49, and of a hundred
# beads of one kind each has more than 0.7.
_LEAST_LIKE = 0.6
_STANDS_OUT = 0.3  # energy of a body relative to that of the strongest one, where nothing is known of the robot
_LEAST_BODY_ENERGY = 20.0  # of such a body, in units of the noise's variance
MOST = 64  # bodies that are told apart
_ONE_SIGNED = 0.9  # share of one polarity in the energy of the core, from which on the object has that polarity


def pixel_noise(image: Image) -> float:
    """Standard deviation of a pixel's noise in grey levels, from mixed second differences, which edges leave small."""
    every = max(1, math.ceil(image.size / _SAMPLES))
    upper, lower = image[:-1:every].astype(np.float32), image[1::every].astype(np.float32)
    differences = np.abs(np.diff(upper[: len(lower)], axis=1) - np.diff(lower, axis=1))
    # Of normal numbers 68.27 % lie within one standard deviation; here it is twice that of a pixel.
    noise = 0.5 * float(np.quantile(differences, 0.6827)) if differences.size else 0.0
    return max(noise, _QUANTUM)


def learn(view: View, stamp_ns: int, at_px: tuple[float, float], polarity: str, what: str) -> Appearance:
    """The appearance of the object near a point, which reaches `view.radius_px` from its centre.

    `polarity` auto finds out whether it is dark, bright or mixed. `what` names the point in the note, which says what
    to do if nothing differs from the background there; `views` is empty then.
    """
    whole, pixel, noise = _foreground(view)
    scale, sign = whole.scale, SIGNS.get(polarity, 0)
    x, y = whole.to_blocks(np.asarray(at_px, np.float64)).tolist()
    found = peaks(energy_map(whole.c, noise, sign, scale.energy), 0.0, scale.apart, 4096)
    distance = np.hypot(found[:, 0] - x, found[:, 1] - y) / scale.radius
    energy = np.where(distance <= _FOUND_WITHIN, found[:, 2] * np.exp(-(distance**2)), 0.0)
    best = int(energy.argmax()) if len(energy) else -1
    size, centre_px, note = scale.window().shape[0], np.asarray(at_px, np.float64), ""
    if best < 0 or energy[best] <= 0.0 or found[best, 2] < _LEAST_ENERGY:
        views = np.zeros((0, size, size), np.float32)
        dark_or_bright = f"{polarity} " if sign else ""
        note = (
            f"nothing {dark_or_bright}differs from the background at {what}: name the robot's centre in pixels of the "
            "image, counted from the upper left pixel, and check robot.radius_um and tracker.polarity"
        )
    else:
        column, row = found[best, :2].tolist()
        x, y, _ = _centroid(whole, noise, sign, column, row, 8)
        if not sign:
            sign = _core_sign(whole, x, y)
            x, y, _ = _centroid(whole, noise, sign, x, y, 8)
        polarity = next(name for name, value in SIGNS.items() if value == sign)
        views, centre_px = patch_at(whole.c, x, y, size // 2)[None], whole.to_px(np.array([x, y]))
    return Appearance(stamp_ns, polarity, pixel, noise, scale.radius_px, centre_px, views, note)


def brightest_spot(view: View, *, outstanding: bool) -> tuple[tuple[float, float], float] | None:
    """Centre and contrast (grey levels) of the bright object of most energy that is brightest in its middle.

    Only its middle must be bright, so it may be a Gaussian spot or have a dark ring. Nothing nearer to a wall than
    `view.solid_px` is looked at, because walls have bright fringes. `outstanding`: no other object, bright or dark, has
    half its energy; else it may be light between dark objects.
    """
    whole, _, noise = _foreground(view)
    scale = whole.scale
    spots: list[tuple[float, float, float, float]] = []
    for column, row, _ in peaks(energy_map(whole.c, noise, 1, scale.energy), _SPOT_ENERGY, scale.apart, 16).tolist():
        x, y, energy = _centroid(whole, noise, 1, column, row, 6)
        patch = patch_at(whole.c, x, y, math.ceil(scale.radius))
        middle, highest = float(patch[len(patch) // 2, len(patch) // 2]), float(patch.max())
        known = any(math.hypot(x - spot[1], y - spot[2]) < scale.radius for spot in spots)
        if middle > _MIDDLE_SHARE * highest and energy > _SPOT_ENERGY and not known:
            spots.append((energy, x, y, middle))
    if not spots:
        return None
    spots.sort(reverse=True)
    energy, x, y, contrast = spots[0]
    if outstanding:
        if len(spots) > 1 and spots[1][0] > 0.5 * energy:
            return None
        for column, row, _ in peaks(energy_map(whole.c, noise, -1, scale.energy), 0.0, scale.apart, 8).tolist():
            dark = _centroid(whole, noise, -1, column, row, 6)[2]
            if dark > 0.5 * energy and math.hypot(column - x, row - y) > 2.0 * scale.radius:
                return None
    px, py = whole.to_px(np.array([x, y])).tolist()
    return (px, py), contrast


def _foreground(view: View) -> tuple[ForegroundRegion, float, float]:
    """The foreground of a whole image, and the noise of a pixel and of the foreground in grey levels."""
    scale, pixel = scale_of(view.radius_px), pixel_noise(view.image)
    whole = view.whole(scale)
    usual = STD_PER_MAD * float(np.median(np.abs(whole.c)))
    return whole, pixel, max(_SMOOTHED * pixel / scale.step, _CLUTTER * usual)


def _centroid(
    region: ForegroundRegion, noise: float, sign: int, x: float, y: float, moves: int
) -> tuple[float, float, float]:
    """The `silhouette_centroid` of an object near a place, in blocks, and its energy."""
    return silhouette_centroid(region.c, noise, sign, x, y, CENTROID_RADII * region.scale.radius, moves)[:3]


def _core_sign(region: ForegroundRegion, x: float, y: float) -> int:
    """The polarity of the inner half of an object: a ring around a bright centre does not make it a mixed one."""
    radius = max(0.5 * region.scale.radius, 1.0)
    half = math.ceil(radius)
    axis = np.arange(-half, half + 1)
    core = patch_at(region.c, x, y, half)[np.hypot(axis[None], axis[:, None]) <= radius]
    bright = float((core[core > 0] ** 2).sum() / max(float((core**2).sum()), 1e-12))
    return 1 if bright > _ONE_SIGNED else -1 if bright < 1.0 - _ONE_SIGNED else 0


def energy_of(appearance: Appearance) -> float:
    """Energy of the first view."""
    return centroid_of(appearance.views[0], appearance, 1)[2]


def box_of(box_px: tuple[float, float, float, float]) -> tuple[tuple[float, float], float]:
    """Centre and radius of a box that a user drew around the robot, in px."""
    x0, y0, x1, y1 = box_px
    return (0.5 * (x0 + x1), 0.5 * (y0 + y1)), 0.5 * max(abs(x1 - x0), abs(y1 - y0))


def bodies_like(view: View, at_px: tuple[float, float], appearance: Appearance) -> Floats:
    """Places (n, 2) in px of the bodies that look like the one at a place, itself included; the most alike first."""
    look = learn(view, 0, at_px, appearance.polarity, "the robot's place")
    if look.note:  # nothing that stands out from the background: nothing else is like it
        return np.array([at_px])
    energy = energy_of(look)
    found = candidates(view, look, view.walls.box, 0.1 * energy, None)[1]
    changed = np.log(np.maximum(found.energy, 1e-6) / energy) / ENERGY_SPREAD
    like = found.similarity * np.exp(-0.125 * changed**2)
    order = [number for number in np.argsort(-like, kind="stable").tolist() if like[number] >= _LEAST_LIKE]
    return found.px[order][:MOST] if order else np.array([at_px])


def bodies_that_stand_out(view: View) -> Floats:
    """Places (n, 2) in px of the bodies that differ most from the background, dark or bright; the strongest first."""
    scale = scale_of(view.radius_px)
    region = view.around(view.walls.box, scale)
    noise = max(pixel_noise(view.image) / scale.step, 1e-6)
    found = peaks(energy_map(region.c, noise, 0, scale.apart), _LEAST_BODY_ENERGY, scale.apart, 4 * MOST)
    kept: list[tuple[float, float, float]] = []
    height, width = view.walls.distance_px.shape
    for column, row, energy in found.tolist():
        x, y = region.to_px(np.array([column, row])).tolist()
        inside = 0.0 <= x <= width - 1.0 and 0.0 <= y <= height - 1.0
        if not inside or view.walls.distance_px[round(y), round(x)] < 0.0:
            continue
        if all(np.hypot(x - other[0], y - other[1]) > 1.5 * scale.radius_px for other in kept):
            kept.append((x, y, energy))
    strongest = max((energy for *_, energy in kept), default=0.0)
    return np.array([(x, y) for x, y, energy in kept if energy >= _STANDS_OUT * strongest]).reshape(-1, 2)[:MOST]
