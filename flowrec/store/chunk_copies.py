"""Copies the intact chunks of a file into a new one as they are stored, and counts what is kept and what is lost.

No message is encoded again. What makes no sense under a right checksum is left out, so that the new file can be read: a
message that can not be decoded, and one of a channel whose declaration is lost. Only a chunk with such a message is put
together anew.
"""

from __future__ import annotations

from array import array
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from mcap.opcode import Opcode
from mcap.records import ChunkIndex, Metadata

from flowrec.core import BY_PATH, Applied, Ints, Message, Outcome, SessionError, Timing, seconds
from flowrec.store.channels import SLOTS, VIEWED, SessionContents
from flowrec.store.chunk import ChunkBuilder, MessageIndexes
from flowrec.store.frame_encodings import ENCODINGS
from flowrec.store.lookup import is_copy
from flowrec.store.mcap_format import CHUNK_HEAD, LONG, MESSAGE_HEAD, RECORD_HEAD, Record, SealedChunk, records_in
from flowrec.store.mcap_writer import McapWriter
from flowrec.store.scan import Scan
from flowrec.store.session_metadata import DIGEST, OUTCOME
from flowrec.store.write_queue import Counters

_MESSAGE_BYTES = RECORD_HEAD.size + MESSAGE_HEAD.size  # of a record besides its payload
# Records of which the new file gets its own, or none: the last one is of older files, and not written any more.
_ANEW = frozenset({OUTCOME, DIGEST, "flowrec.view"})
_COUNTED = ("ticks", "dropped_frames")


@dataclass(frozen=True, slots=True)
class Losses:
    """Amount of a session that is kept, and what was lost."""

    ticks: int  # complete ticks without the keyframe of a part
    lost_bytes: int  # of the old file, unusable
    lost: str  # what was lost, as text; empty when nothing was
    outcome: dict[str, str]  # of the recovered session


