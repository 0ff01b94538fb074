"""The robot's appearance, learned from one image in which its place is known."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from flowrec.core import Appearance, Image
from flowrec.stages.vision.foreground import energy_map, patch_at, peaks, silhouette_centroid
from flowrec.stages.vision.learned import SIGNS, ForegroundRegion, ReducedScale, region_of, scale_of

_QUANTUM = 0.29  # standard deviation of rounding to whole grey levels, 1 / sqrt(12)
_STD_OF_MEDIAN = 1.4826  # standard deviation over the median of the absolute value, of normal numbers
_WINDOW_RADII = 1.15  # radius of the window of a centroid, in radii of the object
_SMOOTHED = 0.375  # noise of a foreground's block relative to that of a block's mean
_CLUTTER = 0.5  # other objects and texture are noise, too: this part of the foreground's usual size
_SAMPLES = 200_000  # pixels from which the noise is taken
_LEAST_ENERGY = 6.0  # of an object, in units of the noise's variance; noise alone has 4 once in 3000 places
_SPOT_ENERGY = 10.0  # the same of a spot that no one has pointed at
_MIDDLE_SHARE = 0.6  # least brightness in the middle of such a spot relative to its greatest
_FOUND_WITHIN = 1.5  # radii of the given point
_ONE_SIGNED = 0.9  # share of one polarity in the energy of the core, from which on the object has that polarity


def pixel_noise(image: Image) -> float:
    """Standard deviation of a pixel's noise in grey levels, from mixed second differences, which edges leave small."""
    every = max(1, math.ceil(image.size / _SAMPLES))
    upper, lower = image[:-1:every].astype(np.float32), image[1::every].astype(np.float32)
    differences = np.abs(np.diff(upper[: len(lower)], axis=1) - np.diff(lower, axis=1))
    # Of normal numbers 68.27 % lie within one standard deviation; here it is twice that of a pixel.
    noise = 0.5 * float(np.quantile(differences, 0.6827)) if differences.size else 0.0
    return max(noise, _QUANTUM)


