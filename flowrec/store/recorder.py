"""Entries of the backlog -> chunks of the file. Runs in the writer's thread and knows nothing of it."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Mapping
from pathlib import Path

from mcap.records import Metadata

import flowrec
from flowrec.store.backlog import Entry
from flowrec.store.chunk import ChunkBuilder
from flowrec.store.codec import encode_record, message_stamp
from flowrec.store.form import Payload
from flowrec.store.header import OUTCOME, PROFILE, VIEW, SessionHeader, records_of
from flowrec.store.layout import FRAMES, GROUPS, SLOTS, STATE, declarations
from flowrec.store.layout import VIEW as VIEW_GROUP
from flowrec.store.mcap_file import McapFile
from flowrec.store.mirrors import Mirrors
from flowrec.topics import BY_FIELD

# A chunk is what one needs to read for one message, and what a compressor sees at once.
_CHUNK_BYTES = {FRAMES: 1 << 20, STATE: 1 << 18, VIEW_GROUP: 1 << 18}
_SYNC_S = 1.0


class Recorder:
    """Encodes ticks and keeps what is not yet on the disk younger than `flush_s`.

    Chunks end between ticks only, so that a flushed file holds whole ticks.

    Raises
    ------
    OSError : from any method, when the disk refuses.
    SessionError : a message that can not be encoded.
    """

    def __init__(self, path: Path, header: SessionHeader, *, flush_s: float, truncate: bool) -> None:
        self._flush_s = flush_s
        self._builders = {group: ChunkBuilder() for group in GROUPS}
        self._sequences: Counter[str] = Counter()
        self._mirrors = Mirrors()
        self._file = McapFile(path, truncate=truncate)
        self._flushed_s = self._synced_s = time.monotonic()
        try:
            self._file.start(PROFILE, f"flowrec {flowrec.__version__}")
            for record in (*records_of(header), *declarations()):
                self._file.add(record)
            self._sync()
        except BaseException:
            self._file.close()
            raise

    @property
    def size(self) -> int:
        """Bytes handed to the operating system."""
        return self._file.size

    @property
    def patience_s(self) -> float | None:
        """For how long one may wait for the next entry before `flush_if_due` has something to do; None: for ever."""
        if any(builder.size for builder in self._builders.values()):
            return max(0.0, self._flushed_s + self._flush_s - time.monotonic())
        if self._synced_size < self._file.size:
            return max(0.0, self._synced_s + _SYNC_S - time.monotonic())
        return None

    def add(self, entry: Entry) -> None:
        """Encode the messages of one tick; write the chunks that are full."""
        for field, message in entry.news.items():
            sequence, payload = encode_record(message)
            self._append(BY_FIELD[field].path, entry.stamp_ns, message_stamp(message), payload, sequence)
        for mirror, stamp_ns, view in self._mirrors.of(entry.news):
            self._append(mirror.path, entry.stamp_ns, stamp_ns, (view,), None)
        full = [builder for group, builder in self._builders.items() if builder.size >= _CHUNK_BYTES[group]]
        if full:
            self._file.add_chunks([builder.seal() for builder in full])

    def flush_if_due(self) -> None:
        """Write what has waited for `flush_s`; have it kept by the disk once a second."""
        now = time.monotonic()
        if now >= self._flushed_s + self._flush_s:
            self._flush()
            self._flushed_s = now
        if now >= self._synced_s + _SYNC_S and self._synced_size < self._file.size:
            self._sync()

    def finish(self, outcome: Mapping[str, str]) -> None:
        """The rest of the messages, the outcome and the summary, down to the disk."""
        self._flush()
        if self._mirrors.top_um_s is not None:
            self._file.add(Metadata(VIEW, {"speed_scale_um_s": repr(self._mirrors.top_um_s)}))
        self._file.add(Metadata(OUTCOME, dict(outcome)))
        self._file.finish()
        self._sync()

    def close(self) -> None:
        """Close the file as it is."""
        self._file.close()

    def _append(self, path: str, log_ns: int, publish_ns: int, payload: Payload, sequence: int | None) -> None:
        if sequence is None:
            sequence = self._sequences[path]
            self._sequences[path] = (sequence + 1) % 2**32
        slot = SLOTS[path]
        # The stamp itself travels in the payload; MCAP knows no time before zero.
        self._builders[slot.group].add(slot.channel, sequence, log_ns, max(0, publish_ns), payload)

    def _sync(self) -> None:
        self._synced_size = self._file.size
        self._file.sync()
        self._synced_s = time.monotonic()

    def _flush(self) -> None:
        waiting = [builder for builder in self._builders.values() if builder.size]
        if waiting:
            self._file.add_chunks([builder.seal() for builder in waiting])
