"""A log of the coils from a table: what the rotating field did, whichever way the laboratory wrote it down.

A row holds from its time until the time of the next row, the last one for as long as there are images. A log tells the
time (time_s, or in another unit, or dates: `Table.times_s`) and, of these, the first that it has columns for:

- frequency_hz, heading_deg or heading_rad, amplitude_mt: the rotating field. The heading is that in which the robot
  should travel.
- b_x_mt, b_y_mt, b_z_mt: the field, sampled so often that it turns by less than a third of a revolution between rows.
- turns_x, turns_y: revolutions since the row before, with amplitude_mt: applied.csv of `flowrec export --format csv`.
- i_x_a, i_y_a, i_z_a, of more than three coils i_1_a, i_2_a, ...: the currents, likewise; the field is coils.mt_per_a
  times the currents, plus coils.bias_mt.

Of a sampled field the rotation from each row to the next is about the axis B1 x B2. A roller on the floor travels along
axis x z: with B = z cos theta + h sin theta, as in coils.py, the axis is z x h, and (z x h) x z = h. A helix travels
along the axis itself.
"""

from __future__ import annotations

import difflib
import math
import re
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from flowrec.core import DATES, NS_PER_S, TIME_UNITS, Floats, MovieError, Table, coil_names, read_table
from flowrec.stages.control.coils import Coils
from flowrec.stages.control.field_log import FieldLog
from flowrec.stages.rig_settings import Column, Columns

_ROTATING = ("frequency_hz", "heading_deg", "amplitude_mt")
_IN_RADIANS = ("frequency_hz", "heading_rad", "amplitude_mt")
_OTHER_TIMES = (*list(TIME_UNITS)[1:], DATES)
_FIELDS = ("b_x_mt", "b_y_mt", "b_z_mt")
_TURNS = ("turns_x", "turns_y", "amplitude_mt")
_KINDS: tuple[tuple[str, ...], ...] = (_TURNS, _ROTATING, _IN_RADIANS, _FIELDS)
_LARGEST_STEP_RAD = 2.0 * math.pi / 3.0
# Units in brackets at the end of a column's name, and what such a column holds.
_BY_UNIT = {
    **{"s": "time_s", "hz": "frequency_hz", "mt": "amplitude_mt", "rad": "heading_rad"},
    **dict.fromkeys(("deg", "degrees", "\u00b0"), "heading_deg"),
}
_UNIT = re.compile(r"[(\[]\s*([^()\[\]]+?)\s*[)\]]\s*$")
_OFF = 0.05  # of the largest amplitude: below it a sampled field is noise, and has no direction


def columns_by_unit(header: Sequence[str]) -> dict[str, str]:
    """Columns of a log of a rotating field under other names, by the units in these: settings of movie.columns.

    A unit that two columns have tells nothing.

    >>> columns_by_unit(["t (s)", "f [Hz]", "x (um)"])
    {'time_s': 't (s)', 'frequency_hz': 'f [Hz]'}
    """
    units = [match[1].lower() if (match := _UNIT.search(name)) else "" for name in header]
    named = {_BY_UNIT[unit]: name for name, unit in zip(header, units, strict=True) if unit in _BY_UNIT}
    count = Counter(_BY_UNIT.get(unit, "") for unit in units)
    return {key: name for key, name in named.items() if count[key] == 1 and key not in header}


def read_coil_log(
    path: Path, columns: Columns, coils: Coils, heading_offset_deg: float = 0.0, heading_mirrored: bool = False
) -> FieldLog:
    """The field of a log, on the clock of the log.

    Parameters
    ----------
    heading_offset_deg, heading_mirrored : the heading in the chip is that of the log, with the opposite sign if it is
        mirrored, plus the offset.

    Raises
    ------
    MovieError : in one line: missing columns, times that go back, a field that is sampled too rarely.
    UsageError : the table can not be read; NaN.
    """
    table = read_table(path)
    if not table.rows:
        raise MovieError(f"{path}: has no rows below its header")
    of_currents = current_columns(coils.count)
    kind = _kind_of(table, columns, (*_KINDS, of_currents))
    times_s = _times_s(table, columns)
    back = np.flatnonzero(np.diff(times_s) < 0.0)
    if len(back):
        line = table.lines[int(back[0]) + 1]
        raise MovieError(
            f"{path}: line {line}: time_s goes back from {times_s[back[0]]:g} to {times_s[back[0] + 1]:g} s; is it two "
            "runs in one file, or a clock that was set? Split or sort it"
        )
    values = [_values(table, columns, name) for name in kind]
    currents: Floats | None = None
    if kind == _TURNS:
        frequency, heading, amplitude = _of_turns(times_s, *values)
    elif kind in (_ROTATING, _IN_RADIANS):
        frequency, heading, amplitude = values
        heading = np.radians(heading) if kind == _ROTATING else heading
        # A negative frequency is the opposite direction; so is a negative amplitude of nothing.
        heading = np.where(frequency < 0.0, heading + math.pi, heading)
        frequency, amplitude = np.abs(frequency), np.abs(amplitude)
    else:
        field = np.column_stack(values)
        if kind == of_currents:
            currents = field
            field = currents @ np.array(coils.mt_per_a).T + np.array(coils.bias_mt)
        frequency, heading, amplitude = _rotation(times_s, field, coils, str(path))
    heading = math.radians(heading_offset_deg) + (-heading if heading_mirrored else heading)
    times_ns = np.rint(times_s * NS_PER_S).astype(np.int64)
    return FieldLog(times_ns, frequency, np.remainder(heading + math.pi, 2.0 * math.pi) - math.pi, amplitude, currents)


