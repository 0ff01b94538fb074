"""Images of the calibrations: the one that is looked at, types of arrays, and what several do with an image or a mask.

The image is that of an image file, the median of a movie's images, or that of a session's.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from flowrec.core import PICTURE, Bools, Coverage, Floats, Floats32, Image, Output, UsageError
from flowrec.movies import ReadOptions, median_of, open_movie
from flowrec.rigs import sha256_of
from flowrec.store import open as open_session

Levels = Floats32  # grey levels, or what is computed of them
Mask = Bools
Colours = NDArray[np.uint8]  # (h, w, 3), blue first
ORANGE = (0, 140, 255)  # blue, green, red
_IMAGES = 31  # of a session, for the median
_SHIFT = 4  # bits after the binary point of drawn points


def blur_image(image: Levels, sigma_px: float) -> Levels:
    """An image (h, w) after a Gaussian blur; beyond the border its edge goes on."""
    return np.asarray(cv2.GaussianBlur(image, (0, 0), sigma_px, borderType=cv2.BORDER_REPLICATE), np.float32)


def slopes(image: Levels, *orders: tuple[int, int], scale: float = 1.0) -> list[Levels]:
    """Sobel's derivatives (h, w) of these orders to the right and down."""
    return [
        np.asarray(
            cv2.Sobel(image, cv2.CV_32F, *each, ksize=3, scale=scale, borderType=cv2.BORDER_REPLICATE), np.float32
        )
        for each in orders
    ]


def gradient(image: Levels) -> list[Levels]:
    """Sobel's derivatives (h, w) to the right and down."""
    return slopes(image, (1, 0), (0, 1))


def shrink(image: NDArray[np.float32 | np.uint8], size_px: tuple[int, int]) -> Levels:
    """An image averaged over areas, of a size (width, height)."""
    return np.asarray(cv2.resize(image, size_px, interpolation=cv2.INTER_AREA), np.float32)


def as_points(curves: Iterable[Floats]) -> list[NDArray[np.int32]]:
    """Curves (n, 2) in px as OpenCV draws them, to a sixteenth of a pixel."""
    return [np.rint(curve * 2**_SHIFT).astype(np.int32) for curve in curves]


def draw_curves(
    canvas: NDArray[np.uint8],
    curves: Iterable[Floats],
    width_px: int,
    colour: Sequence[float] = (1,),
    line: int = cv2.LINE_8,
) -> NDArray[np.uint8]:
    """Draw closed curves (n, 2); returns the canvas."""
    cv2.polylines(canvas, as_points(curves), True, colour, width_px, line, _SHIFT)
    return canvas


def fill_curves(canvas: NDArray[np.uint8], curves: Iterable[Floats]) -> None:
    """Fill what an odd number of closed curves (n, 2) is around."""
    cv2.fillPoly(canvas, as_points(curves), 255, cv2.LINE_8, _SHIFT)


def with_curves(picture: Image, curves: Iterable[Floats]) -> tuple[Colours, int]:
    """A picture (h, w, 3), blue first, with closed curves in orange, and the width of their lines in px."""
    grey = picture.astype(np.float32)
    low, high = np.percentile(grey, (0.5, 99.5))
    shown = np.clip(255.0 * (grey - low) / max(float(high - low), 1.0), 0, 255).astype(np.uint8)
    width_px = max(1, round(max(grey.shape) / 800))
    drawn = np.asarray(cv2.cvtColor(shown, cv2.COLOR_GRAY2BGR), np.uint8)
    return draw_curves(drawn, curves, width_px, ORANGE, cv2.LINE_AA), width_px


class SourcePicture(NamedTuple):
    """A picture and where it comes from."""

    image: Image  # (h, w) grey levels
    source: str  # name of the file, and what was made of it
    sha256: str  # of the file
    covered: Coverage  # the images of which it is the median, of all


def read_picture(path: Path, channel: str | None = None) -> SourcePicture:
    """The picture in a file: what does not move, if the file holds many images.

    `channel` chooses red, green, blue or grey of colours. Raises FlowrecError: one line: no such file, none that can be
    read, or colour without a choice.
    """
    if not path.exists():
        raise UsageError(f"{path}: no such picture; it is an image file, a movie, or a session")
    if path.suffix == ".mcap":
        image, covered = _of_session(path)
    else:
        with open_movie(path, options=ReadOptions(channel)) as movie:
            image = movie.median_image()
            covered = Coverage(len(movie.median_indices()), movie.facts.frames, "images")
    source = path.name if covered.total == 1 else f"{path.name}, median of {covered.amount}"
    return SourcePicture(image, source, sha256_of(path), covered)


def png_of(image: Image) -> bytes:
    """An image as a PNG file, grey or BGR; ValueError if it can not be one."""
    done, png = cv2.imencode(".png", image)
    if not done:
        raise ValueError(f"no PNG can have the shape {image.shape}")
    return png.tobytes()


def _of_session(path: Path) -> tuple[Image, Coverage]:
    session = open_session(path)
    times = np.unique(np.linspace(0.0, session.duration_s, _IMAGES))
    frames = (session.at(time_s).frame for time_s in times.tolist())
    images = {frame.index: frame.image for frame in frames if frame is not None and frame.image.size}
    if not images:
        raise UsageError(f"{path}: holds no images; take a session that was recorded with them")
    return median_of(images.values()), Coverage(len(images), session.topics.get("/camera/frame", len(images)), "images")


def write_picture(picture: Image, path: Path) -> Path:
    """Write a picture under a name that no other file has; where it is there already, its path."""
    done, data = cv2.imencode(PICTURE[0], picture)
    assert done, "OpenCV writes PNG"
    number, target = 1, path
    while target.exists():
        if target.is_file() and target.read_bytes() == data.tobytes():
            return target
        number += 1
        target = path.with_stem(f"{path.stem}_{number}")
    with Output(target, PICTURE).new_file() as part:
        part.write_bytes(data.tobytes())
    return target
