"""Reader of OME-XML: acquisition times of the planes, pixel size, significant bits."""

from __future__ import annotations

import math
from dataclasses import dataclass
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

_S_PER = {"s": 1.0, "ms": 1e-3, "µs": 1e-6, "μs": 1e-6, "us": 1e-6, "ns": 1e-9, "min": 60.0, "h": 3600.0}
_UM_PER = {"µm": 1.0, "μm": 1.0, "um": 1.0, "micron": 1.0, "nm": 1e-3, "mm": 1e3, "cm": 1e4, "m": 1e6}
_LIMIT_CHARACTERS = 1 << 28
NAMESPACE = "flowrec"  # of the annotation in which flowrec keeps movies/notes.py


@dataclass(frozen=True, slots=True, eq=False)
class OmeFacts:
    """None: not stated."""

    times_s: NDArray[np.float64] | None = None  # (n,) DeltaT of each time point
    interval_s: float | None = None  # TimeIncrement
    um_per_px: float | None = None
    bits: int | None = None


def ome_facts(xml: str, frames: int) -> OmeFacts:
    """Read the first image of an OME-XML text; what is damaged there counts as not stated."""
    root = _root(xml)
    pixels = None if root is None else next((each for each in root.iter() if _name(each) == "Pixels"), None)
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


def annotation_in(xml: str) -> str:
    """The text that flowrec put into OME-XML; '' if there is none."""
    root = _root(xml)
    for each in root.iter() if root is not None else ():
        if _name(each) == "CommentAnnotation" and each.get("Namespace") == NAMESPACE:
            return "".join(child.text or "" for child in each)
    return ""


def declared_planes(xml: str) -> int:
    """Number of planes that the images of an OME-XML text declare, whether they exist or not; at least 1."""
    root = _root(xml)
    if root is None:
        return 1
    total = 0
    for pixels in root.iter():
        if _name(pixels) == "Pixels":
            sizes = [_number(pixels.get(f"Size{axis}")) or 1.0 for axis in "TZC"]
            blocks = [_number(block.get("PlaneCount")) or 1.0 for block in pixels if _name(block) == "TiffData"]
            total += int(min(max(math.prod(sizes), sum(blocks)), 1e15))
    return max(total, 1)


def seconds_per(unit: str | None) -> float | None:
    """Length of a unit of time in s, by its short or long name; None: unknown."""
    short = {"second": "s", "millisecond": "ms", "microsecond": "us", "nanosecond": "ns", "minute": "min", "hour": "h"}
    return _S_PER.get(short.get(unit or "", unit or ""))


def um_per(unit: str | None) -> float | None:
    """Length of a unit of length in um, by its short or long name; None: unknown."""
    short = {"micrometer": "um", "nanometer": "nm", "millimeter": "mm", "centimeter": "cm", "meter": "m"}
    return _UM_PER.get(short.get(unit or "", unit or ""))


def _root(xml: str) -> ElementTree.Element | None:
    if len(xml) > _LIMIT_CHARACTERS:
        return None
    try:
        return ElementTree.fromstring(xml.encode())  # noqa: S314  expat bounds the expansion of entities
    except ElementTree.ParseError:
        return None


def _times_s(pixels: ElementTree.Element, frames: int) -> NDArray[np.float64] | None:
    """DeltaT of the first plane of each time point; of the planes in order where they are numbered by Z."""
    planes = [each for each in pixels if _name(each) == "Plane"]
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


def _name(element: ElementTree.Element) -> str:
    return element.tag.rpartition("}")[2]