def learn(
    image: Image,
    distance_px: NDArray[np.float32],
    stamp_ns: int,
    at_px: tuple[float, float],
    radius_px: float,
    polarity: str,
    solid_px: float,
    what: str,
) -> Appearance:
    """The appearance of the object near a point, which reaches `radius_px` from its centre.

    `polarity` auto finds out whether it is dark, bright or mixed. `what` names the point in the note, which says what
    to do if nothing differs from the background there; `views` is empty then.
    """
    height, width = image.shape
    scale = scale_of(radius_px)
    whole = region_of(image, distance_px, (0, 0, width, height), scale, solid_px)
    pixel = pixel_noise(image)
    usual = _STD_OF_MEDIAN * float(np.median(np.abs(whole.c)))
    noise = max(_SMOOTHED * pixel / scale.step, _CLUTTER * usual)
    sign = SIGNS.get(polarity, 0)
    x, y = whole.to_blocks(np.asarray(at_px, np.float64)).tolist()
    found = peaks(energy_map(whole.c, noise, sign, scale.energy), 0.0, scale.apart, 4096)
    distance = np.hypot(found[:, 0] - x, found[:, 1] - y) / scale.radius
    energy = np.where(distance <= _FOUND_WITHIN, found[:, 2] * np.exp(-(distance**2)), 0.0)
    best = int(energy.argmax()) if len(energy) else -1
    if best < 0 or energy[best] <= 0.0 or found[best, 2] < _LEAST_ENERGY:
        dark_or_bright = f"{polarity} " if sign else ""
        note = (
            f"nothing {dark_or_bright}differs from the background at {what}: name the robot's centre in pixels of the "
            "image, counted from the upper left pixel, and check robot.radius_um and tracker.polarity"
        )
        return _appearance(stamp_ns, polarity, pixel, noise, scale, np.asarray(at_px), None, note)
    column, row = found[best, :2].tolist()
    x, y, _, _ = silhouette_centroid(whole.c, noise, sign, column, row, _WINDOW_RADII * scale.radius, 8)
    if not sign:
        sign = _core_sign(whole, x, y)
        x, y, _, _ = silhouette_centroid(whole.c, noise, sign, x, y, _WINDOW_RADII * scale.radius, 8)
    name = next(name for name, value in SIGNS.items() if value == sign)
    view = patch_at(whole.c, x, y, scale.window().shape[0] // 2)
    return _appearance(stamp_ns, name, pixel, noise, scale, whole.to_px(np.array([x, y])), view, "")


def brightest_spot(
    image: Image, distance_px: NDArray[np.float32], radius_px: float, clear_px: float, *, outstanding: bool
) -> tuple[tuple[float, float], float] | None:
    """Centre and contrast (grey levels) of the bright object of most energy that is brightest in its middle.

    Only its middle must be bright, so it may be a Gaussian spot or have a dark ring. Nothing nearer to a wall than
    `clear_px` is looked at, because walls have bright fringes. `outstanding`: no other object, bright or dark, has half
    its energy; else it may be light between dark objects.
    """
    scale = scale_of(radius_px)
    height, width = image.shape
    whole = region_of(image, distance_px, (0, 0, width, height), scale, clear_px)
    usual = _STD_OF_MEDIAN * float(np.median(np.abs(whole.c)))
    noise = max(_SMOOTHED * pixel_noise(image) / scale.step, _CLUTTER * usual)
    spots: list[tuple[float, float, float, float]] = []
    for column, row, _ in peaks(energy_map(whole.c, noise, 1, scale.energy), _SPOT_ENERGY, scale.apart, 16).tolist():
        x, y, energy, _ = silhouette_centroid(whole.c, noise, 1, column, row, _WINDOW_RADII * scale.radius, 6)
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
            dark = silhouette_centroid(whole.c, noise, -1, column, row, _WINDOW_RADII * scale.radius, 6)[2]
            if dark > 0.5 * energy and math.hypot(column - x, row - y) > 2.0 * scale.radius:
                return None
    px, py = whole.to_px(np.array([x, y])).tolist()
    return (px, py), contrast


def _core_sign(region: ForegroundRegion, x: float, y: float) -> int:
    """The polarity of the inner half of an object: a ring around a bright centre does not make it a mixed one."""
    radius = max(0.5 * region.scale.radius, 1.0)
    half = math.ceil(radius)
    axis = np.arange(-half, half + 1)
    core = patch_at(region.c, x, y, half)[np.hypot(axis[None], axis[:, None]) <= radius]
    bright = float((core[core > 0] ** 2).sum() / max(float((core**2).sum()), 1e-12))
    return 1 if bright > _ONE_SIGNED else -1 if bright < 1.0 - _ONE_SIGNED else 0


def _appearance(
    stamp_ns: int,
    polarity: str,
    pixel: float,
    noise: float,
    scale: ReducedScale,
    centre_px: NDArray[np.float64],
    view: NDArray[np.float32] | None,
    note: str,
) -> Appearance:
    size = scale.window().shape[0]
    views = np.zeros((0, size, size), np.float32) if view is None else view[None]
    return Appearance(stamp_ns, polarity, pixel, noise, scale.radius_px, centre_px, views, note)


def energy_of(appearance: Appearance) -> float:
    """Energy of the first view."""
    half = appearance.views.shape[1] // 2
    sign, radius = SIGNS[appearance.polarity], _WINDOW_RADII * ReducedScale(appearance.radius_px).radius
    return silhouette_centroid(
        appearance.views[0], appearance.foreground_noise, sign, float(half), float(half), radius, 1
    )[2]


def box_of(box_px: tuple[float, float, float, float]) -> tuple[tuple[float, float], float]:
    """Centre and radius of a box that a user drew around the robot, in px."""
    x0, y0, x1, y1 = box_px
    return (0.5 * (x0 + x1), 0.5 * (y0 + y1)), 0.5 * max(abs(x1 - x0), abs(y1 - y0))
