"""The rows of a sweep on the disk: a small file a task while it runs, and one Parquet file of all.

OUT.parquet.tasks/KEY.json is written as soon as a task is done, and renamed into place. At the end of a sweep, or at
Ctrl-C, OUT.parquet is written anew with all rows, takes the place of the former one, and the folder is removed.
"""

from __future__ import annotations

import contextlib
import json
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Self

from flowrec.archive.sweep.replay_process import Row
from flowrec.core import (
    FlowrecError,
    Output,
    OutputError,
    SessionError,
    needs,
    replace_content,
    replacing,
    sync_directory,
    try_lock,
    unit_of,
)
from flowrec.store import UrlPath

with needs("a sweep", "cluster"):
    import pyarrow as pa
    import pyarrow.parquet as pq

PARQUET = (".parquet",)
_OURS = b"flowrec_sweep"  # key of the file's metadata: which columns are settings and figures, as JSON
_FOLDER, _TASK = ".tasks", ".json"
_LEVEL = 1  # of zstd
_SIDES = ("recorded_", "replayed_")  # the two columns of a figure
# Columns and what they mean; those with settings and figures come before `refinement`.
COLUMNS = {
    "key": "hash of content, settings and versions",
    "session": "the file",
    "content": "hash of what the session holds",
    "refinement": "what the refinement found",
    "ticks": "images that were processed",
    "duration_s": "session time, from the first image to the last",
    "verdict": "of flowrec check",
    "findings": "of flowrec check",
    "error": "why the task has failed",
    "cpu_s": "CPU time of the replay, without flowrec check",
    "wall_s": "time that the replay took",
    "peak_memory_bytes": "largest memory of the process that replayed",
    "refly": "both plans were flown in a simulator, too",
    "flowrec": "version",
    "numerics_version": "version of the numerics",
}
_FIRST = ("key", "session", "content")


