"""The columns of tables: of a topic, derived from its message type, and those of observations that a person gives.

A plain number, a truth value or a text is a column; a vector of two or three is a column a component, `position_um`
becomes `position_x_um` and `position_y_um`. A vector with a number for each coil is a column a coil: of three coils
`currents_x_a`, `currents_y_a` and `currents_z_a`, of six `currents_1_a` to `currents_6_a`. Every other array is a
column of (nested) lists. The table of the images has neither pixels nor their numbers, for which gigabytes would be
decompressed: `Session.frames` has both.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from flowrec.core import (
    COILS,
    FIXED,
    Floats,
    Frame,
    MessageField,
    Observations,
    TopicTable,
    UsageError,
    coil_names,
    message_fields,
    read_table,
    unit_of,
    unit_suffix,
)

_AXES = "xyz"
_KINDS = {int: "int64", float: "float64", bool: "bool", str: "string"}

# The columns that every table begins with.
STAMP, TIME, WALL = "stamp_ns", "time_s", "wall_time"
_COMMON = {
    STAMP: ("int64", "stamp of the message on the session clock"),
    TIME: ("float64", "stamp in s, as in Session.at"),
    WALL: (
        "timestamp",
        "time of day of the stamp, UTC; empty in files that do not state when their clock was 0, "
        "and of a movie that does not state when it was taken",
    ),
}

_READ_WITH_PIXELS = ("index", "image")  # of a Frame


@dataclass(frozen=True, slots=True)
class Column:
    """One column."""

    name: str  # with the unit at its end
    field: str  # of the message, "" for a column that every table has
    component: int | None  # of a vector field, which this column holds; None: the whole field
    kind: str  # int64, float64, float32, bool, string or timestamp: of its values, or of the elements of its lists
    shape: tuple[int | str, ...]  # of the lists, a letter for a length that changes; () for single values
    unit: str  # such as "um/s"; "" for pure numbers, texts, and where it is not the same for all elements
    meaning: str  # in words


def columns_of(topic: str, topics: TopicTable = FIXED, coils: int = 3) -> tuple[Column, ...]:
    """The columns of the table of a topic, which is named by its field, for a number of coils."""
    message_type: Any = topics.by_field[topic].type
    return _columns_of_type(topic, message_type, coils)


@functools.lru_cache(maxsize=256)
def _columns_of_type(topic: str, message_type: type, coils: int) -> tuple[Column, ...]:
    columns = [Column(name, "", None, kind, (), unit_of(name), text) for name, (kind, text) in _COMMON.items()]
    for each in message_fields(message_type):
        if each.name != STAMP and (message_type is not Frame or each.name not in _READ_WITH_PIXELS):
            columns += _columns(each, coils)
    # A field that is called like a column of every table: the times of observations.
    return tuple(
        replace(column, name=f"{topic.rpartition('/')[2]}_{column.name}")
        if column.field and column.name in _COMMON
        else column
        for column in columns
    )


def _columns(field: MessageField, coils: int) -> list[Column]:
    unit, meaning = unit_of(field.name), field.meaning
    if field.dtype is None:
        return [Column(field.name, field.name, None, _KINDS[field.kind], (), unit, meaning)]
    assert field.shape is not None  # topics.py asks for it
    shape, kind = field.shape.lengths, field.dtype.name
    of_coils = shape == (COILS,) and field.kind == "vector"
    shape = (coils,) if of_coils else shape
    if len(shape) == 1 and (shape[0] in (2, 3) or of_coils) and not field.optional:
        count = int(shape[0])
        parts: Iterable[str] = coil_names(count) if of_coils else _AXES[:count]
        suffix = unit_suffix(field.name)
        stem = field.name.removesuffix(suffix)
        return [
            Column(f"{stem}_{axis}{suffix}", field.name, number, kind, (), unit, f"{axis}: {meaning}")
            for number, axis in enumerate(parts)
        ]
    if field.optional:  # lists of one fixed length can not be absent
        shape = ("any", *shape[1:])
    return [Column(field.name, field.name, None, kind, shape, unit, meaning)]


# Columns in the order of an array's; the first four are needed, the others may be left out.
OBSERVED = {
    "x_um": "place of the observation, x in the chip frame",
    "y_um": "place of the observation, y in the chip frame",
    "u_um_s": "measured flow along x",
    "v_um_s": "measured flow along y",
    "std_um_s": "one standard deviation of each component of the measured flow",
    "own_u_um_s": "the robot's own motion through the fluid as assumed, along x; it is subtracted already",
    "own_v_um_s": "the robot's own motion through the fluid as assumed, along y; it is subtracted already",
    "time_s": "middle of the time that the flow is a mean over, on the session clock",
    "tracer": "number of the tracer that was observed, at an unknown height of its own; -1: the robot",
}
_NEEDED = 4  # of these columns, the first
_DEFAULT_STD = 0.05  # of the rms speed, where no standard deviation is given
# Times the speed below which 90 % of the moving rows are, of at least so many: faster ones are wild, and say nothing of
# the scatter of the others.
_WILD, _USUAL, _FEWEST = 100.0, 0.9, 10
_NAMES = list(OBSERVED)
_WANTED = f"the columns are {', '.join(_NAMES[:_NEEDED])} and, where known, {', '.join(_NAMES[_NEEDED:])}"


def observations_of(given: Any, radius_um: float | None = None, window_um: float | None = None) -> Observations:
    """Observations from a table with a row each, in the columns OBSERVED.

    Without `std_um_s` it is 5 % of the root mean square speed, wild rows left out. A column that may be left out may be
    empty. Raises UsageError: one line with the shape and the columns that are wanted: a missing column, another shape,
    no row, NaN or infinity, a standard deviation, radius or side that is not more than zero.

    Parameters
    ----------
    given : path of a CSV or Excel file; a pandas DataFrame, or anything with columns by name; an array (n, 4 to 9) with
        the columns in this order; or Observations, which are returned as they are.
    radius_um : of the robot or particle, which the flow carries as a sphere; None: not stated.
    window_um : side of the square over which each velocity is a mean; None: it is that at its place.
    """
    sizes = {"radius_um": (radius_um, "the flow was measured"), "window_um": (window_um, "no windows were used")}
    for name, (size, otherwise) in sizes.items():
        if size is not None and not 0.0 < size < math.inf:
            raise UsageError(f"{name} = {size:g}: must be more than zero; leave it out where {otherwise}")
    if isinstance(given, Observations):
        return given
    where, columns = _given_columns(given)
    missing = [name for name in _NAMES[:_NEEDED] if name not in columns]
    if missing:
        raise UsageError(f"{where}: no column {missing[0]}; {_WANTED}")
    if ("own_u_um_s" in columns) != ("own_v_um_s" in columns):
        raise UsageError(f"{where}: own_u_um_s and own_v_um_s belong together; {_WANTED}")
    n = len(columns["x_um"])
    if n == 0:
        raise UsageError(f"{where}: has no row; give at least one observation, {_WANTED}")
    for name, values in columns.items():
        if values.shape != (n,):
            raise UsageError(f"{where}: {name} has the shape {values.shape} where ({n},) belongs, a number a row")
        bad = np.flatnonzero(~np.isfinite(values))
        if len(bad):
            more = f" (and {len(bad) - 1} more rows)" if len(bad) > 1 else ""
            raise UsageError(f"{where}: row {bad[0]}: {name} is {values[bad[0]]:g}{more}; leave these rows out")
    flow = np.column_stack([columns["u_um_s"], columns["v_um_s"]])
    std = columns["std_um_s"] if "std_um_s" in columns else np.full(n, _DEFAULT_STD * _usual_speed(flow))
    if "std_um_s" not in columns and not std[0] > 0:
        raise UsageError(f"{where}: all speeds are 0, and no std_um_s says how well that is known; give it")
    if not (std > 0).all():
        row = int(np.argmin(std > 0))
        raise UsageError(f"{where}: row {row}: std_um_s is {std[row]:g}; it must be more than zero")
    own = np.column_stack([columns["own_u_um_s"], columns["own_v_um_s"]]) if "own_u_um_s" in columns else None
    place = np.column_stack([columns["x_um"], columns["y_um"]])
    return Observations(
        0, place, flow, std, own, columns.get("time_s"), radius_um, columns.get("tracer"), window_um=window_um
    )


def _usual_speed(flow: Floats) -> float:
    """Root mean square speed of the rows (n, 2), but for wild ones."""
    square = (flow**2).sum(axis=1)
    moving = square[square > 0.0]
    if len(moving) >= _FEWEST:
        square = square[square <= _WILD**2 * np.quantile(moving, _USUAL, method="lower")]
    return math.sqrt(float(square.mean()))


def _given_columns(given: Any) -> tuple[str, dict[str, Floats]]:
    """Name of a table for errors, and its columns; what may be left out and is empty is left out."""
    if isinstance(given, str | Path):
        table = read_table(Path(given))
        known = {name: place for name in _NAMES if (place := table.index(name)) is not None}
        empty = {name for name, place in known.items() if all(row[place] in ("", None) for row in table.rows)}
        return table.where, {name: table.numbers(name) for name in known if name not in empty or not table.rows}
    where = f"observations ({type(given).__name__})"
    names = given.keys() if isinstance(given, Mapping) else getattr(given, "column_names", None)
    names = getattr(given, "columns", None) if names is None else names
    try:
        if names is not None and not isinstance(given, np.ndarray):
            found = {name: np.asarray(given[name], np.float64) for name in _NAMES if name in list(names)}
        else:
            array = np.asarray(given, np.float64)
            if array.ndim != 2 or not _NEEDED <= array.shape[1] <= len(_NAMES):
                shape = f"has the shape {array.shape} where (n, {_NEEDED} to {len(_NAMES)}) belongs"
                raise UsageError(f"{where}: {shape}; {_WANTED}, in this order")
            found = dict(zip(_NAMES, array.T, strict=False))
    except (TypeError, ValueError) as error:
        raise UsageError(f"{where}: are no table of numbers ({error}); {_WANTED}") from error
    optional = _NAMES[_NEEDED:]
    empty = {name for name in optional if name in found and found[name].size and np.isnan(found[name]).all()}
    return where, {name: values for name, values in found.items() if name not in empty}