class RecoveryTally:
    """Ticks and messages of a file that are kept, and those that have to be left out; all times are those of ticks.

    `undeclared`: messages of channels whose declaration was not found, or is damaged.
    """

    def __init__(self, contents: SessionContents) -> None:
        self.undeclared = 0
        self._contents = contents
        # The keyframe of a part was counted where it was recorded.
        self._keyframe_ns = contents.part.keyframe_ns if contents.part is not None else None
        self._times_ns = {field: array("q") for field in ("applied", "track", "frame")}
        self._without_image_ns = array("q")  # ticks to which the camera had no image to give
        self._dropped_frames = 0  # as the run counted them itself
        self._ticks = 0  # with anything but an image, complete or not
        self._tick_ns = -1  # of the last of them
        self._first_ns: int | None = None
        self._skipped, self._first_skipped = 0, ""

    def add(self, field: str, tick_ns: int, message: Message) -> None:
        """Enter a message that is kept, by its field of Tick."""
        if self._first_ns is None or tick_ns < self._first_ns:
            self._first_ns = tick_ns
        if field in self._times_ns:
            self._times_ns[field].append(tick_ns)
        if field == "frame":
            return
        if tick_ns > self._tick_ns:
            self._ticks += tick_ns != self._keyframe_ns
            self._tick_ns = tick_ns
        if isinstance(message, Applied) and message.absent_until_ns == message.stamp_ns:
            self._without_image_ns.append(tick_ns)
        elif isinstance(message, Timing):
            self._dropped_frames = message.dropped_frames

    def skip(self, fault: str) -> None:
        """Enter a message that can not be decoded."""
        self._skipped += 1
        self._first_skipped = self._first_skipped or fault

    def losses(self, found: Scan) -> Losses | None:
        """The result, with what a scan found; None where there is no tick with inputs and outputs."""
        applied_ns, track_ns, frames_ns = map(_array, self._times_ns.values())
        if not (applied_ns.size and track_ns.size):
            return None
        end_ns = int(min(applied_ns.max(), track_ns.max()))  # inputs and outputs are always in the same chunk
        complete = np.intersect1d(applied_ns, track_ns)
        complete = complete[(complete <= end_ns) & (complete != self._keyframe_ns)]
        frames_ns = np.unique(frames_ns)
        imageless = np.setdiff1d(complete, frames_ns, assume_unique=True)
        missing = np.setdiff1d(imageless, _array(self._without_image_ns)).size - self._dropped_frames
        # Only replays are written without images.
        missing = missing if frames_ns.size or not self._contents.header.parent else 0
        lost = "; ".join(self._texts(found, missing, int((frames_ns > end_ns).sum())))
        return Losses(complete.size, found.lost_bytes, lost, self._outcome(lost, self._seconds(end_ns)))

    def _seconds(self, tick_ns: int) -> float:
        return seconds(tick_ns - (self._first_ns or 0))

    def _texts(self, found: Scan, images_missing: int, images_ahead: int) -> Iterator[str]:
        if not found.ended:
            yield "the last moments, which were not on the disk"
        if found.lost_bytes:
            yield f"{found.lost_bytes} damaged or cut-off bytes, the first at {found.first_lost}"
        # The sequence numbers of a part may continue those of the part before.
        begin_ns = -1 if self._keyframe_ns is None else self._keyframe_ns
        applied = next((number for number, name in self._contents.fields.items() if name == "applied"), -1)
        if gaps := [gap for gap in found.gaps.get(applied, []) if gap.before_ns > begin_ns]:
            from_s = self._seconds(gaps[0].before_ns)
            yield f"{sum(gap.messages for gap in gaps)} ticks on the way (from {from_s:.2f} s on a replay is not exact)"
        # A topic that the file does not declare was not recorded, unless there are messages that belong to none.
        if self.undeclared:
            absent = sorted(set(BY_PATH) - {channel.topic for channel in self._contents.channels.values()})
            names = ", ".join(absent) or "unknown"
            yield f"{self.undeclared} messages of topics whose declaration is damaged ({names})"
        if images_missing > 0:
            yield f"{images_missing} images"
        if images_ahead:
            yield f"all but the image of the last {images_ahead} ticks, which a replay passes over"
        if self._skipped:
            yield f"{self._skipped} messages that make no sense, the first is {self._first_skipped}"

    def _outcome(self, lost: str, until_s: float) -> dict[str, str]:
        contents = self._contents
        recorded = {key: value for key, value in contents.outcome.items() if key not in _COUNTED}
        encoding = ENCODINGS.get(contents.frame_encoding) or ENCODINGS["raw"]
        marks = {"recovered_from": contents.source.path.name}
        marks |= Counters(ticks=self._ticks, dropped_frames=self._dropped_frames).summary(encoding)
        if not lost:
            return {"outcome": Outcome.ENDED, **recorded, **marks}
        if "outcome" in recorded:
            marks["ended_as"] = recorded["outcome"]
        return {**recorded, **marks, "outcome": Outcome.CUT, "note": f"recovered up to {until_s:.2f} s; lost: {lost}"}


def _array(times: array[int]) -> Ints:
    return np.frombuffer(times, np.int64) if times else np.zeros(0, np.int64)


