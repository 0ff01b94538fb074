"""A drawn chip with a robot: a channel between walls, as a camera on a shaking stage shows it."""

from __future__ import annotations

import cv2
import numpy as np

from flowrec.core import Frame
from flowrec.physics import Calibration, Chip, Opening, Robot

UM_PER_PX = 4.0
WIDTH, HEIGHT = 200, 150
CALIBRATION = Calibration(UM_PER_PX)
ROBOT = Robot(radius_um=20.0, max_speed_um_s=600.0, step_out_hz=20.0)
_ZOOM = 4  # drawn larger, so that it can be shifted by parts of a pixel


def chip(bend: bool = True) -> Chip:
    """A channel from left to right, with a side arm upwards."""
    mask = np.zeros((HEIGHT, WIDTH), bool)
    mask[60:100] = True
    if bend:
        mask[:80, 120:150] = True
    openings = (Opening("left", 60, 99, "inlet", 100.0), Opening("right", 60, 99, "outlet", 0.0))
    return Chip("drawn", mask, UM_PER_PX, openings, 1.0, 1000.0)


def image(
    on: Chip | None,
    at_px: list[tuple[float, float]],
    shift_px: tuple[float, float] = (0.0, 0.0),
    *,
    gain: float = 1.0,
    bits: int = 8,
    seed: int = 0,
) -> np.ndarray:
    """The walls, dark discs of 5 px, and noise of 1.5 grey levels, all shifted by (columns, rows)."""
    size = WIDTH * _ZOOM, HEIGHT * _ZOOM
    picture = np.full(size[::-1], 170.0, np.float32)
    if on is not None:
        fluid = cv2.resize(on.mask.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST)
        picture[fluid == 0] = 140.0
        edge = cv2.morphologyEx(fluid, cv2.MORPH_GRADIENT, np.ones((2 * _ZOOM, 2 * _ZOOM), np.uint8))
        picture[edge > 0] = 95.0
    for x, y in at_px:
        centre = round((x + 0.5) * _ZOOM), round((y + 0.5) * _ZOOM)
        cv2.circle(picture, centre, 5 * _ZOOM, 30.0, -1, cv2.LINE_AA)
    to = np.array([[1.0, 0.0, _ZOOM * shift_px[0]], [0.0, 1.0, _ZOOM * shift_px[1]]])
    picture = cv2.warpAffine(picture, to, size, borderMode=cv2.BORDER_REPLICATE)
    picture = cv2.GaussianBlur(picture, (0, 0), 1.0 * _ZOOM)
    grey = gain * cv2.resize(picture, (WIDTH, HEIGHT), interpolation=cv2.INTER_AREA)
    grey = grey + np.random.default_rng(seed).normal(0.0, 1.5, grey.shape)
    top = 2**bits - 1
    return np.clip(grey * (top / 255.0), 0, top).round().astype(np.uint8 if bits == 8 else np.uint16)


def frame(number: int, picture: np.ndarray, bits: int = 8) -> Frame:
    return Frame(round(number * 1e9 / 30.0), number, picture, bits)
