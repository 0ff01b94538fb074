"""OME-Zarr by zarr: a multiscale image (0.4 and 0.5), also within a bioformats2raw layout; or a plain array."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import zarr
from numpy.typing import NDArray

from flowrec.core import Image, MovieError, refuse_irregular
from flowrec.movies.grey import grey_image, refuse_other_type
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
from flowrec.movies.ome import OmeFacts, ome_facts, seconds_per, um_per

_LARGEST_CHUNK_BYTES = 1 << 30
_XML = Path("OME", "METADATA.ome.xml")


class ZarrMovie(Movie):
    """The finest level of a multiscale image. One chunk along time is held at a time."""

    def __init__(self, path: Path, options: ReadOptions) -> None:
        super().__init__(path, options)
        for each in path.rglob("*"):
            if not each.is_dir():
                refuse_irregular(each, MovieError)
        try:
            self._array, axes, scale, self._ome = _find_array(path)
        except MovieError:
            raise
        except Exception as error:
            raise MovieError(f"{path}: is no OME-Zarr that can be read ({error})") from error
        array = self._array
        long = [n for n in range(array.ndim - 2) if array.shape[n] > 1]
        if array.ndim < 2 or len(long) > 1:
            named = ", ".join(f"{name} {length}" for name, length in zip(axes, array.shape, strict=True))
            raise MovieError(f"{path}: has more than one series of images ({named}); export one channel and one plane")
        self._along = long[0] if long else None
        height, width = array.shape[-2:]
        checked_size(path, width, height)
        if min(array.chunks) < 1:
            raise MovieError(f"{path}: has chunks of shape {array.chunks}, which hold nothing; its head is damaged")
        chunk_bytes = int(np.prod(array.chunks, dtype=np.float64)) * array.dtype.itemsize
        if chunk_bytes > _LARGEST_CHUNK_BYTES:
            raise MovieError(f"{path}: one of its chunks has {chunk_bytes / 1e9:.1f} GB; write it with smaller ones")
        self._held: tuple[int, NDArray[Any]] | None = None
        self.facts = self._facts(axes, scale)

    def _facts(self, axes: list[str], scale: list[tuple[float, str | None]]) -> MovieFacts:
        array, along = self._array, self._along
        count = checked_count(self.path, array.shape[along] if along is not None else 1)
        refuse_other_type(self.path, array.dtype)
        remarks = []
        bits = depth_of(self._ome.bits or 8 * array.dtype.itemsize, self.options.bits)
        if bits == 16 and self._ome.bits is None and self.options.bits is None:
            remarks.append("the file does not say how many of its 16 bits the camera used; 16 are assumed (movie.bits)")
        if along is not None and axes[along] != "t":
            remarks.append(f"its images are numbered along {axes[along]}; they are taken as a movie")
        times, text = None, ""
        factor, unit = scale[along] if along is not None else (0.0, None)
        second = seconds_per(unit)
        if self._ome.times_s is not None and self._ome.times_s.any():
            times, text = whole_ns(self._ome.times_s), "OME DeltaT of each image"
        elif along is not None and axes[along] == "t" and second is not None and factor > 0.0:
            times = whole_ns(np.arange(count, dtype=np.float64) * factor * second)
            text = f"the scale of the time axis, every {1e3 * factor * second:.4g} ms; nominal"
        um = um_per(scale[-1][1])
        return MovieFacts(
            reader="ome_zarr",
            library=f"zarr {zarr.__version__}",
            codec=f"zarr {array.metadata.zarr_format}",
            lossy=False,
            width_px=array.shape[-1],
            height_px=array.shape[-2],
            bits=bits,
            frames=count,
            times_ns=times,
            times=text,
            um_per_px=None if um is None else um * scale[-1][0],
            remarks=tuple(remarks),
        )

    def image(self, index: int) -> Image:
        image = grey_image(self._plane(index), self.options.channel, self.facts.bits, self.path, index)
        return refuse_missing(image, self.path, index)

    def _plane(self, index: int) -> NDArray[Any]:
        """One image, of the chunk that is held; that is read when it is another one."""
        array, along = self._array, self._along
        step = array.chunks[along] if along is not None else 1
        first = index - index % step
        if self._held is None or self._held[0] != first:
            place: list[Any] = [0] * (array.ndim - 2)
            if along is not None:
                place[along] = slice(first, first + step)
            try:
                block = np.asarray(array[tuple(place)])
            except Exception as error:  # of many kinds, by the store and the codec
                raise MovieError(f"{self.path}: image {index} can not be read ({error})") from error
            self._held = first, block if along is not None else block[None]
        plane: NDArray[Any] = self._held[1][index - first]
        return plane


def _find_array(path: Path) -> tuple[Any, list[str], list[tuple[float, str | None]], OmeFacts]:
    """The array, the names of its axes, their scales with units, and what OME-XML beside it says."""
    node = zarr.open(str(path), mode="r")
    if isinstance(node, zarr.Array):
        return node, _default_axes(node), [(0.0, None)] * node.ndim, OmeFacts()
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
    axes = [axis if isinstance(axis, str) else axis["name"] for axis in multiscale.get("axes", _default_axes(array))]
    units = [None if isinstance(axis, str) else axis.get("unit") for axis in multiscale.get("axes", axes)]
    factors = np.ones(array.ndim)
    for each in [*level.get("coordinateTransformations", []), *multiscale.get("coordinateTransformations", [])]:
        if each.get("type") == "scale" and len(each["scale"]) == array.ndim:
            factors = factors * np.asarray(each["scale"], np.float64)
    if len(axes) != array.ndim or axes[-2:] != ["y", "x"]:
        raise MovieError(
            f"{path}: its axes are {', '.join(axes)} where y, x come last in a movie; export it in that order"
        )
    xml = path / _XML
    text = xml.read_text(encoding="utf-8", errors="replace") if xml.is_file() else ""
    count = max((length for length in array.shape[:-2]), default=1)
    scale = [(float(factor), unit) for factor, unit in zip(factors, units, strict=True)]
    return array, axes, scale, ome_facts(text, count) if text else OmeFacts()


def _ome_attributes(group: Any) -> dict[str, Any]:
    """Attributes of OME-Zarr: under `ome` from version 0.5 on."""
    attributes = dict(group.attrs)
    inner = attributes.get("ome")
    return dict(inner) if isinstance(inner, dict) else attributes


def _default_axes(array: Any) -> list[str]:
    return ["t", "c", "z", "y", "x"][-array.ndim :] if array.ndim != 3 else ["t", "y", "x"]
