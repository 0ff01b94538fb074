"""Copies the intact chunks of a file into a new one as they are stored: no message is encoded again.

What makes no sense under a right checksum is left out, so that the new file can be read: a message that can not be
decoded, and one of a channel whose declaration is lost. Only a chunk with such a message is put together anew.
"""

from __future__ import annotations

from array import array
from collections import Counter
from collections.abc import Callable
from dataclasses import replace

from mcap.opcode import Opcode
from mcap.records import Metadata, MetadataIndex

from flowrec.core import FLOW_FIELDS, SessionError, shape_error
from flowrec.store.channels import SessionContents
from flowrec.store.chunk import ChunkBuilder, index_record
from flowrec.store.digest import message_digest
from flowrec.store.losses import RecoveryTally
from flowrec.store.mcap_format import (
    CHUNK_HEAD,
    LONG,
    MESSAGE_HEAD,
    RECORD_HEAD,
    ChannelIndex,
    Record,
    SealedChunk,
    records_in,
)
from flowrec.store.mcap_writer import McapWriter
from flowrec.store.rows import row_decoder
from flowrec.store.scan import Scan
from flowrec.store.session_metadata import DIGEST, OUTCOME, VIEW
from flowrec.store.viewer_scene import brightest_um_s, drawable

_MESSAGE_BYTES = RECORD_HEAD.size + MESSAGE_HEAD.size  # of a record besides its payload
_ANEW = (OUTCOME, DIGEST)  # records of which the new file gets its own


class ChunkCopier:
    """Copies chunk after chunk while a file is scanned.

    Parameters
    ----------
    contents : the file, with all that is declared in it.
    found : the scan, which knows the place of the chunk that is visited.
    out : the new file, not begun.
    tally : receives what is kept and what is left out.

    Raises
    ------
    OSError : from any method, when the disk refuses.
    """

    def __init__(self, contents: SessionContents, found: Scan, out: McapWriter, tally: RecoveryTally) -> None:
        self._contents, self._source, self._scan = contents, contents.source, found
        self._out, self._tally = out, tally
        self._checks = {channel: self._check_of(channel) for channel in contents.fields}
        self._top_um_s: float | None = None
        out.start(self._source.header.profile, self._source.header.library)
        self._add_records([each for each in contents.metadata if each.name != VIEW])
        for place in contents.attachments:
            out.add(self._source.attachment_at(place.offset, place.length))
        for schema in contents.schemas.values():
            out.add(schema)
        for channel in contents.channels.values():
            out.add(channel)

    def visit(self, _offset: int, records: list[Record]) -> None:
        """Copy one intact chunk; its checksum has been verified, where it has one."""
        kept = [self._is_sound(record) for record in records]
        if any(kept):
            chunk = self._stored_chunk(records) if all(kept) else None
            self._out.add_chunks([chunk or self._rebuilt(kept)])

    def finish(self, outcome: dict[str, str]) -> None:
        """Write the outcome and the index, and sync the file."""
        views = [each for each in self._contents.metadata if each.name == VIEW]
        self._add_records(views)
        part = self._contents.part
        # The scale of a part is that of the first one's first flow field.
        if not views and self._top_um_s is not None and (part is None or part.keyframe_ns is None):
            self._out.add(Metadata(VIEW, {"speed_scale_um_s": repr(self._top_um_s)}))
        self._out.add(Metadata(OUTCOME, outcome))
        self._out.add_digest()
        self._out.finish()
        self._out.sync()

    def _add_records(self, places: list[MetadataIndex]) -> None:
        for place in places:
            if place.name not in _ANEW:
                self._out.add(Metadata(place.name, self._source.metadata(place)))

    def _is_sound(self, record: Record) -> bool:
        """True if a message can be kept; what is in it is tallied."""
        if record.channel not in self._contents.channels:
            self._tally.undeclared += 1
            return False
        check = self._checks.get(record.channel)
        if check is None:  # of a viewer topic, or of another program
            return True
        try:
            check(record)
        except SessionError as error:
            path = self._contents.channels[record.channel].topic
            self._tally.skip(f"{path} at {record.log_ns} ns: {error}")
            return False
        return True

    def _check_of(self, channel: int) -> Callable[[Record], None]:
        """Decodes a message of a known topic and tallies it; raises SessionError for one that makes no sense."""
        field = self._contents.fields[channel]
        if field == "frame":
            return self._check_frame
        row_of = row_decoder(self._contents, channel)
        is_field = field in FLOW_FIELDS

        def check(record: Record) -> None:
            row = row_of(record)
            if is_field and self._top_um_s is None:
                flow = self._contents.decode(record)
                self._top_um_s = brightest_um_s(flow) if drawable(flow) else None
            self._tally.add(field, record.log_ns, row)

        return check

    def _check_frame(self, record: Record) -> None:
        frame = self._contents.decode(record)
        if fault := shape_error(frame):
            raise SessionError(fault)
        self._tally.add("frame", record.log_ns, (frame.stamp_ns,))

    def _stored_chunk(self, records: list[Record]) -> SealedChunk | None:
        """The chunk as it is in the file; None where it lacks a checksum, or holds something besides messages."""
        place = self._scan.summary.chunks[-1]
        places: dict[int, array[int]] = {}
        digests: Counter[int] = Counter()
        at, start_unix_ns = 0, self._source.start_unix_ns
        for log_ns, channel, sequence, payload in records:
            assert isinstance(payload, memoryview)
            entries = places.get(channel)
            if entries is None:
                entries = places[channel] = array("Q")
            entries.extend((log_ns + start_unix_ns, at))
            at += _MESSAGE_BYTES + len(payload)
            digests[channel] += message_digest(sequence, log_ns + start_unix_ns, payload)
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
            indexes=[
                ChannelIndex(channel, len(entries) // 2, digests[channel], index_record(channel, entries))
                for channel, entries in places.items()
            ],
        )

    def _rebuilt(self, kept: list[bool]) -> SealedChunk:
        """The chunk with only those of its messages that are kept."""
        place = self._scan.summary.chunks[-1]
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
