"""The export format zarr: images and flow fields in chunks, for xarray, napari and Dask.

The images are the array `frames` of the root group, dimensions time, y_px, x_px, with the places of their pixels on the
chip as x_um and y_um, by the calibration as stated. Each flow field, the last one of its kind, is a group with the
dimensions y_um, x_um, component. `xarray.open_zarr(folder)` opens the images, with `group="refined"` a field.
Format 2 of Zarr, which every reader takes, and which has texts, as the names of the components, and consolidated
metadata; format 3 specifies neither yet. https://zarr-specs.readthedocs.io/en/latest/v2/v2.0.html
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numcodecs
import numpy as np
import zarr

from flowrec.core import SessionError, seconds
from flowrec.exports.formats import TimeProgress
from flowrec.store import Session, columns_of

_CHUNK_BYTES = 8 << 20
_FORMAT = 2  # of Zarr, which older readers have too
_LEVEL = 1  # of zstd: camera noise does not become smaller with more
_DIMENSIONS = "_ARRAY_DIMENSIONS"  # where xarray looks for the names of the dimensions
_EPOCH = "nanoseconds since 1970-01-01T00:00:00"


class ZarrExport:
    """Implements flowrec.exports.formats.Exporter."""

    suffixes = (".zarr",)
    folder = True
    advice = "open it with xarray.open_zarr:"

    def write(self, session: Session, part: Path, progress: TimeProgress) -> None:
        fields, frames = session.fields, session.frames
        if not fields and not len(frames):
            raise SessionError(f"{session.path}: holds neither images nor a flow field, which is what zarr takes")
        root = zarr.create_group(part, zarr_format=_FORMAT)
        root.attrs.update(
            {
                "session": session.path.name,
                "provenance": dict(session.provenance),
                "description": "images of the camera; the groups hold flow fields in the chip frame, y down",
            }
        )
        if len(frames):
            _write_frames(root, session, progress)
        for name, field in fields.items():
            field.to_xarray().to_zarr(part, group=name, zarr_format=_FORMAT, consolidated=False)
        zarr.consolidate_metadata(part, zarr_format=_FORMAT)


def _write_frames(root: zarr.Group, session: Session, progress: TimeProgress) -> None:
    frames, start_unix_ns = session.frames, session.header.taken_unix_ns
    stamps_ns = frames.stamps_ns
    coordinates: dict[str, tuple[Sequence[str], Any, dict[str, Any]]] = {
        column.name: (["time"], values, {"description": column.meaning, "units": column.unit, "long_name": name})
        for column, values, name in zip(
            columns_of("frame")[:2], (stamps_ns, stamps_ns / 1e9), ("stamp", "time"), strict=True
        )
    }
    if start_unix_ns:
        coordinates["time"] = ["time"], stamps_ns + start_unix_ns, {"units": _EPOCH, "calendar": "proleptic_gregorian"}
    numbers = np.empty(len(frames), np.int64)
    first = frames[0].image
    per_chunk = max(1, min(_CHUNK_BYTES // max(first.nbytes, 1), len(frames)))
    array = root.create_array(
        "frames",
        shape=(len(frames), *first.shape),
        chunks=(per_chunk, *first.shape),
        dtype=first.dtype,
        compressors=numcodecs.Zstd(level=_LEVEL),
        fill_value=None,  # xarray reads a fill value as NaN, and 0 is a grey level
    )
    array.attrs.update(
        {_DIMENSIONS: ["time", "y_px", "x_px"], "long_name": "grey level", "bits": session.reader.frame_bits}
    )
    block = np.empty((per_chunk, *first.shape), first.dtype)
    # zarr writes in threads of its own, which an interruption does not end: this one is left when they have.
    with ThreadPoolExecutor(1) as writing:
        for number, frame in enumerate(frames):
            if frame.image.shape != first.shape:
                raise SessionError(
                    f"{session.path}: frame {frame.index} has the shape {frame.image.shape}, not {first.shape}"
                )
            numbers[number], place = frame.index, number % per_chunk
            block[place] = frame.image
            if place == per_chunk - 1 or number == len(frames) - 1:
                chunk = slice(number - place, number + 1)
                writing.submit(array.__setitem__, chunk, block[: place + 1]).result()
                progress(seconds(frame.stamp_ns - session.run.first_ns))
    described = {"description": "of the camera; a gap is images that it did not deliver"}
    coordinates["frame_index"] = ["time"], numbers, described
    pixels = np.arange(first.shape[1]), np.arange(first.shape[0])
    places_um = session.calibration.to_um(np.stack(np.meshgrid(*pixels), -1)).astype(np.float32)
    for number, axis in enumerate("xy"):
        coordinates[f"{axis}_px"] = [f"{axis}_px"], pixels[number], {"units": "px", "long_name": axis}
        meaning = {"units": "um", "long_name": axis, "description": f"centre of the pixel, {axis} in the chip frame"}
        coordinates[f"{axis}_um"] = ["y_px", "x_px"], places_um[..., number], meaning
    for name, (dimensions, values, attributes) in coordinates.items():
        made = root.create_array(name, shape=values.shape, dtype=values.dtype, fill_value=None)
        made[...] = values
        made.attrs.update({_DIMENSIONS: list(dimensions)} | attributes)
    named = {"time", "x_px", "y_px"}  # as their dimensions
    root["frames"].attrs["coordinates"] = " ".join(name for name in coordinates if name not in named)
