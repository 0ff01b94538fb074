"""Conversion factors between units, and constants of statistics.

The unit is part of every name (`_um`, `_um_s`, `_pa`). Only the flow solver works in SI; everything else uses um, um/s,
s, rad, Hz, mT, Pa, mPa*s, kg/m3, A.
"""

import math
import re

NS_PER_S = 1_000_000_000
M_PER_UM = 1e-6
MM_PER_UM = 1e-3
UM_PER_M = 1e6
HALF_PX = 0.5  # from the corner of a pixel, where viewers have their origin, to its centre, where flowrec has it
PA_S_PER_MPA_S = 1e-3
# Of the normal distribution, in standard deviations.
Z95 = 1.959964  # half of the interval that holds 95 %
STD_PER_MAD = 1.4826  # standard deviation over the median of the absolute value
TUKEY = 4.685  # residual from which on Tukey's weight is 0: an estimate with 95 % efficiency
# Units on the command line.
_PER = {"s": {"ms": 1e-3, "s": 1.0, "min": 60.0, "h": 3600.0}, "mb": {"kb": 1e-3, "mb": 1.0, "gb": 1e3, "tb": 1e6}}
_AMOUNT = re.compile(r"\s*(\d+(?:\.\d*)?|\.\d+)\s*([a-z]*)\s*", re.IGNORECASE)


def seconds(stamp_ns: int) -> float:
    """A stamp or a difference of stamps in s."""
    return stamp_ns / NS_PER_S


def nanoseconds(time_s: float) -> int:
    """The nearest integer stamp to a time in s."""
    return round(time_s * NS_PER_S)


def wrap_rad(angle_rad: float) -> float:
    """Angle wrapped to (-pi, pi]."""
    return math.pi - (math.pi - angle_rad) % (2.0 * math.pi)


def amounts(text: str) -> dict[str, list[float]]:
    """Times (key `s`, in s) and sizes (key `mb`, in MB) in a text such as `10min`, `2GB` or `30s,10s`.

    Raises ValueError: a part of the text is neither.
    """
    found: dict[str, list[float]] = {kind: [] for kind in _PER}
    for part in text.split(","):
        match = _AMOUNT.fullmatch(part)
        unit = match[2].lower() if match is not None else ""
        kind = next((kind for kind, units in _PER.items() if unit in units), None)
        if match is not None and kind is not None:
            found[kind].append(float(match[1]) * _PER[kind][unit])
        else:
            raise ValueError(f"{part.strip()!r} is neither a time (ms, s, min, h) nor a size (kB, MB, GB, TB)")
    return found


# What the ends of names mean, the longer ones first; a name with none of them is of a pure number or of a text.
_SYMBOLS = {
    "_um_per_px": "um/px",
    "_um_per_rev": "um/rev",
    "_per_px": "1/px",
    "_mt_per_a": "mT/A",
    "_a_per_v": "A/V",
    "_v_per_v": "1",
    "_kg_m3": "kg/m3",
    "_mpa_s": "mPa*s",
    "_per_s": "1/s",
    "_1_s": "1/s",
    "_um2_s3": "um2/s3",
    "_um2_s": "um2/s",
    "_um_s": "um/s",
    "_px_s": "px/s",
    "_a_s": "A/s",
    "_rad": "rad",
    "_deg": "deg",
    "_ohm": "ohm",
    "_ppm": "ppm",
    "_share": "1",
    "_um": "um",
    "_px": "px",
    "_pa": "Pa",
    "_hz": "Hz",
    "_mt": "mT",
    "_ns": "ns",
    "_ms": "ms",
    "_mb": "MB",
    "_gb": "GB",
    "_mh": "mH",
    "_s": "s",
    "_a": "A",
    "_v": "V",
}


def unit_suffix(name: str) -> str:
    """The end of a name that tells its unit, such as "_um_s"; "" if it has none."""
    return next((suffix for suffix in _SYMBOLS if f"_{name}".endswith(suffix)), "")


def unit_of(name: str) -> str:
    """The unit that a name ends in, such as "um/s"; "" if it has none.

    >>> unit_of("flow_um_s"), unit_of("nis")
    ('um/s', '')
    """
    return _SYMBOLS.get(unit_suffix(name), "")
