"""Entries of the backlog -> sealed chunks. Runs in the writer's thread and knows neither it nor a file."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable

from flowrec.errors import SessionError
from flowrec.messages import Frame
from flowrec.store.channels import FRAMES, GROUPS, SLOTS, STATE
from flowrec.store.channels import VIEW as VIEW_GROUP
from flowrec.store.chunk import ChunkBuilder, Sealed
from flowrec.store.codec import encode_record, message_stamp
from flowrec.store.form import Payload
from flowrec.store.frame_encodings import FrameEncoding
from flowrec.store.mcap_reader import CHUNK_LIMIT_BYTES
from flowrec.store.roi import Blank
from flowrec.store.viewer_topics import Mirrors
from flowrec.store.write_queue import Entry
from flowrec.topics import BY_FIELD

# A chunk is what one needs to read for one message, and what a compressor sees at once.
_CHUNK_BYTES = {FRAMES: 1 << 20, STATE: 1 << 18, VIEW_GROUP: 1 << 18}
# Left in the largest chunk that is read for what surrounds a message.
_CHUNK_ROOM_BYTES = 1 << 20

Take = Callable[[list[Sealed]], None]


class Packer:
    """Encodes messages and their views for other programs, and collects them in chunks by group.

    Parameters
    ----------
    frames : how images travel.
    mirrors : makes the views; one for all pieces of a run, for it remembers their scale of colours.
    take : is given chunks that are full, or sealed on demand; they are to be used before it returns.
    start_unix_ns : of the session (header.py), which is added to all times that MCAP and foxglove know.

    Attributes
    ----------
    take : as above; may be changed between calls.
    sequences : the next number of each path, of those that the writer counts.
    """

    def __init__(self, frames: FrameEncoding, mirrors: Mirrors, take: Take, start_unix_ns: int) -> None:
        self.take = take
        self._start_unix_ns = start_unix_ns
        self.sequences: Counter[str] = Counter()
        self._frames = frames
        self._mirrors = mirrors
        self._blank = Blank()
        self._builders = {group: ChunkBuilder(compressed=frames.packed or group != FRAMES) for group in GROUPS}

    @property
    def size(self) -> int:
        """Bytes in chunks that are not sealed yet, before compression."""
        return sum(builder.size for builder in self._builders.values())

    def add(self, entry: Entry) -> None:
        """Encode the messages of one tick; hand on the chunks that are full.

        Raises
        ------
        SessionError : a message that can not be encoded; and what `take` raises.
        """
        for field, message in entry.news.items():
            codec = self._frames.codec if isinstance(message, Frame) else None
            if isinstance(message, Frame) and entry.window is not None:
                message = self._blank.cut(message, entry.window)  # noqa: PLW2901  the builder copies it
            sequence, payload = encode_record(message, codec, self._start_unix_ns)
            self._append(BY_FIELD[field].path, entry.stamp_ns, message_stamp(message), payload, sequence)
        for mirror, stamp_ns, view in self._mirrors.of(entry.news):
            self._append(mirror.path, entry.stamp_ns, stamp_ns, view, None)
        full = [builder for group, builder in self._builders.items() if builder.size >= _CHUNK_BYTES[group]]
        if full:
            self.take([builder.seal() for builder in full])

    def seal(self, groups: Iterable[str] = GROUPS) -> None:
        """Hand on what waits."""
        waiting = [self._builders[group] for group in groups if self._builders[group].size]
        if waiting:
            self.take([builder.seal() for builder in waiting])

    def _append(self, path: str, log_ns: int, publish_ns: int, payload: Payload, sequence: int | None) -> None:
        if sequence is None:
            sequence = self.sequences[path]
            self.sequences[path] = (sequence + 1) % 2**32
        slot = SLOTS[path]
        size = sum(map(len, payload))
        if size > CHUNK_LIMIT_BYTES - _CHUNK_ROOM_BYTES:
            raise SessionError(f"a message of {path} has {size} bytes, more than a chunk may hold; use a smaller chip")
        builder = self._builders[slot.group]
        if builder.size and builder.size + size > CHUNK_LIMIT_BYTES - _CHUNK_ROOM_BYTES:
            self.take([builder.seal()])
        log_unix_ns, publish_unix_ns = log_ns + self._start_unix_ns, publish_ns + self._start_unix_ns
        # The stamp itself travels in the payload; MCAP knows no time before zero.
        builder.add(slot.channel, sequence, log_unix_ns, max(0, publish_unix_ns), payload)