class ChunkCopier:
    """Copies chunk after chunk while a file is scanned.

    `draws`: the viewer topics are not copied, but made again from what is kept. Those of another flowrec, which has
    declared them otherwise, stay. Raises OSError: from any method, when the disk refuses.

    Parameters
    ----------
    contents : the file, with all that is declared in it.
    out : the new file, not begun.
    tally : receives what is kept and what is left out.
    """

    def __init__(self, contents: SessionContents, out: McapWriter, tally: RecoveryTally) -> None:
        self._contents, self._source = contents, contents.source
        self._out, self._tally = out, tally
        declared = {(number, channel.topic) for number, channel in contents.channels.items()}
        self.draws = {(slot.channel, path) for path, slot in SLOTS.items() if path in VIEWED} <= declared
        out.start(self._source.header.profile, self._source.header.library)
        for record in contents.metadata:
            if record.name not in _ANEW:
                out.add(Metadata(record.name, self._source.metadata(record)))
        for place in contents.attachments:
            if not is_copy(place.name):
                out.add(self._source.record(place.offset, place.length, Opcode.ATTACHMENT))
        for schema in contents.schemas.values():
            out.add(schema)
        for channel in contents.channels.values():
            out.add(channel)

    def visit(self, place: ChunkIndex, records: list[Record]) -> None:
        """Copy one intact chunk; its checksum has been verified, where it has one."""
        kept = [self._is_sound(record) for record in records]
        if any(kept):
            chunk = self._stored_chunk(place, records) if all(kept) else None
            self._out.add_chunks([chunk or self._rebuilt(place, kept)])

    def _is_sound(self, record: Record) -> bool:
        """True if a message can be kept; what is in it is tallied."""
        if record.channel not in self._contents.channels:
            self._tally.undeclared += 1
            return False
        if self.draws and self._contents.channels[record.channel].topic in VIEWED:
            return False
        field = self._contents.fields.get(record.channel)
        if field is None:  # of another program
            return True
        try:
            message = self._contents.decode(record)
        except SessionError as error:
            path = self._contents.channels[record.channel].topic
            self._tally.skip(f"{path} at {record.log_ns} ns: {error}")
            return False
        self._tally.add(field, record.log_ns, message)
        return True

    def _stored_chunk(self, place: ChunkIndex, records: list[Record]) -> SealedChunk | None:
        """The chunk as it is in the file; None where it lacks a checksum, or holds something besides messages."""
        indexes = MessageIndexes()
        at, start_unix_ns = 0, self._source.start_unix_ns
        for log_ns, channel, sequence, payload in records:
            indexes.add(channel, sequence, log_ns + start_unix_ns, at, payload)
            at += _MESSAGE_BYTES + len(payload)
        body = self._source.body(place.chunk_start_offset, place.chunk_length, Opcode.CHUNK)
        crc, name_bytes = CHUNK_HEAD.unpack_from(body)[3:]
        if not crc or at != place.uncompressed_size:
            return None
        name_end = CHUNK_HEAD.size + name_bytes
        return SealedChunk(
            compression=str(body[CHUNK_HEAD.size : name_end], "utf-8"),
            data=body[name_end + LONG.size :],
            message_start_time=place.message_start_time + start_unix_ns,
            message_end_time=place.message_end_time + start_unix_ns,
            uncompressed_crc=crc,
            uncompressed_size=at,
            indexes=indexes.channel_indexes(),
        )

    def _rebuilt(self, place: ChunkIndex, kept: list[bool]) -> SealedChunk:
        """The chunk with only those of its messages that are kept."""
        content = memoryview(self._source.content(place.chunk_start_offset, place.chunk_length))
        messages = [(at, nbytes) for opcode, at, nbytes in records_in(content) if opcode == Opcode.MESSAGE]
        head = self._source.read(place.chunk_start_offset + RECORD_HEAD.size, CHUNK_HEAD.size)
        builder = ChunkBuilder(compressed=bool(CHUNK_HEAD.unpack(head)[4]))
        times: list[int] = []
        for keep, (at, nbytes) in zip(kept, messages, strict=True):
            if keep:
                channel, sequence, log_unix_ns, publish_unix_ns = MESSAGE_HEAD.unpack_from(content, at)
                payload = (content[at + MESSAGE_HEAD.size : at + nbytes],)
                builder.add(channel, sequence, log_unix_ns, publish_unix_ns, payload)
                times.append(log_unix_ns)
        return replace(builder.seal(), message_start_time=min(times), message_end_time=max(times))
