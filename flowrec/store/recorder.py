"""Entries of the backlog -> chunks of the file. Runs in the writer's thread and knows nothing of it."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path

from mcap.records import Metadata

import flowrec
from flowrec.errors import SessionError
from flowrec.messages import Frame
from flowrec.store.backlog import Entry
from flowrec.store.chunk import ChunkBuilder
from flowrec.store.codec import encode_record, message_stamp
from flowrec.store.form import Payload
from flowrec.store.frames import FrameEncoding
from flowrec.store.header import OUTCOME, PROFILE, VIEW, SessionHeader, records_of
from flowrec.store.layout import FRAMES, GROUPS, SLOTS, STATE, declarations
from flowrec.store.layout import VIEW as VIEW_GROUP
from flowrec.store.mcap_file import McapFile
from flowrec.store.mirrors import Mirrors
from flowrec.store.region import Blank, Region
from flowrec.store.source import CHUNK_LIMIT_BYTES
from flowrec.topics import BY_FIELD
from flowrec.units import seconds

# A chunk is what one needs to read for one message, and what a compressor sees at once.
_CHUNK_BYTES = {FRAMES: 1 << 20, STATE: 1 << 18, VIEW_GROUP: 1 << 18}
# Left in the largest chunk that is read for what surrounds a message.
_CHUNK_ROOM_BYTES = 1 << 20
_SYNC_POLL_S = 0.05


class Recorder:
    """Encodes ticks and keeps what is not yet on the disk young.

    What is older than `flush_s`, in wall time or in stamps, is with the operating system, and what is older than
    `sync_s` is kept by the disk, as long as one fsync takes less than half of that. It is done in a thread of its
    own: on a busy disk it may take a second, in which a camera fills the queue.

    Raises
    ------
    OSError : from any method, when the disk refuses.
    SessionError : a message that can not be encoded.
    """

    def __init__(
        self,
        path: Path,
        header: SessionHeader,
        *,
        frames: FrameEncoding,
        flush_s: float,
        sync_s: float,
        truncate: bool,
        region: Region | None = None,
    ) -> None:
        # A message waits up to half of the time for the next fsync to begin, and the other half until it is done.
        self._sync_every_s = sync_s / 2
        # Begun a fifth early, a flush is over in time also on a busy machine.
        self._flush_s = 0.8 * min(flush_s, self._sync_every_s)
        self._frames = frames
        self._builders = {group: ChunkBuilder(compressed=frames.packed or group != FRAMES) for group in GROUPS}
        self._sequences: Counter[str] = Counter()
        self._mirrors = Mirrors()
        self._blank = Blank()
        self._file = McapFile(path, truncate=truncate)
        self._flushed_s = self._synced_s = time.monotonic()
        self._flushed_ns: int | None = None
        self._last_ns = 0
        self._syncing: Future[None] | None = None
        self._beside = ThreadPoolExecutor(1, "session-sync")
        try:
            self._file.start(PROFILE, f"flowrec {flowrec.__version__}")
            for record in (*records_of(header), *declarations(frames, region)):
                self._file.add(record)
            self._sync()
        except BaseException:
            self.close()
            raise

    @property
    def size(self) -> int:
        """Bytes handed to the operating system."""
        return self._file.size

    @property
    def encoding(self) -> str:
        """How images travel."""
        return self._frames.name

    @property
    def lossless(self) -> bool:
        """Whether they come back as they were."""
        return self._frames.lossless

    @property
    def patience_s(self) -> float | None:
        """For how long one may wait for the next entry before `flush_if_due` has something to do; None: for ever."""
        if any(builder.size for builder in self._builders.values()):
            return max(0.0, self._flushed_s + self._flush_s - time.monotonic())
        if self._synced_size < self._file.size:
            # While the last fsync is still running there is nothing to do about the next one.
            shortest = _SYNC_POLL_S if self._sync_running else 0.0
            return max(shortest, self._synced_s + self._sync_every_s - time.monotonic())
        return None

    def add(self, entry: Entry) -> None:
        """Encode the messages of one tick; write the chunks that are full."""
        if self._flushed_ns is None:
            self._flushed_ns = entry.stamp_ns
        self._last_ns = max(self._last_ns, entry.stamp_ns)
        for field, message in entry.news.items():
            codec = self._frames.codec if isinstance(message, Frame) else None
            if isinstance(message, Frame) and entry.window is not None:
                message = self._blank.cut(message, entry.window)  # noqa: PLW2901  the builder copies it
            sequence, payload = encode_record(message, codec)
            self._append(BY_FIELD[field].path, entry.stamp_ns, message_stamp(message), payload, sequence)
        for mirror, stamp_ns, view in self._mirrors.of(entry.news):
            self._append(mirror.path, entry.stamp_ns, stamp_ns, (view,), None)
        full = [builder for group, builder in self._builders.items() if builder.size >= _CHUNK_BYTES[group]]
        if full:
            self._file.add_chunks([builder.seal() for builder in full])

    def flush_if_due(self) -> None:
        """Write what has waited for long enough, and have the disk keep it."""
        now, stamps_s = time.monotonic(), seconds(self._last_ns - (self._flushed_ns or 0))
        if now >= self._flushed_s + self._flush_s or stamps_s >= self._flush_s:
            self._flush()
            self._flushed_s, self._flushed_ns = now, self._last_ns
        if now >= self._synced_s + self._sync_every_s and self._synced_size < self._file.size:
            self._sync_beside(now)

    def finish(self, outcome: Mapping[str, str]) -> None:
        """The rest of the messages, the outcome and the summary, down to the disk."""
        self._flush()
        self._join_sync()
        if self._mirrors.top_um_s is not None:
            self._file.add(Metadata(VIEW, {"speed_scale_um_s": repr(self._mirrors.top_um_s)}))
        self._file.add(Metadata(OUTCOME, dict(outcome)))
        self._file.finish()
        self._sync()

    def close(self) -> None:
        """Close the file as it is."""
        self._beside.shutdown()
        self._file.close()

    def _append(self, path: str, log_ns: int, publish_ns: int, payload: Payload, sequence: int | None) -> None:
        if sequence is None:
            sequence = self._sequences[path]
            self._sequences[path] = (sequence + 1) % 2**32
        slot = SLOTS[path]
        size = sum(map(len, payload))
        if size > CHUNK_LIMIT_BYTES - _CHUNK_ROOM_BYTES:
            raise SessionError(f"a message of {path} has {size} bytes, more than a chunk may hold; use a smaller chip")
        builder = self._builders[slot.group]
        if builder.size and builder.size + size > CHUNK_LIMIT_BYTES - _CHUNK_ROOM_BYTES:
            self._file.add_chunks([builder.seal()])
        # The stamp itself travels in the payload; MCAP knows no time before zero.
        self._builders[slot.group].add(slot.channel, sequence, log_ns, max(0, publish_ns), payload)

    def _sync(self) -> None:
        self._synced_size = self._file.size
        self._file.sync()
        self._synced_s = time.monotonic()

    def _sync_beside(self, now_s: float) -> None:
        if self._sync_running:
            return
        self._join_sync()
        self._flush()
        self._synced_s, self._synced_size = now_s, self._file.size
        self._syncing = self._beside.submit(self._file.sync)

    @property
    def _sync_running(self) -> bool:
        return self._syncing is not None and not self._syncing.done()

    def _join_sync(self) -> None:
        """Wait for the thread, and hear of its failure."""
        if self._syncing is not None:
            self._syncing.result()
            self._syncing = None

    def _flush(self) -> None:
        waiting = [builder for builder in self._builders.values() if builder.size]
        if waiting:
            self._file.add_chunks([builder.seal() for builder in waiting])
