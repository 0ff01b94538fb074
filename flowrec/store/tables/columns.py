"""The columns of the table of a topic, derived from the declaration of its message type.

A plain number, a truth value or a text is a column; a vector of two or three is a column a component, `position_um`
becomes `position_x_um` and `position_y_um`. A vector with a number for each coil is a column a coil: of three coils
`currents_x_a`, `currents_y_a` and `currents_z_a`, of six `currents_1_a` to `currents_6_a`. Every other array is a
column of (nested) lists. The table of the images has neither pixels nor their numbers, for which gigabytes would be
decompressed: `Session.frames` has both.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass, replace
from typing import Any

from flowrec.core import COILS, FIXED, Frame, MessageField, TopicTable, message_fields, unit_of, unit_suffix

_AXES = "xyz"
_KINDS = {int: "int64", float: "float64", bool: "bool", str: "string"}

# The columns that every table begins with.
STAMP, TIME, WALL = "stamp_ns", "time_s", "wall_time"
_COMMON = {
    STAMP: ("int64", "stamp of the message on the session clock"),
    TIME: ("float64", "the same in s, as in Session.at"),
    WALL: ("timestamp", "the same as time of day, UTC; empty in files that do not state when their clock was 0"),
}
_READ_WITH_PIXELS: dict[type, tuple[str, ...]] = {Frame: ("index", "image")}


@dataclass(frozen=True, slots=True)
class Column:
    """One column.

    Attributes
    ----------
    name : with the unit at its end.
    field : of the message, "" for a column that every table has.
    component : of a vector field, which this column holds; None: the whole field.
    kind : int64, float64, float32, bool, string or timestamp: of its values, or of the elements of its lists.
    shape : of the lists, a letter for a length that changes; () for single values.
    unit : such as "um/s"; "" for pure numbers, texts, and where it is not the same for all elements.
    meaning : in words.
    """

    name: str
    field: str
    component: int | None
    kind: str
    shape: tuple[int | str, ...]
    unit: str
    meaning: str


def columns_of(topic: str, topics: TopicTable = FIXED, coils: int = 3) -> tuple[Column, ...]:
    """The columns of the table of a topic, which is named by its field, for a number of coils."""
    message_type: Any = topics.by_field[topic].type
    return _columns_of_type(topic, message_type, coils)


@functools.lru_cache(maxsize=256)
def _columns_of_type(topic: str, message_type: type, coils: int) -> tuple[Column, ...]:
    columns = [Column(name, "", None, kind, (), unit_of(name), text) for name, (kind, text) in _COMMON.items()]
    for each in message_fields(message_type):
        if each.name not in (STAMP, *_READ_WITH_PIXELS.get(message_type, ())):
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
        parts = _AXES[: int(shape[0])] if int(shape[0]) in (2, 3) else [str(coil + 1) for coil in range(coils)]
        suffix = unit_suffix(field.name)
        stem = field.name.removesuffix(suffix)
        return [
            Column(f"{stem}_{axis}{suffix}", field.name, number, kind, (), unit, f"{axis}: {meaning}")
            for number, axis in enumerate(parts)
        ]
    if field.optional:  # lists of one fixed length can not be absent
        shape = ("any", *shape[1:])
    return [Column(field.name, field.name, None, kind, shape, unit, meaning)]
