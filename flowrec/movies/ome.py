"""Reader of OME-XML: acquisition times of the planes, pixel size, significant bits."""

from __future__ import annotations

import math
from dataclasses import dataclass
from xml.etree import ElementTree

import numpy as np

from flowrec.core import Floats

# Units by their short names, with both letters for micro, and by their long ones.
_S_PER = {"s": 1.0, "ms": 1e-3, "µs": 1e-6, "μs": 1e-6, "us": 1e-6, "ns": 1e-9, "min": 60.0, "h": 3600.0}
_S_PER |= {"second": 1.0, "millisecond": 1e-3, "microsecond": 1e-6, "nanosecond": 1e-9, "minute": 60.0, "hour": 3600.0}
_UM_PER = {"µm": 1.0, "μm": 1.0, "um": 1.0, "micron": 1.0, "nm": 1e-3, "mm": 1e3, "cm": 1e4, "m": 1e6}
_UM_PER |= {"micrometer": 1.0, "nanometer": 1e-3, "millimeter": 1e3, "centimeter": 1e4, "meter": 1e6}
_LIMIT_CHARACTERS = 1 << 28  # bounds the memory that a damaged description can take
NAMESPACE = "flowrec"  # of the annotation in which flowrec keeps movies/notes.py


@dataclass(frozen=True, slots=True, eq=False)
class OmeFacts:
    """None: not stated."""

    times_s: Floats | None = None  # (n,) DeltaT of each time point
    interval_s: float | None = None  # TimeIncrement
    um_per_px: float | None = None
    bits: int | None = None


def parse_ome(xml: str) -> ElementTree.Element:
    """The root of an OME-XML text; one without anything in it where the text is damaged."""
    if len(xml) > _LIMIT_CHARACTERS:
        return ElementTree.Element("")
    try:
        return ElementTree.fromstring(xml.encode())  # noqa: S314  expat bounds the expansion of entities
    except ElementTree.ParseError:
        return ElementTree.Element("")


def ome_facts(root: ElementTree.Element, frames: int) -> OmeFacts:
    """Read the first image of OME-XML; what is damaged there counts as not stated."""
    pixels = root.find(".//{*}Pixels")
    if pixels is None:
        return OmeFacts()
    given = pixels.attrib
    bits = _number(given.get("SignificantBits"))
    return OmeFacts(
        _times_s(pixels, frames),
        _scale(given.get("TimeIncrement"), given.get("TimeIncrementUnit", "s"), _S_PER),
        _scale(given.get("PhysicalSizeX"), given.get("PhysicalSizeXUnit", "µm"), _UM_PER),
        int(bits) if bits is not None and 1 <= bits <= 16 else None,
    )


def annotation_in(root: ElementTree.Element) -> str:
    """The text that flowrec put into OME-XML; '' if there is none."""
    found = root.find(f".//{{*}}CommentAnnotation[@Namespace='{NAMESPACE}']")
    return "" if found is None else "".join(child.text or "" for child in found)


def declared_planes(root: ElementTree.Element) -> int:
    """Number of planes that the images of OME-XML declare, whether they exist or not; at least 1."""
    total = 0
    for pixels in root.iterfind(".//{*}Pixels"):
        sizes = [_number(pixels.get(f"Size{axis}")) or 1.0 for axis in "TZC"]
        blocks = [_number(block.get("PlaneCount")) or 1.0 for block in pixels.iterfind("{*}TiffData")]
        total += int(min(max(math.prod(sizes), sum(blocks)), 1e15))
    return max(total, 1)


def seconds_per(unit: str | None) -> float | None:
    """Length of a unit of time in s, by its short or long name; None: unknown."""
    return _S_PER.get(unit or "")


def um_per(unit: str | None) -> float | None:
    """Length of a unit of length in um, by its short or long name; None: unknown."""
    return _UM_PER.get(unit or "")


def _times_s(pixels: ElementTree.Element, frames: int) -> Floats | None:
    """DeltaT of the first plane of each time point; of the planes in order where they are numbered by Z."""
    planes = pixels.findall("{*}Plane")
    axis = "TheT" if len({each.get("TheT") for each in planes}) > 1 else "TheZ"
    found: dict[int, float] = {}
    for each in planes:
        number, time_s = _number(each.get(axis)), _scale(each.get("DeltaT"), each.get("DeltaTUnit", "s"), _S_PER)
        if number is not None and time_s is not None:
            found.setdefault(int(number), time_s)
    if len(found) < frames or any(number not in found for number in range(frames)):
        return None
    return np.array([found[number] for number in range(frames)])


def _scale(text: str | None, unit: str, factors: dict[str, float]) -> float | None:
    number, factor = _number(text), factors.get(unit)
    return None if number is None or factor is None else number * factor


def _number(text: str | None) -> float | None:
    try:
        number = float(text) if text is not None else np.nan
    except ValueError:
        return None
    return number if np.isfinite(number) else None
