"""OME-Zarr by zarr: a multiscale image (0.4 and 0.5), also within a bioformats2raw layout; or a plain array."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import zarr
from numpy.typing import NDArray

from flowrec.core import Image, MovieError, refuse_irregular
from flowrec.movies.grey import refuse_other_type
from flowrec.movies.movie import (
    Movie,
    MovieFacts,
    checked_count,
    checked_size,
    nominal_times,
    refuse_missing,
    refuse_series,
    refusing,
    whole_ns,
)
from flowrec.movies.ome import OmeFacts, ome_facts, parse_ome, seconds_per, um_per

_LARGEST_CHUNK_BYTES = 1 << 30
_XML = Path("OME", "METADATA.ome.xml")


class ZarrMovie(Movie):
    """The finest level of a multiscale image. One chunk along time is held at a time."""

    def _open(self) -> MovieFacts:
        path = self.path
        for each in path.rglob("*"):
            if not each.is_dir():
                refuse_irregular(each, MovieError)
        with refusing(f"{path}: is no OME-Zarr that can be read"):
            array, axes, interval_s, um_per_px, ome = _find_array(path)
        long = [n for n in range(array.ndim - 2) if array.shape[n] > 1]
        if array.ndim < 2 or len(long) > 1:
            raise refuse_series(path, zip(axes, array.shape, strict=True))
        along = long[0] if long else None
        height, width = array.shape[-2:]
        checked_size(path, width, height)
        if min(array.chunks) < 1:
            raise MovieError(f"{path}: has chunks of shape {array.chunks}, which hold nothing; its head is damaged")
        chunk_bytes = int(np.prod(array.chunks, dtype=np.float64)) * array.dtype.itemsize
        if chunk_bytes > _LARGEST_CHUNK_BYTES:
            raise MovieError(f"{path}: one of its chunks has {chunk_bytes / 1e9:.1f} GB; write it with smaller ones")
        self._array, self._along = array, along
        self._held: tuple[int, NDArray[Any]] | None = None
        count = checked_count(path, array.shape[along] if along is not None else 1)
        refuse_other_type(path, array.dtype)
        bits = self._depth(8 * array.dtype.itemsize, ome.bits)
        in_time = along is not None and axes[along] == "t"
        if along is not None and not in_time:
            self._assumed.append(f"its images are numbered along {axes[along]}; they are taken as a movie")
        times, text = None, ""
        if ome.times_s is not None and ome.times_s.any():
            times, text = whole_ns(ome.times_s), "OME DeltaT of each image"
        elif in_time and interval_s is not None and interval_s > 0.0:
            times, text = nominal_times(count, interval_s, "the scale of the time axis")
        return MovieFacts(
            reader="ome_zarr",
            library=f"zarr {zarr.__version__}",
            codec=f"zarr {array.metadata.zarr_format}",
            lossy=False,
            width_px=width,
            height_px=height,
            bits=bits,
            frames=count,
            times_ns=times,
            times=text,
            um_per_px=um_per_px,
        )

    def image(self, index: int) -> Image:
        return refuse_missing(self._grey(self._plane(index), index), self.path, index)

    def _plane(self, index: int) -> NDArray[Any]:
        """One image, of the chunk that is held; that is read when it is another one."""
        array, along = self._array, self._along
        step = array.chunks[along] if along is not None else 1
        first = index - index % step
        if self._held is None or self._held[0] != first:
            place: list[Any] = [0] * (array.ndim - 2)
            if along is not None:
                place[along] = slice(first, first + step)
            with refusing(f"{self.path}: image {index} can not be read"):
                block = np.asarray(array[tuple(place)])
            self._held = first, block if along is not None else block[None]
        return self._held[1][index - first]


class _FinestLevel(NamedTuple):
    """An array, and what the metadata beside it say; None: they do not."""

    array: Any
    axes: list[str]
    interval_s: float | None = None
    um_per_px: float | None = None
    ome: OmeFacts = OmeFacts()


def _find_array(path: Path) -> _FinestLevel:
    node = zarr.open(str(path), mode="r")
    if isinstance(node, zarr.Array):
        return _FinestLevel(node, _default_axes(node))
    attributes = _ome_attributes(node)
    if "multiscales" not in attributes and "0" in node and isinstance(node["0"], zarr.Group):
        node = node["0"]  # bioformats2raw
        attributes = _ome_attributes(node)
    if not attributes.get("multiscales"):
        raise MovieError(
            f"{path}: is a group of Zarr without the multiscale image of OME-Zarr; name the image inside it"
        )
    multiscale = attributes["multiscales"][0]
    level = multiscale["datasets"][0]
    array = node[level["path"]]
    stated = [{"name": axis} if isinstance(axis, str) else axis
              for axis in multiscale.get("axes", _default_axes(array))]  # fmt: skip
    axes, units = [axis["name"] for axis in stated], [axis.get("unit") for axis in stated]
    factors = np.ones(array.ndim)
    for each in [*level.get("coordinateTransformations", []), *multiscale.get("coordinateTransformations", [])]:
        if each.get("type") == "scale" and len(each["scale"]) == array.ndim:
            factors = factors * np.asarray(each["scale"], np.float64)
    if len(axes) != array.ndim or axes[-2:] != ["y", "x"]:
        raise MovieError(
            f"{path}: its axes are {', '.join(axes)} where y, x come last in a movie; export it in that order"
        )
    second, um = seconds_per(units[axes.index("t")]) if "t" in axes else None, um_per(units[-1])
    xml = path / _XML
    text = xml.read_text(encoding="utf-8", errors="replace") if xml.is_file() else ""
    return _FinestLevel(
        array,
        axes,
        interval_s=None if second is None else float(factors[axes.index("t")]) * second,
        um_per_px=None if um is None else um * float(factors[-1]),
        ome=ome_facts(parse_ome(text), max(array.shape[:-2], default=1)),
    )


def _ome_attributes(group: Any) -> dict[str, Any]:
    """Attributes of OME-Zarr: under `ome` from version 0.5 on."""
    attributes = dict(group.attrs)
    inner = attributes.get("ome")
    return dict(inner) if isinstance(inner, dict) else attributes


def _default_axes(array: Any) -> list[str]:
    return ["t", "c", "z", "y", "x"][-array.ndim :] if array.ndim != 3 else ["t", "y", "x"]
