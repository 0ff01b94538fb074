"""Tables of numbers: a header, then rows. CSV with commas, semicolons or tabs; .xlsx; program_tables.py has .mat, .xdf.

A column `time_s` may also be called `Time [s]` or `TIME (s)`: case, spaces and brackets of a unit do not matter.
"""

from __future__ import annotations

import csv
import importlib.util
import io
import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from datetime import UTC, datetime, time, timedelta
from pathlib import Path
from typing import Any

import numpy as np

from flowrec.core.declarations import Floats
from flowrec.core.errors import UsageError
from flowrec.core.system.bounded_process import BoundedProcess
from flowrec.core.system.program_tables import HEAD_BYTES, program_of, program_rows
from flowrec.core.system.regular_file import refuse_irregular

# Columns of times, and what their numbers are in s.
TIME_UNITS = {"time_s": 1.0, "time_ms": 1e-3, "time_us": 1e-6, "time_ns": 1e-9}
DATES = "time"  # a column without a unit: dates or times of day
_EXCEL = (".xlsx", ".xlsm")
_BRACKETS = re.compile(r"[\[(]\s*(.*?)\s*[\])]")
_ZIP = b"PK\x03\x04"
_LIMIT_BYTES = 1 << 31
_UNPACKED_LIMIT_BYTES = 1 << 30  # of an Excel file, which is compressed
_EXCEL_ROWS = 1 << 20  # of a sheet, by Excel itself
_EXCEL_S, _EXCEL_S_PER_MB = 20.0, 20.0  # CPU time; openpyxl takes some 3 s for a MB of numbers


@dataclass(frozen=True, slots=True, eq=False)
class Table:
    """A table; cells are text or, of an Excel file, numbers."""

    where: str  # the file, for messages
    header: tuple[str, ...]  # names of the columns, as written
    rows: list[list[Any]]  # cells of each row, as many as the header has
    lines: list[int]  # (n,) line of the file, or row of the sheet, of each row
    decimal_comma: bool = False  # numbers are written as 1,5

    def index(self, name: str) -> int | None:
        """Place of a column by its name, or else by its name in another spelling; None: there is none.

        Raises UsageError: there are two.
        """
        places = [n for n, given in enumerate(self.header) if given == name.strip()]
        if not places:
            places = [n for n, given in enumerate(self.header) if _plain(given) == _plain(name)]
        if len(places) > 1:
            raise UsageError(f"{self.where}: two columns are named {name}; rename one")
        return places[0] if places else None

    def numbers(self, name: str) -> Floats:
        """(n,) the numbers of a column.

        Raises UsageError: no such column; an empty cell, NaN, or what is no number, with its line.
        """
        return self._values(name, dates=False)

    def times_s(self, name: str | None = None) -> tuple[str, Floats] | None:
        """The column of times, and its times (n,) in s. None: there is none.

        Dates (ISO 8601, or of Excel) count from 1970 in UTC, unless they state an offset; times of day from midnight.
        `name`: of the column, in s or dates; None: the first of TIME_UNITS that there is, or DATES. Raises UsageError:
        as `numbers`.
        """
        known = (name,) if name is not None else (*TIME_UNITS, DATES)
        found = next((each for each in known if self.index(each) is not None), None)
        if found is None:
            return None
        return found, self._values(found, dates=True) * TIME_UNITS.get(_plain(found), 1.0)

    def _values(self, name: str, *, dates: bool) -> Floats:
        place = self.index(name)
        if place is None:
            raise UsageError(f"{self.where}: no column {name}; its columns are {', '.join(self.header)}")
        only_dates = dates and _plain(name) == DATES
        values = np.empty(len(self.rows))
        for number, cells in enumerate(self.rows):
            try:
                date_s = _date_s(cells[place]) if dates else None
                if date_s is None and only_dates:
                    raise ValueError
                values[number] = self._number(cells[place]) if date_s is None else date_s
            except (ValueError, TypeError) as error:
                what = _not_a_number(cells[place], only_dates=only_dates)
                raise UsageError(f"{self.where}: line {self.lines[number]}: {name} {what}") from error
        bad = np.flatnonzero(~np.isfinite(values))
        if len(bad):
            more = f" (and {len(bad) - 1} more rows)" if len(bad) > 1 else ""
            where = f"{self.where}: line {self.lines[bad[0]]}"
            raise UsageError(f"{where}: {name} is {values[bad[0]]:g}{more}; leave these rows out, or give their values")
        return values

    def _number(self, cell: Any) -> float:
        if isinstance(cell, str) and self.decimal_comma:
            cell = cell.replace(",", ".")
        return float(cell)