class Results:
    """The rows of one sweep; open it with `opened`.

    Attributes
    ----------
    failed : whether each task that is done has failed, by key.
    judged : hashes of the sessions whose verdict is known.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.failed: dict[str, bool] = {}
        self.judged: set[str] = set()
        self._folder = path.with_name(path.name + _FOLDER)

    @classmethod
    @contextmanager
    def open_locked(cls, path: Path, inputs: Iterable[Path], contents: Collection[str]) -> Iterator[Self]:
        """The results under a name, for one process at a time; gathered into the file however the block ends.

        Raises OutputError: it may not be written, or holds something else than a sweep of some of these sessions.

        Parameters
        ----------
        inputs : files that are read, none of which the output may be.
        contents : hashes of the sessions of this sweep.
        """
        Output(path, PARQUET, tuple(each for each in inputs if not isinstance(each, UrlPath)), overwrite=True).check()
        results = cls(path)
        before = read_rows(path) if path.exists() else []
        with results._lock_folder():
            before += [row for _, row in results._files()]
            if before and not any(row["content"] in contents for row in before):
                raise OutputError(f"{path}: holds a sweep of other sessions, and stays; choose another name")
            for row in before:
                results._note(row)
            del before  # a sweep may be long
            try:
                yield results
            finally:
                results._gather()

    def put(self, row: Row) -> None:
        """Keep the row of a task; FlowrecError if it can not be written."""
        file = self._folder / (row["key"] + _TASK)
        try:
            replace_content(file, json.dumps(row).encode())
        except OSError as error:
            raise FlowrecError(
                f"{file}: can not be written ({error.strerror or error}); what was done before is kept, and the same "
                "command goes on"
            ) from error
        self._note(row)

    def _note(self, row: Row) -> None:
        self.failed[row["key"]] = bool(row.get("error"))
        if row.get("verdict"):
            self.judged.add(row["content"])

    @contextmanager
    def _lock_folder(self) -> Iterator[None]:
        """The folder is there, and no other process uses it."""
        try:
            self._folder.mkdir(exist_ok=True)
            sync_directory(self._folder.absolute().parent)  # the rows in it would be lost with its name
        except OSError as error:
            reason = error.strerror or error
            raise OutputError(f"{self._folder}: can not be made ({reason}); choose another place") from error
        lock = self._folder / "lock"
        with contextlib.ExitStack() as stack:
            opened = stack.enter_context(lock.open("a"))
            if not try_lock(opened.fileno(), exclusive=True):
                raise OutputError(f"{self.path}: another sweep writes it just now; let it end, or choose another name")
            try:
                yield
            finally:
                if not self._files_left():
                    lock.unlink(missing_ok=True)
                    self._folder.rmdir()

    def _files_left(self) -> list[Path]:
        return list(self._folder.glob(f"*{_TASK}"))

    def _files(self) -> Iterator[tuple[Path, Row]]:
        """The rows that are not in the Parquet file yet."""
        for file in sorted(self._files_left()):
            try:
                yield file, json.loads(file.read_text(encoding="utf-8"))
            except ValueError:
                file.unlink()  # of a disk that lost power: it is computed again

    def _gather(self) -> None:
        """Move all rows into the Parquet file."""
        found = list(self._files())
        if not found:
            return
        before = read_rows(self.path) if self.path.exists() else []
        rows = {row["key"]: row for row in [*before, *(row for _, row in found)]}
        try:
            with replacing(self.path) as part:
                pq.write_table(_table(list(rows.values())), part, compression="zstd", compression_level=_LEVEL)
        except OSError as error:
            raise FlowrecError(
                f"{self.path}: can not be written ({error.strerror or error}); the results stay in {self._folder}, and "
                "the same command goes on"
            ) from error
        for path, _ in found:
            path.unlink()


def read_rows(path: Path) -> list[Row]:
    """The rows of a sweep's file, as its tasks returned them.

    Raises SessionError: there is no such file, or it can not be read; OutputError: `flowrec sweep` has not written it.
    """
    try:
        table = pq.read_table(path, partitioning=None)
    except (OSError, pa.ArrowException) as error:
        reason = str(error).partition("\n")[0]
        raise SessionError(f"{path}: can not be read as Parquet ({reason}); flowrec sweep writes such files") from error
    if not is_sweep(table.schema):
        raise OutputError(f"{path}: was not written by flowrec sweep; name a table that was, or a new one")
    settings, names = settings_in(table), json.loads(table.schema.metadata[_OURS])["figures"]
    rows = []
    for columns in table.to_pylist():
        figures = {name: [columns[side + name] for side in _SIDES] for name in names}
        stated = {name: pair for name, pair in figures.items() if pair != [None, None]}
        rows.append({name: columns[name] for name in COLUMNS} | {"settings": settings(columns), "figures": stated})
    return rows


def is_sweep(schema: pa.Schema) -> bool:
    """True if a file of this schema was written by `flowrec sweep`."""
    return _OURS in (schema.metadata or {})


def settings_in(table: pa.Table) -> Callable[[Row], dict[str, str]]:
    """The settings among the columns of a row; KeyError or ValueError if the table was changed since."""
    names = json.loads(table.schema.metadata[_OURS])["settings"]
    return lambda columns: {name: columns[name] for name in names if columns[name] is not None}


def _table(rows: Sequence[Row]) -> pa.Table:
    """The rows with a column a setting, two a figure, and those of COLUMNS; all rows of a session get its verdict."""
    verdicts = {row["content"]: row for row in rows if row.get("verdict")}
    settings = list(dict.fromkeys(name for row in rows for name in row["settings"]))
    figures = list(dict.fromkeys(name for row in rows for name in row.get("figures", {})))
    flat = []
    for row in rows:
        pairs = row.get("figures", {}).items()
        sides = {side + name: value for name, pair in pairs for side, value in zip(_SIDES, pair, strict=True)}
        judged = {name: verdicts.get(row["content"], row).get(name) for name in ("verdict", "findings")}
        flat.append({**row, **row["settings"], **sides, **judged})
    names = (*_FIRST, *settings, *(side + name for name in figures for side in _SIDES), *COLUMNS)
    arrays = {name: array_of([row.get(name) for row in flat]) for name in dict.fromkeys(names)}
    fields = [
        pa.field(name, array.type, metadata={"unit": unit_of(name), "meaning": COLUMNS.get(name, "")})
        for name, array in arrays.items()
    ]
    ours = json.dumps({"settings": settings, "figures": figures})
    return pa.Table.from_arrays(list(arrays.values()), schema=pa.schema(fields, metadata={_OURS: ours}))


def array_of(values: Sequence[Any], empty: pa.DataType | None = None) -> pa.Array:
    """Values of one kind; whole and broken numbers are float64, any other mixture is text.

    `empty`: type of values that are all unknown; None: text.
    """
    kinds = {type(value) for value in values if value is not None}
    if kinds == {int, float}:
        return pa.array(values, pa.float64())
    if kinds == {list}:
        return pa.array([value and list(map(str, value)) for value in values], pa.list_(pa.string()))
    if len(kinds) > 1:
        return pa.array([None if value is None else str(value) for value in values], pa.string())
    return pa.array(values, None if kinds else empty or pa.string())
