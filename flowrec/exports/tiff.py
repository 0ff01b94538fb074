"""The format tiff: the camera's images without loss as OME-TIFF, for Fiji, napari, QuPath and tifffile.

DeltaT of each plane is its session stamp in s, AcquisitionDate the start of the run, PhysicalSizeX and Y the size of a
pixel, SignificantBits the depth of the camera. A file that may become larger than 4 GB is a BigTIFF. Pages are
compressed by Deflate with differences of neighbours, which every reader knows.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import tifffile

from flowrec.core import Image, SessionError, seconds
from flowrec.exports.camera_images import GreyScale, first_frame, image_stamps, notes_of, title_of, with_images
from flowrec.exports.formats import TimeProgress
from flowrec.movies import NAMESPACE, MovieNotes
from flowrec.store import Session

_BIG_BYTES = 3_900_000_000  # of pixels; a plain TIFF holds 4 GiB, of which headers and the text need some
_LEVEL = 3  # of Deflate


class TiffExport:
    """Implements flowrec.exports.formats.Exporter. Memory grows with the number of images by some 300 bytes each."""

    suffixes = (".ome.tif", ".tif", ".tiff", ".btf")
    folder = False
    advice = "open it with Fiji (Bio-Formats), napari or tifffile:"

    def write(self, session: Session, part: Path, progress: TimeProgress) -> None:
        first = first_frame(session)
        stamps = image_stamps(session)
        height, width = first.image.shape
        notes = notes_of(session, first, GreyScale(first.bits, 0, (1 << first.bits) - 1))
        with tifffile.TiffWriter(part, bigtiff=first.image.nbytes * len(stamps) > _BIG_BYTES, ome=True) as file:
            file.write(
                _images(session, stamps, progress),
                shape=(len(stamps), height, width),
                dtype=first.image.dtype,
                photometric="minisblack",
                compression="adobe_deflate",
                compressionargs={"level": _LEVEL},
                predictor=True,
                rowsperstrip=height,
                metadata=_metadata(session, notes, stamps),
                resolution=(1e4 / notes.um_per_px, 1e4 / notes.um_per_px),
                resolutionunit="CENTIMETER",
                software=f"flowrec {session.provenance.get('flowrec', '')}".strip(),
            )


def _images(session: Session, stamps: list[int], progress: TimeProgress) -> Iterator[Image]:
    """The images that the file was made for, one after another."""
    number = 0
    for _, frame in with_images(session, progress):
        if number == len(stamps) or frame.stamp_ns != stamps[number]:
            break
        yield frame.image
        number += 1
    if number != len(stamps):
        raise SessionError(
            f"{session.path}: its index names {len(stamps)} images, {number} are there; flowrec check says more"
        )


def _metadata(session: Session, notes: MovieNotes, stamps: list[int]) -> dict[str, Any]:
    """OME-XML as tifffile takes it."""
    facts: dict[str, Any] = {
        "axes": "TYX",
        "Name": title_of(session),
        "Description": f"flowrec session {notes.session_key}; DeltaT is the time on the session clock",
        "SignificantBits": notes.bits,
        "PhysicalSizeX": notes.um_per_px,
        "PhysicalSizeXUnit": "µm",
        "PhysicalSizeY": notes.um_per_px,
        "PhysicalSizeYUnit": "µm",
        "Plane": {"DeltaT": [seconds(stamp) for stamp in stamps], "DeltaTUnit": ["s"] * len(stamps)},
        "CommentAnnotation": {"Namespace": NAMESPACE, "Value": notes.text()},
    }
    return facts | ({"AcquisitionDate": notes.started} if notes.started else {})
