"""Pictures of a chip that our own microscope did not render: dyes, lines, shades, real textures, dust.

The channel's outline is drawn at four times the mask's resolution and warped into the image; nothing here uses the
distance to the walls, in which flowrec thinks.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from flowrec.physics import Calibration

Picture = NDArray[np.float32]
_FINER = 4


@dataclass(frozen=True)
class Look:
    """How channel and walls appear. Grey levels are relative to the background's 1."""

    channel: float = 0.0  # added inside of the channel
    line: float = 0.0  # added on the walls
    line_um: float = 20.0  # width of the line on the walls
    fringe: float = 0.0  # added on a second line beside the first, in the channel
    shade: float = 0.0  # relief, lit from the left
    blur_px: float = 1.0
    noise: float = 0.02
    vignette: float = 0.0  # light lost in the corners
    tilt: float = 0.0  # light that grows from the left to the right
    debris: int = 0
    robot: bool = False
    bits: int = 8


LOOKS = {
    "dark lines": Look(line=-0.4),
    "thin bright lines": Look(line=0.5, line_um=12.0, noise=0.04),
    "thick dark lines": Look(line=-0.3, line_um=60.0, debris=20),
    "phase edges": Look(line=-0.35, line_um=15.0, fringe=0.25, debris=30, robot=True),
    "dye": Look(channel=1.5, blur_px=2.5, vignette=0.4),
    "ink": Look(channel=-0.5, blur_px=1.5, tilt=0.6),
    "faint dye": Look(channel=0.12, noise=0.08, tilt=0.3),
    "relief": Look(shade=0.4, line=-0.1, noise=0.03),
    "uneven": Look(line=-0.3, channel=0.08, vignette=0.8, tilt=0.5, debris=15, bits=12),
    "out of focus": Look(line=-0.5, blur_px=5.0, noise=0.03),
    "noisy": Look(line=-0.3, channel=-0.1, noise=0.2),
    "dirty": Look(line=-0.3, debris=150, robot=True, noise=0.04),
}


def picture(
    mask: NDArray[np.bool_],
    um_per_px: float,
    camera: Calibration,
    size_px: tuple[int, int],
    look: Look,
    rng: np.random.Generator,
    texture: Picture | None = None,
    texture_contrast: float = 0.1,
) -> NDArray[np.uint8 | np.uint16]:
    """The picture of a chip that a camera takes.

    Parameters
    ----------
    mask, um_per_px : the chip; beyond its border the channels go straight on.
    camera : how the chip truly lies in the image of `size_px` (width, height).
    texture : any image, laid under the chip, with this contrast (one standard deviation).
    """
    width, height = size_px
    pad = max(mask.shape) // 2
    share = cv2.resize(
        np.pad(mask, pad, mode="edge").astype(np.float32), None, fx=_FINER, fy=_FINER, interpolation=cv2.INTER_CUBIC
    )
    inside = (cv2.GaussianBlur(share, (0, 0), 0.8 * _FINER) > 0.5).astype(np.uint8)
    fine_um = um_per_px / _FINER
    wide = 2 * round(0.5 * look.line_um / fine_um) + 1  # odd: a line whose middle is the wall
    drawn = look.channel * inside.astype(np.float32)
    # What a look does not have is not computed: on the fine raster each of these takes a quarter of a second.
    if look.line:
        drawn += np.float32(look.line) * _outline(inside, wide)
    if look.fringe:
        inner = cv2.erode(inside, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * wide + 1,) * 2))
        drawn += np.float32(look.fringe) * _outline(inner, wide)
    if look.shade:
        soft = cv2.GaussianBlur(inside.astype(np.float32), (0, 0), max(wide, 2))
        relief = cv2.Sobel(soft, cv2.CV_32F, 1, 0, ksize=3)
        drawn += np.float32(look.shade) * relief / max(float(np.abs(relief).max()), 1e-6)
    # Averaged to the camera's pixels, then warped: image pixel -> um -> fine pixel.
    drawn = cv2.GaussianBlur(drawn, (0, 0), max(0.35 * camera.um_per_px / fine_um, 0.3))
    matrix = camera.matrix / fine_um
    matrix[:, 2] += _FINER * pad + (_FINER - 1) / 2
    seen = cv2.warpAffine(
        drawn, matrix, (width, height), flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP, borderMode=cv2.BORDER_REPLICATE
    )
    scene = 1.0 + seen
    if texture is not None:
        scale = max(width / texture.shape[1], height / texture.shape[0])
        laid = cv2.resize(texture.astype(np.float32), None, fx=scale, fy=scale)[:height, :width]
        scene *= 1.0 + texture_contrast * (laid - laid.mean()) / max(float(laid.std()), 1e-6)
    for _ in range(look.debris):
        centre = tuple(int(v) for v in rng.uniform((0, 0), (16 * width, 16 * height)))
        spot = np.zeros((height, width), np.float32)
        cv2.circle(spot, centre, int(16 * rng.uniform(1.0, 0.012 * width)), 1.0, -1, cv2.LINE_AA, 4)
        scene += np.float32(rng.uniform(-0.35, 0.2)) * spot
    if look.robot:
        spot = np.zeros((height, width), np.float32)
        x, y = rng.uniform(0.3, 0.6, 2) * width
        cv2.circle(spot, (int(x), int(y)), round(width / 80), 1.0, -1, cv2.LINE_AA)
        scene = scene * (1.0 - 0.8 * spot)
    scene = cv2.GaussianBlur(scene, (0, 0), look.blur_px)
    x, y = np.meshgrid(np.linspace(-1, 1, width, dtype=np.float32), np.linspace(-1, 1, height, dtype=np.float32))
    scene *= (1.0 - 0.5 * look.vignette * (x * x + y * y)) * (1.0 + 0.5 * look.tilt * x)
    scene += look.noise * rng.standard_normal(scene.shape).astype(np.float32)
    low, high = np.percentile(scene, (0.2, 99.8))
    top = 2**look.bits - 1
    levels = np.clip((0.1 + 0.8 * (scene - low) / max(high - low, 1e-6)) * top, 0, top)
    return np.rint(levels).astype(np.uint8 if look.bits <= 8 else np.uint16)


def _outline(inside: NDArray[np.uint8], wide_px: int) -> NDArray[np.uint8]:
    """A line (h, w) of this width on the border of what is inside."""
    return cv2.morphologyEx(inside, cv2.MORPH_GRADIENT, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (wide_px,) * 2))
