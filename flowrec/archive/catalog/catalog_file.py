"""The Parquet file of a catalog: a row a session; lists of structures hold the operator's events and the replays.

It is written anew under another name and renamed, by one process at a time. Nothing recorded is in it: a catalog that
is damaged or of another version is made anew.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from flowrec.archive.catalog.format import EVENTS, KEY, NAME, PARQUET, PLACE, SIGNATURE, SWEEP, About
from flowrec.core import FlowrecError, Output, OutputError, needs, open_new, refuse_irregular, replacing, unit_of
from flowrec.verbs import ALWAYS, LISTS, kind_of

with needs("a catalog", "catalog"):
    import pyarrow as pa
    import pyarrow.parquet as pq

_LOCK = ".lock"
_LEVEL = 1  # of zstd
_COLUMNS_LIMIT = 400  # a file can state any number of facts
VERDICT = "verdict"
_OURS = (*ALWAYS, "content", VERDICT, SIGNATURE, PLACE)  # columns that are never left out
_KINDS = {int: pa.int64(), float: pa.float64(), bool: pa.bool_(), str: pa.string()}
_EVENT = pa.list_(pa.struct([("time_s", pa.float64()), ("action", pa.string()), ("text", pa.string())]))


@dataclass(frozen=True, slots=True)
class Known:
    """Contents of a catalog file: its sessions, without the columns that are joined to them anew, and its metadata.

    `remark` : that the file can not be used.
    """

    sessions: pa.Table
    about: About | None = None
    remark: str = ""


def read(path: Path) -> Known:
    """Read the contents of an earlier catalog: no session where there is none, or it can not be used.

    Raises OutputError: the file is something else, which is never replaced.
    """
    if not os.path.lexists(path):
        return Known(table_of([]))
    refuse_irregular(path)
    try:
        table = pq.read_table(path, partitioning=None)
    except (OSError, pa.ArrowException) as error:
        reason = str(error).partition("\n")[0]
        if path.name == NAME:
            return Known(table_of([]), remark=f"{path}: is damaged ({reason}), and is made anew")
        raise OutputError(
            f"{path}: can not be read as Parquet ({reason}), and stays; remove it, or choose another name"
        ) from error
    ours = (table.schema.metadata or {}).get(KEY.encode())
    if ours is None:
        raise OutputError(f"{path}: was not written by flowrec catalog, and stays; choose another name")
    about = About.of(ours.decode(errors="replace"))
    if about is None or not {"path", PLACE, SIGNATURE} <= set(table.column_names):
        return Known(table_of([]), remark=f"{path}: is a catalog of another version of flowrec, and is made anew")
    return Known(table.drop_columns([SWEEP, VERDICT]), about)


@contextlib.contextmanager
def lock_catalog(path: Path) -> Iterator[None]:
    """Keep other processes from refreshing a catalog.

    Raises OutputError: another one does so just now, or the file may not be written.
    """
    Output(path, PARQUET, overwrite=True).check()
    lock = path.with_name(f".{path.name}{_LOCK}")
    try:
        file = open_new(lock, overwrite=True)
    except BlockingIOError as error:
        raise OutputError(f"{path}: is being refreshed by another process just now; let it end") from error
    except OSError as error:
        raise OutputError(f"{lock}: can not be made ({error.strerror}); choose another place with --out") from error
    with file:
        try:
            yield
        finally:
            lock.unlink(missing_ok=True)


def table_of(rows: Sequence[dict[str, Any]]) -> pa.Table:
    """Rows of sessions as a table; the kind of a column follows from its name."""
    names = dict.fromkeys((*ALWAYS, "content", SIGNATURE, PLACE, EVENTS, *(name for row in rows for name in row)))
    columns = {name: pa.array([row.get(name) for row in rows], _type(name)) for name in names}
    return pa.table(columns)


def join_rows(before: pa.Table, kept: Sequence[bool], rows: Sequence[dict[str, Any]]) -> pa.Table:
    """Sessions of a catalog that are kept, and new rows, in order of path, with the columns that most of them have."""
    same = before.filter(pa.array(kept, pa.bool_()))
    both = pa.concat_tables([same, table_of(rows)], promote_options="default")
    own = [name for name in both.column_names if name not in (*_OURS, EVENTS)]
    often = sorted(own, key=lambda name: (both[name].null_count, kind_of(name) is str))[:_COLUMNS_LIMIT]
    kept = [name for name in both.column_names if name in often or name in (*_OURS, EVENTS)]
    return both.select(kept).sort_by(PLACE)


def write(path: Path, sessions: pa.Table, replays: pa.ListArray, verdicts: Sequence[str | None], about: About) -> None:
    """Write a catalog and give it its name; FlowrecError if the disk refuses, and the former one stays."""
    table = sessions.append_column(VERDICT, pa.array(verdicts, pa.string())).append_column(SWEEP, replays)
    fields = [field.with_metadata({"unit": unit_of(field.name)}) for field in table.schema]
    table = table.cast(pa.schema(fields, {KEY: about.to_json()}))
    try:
        with replacing(path) as part:
            pq.write_table(table, part, compression="zstd", compression_level=_LEVEL)
    except OSError as error:
        raise FlowrecError(
            f"{path}: can not be written ({error.strerror or error}); choose another place with --out"
        ) from error


def _type(name: str) -> pa.DataType:
    if name in (EVENTS, PLACE):
        return _EVENT if name == EVENTS else pa.binary()
    return pa.list_(pa.string()) if name in LISTS else _KINDS[kind_of(name)]