def _is_number(text: str) -> bool:
    try:
        float(text.replace(",", "."))
    except ValueError:
        return False
    return True


def _plain(name: str) -> str:
    """A name of a column in one spelling: `Heading (°)` is heading_deg, `Time [s]` is time_s, `U [µm/s]` is u_um_s."""
    name = _BRACKETS.sub(r" \1 ", name.casefold().replace("°", "deg").replace("µ", "u").replace("μ", "u"))
    return "_".join(re.split(r"[\s_/]+", name.strip(" _\t")))


def _date_s(cell: Any) -> float | None:
    """Seconds of a date since 1970 in UTC, or of a time of day since midnight; None: it is neither."""
    if isinstance(cell, str) and (":" in cell or "-" in cell.strip()[1:]):  # digits alone are no date
        for kind in (datetime, time):
            try:
                cell = kind.fromisoformat(cell.strip())
                break
            except ValueError:
                continue
    if isinstance(cell, datetime):
        return (cell if cell.tzinfo is not None else cell.replace(tzinfo=UTC)).timestamp()
    if isinstance(cell, time):
        return timedelta(
            hours=cell.hour, minutes=cell.minute, seconds=cell.second, microseconds=cell.microsecond
        ).total_seconds()
    return cell.total_seconds() if isinstance(cell, timedelta) else None


def _not_a_number(cell: Any, *, only_dates: bool) -> str:
    """Error text for a cell that is no number, and what to do."""
    if cell in ("", None):
        return "is empty; give its value (of a formula: open and save the file in Excel, which stores it)"
    if only_dates:
        return (
            f"= {str(cell)!r} is no date; dates are as in 2026-05-03T14:00:00.123; of numbers name the unit, as time_s"
        )
    hint = "write a decimal point" if isinstance(cell, str) and "," in cell else "correct that line"
    return f"= {str(cell)!r} is no number; {hint}"


def read_table(path: Path) -> Table:
    """Read a table. Lines that begin with # and empty ones are passed over; the first of the others is the header.

    Raises UsageError: one line: no such file, no table, rows of unequal length, or a missing package.
    """
    refuse_irregular(path)
    try:
        if path.stat().st_size > _LIMIT_BYTES:
            raise UsageError(f"{path}: has {path.stat().st_size / 1e9:.1f} GB; a table of at most 2 GB is read")
        with path.open("rb") as file:
            head = file.read(HEAD_BYTES)
        if program := program_of(head):
            return _check_rows(path, program_rows(path, program))
        if head.startswith(_ZIP) or path.suffix.lower() in _EXCEL:
            return _check_rows(path, _excel_rows(path))
        text = _text(path.read_bytes())
    except FileNotFoundError as error:
        raise UsageError(f"{path}: no such file; a table is CSV, Excel (.xlsx), .mat or .xdf") from error
    except UnicodeDecodeError as error:
        raise UsageError(f"{path}: is no text that can be read; save it as CSV in UTF-8, or as .xlsx") from error
    except OSError as error:
        raise UsageError(f"{path}: can not be read ({error.strerror or error}); check its permissions") from error
    if "\0" in text:
        raise UsageError(f"{path}: is no text; save it as CSV in UTF-8, or as .xlsx")
    begin = next((line for line in text.splitlines() if line.strip() and not line.lstrip().startswith("#")), "")
    separator = max(",;\t", key=begin.count)
    return _check_rows(path, _text_rows(path, text, separator), separator == ";")


