"""Tables of numbers in text or Excel files: a header, then rows. CSV with commas, semicolons or tabs; .xlsx."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flowrec.errors import UsageError

_EXCEL = (".xlsx", ".xlsm")
_ZIP = b"PK\x03\x04"
_LIMIT_BYTES = 1 << 31
_UNPACKED_LIMIT_BYTES = 1 << 30  # of an Excel file, which is compressed


@dataclass(frozen=True, slots=True, eq=False)
class Table:
    """A table; cells are text or, of an Excel file, numbers.

    Attributes
    ----------
    where : the file, for messages.
    header : names of the columns, as written.
    rows : cells of each row, as many as the header has.
    lines : (n,) line of the file, or row of the sheet, of each row.
    decimal_comma : numbers are written as 1,5.
    """

    where: str
    header: tuple[str, ...]
    rows: list[list[Any]]
    lines: list[int]
    decimal_comma: bool = False

    def index(self, name: str) -> int | None:
        """Place of a column, whatever the case of its letters; None: there is none.

        Raises
        ------
        UsageError : there are two.
        """
        places = [n for n, given in enumerate(self.header) if given.casefold() == name.strip().casefold()]
        if len(places) > 1:
            raise UsageError(f"{self.where}: two columns are named {name}; rename one")
        return places[0] if places else None

    def numbers(self, name: str) -> NDArray[np.float64]:
        """(n,) the numbers of a column.

        Raises
        ------
        UsageError : no such column; an empty cell, NaN, or what is no number, with its line.
        """
        place = self.index(name)
        if place is None:
            raise UsageError(f"{self.where}: no column {name}; its columns are {', '.join(self.header)}")
        values = np.empty(len(self.rows))
        for number, cells in enumerate(self.rows):
            try:
                values[number] = self._number(cells[place])
            except (ValueError, TypeError) as error:
                cell = "is empty" if cells[place] in ("", None) else f"= {cells[place]!r} is no number"
                raise UsageError(
                    f"{self.where}: line {self.lines[number]}: {name} {cell}; correct that line"
                ) from error
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


def read_table(path: Path) -> Table:
    """Read a table. Lines that begin with # and empty ones are passed over; the first of the others is the header.

    Raises
    ------
    UsageError : one line: no such file, no table, rows of unequal length, or a missing package.
    """
    try:
        if path.stat().st_size > _LIMIT_BYTES:
            raise UsageError(f"{path}: has {path.stat().st_size / 1e9:.1f} GB; a table of at most 2 GB is read")
        with path.open("rb") as file:
            excel = file.read(4) == _ZIP
        if excel or path.suffix.lower() in _EXCEL:
            return _checked(path, _excel_rows(path))
        data = path.read_bytes()
        text = data.decode("utf-16" if data[:2] in (b"\xff\xfe", b"\xfe\xff") else "utf-8-sig")
    except FileNotFoundError as error:
        raise UsageError(f"{path}: no such table") from error
    except UnicodeDecodeError as error:
        raise UsageError(f"{path}: is no text that can be read; save it as CSV in UTF-8, or as .xlsx") from error
    except OSError as error:
        raise UsageError(f"{path}: can not be read ({error.strerror or error}); check its permissions") from error
    if "\0" in text:
        raise UsageError(f"{path}: is no text; save it as CSV in UTF-8, or as .xlsx")
    begin = next((line for line in text.splitlines() if line.strip() and not line.lstrip().startswith("#")), "")
    separator = max(",;\t", key=begin.count)
    return _checked(path, _text_rows(text, separator), separator == ";")


def _text_rows(text: str, separator: str) -> Iterator[tuple[int, list[Any]]]:
    lines = csv.reader(io.StringIO(text), delimiter=separator)
    for cells in lines:
        if any(cell.strip() for cell in cells) and not cells[0].lstrip().startswith("#"):
            yield lines.line_num, [cell.strip() for cell in cells]


def _excel_rows(path: Path) -> Iterator[tuple[int, list[Any]]]:
    """Rows of the first sheet; of formulas their values."""
    try:
        import openpyxl
    except ModuleNotFoundError as error:
        raise UsageError(
            f"{path}: Excel files need openpyxl: pip install 'flowrec[movies]', or save it as CSV"
        ) from error
    import zipfile

    try:
        with zipfile.ZipFile(path) as parts:
            if sum(part.file_size for part in parts.infolist()) > _UNPACKED_LIMIT_BYTES:
                raise UsageError(f"{path}: unpacks to more than 1 GB; save it as CSV")
        data = io.BytesIO(path.read_bytes())  # of a path it would look at the suffix
        book = openpyxl.load_workbook(data, read_only=True, data_only=True)
    except (zipfile.BadZipFile, KeyError, ValueError, OSError) as error:
        raise UsageError(f"{path}: is no Excel file that can be read ({error}); save it as CSV in UTF-8") from error
    try:
        for number, row in enumerate(book.worksheets[0].iter_rows(values_only=True), 1):
            cells = list(row)
            if any(cell not in (None, "") for cell in cells) and not str(cells[0]).lstrip().startswith("#"):
                yield number, cells
    finally:
        book.close()


def _checked(path: Path, rows: Iterable[tuple[int, list[Any]]], decimal_comma: bool = False) -> Table:
    lines: list[int] = []
    cells: list[list[Any]] = []
    header: tuple[str, ...] = ()
    for line, row in rows:
        if not header:
            while row and row[-1] in (None, ""):
                row.pop()
            header = tuple("" if cell is None else str(cell).strip() for cell in row)
            continue
        if len(row) < len(header) or any(cell not in (None, "") for cell in row[len(header) :]):
            raise UsageError(f"{path}: line {line}: {len(row)} values where the header has {len(header)}; correct it")
        lines.append(line)
        cells.append(row[: len(header)])
    if not header:
        raise UsageError(f"{path}: is empty; its first line names the columns")
    return Table(str(path), header, cells, lines, decimal_comma)
