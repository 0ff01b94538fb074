"""The tables of `flowrec sweep` in a catalog: the replays of each session as a list of structures.

A member of the structure is a column of the sweep's table, and three more: `settings` as one text, `place` among the
replays of the same session, 1 for the best, and `table`, the file.
"""

from __future__ import annotations

import io
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from flowrec.archive.sweep.ranking import RANKED_BY, settings_text
from flowrec.archive.sweep.results import COLUMNS, array_of, is_sweep, settings_in
from flowrec.core import FlowrecError, SessionError
from flowrec.store import open_bytes

_LIMIT_BYTES = 1 << 30
_TEXTS = pa.list_(pa.string())
_EMPTY = {"place": pa.int64(), "ticks": pa.int64(), "refinement": _TEXTS, "findings": _TEXTS}  # where all are unknown


def sweep_rows(tables: Iterable[Path], named: Callable[[Path], str], remark: Callable[[str], None]) -> pa.Table:
    """The replays of all tables of sweeps, each once; a table of another program is passed over.

    Parameters
    ----------
    named : how the catalog states a path.
    remark : takes lines about what can not be read.
    """
    rows: dict[str, dict[str, Any]] = {}
    for path in tables:
        try:
            found = _read(path)
        except (FlowrecError, pa.ArrowException, OSError, ValueError, KeyError) as error:
            reason = str(error).partition("\n")[0]
            remark(f"{path}: can not be read as Parquet, and is passed over ({reason})")
            continue
        for row in found:
            rows[row["key"]] = row | {"table": named(path)}
    _rank(rows.values())
    names = dict.fromkeys(("settings", "place", "table", *COLUMNS, *(name for row in rows.values() for name in row)))
    columns = {name: array_of([row.get(name) for row in rows.values()], _EMPTY.get(name)) for name in names}
    return pa.table(columns)


def lists_of(contents: Sequence[str | None], rows: pa.Table) -> tuple[pa.ListArray, list[str | None]]:
    """The replays of each session, by the hash of its content, and the verdict on it where a row has one."""
    by_content: dict[str, list[int]] = {}
    verdicts: dict[str, str] = {}
    for number, (content, verdict) in enumerate(
        zip(rows["content"].to_pylist(), rows["verdict"].to_pylist(), strict=True)
    ):
        by_content.setdefault(content, []).append(number)
        if verdict:
            verdicts[content] = verdict
    order: list[int] = []
    offsets = [0]
    for content in contents:
        order += by_content.get(content or "", ())
        offsets.append(len(order))
    structures = rows.take(pa.array(order, pa.int64())).to_struct_array().combine_chunks()
    lists = pa.ListArray.from_arrays(pa.array(offsets, pa.int32()), structures)
    return lists, [verdicts.get(content or "") for content in contents]


def _read(path: Path) -> list[dict[str, Any]]:
    """The rows of the table of a sweep by column, with their settings as one text; [] if it is another table."""
    with open_bytes(path) as source:
        if source.size > _LIMIT_BYTES:
            raise SessionError(f"{path}: is larger than the table of a sweep")
        file = pq.ParquetFile(io.BytesIO(source.read(0, source.size)))
        if not is_sweep(file.schema_arrow):
            return []
        table = file.read()
    rows = table.select([*COLUMNS, *(name for name in table.column_names if name not in COLUMNS)]).to_pylist()
    settings = settings_in(table)
    return [row | {"settings": settings_text(row | {"settings": settings(row)})} for row in rows]


def _rank(rows: Iterable[dict[str, Any]]) -> None:
    """Number the replays of each session by the first figure of RANKED_BY that one of them has."""
    by_content: dict[str, list[dict[str, Any]]] = {}
    for row in rows:
        by_content.setdefault(row["content"], []).append(row)
    for own in by_content.values():
        for figure in RANKED_BY:
            ranked = [row for row in own if isinstance(row.get(f"replayed_{figure}"), int | float)]
            if ranked:
                ranked.sort(key=lambda row: row[f"replayed_{figure}"])
                for place, row in enumerate(ranked, 1):
                    row["place"] = place
                break