def _text(data: bytes) -> str:
    """Text in UTF-8, UTF-16 with its mark, or as Excel writes CSV in Western Europe; UnicodeDecodeError."""
    if data[:2] in (b"\xff\xfe", b"\xfe\xff"):
        return data.decode("utf-16")
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError:
        return data.decode("cp1252")  # numbers are the same in all of them


def _text_rows(path: Path, text: str, separator: str) -> Iterator[tuple[int, list[Any]]]:
    lines, read = csv.reader(io.StringIO(text), delimiter=separator), 0
    try:
        for cells in lines:
            read = lines.line_num
            if any(cell.strip() for cell in cells) and not cells[0].lstrip().startswith("#"):
                yield read, [cell.strip() for cell in cells]
    except csv.Error as error:
        raise UsageError(
            f"{path}: line {read + 1}: {error}; is a quotation mark left open there, or is it no table?"
        ) from error


def _excel_rows(path: Path) -> list[tuple[int, list[Any]]]:
    """Rows of the first sheet; of formulas their values."""
    if importlib.util.find_spec("openpyxl") is None:
        raise UsageError(f"{path}: Excel files need openpyxl: pip install 'flowrec[movies]', or save it as CSV")
    megabytes = path.stat().st_size / 1e6
    with BoundedProcess(str(path), _EXCEL_S + _EXCEL_S_PER_MB * megabytes) as process:
        return process.call(_sheet_rows, path)


def _sheet_rows(path: Path) -> list[tuple[int, list[Any]]]:
    """Rows of the first sheet, with their numbers; an empty one for each that is left out before a later one."""
    import zipfile

    import openpyxl

    rows: list[tuple[int, list[Any]]] = []
    try:
        with zipfile.ZipFile(path) as parts:
            if sum(part.file_size for part in parts.infolist()) > _UNPACKED_LIMIT_BYTES:
                raise UsageError(f"{path}: unpacks to more than 1 GB; save it as CSV")
        data = io.BytesIO(path.read_bytes())  # of a path it would look at the suffix
        book = openpyxl.load_workbook(data, read_only=True, data_only=True)
    except (zipfile.BadZipFile, KeyError, ValueError, OSError) as error:
        raise UsageError(f"{path}: is no Excel file that can be read ({error}); save it as CSV in UTF-8") from error
    try:
        sheet = book.worksheets[0]
        for number, row in enumerate(sheet.iter_rows(values_only=True), 1):
            if number > _EXCEL_ROWS:
                raise UsageError(f"{path}: names a row beyond {_EXCEL_ROWS}, the last one of a sheet; it is damaged")
            cells = list(row)
            if any(cell not in (None, "") for cell in cells) and not str(cells[0]).lstrip().startswith("#"):
                rows.append((number, cells))
        if len(rows) < 2 and len(book.worksheets) > 1:
            raise UsageError(
                f"{path}: its first sheet, {sheet.title!r}, holds no table, and only that is read; move the sheet with "
                "the table to the front"
            )
    finally:
        book.close()
    return rows


def _check_rows(path: Path, rows: Iterable[tuple[int, list[Any]]], decimal_comma: bool = False) -> Table:
    lines: list[int] = []
    cells: list[list[Any]] = []
    header: tuple[str, ...] = ()
    for line, row in rows:
        if not header:
            while row and row[-1] in (None, ""):
                row.pop()
            header = tuple("" if cell is None else str(cell).strip() for cell in row)
            if all(_is_number(name) for name in header):
                raise UsageError(
                    f"{path}: line {line}: numbers where the names of the columns are expected; add a header"
                )
            continue
        if len(row) < len(header) or any(cell not in (None, "") for cell in row[len(header) :]):
            raise UsageError(f"{path}: line {line}: {len(row)} values where the header has {len(header)}; correct it")
        lines.append(line)
        cells.append(row[: len(header)])
    if not header:
        raise UsageError(f"{path}: is empty; its first line names the columns")
    return Table(str(path), header, cells, lines, decimal_comma)
