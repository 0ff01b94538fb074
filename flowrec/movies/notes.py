"""Metadata of a session in the movies that flowrec exports, so that `flowrec import` need not be told.

It is JSON: the description of an MP4 file, and a structured annotation in OME-TIFF.
"""

from __future__ import annotations

import base64
import binascii
import json
import math
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

from flowrec.core import MovieError, parse_toml

_KEY, _VERSION = "flowrec_movie", 1
_MOST_CHARACTERS = 32_000_000  # bounds the memory that a damaged note can take
_LARGEST_NS = 1 << 62


@dataclass(frozen=True, slots=True)
class MovieNotes:
    """Metadata of the session that a movie was exported from.

    Attributes
    ----------
    session, session_key : file name and `Session.key`.
    started : wall time of the start of the run, ISO 8601 with its zone; '' if not known.
    first_stamp_ns : session stamp of the first image. The stamp of an image is this plus its time since the first one.
    um_per_px : size of a pixel of the movie.
    width_px, height_px : size of the camera's image; a movie of even sizes may have one more column and row.
    bits : depth of the camera's pixels.
    grey_low, grey_high : levels of the camera that are black and white in a movie of 8 bits, linear between them.
    drawn : robot, route, flow and a strip with a clock are drawn over the images.
    region : "whole", or "robot" where images are black but for the region that the tracker read.
    settings : TOML of the sections robot, camera and coils of the session, without what the images tell.
    chip_png, chip_toml : the chip; the PNG in base64.
    """

    session: str
    session_key: str
    started: str
    first_stamp_ns: int
    um_per_px: float
    width_px: int
    height_px: int
    bits: int
    grey_low: int
    grey_high: int
    drawn: bool
    region: str
    settings: str
    chip_png: str
    chip_toml: str

    def text(self) -> str:
        """JSON, for the file."""
        return json.dumps({_KEY: _VERSION} | asdict(self))

    @property
    def radius_um(self) -> float | None:
        """Radius of the robot; None: the settings do not state it."""
        try:
            radius = parse_toml(self.settings).get("robot", {}).get("radius_um")
        except (ValueError, RecursionError, AttributeError):
            return None
        return float(radius) if isinstance(radius, (int, float)) and math.isfinite(radius) and radius > 0.0 else None

    def chip_files(self) -> tuple[bytes, str]:
        """PNG and TOML of the chip, see physics/chip/io.py."""
        return base64.b64decode(self.chip_png), self.chip_toml


def notes_in(text: str, path: Path) -> MovieNotes | None:
    """The notes in a text of a movie file; None if flowrec has not written it.

    Raises MovieError: flowrec has written it, and it is damaged, or of a later version.
    """
    if f'"{_KEY}"' not in text[:200] or len(text) > _MOST_CHARACTERS:
        return None
    try:
        tree = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise _damage_error(path, f"no JSON, {error}") from error
    if not isinstance(tree, dict) or _KEY not in tree:
        return None
    if tree[_KEY] != _VERSION:
        raise MovieError(
            f"{path}: its notes are of version {str(tree[_KEY])[:20]}, this flowrec reads {_VERSION}; update flowrec"
        )
    given: dict[str, Any] = {each.name: tree.get(each.name) for each in fields(MovieNotes)}
    wrong = next((name for name, value in given.items() if not _fits(name, value)), None)
    if wrong is not None:
        raise _damage_error(path, f"{wrong} is {str(given[wrong])[:40]!r}")
    notes = MovieNotes(**given)
    try:
        notes.chip_files()
    except (binascii.Error, ValueError) as error:
        raise _damage_error(path, "chip_png is not base64") from error
    return notes


def refuse_drawn(notes: MovieNotes | None, path: Path) -> None:
    """MovieError for images that are not those of the camera."""
    if notes is not None and notes.drawn:
        raise MovieError(
            f"{path}: robot, route and flow are drawn over its images; import what flowrec export makes of the session "
            "with --format mp4_plain or tiff"
        )
    if notes is not None and notes.region != "whole":
        raise MovieError(
            f"{path}: its images are black but for the region around the robot; flowrec replay works on the session "
            f"itself, {notes.session[:80]}"
        )


def _fits(name: str, value: Any) -> bool:
    kind = next(each.type for each in fields(MovieNotes) if each.name == name)
    if kind == "float":
        return isinstance(value, (int, float)) and math.isfinite(value) and 1e-6 < value < 1e6
    if kind == "int":
        return type(value) is int and 0 <= value <= _LARGEST_NS
    return type(value).__name__ == kind


def _damage_error(path: Path, why: str) -> MovieError:
    return MovieError(
        f"{path}: what flowrec wrote into it is damaged ({why}); export it again, or remove its description"
    )
