"""The table of a coil calibration: currents that were set and the fields that a probe at the robot's place showed."""

from __future__ import annotations

import csv
import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from flowrec.errors import UsageError

CURRENTS = ("i_x_a", "i_y_a", "i_z_a")
FIELDS = ("b_x_mt", "b_y_mt", "b_z_mt")
_HEADER = ",".join(CURRENTS + FIELDS)


@dataclass(frozen=True, slots=True, eq=False)
class Excitations:
    """Rows as in the file. Axes as those of the chip: x and y as in the image, z up from the floor."""

    currents_a: NDArray[np.float64]  # (n, 3)
    field_mt: NDArray[np.float64]  # (n, 3)
    lines: tuple[int, ...]  # (n,) where each row stands in the file
    name: str


def read_excitations(path: Path) -> Excitations:
    """A CSV file with the columns i_x_a, i_y_a, i_z_a, b_x_mt, b_y_mt, b_z_mt in any order; # begins a remark.

    Raises
    ------
    UsageError : what can not be read, with its line.
    """
    try:
        text = path.read_text(encoding="utf-8-sig")
    except FileNotFoundError as error:
        raise UsageError(f"{path}: no such file; it wants rows of {_HEADER}") from error
    except (OSError, UnicodeDecodeError) as error:
        raise UsageError(f"{path}: can not be read as a CSV file ({error})") from error
    rows = [
        (number, [cell.strip() for cell in next(csv.reader([line]))])
        for number, line in enumerate(text.splitlines(), 1)
        if line.strip() and not line.lstrip().startswith("#")
    ]
    if not rows:
        raise UsageError(f"{path}: is empty; the first line is {_HEADER}, then one row for each excitation")
    at, header = rows[0]
    columns = _columns(header, f"{path}:{at}")
    values = [_numbers(cells, columns, len(header), f"{path}:{number}") for number, cells in rows[1:]]
    table = np.array(values, np.float64).reshape(-1, 6)
    return Excitations(table[:, :3], table[:, 3:], tuple(number for number, _ in rows[1:]), path.name)


def _columns(header: list[str], where: str) -> list[int]:
    """Where each of the six stands."""
    given = [name.lower() for name in header]
    if len(given) == 1 and ";" in given[0]:
        raise UsageError(f"{where}: columns are parted by ';'; save it with commas, and points in the numbers")
    for name in CURRENTS + FIELDS:
        if given.count(name) == 1:
            continue
        stem, _, unit = name.rpartition("_")
        other = next((word for word in given if word.rpartition("_")[0] == stem or word == stem), None)
        if given.count(name) > 1:
            raise UsageError(f"{where}: two columns are named {name}; leave one")
        if other is not None:
            raise UsageError(
                f"{where}: column {other!r} where {name!r} belongs: give it in {_UNITS[unit]}, and say so in its name"
            )
        raise UsageError(f"{where}: no column {name}; the header is {_HEADER}")
    return [given.index(name) for name in CURRENTS + FIELDS]


_UNITS = {"a": "ampere", "mt": "millitesla"}


def _numbers(cells: list[str], columns: list[int], count: int, where: str) -> list[float]:
    if len(cells) != count:
        raise UsageError(f"{where}: {len(cells)} values where the header has {count} columns; mend that line")
    values = []
    for column, name in zip(columns, CURRENTS + FIELDS, strict=True):
        try:
            value = float(cells[column])
        except ValueError as error:
            raise UsageError(f"{where}: {name} = {cells[column]!r} is no number; mend that line") from error
        if not math.isfinite(value):
            raise UsageError(f"{where}: {name} = {cells[column]}: give a finite number or leave the row out")
        values.append(value)
    return values
