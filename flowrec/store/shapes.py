"""What the arrays of a message must look like before anybody computes with them, and where numbers must be finite.

The wire keeps any shape. A file that was damaged or made up with all checksums right is stopped here.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from flowrec import messages as m
from flowrec.messages import Message, array_fields

Shape = tuple[int | str, ...]

# A letter is any length, the same one throughout a message; `n`, `m` and `o` may be zero, `h` and `w` may not.
_SHAPES: Mapping[type[Message], Mapping[str, Shape]] = {
    m.Frame: {"image": ("h", "w")},
    m.Applied: {"currents_a": (3,), "turns": (2,)},
    m.OperatorEvent: {},
    m.FlowField: {
        "velocity_um_s": ("h", "w", 2),
        "pressure_pa": ("h", "w"),
        "std_um_s": ("h", "w", 2),
        "boundary_values": ("n",),
    },
    m.Route: {"waypoints_um": ("n", 2), "arrival_s": ("n",), "time_to_go_s": ("h", "w")},
    m.Track: {"position_um": (2,), "roi_px": (4,)},
    m.Estimate: {
        "position_um": (2,),
        "flow_um_s": (2,),
        "covariance": ("k", "k"),
        "measured_um": (2,),
        "slopes_per_s": ("n",),
        "surprise": ("m",),
    },
    m.Health: {
        "bank_re": ("n",),
        "bank_im": ("n",),
        "bank_power": ("n",),
        "mean_um_s": (2,),
        "rolled_sums": ("m",),
        "rolled_before_um_s": ("o",),
    },
    m.Observations: {"position_um": ("n", 2), "flow_um_s": ("n", 2), "std_um_s": ("n",)},
    m.Mission: {"start_um": (2,), "goal_um": (2,)},
    m.Demand: {"velocity_um_s": (2,), "reference_um": (2,), "sent_um_s": ("m", 2)},
    m.Currents: {"currents_a": (3,), "voltages_v": ("n",)},
    m.Event: {},
    m.Timing: {},
    m.Drops: {},
    m.Clocks: {},
    m.Truth: {"position_um": (2,), "flow_um_s": (2,)},
}
# Where a value that is not finite says something: no measurement, no reference, no way, wall beyond sight.
_MAY_BE_INFINITE: Mapping[type[Message], frozenset[str]] = {
    m.Estimate: frozenset({"nis", "measured_um"}),
    m.Health: frozenset({"nis"}),
    m.Demand: frozenset({"error_um", "reference_um"}),
    m.Route: frozenset({"time_to_go_s"}),
    m.Truth: frozenset({"clearance_um"}),
}


def misfit(message: Message) -> str:
    """Why nobody can compute with a message: an array of another shape than its topic's; '' when all fit."""
    shapes = _SHAPES.get(type(message), {})
    lengths: dict[str, int] = {}
    for name, wanted in shapes.items():
        array = getattr(message, name)
        if array is None:
            continue
        fits = array.ndim == len(wanted)
        for found, length in zip(array.shape, wanted, strict=False):
            if isinstance(length, int):
                fits = fits and found == length
            else:
                fits = fits and lengths.setdefault(length, found) == found and (found > 0 or length in "nmo")
        if not fits:
            return f"{name} has the shape {array.shape} where ({', '.join(map(str, wanted))}) belongs"
    return ""


def not_finite(message: Message) -> tuple[str, ...]:
    """Names of the fields that hold NaN or infinity where there must be none."""
    kind = type(message)
    allowed = _MAY_BE_INFINITE.get(kind, frozenset())
    found = []
    for name in _float_fields(kind):
        value = getattr(message, name)
        if value is not None and name not in allowed and not np.isfinite(value).all():
            found.append(name)
    return tuple(found)


def beyond_measure(message: Message) -> tuple[str, ...]:
    """Names of the fields that hold what no run can have: `not_finite`, or a number of `_NEVER` or more."""
    found = list(not_finite(message))
    for name in _float_fields(type(message)):
        value = getattr(message, name)
        with np.errstate(invalid="ignore"):
            if value is not None and name not in found and (np.abs(value)[np.isfinite(value)] >= _NEVER).any():
                found.append(name)
    return tuple(found)


_NEVER = 1e15  # a million kilometres in um
_FLOATS: dict[type[Any], tuple[str, ...]] = {}


def _float_fields(kind: Any) -> tuple[str, ...]:
    names = _FLOATS.get(kind)
    if names is None:
        arrays = {name for name, dtype in array_fields(kind) if dtype.kind == "f"}
        names = tuple(name for name, hint in kind.__annotations__.items() if name in arrays or hint in ("float", float))
        _FLOATS[kind] = names
    return names


def shapes_of(kind: type[Message]) -> Mapping[str, Shape]:
    """The shape of each array of a message type."""
    return _SHAPES[kind]