def current_columns(coils: int) -> tuple[str, ...]:
    """The columns of a table that hold the currents of so many coils."""
    return tuple(f"i_{name}_a" for name in coil_names(coils))


def _kind_of(table: Table, columns: Columns, kinds: Sequence[tuple[str, ...]]) -> tuple[str, ...]:
    """The columns that the log is read by."""
    missing: dict[tuple[str, ...], list[str]] = {}
    for kind in kinds:
        lacks = [name for name in ("time_s", *kind) if not _has(table, columns, name)]
        if not lacks:
            return kind
        missing[kind] = lacks
    nearest = min(kinds[1:], key=lambda kind: len(missing[kind]))
    lacks = missing[nearest]
    given = getattr(columns, lacks[0], None)
    if given is not None:
        raise MovieError(
            f"{table.where}: no column {_name(given)!r}; its columns are {', '.join(table.header)}; correct "
            f"movie.columns.{lacks[0]}"
        )
    near = difflib.get_close_matches(lacks[0], table.header, 1, 0.5)
    example = near[0] if near else table.header[0]
    raise MovieError(
        f"{table.where}: no column {', '.join(lacks)}; its columns are {', '.join(table.header)}; name them in the "
        f'configuration, as in [movie.columns] {lacks[0]} = "{example}", or give a number that holds throughout'
    )


def _of_turns(times_s: Floats, turns_x: Floats, turns_y: Floats, amplitude: Floats) -> tuple[Floats, Floats, Floats]:
    """Mean frequency, heading and amplitude (n,) from each row to the next, which has the revolutions between the two.

    The field lasts where it turned, also if it is switched on or off between the two rows.
    """
    frequency, heading = _from_turns(times_s, turns_x[1:], turns_y[1:])
    held = amplitude.copy()
    held[:-1] = np.where(frequency[:-1] > 0.0, np.maximum(amplitude[:-1], amplitude[1:]), amplitude[:-1])
    return frequency, heading, held


def _from_turns(times_s: Floats, along_x: Floats, along_y: Floats) -> tuple[Floats, Floats]:
    """Frequency and heading (n,) of revolutions (n - 1,) from each row to the next; 0 from the last row on."""
    lasts_s = np.diff(times_s)
    frequency, heading = np.zeros(len(times_s)), np.zeros(len(times_s))
    frequency[:-1] = np.hypot(along_x, along_y) / np.where(lasts_s > 0.0, lasts_s, np.inf)
    heading[:-1] = np.arctan2(along_y, along_x)
    return frequency, heading


def is_of_session(path: Path) -> bool:
    """True if a log is `applied.csv` of a session, on the session's clock."""
    table = read_table(path)
    return all(table.index(name) is not None for name in ("stamp_ns", "time_s", *_TURNS))


def _has(table: Table, columns: Columns, name: str) -> bool:
    column: Column | None = getattr(columns, name, None)
    if isinstance(column, (int, float)):
        return True
    names = [_name(column)] if column is not None else [name, *(_OTHER_TIMES if name == "time_s" else ())]
    return any(table.index(each) is not None for each in names)


def _times_s(table: Table, columns: Columns) -> Floats:
    """Numbers or dates of the column that is named, or else of the first with times."""
    column = columns.time_s
    if column is not None and not isinstance(column, str):
        return _values(table, columns, "time_s")
    found = table.times_s(column)
    assert found is not None, "there is a column of times"
    return found[1]


def _name(column: Column | None) -> str:
    return (
        "" if column is None or isinstance(column, (int, float)) else column if isinstance(column, str) else column[0]
    )


def _values(table: Table, columns: Columns, name: str) -> Floats:
    column: Column | None = getattr(columns, name, None)
    if isinstance(column, (int, float)):
        return np.full(len(table.rows), float(column))
    values = table.numbers(_name(column) or name)
    if isinstance(column, tuple):
        factor, offset = (*column[1:], 0.0)[:2]
        values = factor * values + offset
    return values


def _rotation(times_s: Floats, field_mt: Floats, coils: Coils, where: str) -> tuple[Floats, Floats, Floats]:
    """Frequency, heading and amplitude (n,) of a sampled field (n, 3): the mean rotation from each row to the next."""
    amplitude = np.linalg.norm(field_mt, axis=1)
    on = amplitude > _OFF * amplitude.max()
    first, second = field_mt[:-1], field_mt[1:]
    axis = np.cross(first, second)
    sine, cosine = np.linalg.norm(axis, axis=1), np.einsum("ij,ij->i", first, second)
    angle = np.where(on[:-1] & on[1:], np.arctan2(sine, cosine), 0.0)
    if (angle > _LARGEST_STEP_RAD).any():
        worst, interval_s = int(np.argmax(angle)), float(np.median(np.diff(times_s)))
        raise MovieError(
            f"{where}: the field turns by {math.degrees(angle[worst]):.0f} degrees from {times_s[worst]:g} to "
            f"{times_s[worst + 1]:g} s, so its sense of rotation is not known; log it more often than every "
            f"{1e3 * interval_s:.3g} ms, or log frequency_hz, heading_deg and amplitude_mt"
        )
    turns = axis / np.maximum(sine, 1e-300)[:, None] * angle[:, None] / (2.0 * math.pi)
    along = np.column_stack([turns[:, 1], -turns[:, 0]]) if coils.mode == "roller" else turns[:, :2]
    reversed_ = coils.surface == "ceiling" if coils.mode == "roller" else coils.handedness == "left"
    along = -along if reversed_ else along
    return *_from_turns(times_s, *along.T), np.where(on, amplitude, 0.0)
