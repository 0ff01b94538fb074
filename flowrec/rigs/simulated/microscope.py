"""Simulated bright-field images of the chip: walls as dark refracting lines, particles as defocused discs.

The optics `disc` draw a particle with the profile that the tracker fits. `oblique` is another one: light from one side,
so that the rim is bright there and dark on the other side, a softer outline, and a bright spot in the middle where the
particle acts as a lens.

Noise: shot noise is Gaussian of variance level / photons_per_level, with read noise added. Its normal numbers are
not drawn again: each row of an image takes a stretch, at a place drawn from the seed, of one pool of a million
numbers of 1/32 sigma resolution. So single pixels are independent of their neighbours and of the next frame, but the
whole film holds no more than a million different values. Same seed and frames, same bytes; wall time has no part in it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np
import scipy  # its special loads at first use, not at start-up
from numpy.typing import NDArray

from flowrec.core import Bools, Floats, Floats32, Image, Ints, compiled, pixel_type
from flowrec.physics import Calibration, clearance_um
from flowrec.stages import CameraSettings, Optics, SimulatedImage

_POOL = 1 << 20  # normal numbers drawn once; an image takes its noise from them at random offsets
_NOISE_STEPS = 32.0  # of the pool's int8, to one sigma


@compiled
def _draw(scene: Floats32, discs: Floats, lit_x: float, lit_y: float) -> Ints:
    """Multiply the light of n defocused discs into the scene; returns the touched windows (n, 4), x0, y0, x1, y1.

    `discs` (n, 7), lengths in pixels: column, row, radius, softness `edge` of its outline, outside of which is a bright
    rim and a faint dark ring, darkness, and the way `smear` in columns and rows that it goes during the exposure. `lit`
    is the direction from which oblique light comes (0: from above).
    """
    windows = np.empty((len(discs), 4), np.int64)
    for n in range(len(discs)):
        column, row, radius, edge, darkness = discs[n, 0], discs[n, 1], discs[n, 2], discs[n, 3], discs[n, 4]
        found = _draw_one(scene, column, row, radius, edge, darkness, discs[n, 5], discs[n, 6], lit_x, lit_y)
        windows[n, 0], windows[n, 1], windows[n, 2], windows[n, 3] = found
    return windows


@compiled
def _draw_one(
    scene: Floats32,
    column: float,
    row: float,
    radius: float,
    edge: float,
    darkness: float,
    smear_x: float,
    smear_y: float,
    lit_x: float,
    lit_y: float,
) -> tuple[int, int, int, int]:
    height, width = scene.shape
    rim = 0.35 * darkness
    reach = radius + 9.0 * edge + 0.5 * max(abs(smear_x), abs(smear_y))
    x0, x1 = max(math.floor(column - reach), 0), min(math.ceil(column + reach) + 1, width)
    y0, y1 = max(math.floor(row - reach), 0), min(math.ceil(row + reach) + 1, height)
    length = math.hypot(smear_x, smear_y)
    copies = 1 + min(8, int(length / 0.35))
    for y in range(y0, y1):
        for x in range(x0, x1):
            light = 0.0
            for n in range(copies):
                share = (n + 0.5) / copies - 0.5
                r = math.hypot(x - column - share * smear_x, y - row - share * smear_y)
                s = (r - radius) / edge
                inside = 1.0 / (1.0 + math.exp(min(2.2 * s, 40.0)))
                bright = math.exp(-(((s - 2.0) / 1.1) ** 2))
                ring = math.exp(-(((s - 4.8) / 1.4) ** 2))
                core = 0.86 + 0.14 * min(r / radius, 1.0) ** 2
                if lit_x == 0.0 and lit_y == 0.0:
                    light += 1.0 - darkness * core * inside + rim * bright - 0.25 * rim * ring
                else:
                    to_x, to_y = x - column - share * smear_x, y - row - share * smear_y
                    facing = (lit_x * to_x + lit_y * to_y) / max(r, 1e-6)
                    soft = 1.0 / (1.0 + math.exp(min(1.6 * s, 40.0)))
                    core = 0.9 - 0.3 * math.exp(-((r / (0.35 * radius)) ** 2)) - 0.1 * facing * min(r / radius, 1.0)
                    light += 1.0 - darkness * core * soft + rim * bright * (0.6 + 0.5 * facing)
            scene[y, x] *= np.float32(light / copies)
    return x0, y0, x1, y1


@compiled
def _expose(
    scene: Floats32,
    pool: NDArray[np.int8],
    offsets: Ints,
    shot: float,
    read: float,
    top: int,
    image: Image,
) -> None:
    """Add the noise to grey levels (h, w) of 8 bit and digitise, with `top` as the highest level."""
    height, width = scene.shape
    per_level = np.float32(shot / (_NOISE_STEPS * _NOISE_STEPS))
    fixed = np.float32(read * read / (_NOISE_STEPS * _NOISE_STEPS))
    half, low, high = np.float32(0.5), np.float32(0.0), np.float32(top)
    scale = np.float32((top + 1) // 256)
    for y in range(height):
        noise = pool[offsets[y] : offsets[y] + width]
        line = scene[y]
        out = image[y]
        for x in range(width):
            level = line[x]
            grey = level + np.float32(math.sqrt(level * per_level + fixed)) * np.float32(noise[x])
            out[x] = min(max(grey * scale + half, low), high)


class DrawnRobot(NamedTuple):
    """A robot in an image."""

    position_um: Floats  # (2,)
    radius_um: float
    velocity_um_s: Floats = np.zeros(2)  # (2,)
    darkness: float = 0.8  # from 0 to 1: this is that of the robot of the mission


class Particles(NamedTuple):
    """Particles in an image, n of them."""

    points_um: Floats  # (n, 2)
    radii_um: Floats  # (n,)
    darkness: Floats  # (n,) from 0 to 1


NO_PARTICLES = Particles(np.zeros((0, 2)), np.zeros(0), np.zeros(0))


class Microscope:
    """Renders frames.

    Parameters
    ----------
    mask, um_per_px : (h, w) True in fluid, and the size of its pixels.
    optics : see above; the direction of oblique light is drawn from the seed.
    mask_origin_um : where the centre of the mask's first pixel lies, on either axis of the chip frame.
    """

    def __init__(
        self,
        mask: Bools,
        um_per_px: float,
        calibration: Calibration,
        camera: CameraSettings,
        image: SimulatedImage,
        seed: int,
        optics: Optics = "disc",
        mask_origin_um: float = 0.0,
    ) -> None:
        rng = np.random.default_rng([seed, 3])
        lit_rad = float(np.random.default_rng([seed, 8]).uniform(0.0, 2.0 * math.pi))
        self._lit = (0.0, 0.0) if optics == "disc" else (math.cos(lit_rad), math.sin(lit_rad))
        self._camera, self._image = camera, image
        self._calibration = calibration
        self._noise = np.random.default_rng([seed, 4])
        self._pool = np.clip(np.rint(self._noise.standard_normal(_POOL) * _NOISE_STEPS), -127, 127).astype(np.int8)
        self._empty = _empty_scene(mask, um_per_px, calibration, camera.shape, image, rng, mask_origin_um)
        self._scene = self._empty.copy()

    def add_still(self, point_um: Floats, radius_um: float, darkness: float) -> None:
        """Put a particle that never moves into the background."""
        still = self._discs(point_um[None], np.array([radius_um]), np.array([darkness]), np.zeros((1, 2)))
        _draw(self._empty, still, *self._lit)
        self._scene[:] = self._empty

    def image(
        self, robots: Sequence[DrawnRobot], particles: Particles = NO_PARTICLES, stage_um: Floats | None = None
    ) -> Image:
        """One frame (h, w): the robots over the particles, at the middle of the exposure.

        `stage_um` (2,) is how far the stage, and all that is on it, has moved; None: not at all. Where two lie over
        each other the light is that through both.
        """
        off_um = np.zeros(2)
        if stage_um is not None:
            off_um, shift = stage_um, self._calibration.vectors_to_px(stage_um)
            move = np.column_stack((np.eye(2), shift))
            size = self._scene.shape[::-1]
            cv2.warpAffine(self._empty, move, size, dst=self._scene, borderMode=cv2.BORDER_REPLICATE)
        points_um = np.vstack((particles.points_um, *(each.position_um for each in robots))) + off_um
        radii_um = np.append(particles.radii_um, [each.radius_um for each in robots])
        darkness = np.append(particles.darkness, [each.darkness for each in robots])
        velocity_um_s = np.vstack((np.zeros_like(particles.points_um), *(each.velocity_um_s for each in robots)))
        discs = self._discs(points_um, radii_um, darkness, velocity_um_s * self._camera.exposure_s)
        windows = _draw(self._scene, discs, *self._lit).tolist()
        height, width = self._scene.shape
        camera = self._camera
        image = np.empty((height, width), pixel_type(camera.bits))
        offsets = self._noise.integers(0, _POOL - width, height)
        shot, top = 1.0 / self._image.photons_per_level, 2**camera.bits - 1
        _expose(self._scene, self._pool, offsets, shot, self._image.read_noise, top, image)
        for x0, y0, x1, y1 in windows:
            self._scene[y0:y1, x0:x1] = self._empty[y0:y1, x0:x1]
        return image

    def _discs(self, points_um: Floats, radii_um: Floats, darkness: Floats, smear_um: Floats) -> Floats:
        """The rows (n, 7) that `_draw` takes."""
        to_px, blur_px = self._calibration.vectors_to_px, max(self._image.blur_px, 0.3)
        radii_px = radii_um / self._calibration.um_per_px
        edges_px = [math.hypot(blur_px, 0.05 * each) for each in radii_px.tolist()]
        return np.column_stack((self._calibration.to_px(points_um), radii_px, edges_px, darkness, to_px(smear_um)))


def _empty_scene(
    mask: Bools,
    um_per_px: float,
    calibration: Calibration,
    shape: tuple[int, int],
    settings: SimulatedImage,
    rng: np.random.Generator,
    mask_origin_um: float,
) -> Floats32:
    """Grey levels (h, w) = `shape` of the chip without particles."""
    height, width = shape
    pixels = np.stack(np.meshgrid(np.arange(width), np.arange(height)), -1)
    places = (calibration.to_um(pixels) - mask_origin_um) / um_per_px
    map_x, map_y = np.moveaxis(places.astype(np.float32), -1, 0)
    outline = outline_px(mask) * np.float32(um_per_px)
    distance = cv2.remap(outline, map_x, map_y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)

    # The milled edge refracts: a dark line with a bright fringe towards the fluid, a fainter pair behind it.
    # Narrower on fine masks, whose outline is only known within three pixels.
    line = max(min(9.0, 0.45 * um_per_px), 1.1 * calibration.um_per_px)
    s = distance / line

    def stripe(at: float, half_width: float) -> Floats32:
        return np.asarray(np.exp(-(((s - at) / half_width) ** 2)), np.float32)

    solid = 1.0 / (1.0 + np.exp(np.clip(4.0 * (s + 0.5), -40, 40)))
    light = 1.0 - 0.11 * solid
    light += -0.52 * stripe(-0.4, 0.75) + 0.15 * stripe(1.3, 0.7) - 0.04 * stripe(2.7, 0.8)
    light += -0.16 * stripe(-3.2, 0.7) + 0.08 * stripe(-4.6, 0.8)
    # Machined and glued plastic: blotches of several sizes, much fainter in the channel.
    texture = np.zeros((height, width), np.float32)
    for size_um, share in ((12.0, 0.4), (40.0, 0.8), (160.0, 1.0)):
        texture += share * blotches(rng, height, width, size_um / calibration.um_per_px)
    light *= 1.0 + texture * (0.004 + 0.014 * solid)

    x = np.linspace(-1.0, 1.0, width, dtype=np.float32)[None]
    y = np.linspace(-1.0, 1.0, height, dtype=np.float32)[:, None]
    cx, cy, tilt = rng.uniform(-0.2, 0.2), rng.uniform(-0.2, 0.2), rng.uniform(0, 2 * math.pi)
    lamp = 1.0 - 0.5 * settings.illumination * ((x - cx) ** 2 + (y - cy) ** 2)
    lamp += 0.25 * settings.illumination * (x * math.cos(tilt) + y * math.sin(tilt))
    scene = np.asarray(settings.background * light * lamp, np.float32)
    if settings.blur_px > 0:
        blurred = cv2.GaussianBlur(scene, (0, 0), settings.blur_px, borderType=cv2.BORDER_REPLICATE)
        scene = np.asarray(blurred, np.float32)
    return np.ascontiguousarray(np.clip(scene, 0.0, 255.0), np.float32)


def outline_px(mask: Bools) -> Floats32:
    """Signed distance (h, w) in pixels to a smooth outline behind the pixels of a mask, true within three pixels of it.

    The half level of the blurred mask, as in the solver's smooth walls: a blurred straight edge is a Gaussian
    integral, whose inverse is the distance. Farther away only the sign matters here.
    """
    sigma, pad = 1.0, 8
    padded = np.pad(mask, pad, mode="edge").astype(np.float64)
    share = cv2.GaussianBlur(padded, (0, 0), sigma, borderType=cv2.BORDER_REPLICATE)[pad:-pad, pad:-pad]
    near = sigma * scipy.special.ndtri(np.clip(share, 1e-6, 1.0 - 1e-6))
    far = clearance_um(mask, 1.0)
    weight = np.clip(np.abs(far) - 2.0, 0.0, 1.0)
    return np.asarray((1.0 - weight) * near + weight * far, np.float32)


def blotches(rng: np.random.Generator, height: int, width: int, size_px: float) -> Floats32:
    """Smooth noise (h, w) of unit variance and a given size of its spots."""
    step = max(size_px / 2.0, 1.0)
    shape = (math.ceil(height / step) + 4, math.ceil(width / step) + 4)
    coarse = cv2.GaussianBlur(rng.standard_normal(shape).astype(np.float32), (0, 0), 1.0)
    fine = cv2.resize(coarse, (math.ceil(shape[1] * step), math.ceil(shape[0] * step)), interpolation=cv2.INTER_CUBIC)
    cut = fine[:height, :width]
    return np.asarray(cut / max(float(cut.std()), 1e-6), np.float32)
