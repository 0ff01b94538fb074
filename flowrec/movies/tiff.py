"""TIFF stacks by tifffile: plain pages, OME (also over several files), ImageJ, BigTIFF."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any
from xml.etree.ElementTree import Element

import numpy as np
import tifffile
from numpy.typing import NDArray

from flowrec.core import Image, Ints, MovieError
from flowrec.movies.grey import refuse_other_type
from flowrec.movies.movie import (
    Movie,
    MovieFacts,
    checked_count,
    checked_size,
    colours_last,
    nominal_times,
    refuse_series,
    refusing,
    whole_ns,
)
from flowrec.movies.notes import notes_in, refuse_drawn
from flowrec.movies.ome import OmeFacts, annotation_in, declared_planes, ome_facts, parse_ome, um_per

_LOSSY = ("JPEG", "JPEG_LOSSY", "OJPEG", "WEBP", "JPEGXR", "JPEGXL", "JPEG2000", "JETRAW")
_MINISWHITE, _PALETTE = 0, 3  # values of the tag PhotometricInterpretation in TIFF 6.0


class TiffMovie(Movie):
    """A stack of images. One page is decoded at a time."""

    def _open(self) -> MovieFacts:
        unreadable = refusing(f"{self.path}: is no TIFF that can be read", "; the file is damaged or cut short")
        with unreadable, _collect_errors() as complaints:
            self._file = self._opened.enter_context(tifffile.TiffFile(self.path))
            ome = parse_ome(self._file.ome_metadata or "" if self._file.is_ome else "")
            checked_count(self.path, declared_planes(ome))  # before tifffile makes a list of all that the text declares
            self._pages = self._pages_of(self._file)
            facts = self._facts(ome)
        if complaints:
            found = len(self._pages)
            self.broken_off(found, f"is damaged or breaks off, {found} images are there ({complaints[0]})")
        return facts

    def _pages_of(self, file: tifffile.TiffFile) -> list[Any]:
        """The pages of the movie in order; of those that are not there, None. Or frames of contiguous pixels."""
        series = file.series
        if not series:
            raise MovieError(f"{self.path}: holds no image")
        if len(series) > 1:
            sizes = list(
                dict.fromkeys(f"{each.sizes.get('width', 0)} x {each.sizes.get('height', 0)}" for each in series)
            )
            what = f"images of different sizes ({', '.join(sizes[:3])})" if len(sizes) > 1 else f"{len(series)} series"
            raise MovieError(f"{self.path}: holds {what}; a movie has one: export it alone")
        first = series[0]
        checked_size(self.path, first.keyframe.imagewidth, first.keyframe.imagelength)
        axes = first.axes.removesuffix("S")
        long = {
            axis: length for axis, length in zip(axes, first.shape, strict=False) if length > 1 and axis not in "YX"
        }
        if len(long) > 1:
            raise refuse_series(self.path, long.items())
        return self._whole_pages(first, next(iter(long.values()), 1))

    def _whole_pages(self, series: Any, count: int) -> list[Any]:
        pages = list(series.pages)
        if len(pages) == 1 < count and series.dataoffset is not None:  # ImageJ: one page, then nothing but pixels
            shape, dtype = (count, *series.keyframe.shape), series.keyframe.dtype.newbyteorder(self._file.byteorder)
            there = (self.path.stat().st_size - series.dataoffset) // (series.keyframe.size * dtype.itemsize)
            self._check_whole(there, count)
            return list(np.memmap(self.path, dtype, "r", series.dataoffset, (min(there, count), *shape[1:])))
        there = next((n for n, page in enumerate(pages) if page is None), len(pages))
        self._check_whole(there, count)
        return pages[: min(there, count)]

    def _check_whole(self, there: int, count: int) -> None:
        if there < count:
            self.broken_off(there, f"breaks off: its header promises {count} images, {there} are there")

    def _facts(self, xml: Element) -> MovieFacts:
        file, page, count = self._file, self._file.series[0].keyframe, len(self._pages)
        refuse_other_type(self.path, page.dtype)
        notes = notes_in(annotation_in(xml), self.path)
        refuse_drawn(notes, self.path)
        ome = ome_facts(xml, count)
        imagej: dict[str, Any] = dict(file.imagej_metadata or {})
        micromanager: dict[str, Any] = dict(file.micromanager_metadata or {}) if file.is_micromanager else {}
        stated = ome.bits or _whole(micromanager.get("Summary", {}).get("BitDepth"))
        kept = page.bitspersample
        bits = self._depth(kept, stated) if kept == 16 else self._depth(kept)
        if int(page.photometric) == _PALETTE:
            raise MovieError(f"{self.path}: its pixels are numbers of colours (a palette); export grey levels")
        if int(page.photometric) == _MINISWHITE:
            self._assumed.append("it declares 0 as white; grey levels are used as they are stored")
        axis = file.series[0].axes[:1]
        if axis == "Z" and count > 1:
            self._assumed.append("its images are numbered as planes of depth (Z); they are taken as a movie")
        times, text = _times(ome, imagej, count)
        compression = page.compression.name if hasattr(page.compression, "name") else str(page.compression)
        return MovieFacts(
            reader="tiff",
            library=f"tifffile {tifffile.__version__}",
            codec="" if compression == "NONE" else compression.lower(),
            lossy=compression in _LOSSY,
            width_px=page.imagewidth,
            height_px=page.imagelength,
            bits=bits,
            frames=count,
            times_ns=times,
            times=text,
            um_per_px=ome.um_per_px if ome.um_per_px is not None else _imagej_um_per_px(page, imagej),
            notes=notes,
        )

    def image(self, index: int) -> Image:
        page = self._pages[index]
        with refusing(f"{self.path}: image {index} can not be decoded"):
            array = np.asarray(page) if isinstance(page, np.ndarray) else _decode(page)
        return self._grey(colours_last(array, (3, 4)), index)


def _decode(page: Any) -> NDArray[Any]:
    """The pixels of a page; tifffile has closed the other files of an OME series."""
    file = page.parent.filehandle
    was_closed = file.closed
    if was_closed:
        file.open()
    try:
        return np.asarray(page.asarray())
    finally:
        if was_closed:
            file.close()


@contextmanager
def _collect_errors() -> Iterator[list[str]]:
    """Collect the errors that tifffile logs: it goes on with the pages that it has found."""
    complaints: list[str] = []
    handler = logging.Handler(logging.ERROR)
    handler.emit = lambda record: complaints.append(record.getMessage().rpartition("> ")[2])  # type: ignore[method-assign]
    tifffile.logger().addHandler(handler)
    try:
        yield complaints
    finally:
        tifffile.logger().removeHandler(handler)


def _times(ome: OmeFacts, imagej: dict[str, Any], count: int) -> tuple[Ints | None, str]:
    """Times of the images, and where they come from."""
    if ome.times_s is not None and (count == 1 or ome.times_s.any()):  # some writers leave all of them 0
        return whole_ns(ome.times_s), "OME DeltaT of each image"
    interval_s, text = ome.interval_s, "OME TimeIncrement"
    if not interval_s:
        interval_s, text = imagej.get("finterval"), "the interval that ImageJ states"
    if not isinstance(interval_s, (int, float)) or not interval_s > 0.0:
        return None, ""
    return nominal_times(count, float(interval_s), text)


def _imagej_um_per_px(page: Any, imagej: dict[str, Any]) -> float | None:
    factor, tag = um_per(str(imagej.get("unit", "")).replace("\\u00B5", "µ")), page.tags.get("XResolution")
    if factor is None or tag is None:
        return None
    pixels, units = tag.value
    return factor * units / pixels if pixels else None


def _whole(number: Any) -> int | None:
    return int(number) if isinstance(number, (int, float)) and 1 <= number <= 16 else None
