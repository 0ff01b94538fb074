"""The picture that a calibration looks at: an image file, the median of a movie's images, or that of a session's."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from flowrec.core import Coverage, Image, UsageError
from flowrec.movies import ReadOptions, median_of, open_movie
from flowrec.rigs import sha256_of
from flowrec.store import open as open_session

_IMAGES = 31  # of a session, for the median


@dataclass(frozen=True, slots=True, eq=False)
class SourcePicture:
    """A picture and where it comes from.

    Attributes
    ----------
    image : (h, w) grey levels.
    source : name of the file, and what was made of it.
    sha256 : of the file.
    covered : the images of which it is the median, of all.
    """

    image: Image
    source: str
    sha256: str
    covered: Coverage


def read_picture(path: Path, channel: str | None = None) -> SourcePicture:
    """The picture in a file: what does not move, if the file holds many images.

    `channel` chooses red, green, blue or grey of colours.

    Raises
    ------
    FlowrecError : one line: no such file, none that can be read, or colour without a choice.
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
