"""A folder of images by OpenCV, in natural order of their names: img_2 before img_10. Or a single image."""

from __future__ import annotations

import re
import warnings
from pathlib import Path

import cv2
import numpy as np
from PIL import Image as Header
from PIL import UnidentifiedImageError

from flowrec.core import Image, MovieError
from flowrec.movies.grey import grey_image
from flowrec.movies.movie import MOST_PIXELS, Movie, MovieFacts, checked_size

SUFFIXES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp", ".pgm", ".ppm")
_DIGITS = re.compile(r"(\d+)")
_LOSSY = ("JPEG", "MPO")


class FolderMovie(Movie):
    """Images of one size and kind. Headers are read by Pillow before OpenCV decodes anything."""

    def _open(self) -> MovieFacts:
        path = self.path
        self._files = [path] if path.is_file() else images_in(path)
        if not self._files:
            kinds = ", ".join(suffix.lstrip(".") for suffix in SUFFIXES)
            raise MovieError(f"{path}: no image is in this folder; images are {kinds}")
        width, height, kind = _header(self._files[0])
        kept = 16 if _decode(self._files[0]).dtype == np.uint16 else 8
        bits = self._depth(kept, who="images do not say how many of their")
        left = sum(1 for each in path.iterdir() if each.is_file()) - len(self._files) if path.is_dir() else 0
        if left:
            self._assumed.append(f"{left} other files in the folder are no images by their names")
        return MovieFacts(
            reader="folder",
            library=f"OpenCV {cv2.__version__}",
            codec=kind.lower(),
            lossy=kind in _LOSSY,
            width_px=width,
            height_px=height,
            bits=bits,
            frames=len(self._files),
        )

    def image(self, index: int) -> Image:
        file, facts = self._files[index], self.facts
        width, height, _ = _header(file)
        if (width, height) != (facts.width_px, facts.height_px):
            raise MovieError(
                f"{file}: has {width} x {height} pixels, {self._files[0].name} {facts.width_px} x {facts.height_px}; "
                "images of a movie have one size: move the others to a folder of their own"
            )
        array = _decode(file)
        if array.ndim == 3:
            array = array[..., [2, 1, 0, *range(3, array.shape[2])]]  # OpenCV puts blue first
        return grey_image(array, self.options.channel, facts.bits, file, index)

    def broken_off(self, read: int, why: str, error: Exception | None = None) -> None:
        if not self.options.partial and error is not None:  # names the file, which tells more than the number
            raise MovieError(
                f"{error}; or --partial takes the {read} images before it" if read else str(error)
            ) from error
        super().broken_off(read, why, error)


def _header(file: Path) -> tuple[int, int, str]:
    """Width, height and format, from the first bytes."""
    try:
        with warnings.catch_warnings(action="ignore", category=Header.DecompressionBombWarning), file.open("rb") as f:
            header = Header.open(f)
            if getattr(header, "n_frames", 1) > 1:
                raise MovieError(f"{file}: holds several images; a stack is imported by its own name, not as a folder")
            return *checked_size(file, *header.size), header.format or ""
    except Header.DecompressionBombError as error:
        raise MovieError(f"{file}: more than {MOST_PIXELS / 1e6:g} million pixels; crop or bin the images") from error
    except (UnidentifiedImageError, OSError, ValueError, SyntaxError) as error:
        raise MovieError(
            f"{file}: is no image that can be read; it is damaged, or another file by that name"
        ) from error


def images_in(folder: Path) -> list[Path]:
    """The images of a folder, by their suffix, in natural order."""
    files = [each for each in folder.iterdir() if each.suffix.lower() in SUFFIXES and not each.name.startswith(".")]
    return sorted((each for each in files if each.is_file()), key=lambda each: natural(each.name))


def natural(name: str) -> tuple[list[tuple[int, int, str]], str]:
    """Key of the natural order: runs of digits are compared as numbers, however long they are."""
    parts = [part for part in _DIGITS.split(name.casefold()) if part]
    return [(0, int(part), "") if part.isdecimal() and len(part) < 4000 else (1, 0, part) for part in parts], name


def _decode(file: Path) -> np.ndarray:
    data = np.fromfile(file, np.uint8)  # OpenCV itself does not open every name
    array = cv2.imdecode(data, cv2.IMREAD_UNCHANGED) if data.size else None
    if array is None:
        raise MovieError(f"{file}: can not be decoded; the file is damaged or cut short")
    return array
