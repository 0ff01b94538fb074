"""Nikon ND2 by the library nd2."""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import nd2
import numpy as np
from numpy.typing import NDArray

from flowrec.core import Image, MovieError
from flowrec.movies.grey import grey_image
from flowrec.movies.movie import (
    Movie,
    MovieFacts,
    ReadOptions,
    checked_count,
    checked_size,
    depth_of,
    refuse_missing,
    whole_ns,
)

_S_PER_MS = 1e-3


class NikonMovie(Movie):
    """The images of an ND2 file in the order of their acquisition."""

    def __init__(self, path: Path, options: ReadOptions) -> None:
        super().__init__(path, options)
        with ExitStack() as refused:
            try:
                self._file = refused.enter_context(nd2.ND2File(path))
                self.facts = self._facts(self._file)
            except MovieError:
                raise
            except Exception as error:  # of many kinds, by the version of the format
                raise MovieError(
                    f"{path}: is no ND2 file that can be read ({error}); the file is damaged or cut short"
                ) from error
            refused.pop_all()

    def close(self) -> None:
        self._file.close()

    def _facts(self, file: Any) -> MovieFacts:
        sizes = dict(file.sizes)
        width, height = checked_size(self.path, sizes.get("X", 0), sizes.get("Y", 0))
        long = {axis: length for axis, length in sizes.items() if axis not in "YXS" and length > 1}
        if len(long) > 1 or "C" in long:
            named = ", ".join(f"{axis} {length}" for axis, length in long.items())
            raise MovieError(
                f"{self.path}: has more than one series of images ({named}); export one channel and one plane"
            )
        attributes = file.attributes
        count = checked_count(self.path, math.prod(long.values()) if long else int(attributes.sequenceCount))
        times = _times_s(file, count)
        stated = attributes.bitsPerComponentSignificant
        lossy = (attributes.compressionType or "").lower() == "lossy"
        return MovieFacts(
            reader="nd2",
            library=f"nd2 {nd2.__version__}",
            codec=f"nd2 {attributes.compressionType or ''}".strip(),
            lossy=lossy,
            width_px=width,
            height_px=height,
            bits=depth_of(stated, self.options.bits),
            frames=count,
            times_ns=None if times is None else whole_ns(times),
            times="" if times is None else "acquisition times of ND2",
            um_per_px=float(file.voxel_size().x) or None,
            remarks=tuple(self._unusual(long)),
        )

    def _unusual(self, long: dict[str, int]) -> Iterator[str]:
        if long and "T" not in long:
            yield f"its images are numbered along {next(iter(long))}; they are taken as a movie"

    def image(self, index: int) -> Image:
        try:
            # A copy: what the library returns is memory of the file, which is gone when the file is closed.
            array: NDArray[Any] = np.array(self._file.read_frame(index))
        except Exception as error:  # of many kinds, by the version of the format
            raise MovieError(f"{self.path}: image {index} can not be read ({error})") from error
        if array.ndim == 3 and array.shape[0] in (1, 3) and array.shape[2] not in (1, 3):  # components first
            array = np.moveaxis(array, 0, 2)
        image = grey_image(array, self.options.channel, self.facts.bits, self.path, index)
        return refuse_missing(image, self.path, index)


def _times_s(file: Any, count: int) -> NDArray[np.float64] | None:
    """Acquisition time of each image since the start of the acquisition; None if one is missing."""
    times = []
    with warnings.catch_warnings(action="ignore"):  # it warns of a file without times
        for index in range(count):
            try:
                channels = getattr(file.frame_metadata(index), "channels", None)
            except IndexError:
                return None
            if not channels:
                return None
            times.append(channels[0].time.relativeTimeMs * _S_PER_MS)
    return np.array(times)
