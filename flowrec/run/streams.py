"""Messages of other programs and devices, such as a pump or a stream of the network, join the inputs of a run.

Each is read in a thread of its own, so that the loop waits for none. A tick takes the latest message of a topic; the
message gets the stamp of that tick.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from typing import Any, Self

from flowrec.stages import ExtraRow, Inputs

_JOIN_S = 1.0


class Streams:
    """The streams of a run, read while it is entered as a context.

    Parameters
    ----------
    rows : the extra topics of the run; those whose row has `stream` are read.
    tell : called with one line if a stream fails or yields what is no message of its topic; the run goes on without it.
    """

    def __init__(self, rows: Iterable[ExtraRow], tell: Callable[[str], None]) -> None:
        self._rows = [row for row in rows if callable(getattr(row.settings, "stream", None))]
        self._tell = tell
        self._latest: dict[str, Any] = {}  # messages by path
        self._changed = threading.Lock()
        self._closing = threading.Event()
        self._threads = [
            threading.Thread(target=self._read, args=(row,), name=f"stream {row.topic.path}", daemon=True)
            for row in self._rows
        ]

    def __enter__(self) -> Self:
        for thread in self._threads:
            thread.start()
        return self

    def __exit__(self, *error: object) -> None:
        self._closing.set()
        for thread in self._threads:
            thread.join(_JOIN_S)  # a thread that still waits for its device ends with the process

    def join(self, arriving: Iterator[Inputs]) -> Iterator[Inputs]:
        """The inputs with the messages that have come since the last ones."""
        for inputs in arriving:
            if not self._latest:
                yield inputs
                continue
            with self._changed:
                taken, self._latest = self._latest, {}
            new = {path: replace(message, stamp_ns=inputs.stamp_ns) for path, message in taken.items()}
            yield replace(inputs, extra={**inputs.extra, **new})

    def _read(self, row: ExtraRow) -> None:
        path, kind = row.topic.path, row.topic.type
        try:
            for message in row.settings.stream():
                if type(message) is not kind:
                    raise TypeError(f"a {type(message).__name__} where a {kind.__name__} belongs")
                with self._changed:
                    self._latest[path] = message
                if self._closing.is_set():
                    return
        except Exception as error:  # noqa: BLE001 - the code of others; it is told
            why = f"{type(error).__name__}: {str(error).partition(chr(10))[0]}"
            self._tell(f"{path}: its stream has failed ({why}); the run goes on without it")
