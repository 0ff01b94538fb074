"""Synthetic movies of robots that are no dark discs, with known centres; they share no formula with the tracker.

Objects are drawn on a grid finer than the pixels, blurred, and photographed by a camera with shot noise, an offset and
a number of bits.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import cv2
import numpy as np

from flowrec.core import Floats, Image, pixel_type

_FINE = 4  # samples per pixel side


@dataclass(frozen=True, slots=True)
class RobotMovie:
    """Images (uint8 up to 8 bits, else uint16), true centres (n, 2) in px, and what a user knows."""

    images: list[Image]
    centres_px: Floats
    radius_px: float
    bits: int = 8
    box: bool = False  # elongated: marked by a box, not by a click

    @property
    def box_px(self) -> tuple[float, float, float, float]:
        """Box around the robot on the first image."""
        x, y = self.centres_px[0].tolist()
        return x - self.radius_px, y - self.radius_px, x + self.radius_px, y + self.radius_px


@dataclass(frozen=True, slots=True)
class Exposure:
    """Light and camera. Levels are in units of 8-bit grey levels, which `gain` and `bits` turn into counts.

    `fade` is the part of the contrast that is lost by the end, `vignette` the part of the light lost in the corners.
    """

    contrast: float = 60.0
    level: float = 120.0
    bits: int = 8
    gain: float = 1.0
    electrons: float = 20.0  # per grey level
    read_noise: float = 1.0
    fade: float = 0.0
    vignette: float = 0.0


Drawing = Callable[[Floats, Floats, int], Floats]


def movie(
    draw: Drawing,
    path: Floats,
    radius_px: float,
    exposure: Exposure,
    *,
    size: tuple[int, int] = (160, 200),
    blur_px: float = 0.9,
    neighbours: Floats | None = None,
    box: bool = False,
    seed: int = 0,
) -> RobotMovie:
    """A robot drawn by `draw(dx, dy, frame)` (offsets in px from its centre; about -1 to 1) on its path (n, 2) in px.

    `size` is (rows, columns) of the images; `neighbours` (m, n, 2) are paths of objects that look the same.
    """
    rng = np.random.default_rng(seed)
    rows, columns = size
    x, y = np.meshgrid(np.linspace(-1, 1, columns), np.linspace(-1, 1, rows))
    light = 1.0 - exposure.vignette * 0.5 * (x**2 + y**2)
    images: list[Image] = []
    reach = math.ceil(2.5 * radius_px + 4 * blur_px) + 1
    for frame, centre in enumerate(path):
        scene = np.zeros(size)
        others = [] if neighbours is None else list(neighbours[:, frame])
        for px, py in (centre, *others):
            left, top = round(px) - reach, round(py) - reach
            n = 2 * reach + 1
            axis = (np.arange(n * _FINE) + 0.5) / _FINE - 0.5
            fine = draw(axis[None] + left - px, axis[:, None] + top - py, frame)
            fine = np.asarray(cv2.GaussianBlur(fine, (0, 0), blur_px * _FINE), np.float64)
            patch = fine.reshape(n, _FINE, n, _FINE).mean(axis=(1, 3))
            i0, i1, j0, j1 = max(left, 0), min(left + n, columns), max(top, 0), min(top + n, rows)
            if i0 < i1 and j0 < j1:
                scene[j0:j1, i0:i1] += patch[j0 - top : j1 - top, i0 - left : i1 - left]
        strength = exposure.contrast * (1.0 - exposure.fade * frame / max(len(path) - 1, 1))
        ideal = np.maximum((exposure.level + strength * scene) * light, 0.0)
        grey = rng.poisson(ideal * exposure.electrons) / exposure.electrons
        grey = grey + exposure.read_noise * rng.standard_normal(size)
        counts = np.rint(np.clip(grey * exposure.gain, 0, 2**exposure.bits - 1))
        images.append(counts.astype(pixel_type(exposure.bits)))
    return RobotMovie(images, path, radius_px, exposure.bits, box)


def disc(radius: float) -> Drawing:
    """1 inside."""
    return lambda dx, dy, _frame: (np.hypot(dx, dy) < radius).astype(np.float64)


def spot(sigma: float) -> Drawing:
    """Gaussian, as a bead in fluorescence."""
    return lambda dx, dy, _frame: np.exp(-0.5 * (dx**2 + dy**2) / sigma**2)


def ring(radius: float, focus_per_frame: float = 0.0) -> Drawing:
    """Bright centre, dark ring, faint bright halo, as in phase contrast; the centre fades and widens out of focus."""

    def draw(dx: Floats, dy: Floats, frame: int) -> Floats:
        rho, focus = np.hypot(dx, dy) / radius, focus_per_frame * frame
        centre = (1.0 - 0.6 * focus) * np.exp(-((rho / (0.55 + 0.25 * focus)) ** 2))
        return (
            centre
            - (0.7 + 0.3 * focus) * np.exp(-(((rho - 1.0) / 0.3) ** 2))
            + 0.15 * np.exp(-(((rho - 1.6) / 0.25) ** 2))
        )

    return draw


def janus(radius: float, turn_per_frame: float, bright: float = 0.8) -> Drawing:
    """Half dark, half bright disc that turns in the plane and, slower, out of it."""

    def draw(dx: Floats, dy: Floats, frame: int) -> Floats:
        angle = turn_per_frame * frame
        tilt = 0.8 * math.sin(0.37 * angle)
        across = (dx * math.cos(angle) + dy * math.sin(angle)) / radius
        along = (-dx * math.sin(angle) + dy * math.cos(angle)) / radius
        edge = tilt * np.sqrt(np.clip(1.0 - along**2, 0.0, None))
        return np.where(np.hypot(dx, dy) < radius, np.where(across < edge, -1.0, bright), 0.0)

    return draw


def helix(
    length: float, width: float, pitch: float, roll_per_frame: float, turn_per_frame: float, sign: float = -1.0
) -> Drawing:
    """Projection of a helical filament that rolls about its axis and turns in the plane."""

    def draw(dx: Floats, dy: Floats, frame: int) -> Floats:
        angle, phase = 0.4 + turn_per_frame * frame, roll_per_frame * frame
        along = dx * math.cos(angle) + dy * math.sin(angle)
        across = -dx * math.sin(angle) + dy * math.cos(angle)
        middle = 0.5 * width * np.sin(2 * math.pi * along / pitch + phase)
        # Thickness measured along the normal of the projected centre line.
        slope = math.pi * width / pitch * np.cos(2 * math.pi * along / pitch + phase)
        off = np.abs(across - middle) / np.sqrt(1.0 + slope**2)
        return sign * ((off < 0.22 * width) & (np.abs(along) < 0.5 * length)).astype(np.float64)

    return draw


def wander(
    frames: int, start: tuple[float, float], velocity: tuple[float, float], diffusion_px: float, seed: int = 1
) -> Floats:
    """Path (frames, 2): a drift in px per frame and a random walk; the first point is the start."""
    steps = np.asarray(velocity) + diffusion_px * np.random.default_rng(seed).standard_normal((frames, 2))
    steps[0] = 0.0
    return np.asarray(start, np.float64) + np.cumsum(steps, axis=0)


def _jumps(frames: int, radius_px: float, radii: float) -> Floats:
    path = wander(frames, (60.0, 60.0), (0.3, 0.2), 0.1 * radius_px)
    for frame in range(10, frames, 10):
        path[frame:] += radii * radius_px * np.array([1.0, 0.0] if (frame // 10) % 2 else [-0.6, 0.8])
    return path


def _crossing(frames: int, apart_px: float) -> tuple[Floats, Floats]:
    """The robot passes between and beside objects that look the same, two of which cross its way."""
    rng = np.random.default_rng(5)
    robot = wander(frames, (30.0, 80.0), (2.0, 0.0), 0.25)
    meeting = np.stack([robot[::-1] + np.array([0.0, apart_px]), wander(frames, (130.0, 20.0), (-0.6, 1.8), 0.25, 7)])
    still = np.stack(
        [wander(frames, tuple(at), (0.0, 0.0), 0.4, 20 + n) for n, at in enumerate(rng.uniform(10, 150, (10, 2)))]
    )
    clear = np.array([np.hypot(*(each - robot).T).min() > apart_px for each in still])
    return robot, np.concatenate([meeting, still[clear]])


def judges(frames: int = 60) -> dict[str, Callable[[], RobotMovie]]:
    """Functions that make each movie, by its name."""
    walk = wander(frames, (50.0, 60.0), (1.2, 0.8), 0.6)
    slow = wander(frames, (80.0, 70.0), (0.5, 0.3), 0.3)
    far = wander(min(frames, 30), (150.0, 130.0), (4.0, 1.0), 3.0)
    fast = wander(frames, (20.0, 80.0), (9.0, 0.5), 0.5)
    robot, others = _crossing(frames, 9.0)
    night = Exposure(level=3.0, electrons=4.0, read_noise=0.6)
    wide = (300, 400)
    return {
        "spot, 12 bit": partial(movie, spot(2.0), walk, 4.0, replace(night, contrast=12.0, bits=12, gain=8.0), seed=1),
        "spot, 16 bit": partial(
            movie, spot(2.0), walk, 4.0, replace(night, contrast=100.0, bits=16, gain=150.0), seed=2
        ),
        "spot, faint": partial(movie, spot(2.5), walk, 5.0, Exposure(4.0, level=8.0, electrons=10.0), seed=3),
        "spot, bleaching by 70 %": partial(
            movie, spot(2.0), walk, 4.0, replace(night, contrast=12.0, bits=16, gain=60.0, fade=0.7), seed=4
        ),
        "ring": partial(movie, ring(6.0), walk, 8.0, Exposure(), seed=5),
        "ring, drifting out of focus": partial(movie, ring(6.0, 1.0 / frames), walk, 8.0, Exposure(), seed=6),
        "Janus, 20 degrees a frame": partial(movie, janus(8.0, 0.35), walk, 8.0, Exposure(45.0), seed=7),
        "Janus, 60 degrees a frame": partial(movie, janus(8.0, 1.05), walk, 8.0, Exposure(45.0), seed=8),
        "helix, rolling slowly": partial(
            movie, helix(36, 8, 12, 0.5, 0.01), slow, 19.0, Exposure(50.0), box=True, seed=9
        ),
        "helix, rolling and turning": partial(
            movie, helix(36, 8, 12, 2.0, 0.06), slow, 19.0, Exposure(50.0), box=True, seed=10
        ),
        "helix, bright": partial(
            movie,
            helix(30, 7, 10, 1.3, -0.04, 1.0),
            slow,
            16.0,
            replace(night, contrast=20.0, bits=12, gain=8.0),
            box=True,
            seed=11,
        ),
        "dark disc, vignette": partial(movie, disc(5.0), walk, 5.0, Exposure(-30.0, vignette=0.8), seed=12),
        "radius 1.5 px": partial(movie, disc(1.5), walk, 1.5, Exposure(-60.0), seed=13),
        "radius 1.5 px, bright": partial(movie, disc(1.5), walk, 1.5, Exposure(40.0, level=20.0), seed=14),
        "radius 40 px": partial(movie, disc(40.0), far, 40.0, Exposure(-50.0), size=wide, seed=15),
        "ring of 40 px": partial(movie, ring(30.0), far, 40.0, Exposure(), size=wide, seed=16),
        "jumps of 5 radii": partial(
            movie, spot(2.0), _jumps(frames, 4.0, 5.0), 4.0, Exposure(40.0, level=20.0), seed=17
        ),
        "3 radii a frame": partial(movie, disc(3.0), fast, 3.0, Exposure(-50.0), size=(160, 640), seed=18),
        "crossing neighbours": partial(
            movie, spot(1.5), robot, 3.0, Exposure(60.0, level=30.0), neighbours=others, seed=19
        ),
        "crossing dark neighbours": partial(movie, disc(3.0), robot, 3.0, Exposure(-50.0), neighbours=others, seed=20),
    }
