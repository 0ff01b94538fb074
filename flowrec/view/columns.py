"""Rows of moving entities that are sent to Rerun many at a time: its call for one row costs more than the row."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any, NamedTuple, Self

import numpy as np
import rerun as rr

SESSION_TIME = "session time"
FRAME = "frame"
LOG_TIME = "message_log_time"  # Rerun's name for the time of a message of an .mcap
_ROWS = 64  # of an entity that wait at most
_ENCODERS = 2  # threads


class _Row(NamedTuple):
    stamp_ns: int
    frame: int | None
    fields: tuple[Sequence[Any], ...]


class ColumnBuffer:
    """Rows that wait until there are many of an entity, or for `flush`. In a file their order does not matter.

    As a context it ends its threads.
    """

    def __init__(self, stream: rr.RecordingStream) -> None:
        self._stream = stream
        self._waiting: dict[tuple[Any, ...], list[_Row]] = {}
        self._encoders = ThreadPoolExecutor(_ENCODERS)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self._encoders.shutdown()

    def encode(self, function: Callable[..., bytes], *given: Any) -> Future[bytes]:
        """Call a function in another thread; the result may be a component of a row."""
        return self._encoders.submit(function, *given)

    def add(self, path: str, kind: Any, stamp_ns: int, frame: int | None, fields: dict[str, Sequence[Any]]) -> None:
        """Take a row of an entity: a list of components for each field of the archetype `kind`."""
        key = (path, kind, frame is None, *fields)
        rows = self._waiting.setdefault(key, [])
        rows.append(_Row(stamp_ns, frame, tuple(fields.values())))
        if len(rows) >= _ROWS:
            self._send(key)

    def flush(self) -> None:
        """Send all rows."""
        for key in [*self._waiting]:
            self._send(key)

    def _send(self, key: tuple[Any, ...]) -> None:
        path, kind, frameless, *names = key
        rows = self._waiting.pop(key)
        indexes = [rr.TimeColumn(SESSION_TIME, duration=np.array([r.stamp_ns for r in rows], "timedelta64[ns]"))]
        if not frameless:
            indexes.append(rr.TimeColumn(FRAME, sequence=[row.frame for row in rows if row.frame is not None]))
        columns: list[Any] = []
        for place, name in enumerate(names):
            components = [_result(component) for row in rows for component in row.fields[place]]
            lengths = [len(row.fields[place]) for row in rows]
            columns += kind.columns(**{name: components}).partition(lengths)
        rr.send_columns(path, indexes, columns, recording=self._stream, strict=True)


def _result(component: Any) -> Any:
    return component.result() if isinstance(component, Future) else component
