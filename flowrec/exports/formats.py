"""The table of the formats that a session can be exported to, and what a row implements."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Protocol

from flowrec.core import Method, Methods
from flowrec.store import Session

TimeProgress = Callable[[float], None]  # takes the session time in s since the first tick

EXPORTS = Methods(
    "--format",
    Method("rrd", "flowrec.exports.rrd:RrdExport", "a recording for Rerun, what flowrec view opens"),
    Method("parquet", "flowrec.exports.tabular:ParquetExport", "a folder with a table a topic", extra="export"),
    Method("csv", "flowrec.exports.tabular:CsvExport", "the same as text, for spreadsheets", extra="export"),
    Method(
        "mp4",
        "flowrec.exports.mp4:Mp4Export",
        "a movie with robot, route, flow, clock and scale bar drawn over the images",
        extra="export",
    ),
    Method(
        "mp4_plain",
        "flowrec.exports.mp4:PlainMp4Export",
        "the camera's images alone, which flowrec import reads",
        extra="export",
    ),
    Method(
        "tiff",
        "flowrec.exports.tiff:TiffExport",
        "OME-TIFF, the camera's images without loss, which flowrec import reads",
        extra="export",
    ),
    Method("zarr", "flowrec.exports.zarr:ZarrExport", "images and flow fields in chunks, for xarray", extra="export"),
    group="flowrec.exports",
    verb="write",
)


class Exporter(Protocol):
    """Interface of a row of EXPORTS."""

    # that the name of the output ends in, the usual one first; of a folder "" allows any name
    suffixes: tuple[str, ...]
    folder: bool  # the output is a folder; else one file
    advice: str  # how to open the output, as words before its name

    def write(self, session: Session, part: Path, progress: TimeProgress) -> None:
        """Write a new file, or fill an empty folder, which gets its name when this returns.

        Raises SessionError: the session has nothing that this format holds, in one line. An OSError without a file
        name, or with one inside `part`, becomes the error "can not be written".

        Parameters
        ----------
        part : the empty file or the empty folder; the suffix of a file is that of the output.
        progress : takes the session time in s since the first tick.
        """
