"""Nikon ND2 by the library nd2."""

from __future__ import annotations

import math
import warnings
from typing import Any

import nd2
import numpy as np
from numpy.typing import NDArray

from flowrec.core import Floats, Image
from flowrec.movies.movie import (
    Movie,
    MovieFacts,
    checked_count,
    checked_size,
    colours_last,
    refuse_missing,
    refuse_series,
    refusing,
    whole_ns,
)

_S_PER_MS = 1e-3


class NikonMovie(Movie):
    """The images of an ND2 file in the order of their acquisition."""

    def _open(self) -> MovieFacts:
        with refusing(f"{self.path}: is no ND2 file that can be read", "; the file is damaged or cut short"):
            self._file: Any = self._opened.enter_context(nd2.ND2File(self.path))
            return self._facts(self._file)

    def _facts(self, file: Any) -> MovieFacts:
        sizes = dict(file.sizes)
        width, height = checked_size(self.path, sizes.get("X", 0), sizes.get("Y", 0))
        long = {axis: length for axis, length in sizes.items() if axis not in "YXS" and length > 1}
        if len(long) > 1 or "C" in long:
            raise refuse_series(self.path, long.items())
        attributes = file.attributes
        count = checked_count(self.path, math.prod(long.values()) if long else int(attributes.sequenceCount))
        times = _times_s(file, count)
        if long and "T" not in long:
            self._assumed.append(f"its images are numbered along {next(iter(long))}; they are taken as a movie")
        stated = attributes.bitsPerComponentSignificant
        return MovieFacts(
            reader="nd2",
            library=f"nd2 {nd2.__version__}",
            codec=f"nd2 {attributes.compressionType or ''}".strip(),
            lossy=(attributes.compressionType or "").lower() == "lossy",
            width_px=width,
            height_px=height,
            bits=self._depth(stated, stated),
            frames=count,
            times_ns=None if times is None else whole_ns(times),
            times="" if times is None else "acquisition times of ND2",
            um_per_px=float(file.voxel_size().x) or None,
        )

    def image(self, index: int) -> Image:
        with refusing(f"{self.path}: image {index} can not be read"):
            # A copy: what the library returns is memory of the file, which is gone when the file is closed.
            array: NDArray[Any] = np.array(self._file.read_frame(index))
        return refuse_missing(self._grey(colours_last(array, (1, 3)), index), self.path, index)


def _times_s(file: Any, count: int) -> Floats | None:
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
