"""The digest of what a session file holds: one per topic over its messages, and one over its head.

It detects damage and edits after the recording, also where a replay can not: in inputs, truth, diagnostics, views and
the configuration. It does not detect a forgery, because whoever can write the file can write the digest: a file that
agrees with it is consistent, and unsigned.

The digest of a topic is the sum, modulo 2^256, of the SHA-256 of each message: MCAP sequence, log time, and payload. So
it does not depend on the order, the chunks or the compression: a file that another MCAP tool has rewritten with the
same messages keeps it. Of a payload of 64 KiB or more the length and the CRC-32 go into the SHA-256, which takes a
quarter of the time; one edit in 4e9 is not detected.

With it stands the SHA-256 of what the topic's channel declares: its schema, and its metadata, as depth and region of
the images, without which a message means something else. Files of older versions have none.
"""

from __future__ import annotations

import hashlib
import json
import struct
import zlib
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, field

from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, ChunkIndex, Metadata, Schema

from flowrec.core import SessionError, printable, seconds
from flowrec.store.mcap_format import Record
from flowrec.store.session_metadata import DIGEST, SessionMetadata, is_header_file

_MODULUS = 1 << 256
_MESSAGE = struct.Struct("<IQ")  # sequence, log time
_LARGE_BYTES, _LARGE = 1 << 16, struct.Struct("<QI")  # length, checksum
_HEAD = "head"  # key of the digest of the records that are no messages
_PREFIX = "flowrec."
_FAULTS_LIMIT, _TEXT_LIMIT = 40, 200  # a made-up file may name any number of topics


def message_digest(sequence: int, log_ns: int, payload: bytes | memoryview) -> int:
    """Term of one message in the sum of its topic; `log_ns` as in the file."""
    hashed = hashlib.sha256(_MESSAGE.pack(sequence, log_ns))
    hashed.update(payload if len(payload) < _LARGE_BYTES else _LARGE.pack(len(payload), zlib.crc32(payload)))
    return int.from_bytes(hashed.digest(), "little")


def head_digest(record: Metadata | Attachment) -> int:
    """Term of one record outside the chunks in the sum of the head; 0 where it is none of flowrec's."""
    if isinstance(record, Metadata):
        if record.name == DIGEST or not record.name.startswith(_PREFIX):
            return 0
        hashed = hashlib.sha256(json.dumps([record.name, sorted(record.metadata.items())]).encode())
    else:
        if not is_header_file(record.name):
            return 0
        hashed = hashlib.sha256(json.dumps([record.name, record.media_type, record.log_time]).encode())
        hashed.update(record.data)
    return int.from_bytes(hashed.digest(), "little")


def channel_digest(channel: Channel, schema: Schema | None) -> str:
    """The digest of what a channel declares."""
    declared = [channel.message_encoding, sorted(channel.metadata.items())]
    if schema is not None:
        declared += [schema.name, schema.encoding, schema.data.hex()]
    return hashlib.sha256(json.dumps(declared).encode()).hexdigest()


def digest_record(head: int, topics: Iterable[tuple[str, int, int, str]]) -> Metadata:
    """The record of a file's digest: sum of its head; name, number of messages, sum and channel of each topic."""
    of_topics = {topic: f"{_topic_text(count, total)} {declared}" for topic, count, total, declared in topics if count}
    return Metadata(DIGEST, {_HEAD: _text(head), **of_topics})


def _text(total: int) -> str:
    return f"{total % _MODULUS:064x}"


def _topic_text(count: int, total: int) -> str:
    return f"{count} {_text(total)}" if count else "0"


@dataclass(slots=True)
class FileDigest:
    """The digest of a file, computed while it is read.

    `start_unix_ns` of the session is added to the times of the messages, to have them as in the file.
    """

    start_unix_ns: int = 0
    counts: Counter[int] = field(default_factory=Counter)
    sums: Counter[int] = field(default_factory=Counter)
    first: dict[int, tuple[int, int]] = field(default_factory=dict)  # by channel, session time in ns and chunk's offset
    last: dict[int, tuple[int, int]] = field(default_factory=dict)

    def add(self, place: ChunkIndex, records: Iterable[Record]) -> None:
        """Add the messages of one chunk."""
        for record in records:
            assert isinstance(record.payload, memoryview)
            self.counts[record.channel] += 1
            self.last[record.channel] = at = (record.log_ns, place.chunk_start_offset)
            self.first.setdefault(record.channel, at)
            log_ns = record.log_ns + self.start_unix_ns
            self.sums[record.channel] += message_digest(record.sequence, log_ns, record.payload)

    def faults(self, file: SessionMetadata) -> list[str] | None:
        """Differences of a finished file from the digest that it contains, as far as known; None: it contains none.

        Topics and records that flowrec has not written are passed over.
        """
        recorded = file.digest
        if recorded is None:
            # Files of the first release have neither a digest nor a start.
            return ["the digest, which was taken out"] if self.start_unix_ns and file.outcome else None
        counts: Counter[str] = Counter()
        sums: Counter[str] = Counter()
        declared: dict[str, set[str]] = {}
        ours: set[str] = set()
        for number, channel in file.channels.items():
            counts[channel.topic] += self.counts[number]
            sums[channel.topic] += self.sums[number]
            if self.counts[number]:  # other programs leave out channels without a message
                of_channel = channel_digest(channel, file.schemas.get(channel.schema_id))
                declared.setdefault(channel.topic, set()).add(of_channel)
            if "role" in channel.metadata:  # flowrec has declared it
                ours.add(channel.topic)
        faults = []
        if not _head_matches(file, recorded.get(_HEAD)):
            faults.append("the head (configuration, chip, origin or outcome)")
        for topic in sorted((recorded.keys() | {topic for topic in ours if counts[topic]}) - {_HEAD}):
            expected, found = recorded.get(topic, "0").split(" "), _topic_text(counts[topic], sums[topic]).split(" ")
            if declared.get(topic, set()) - set(expected[2:]) and expected[2:]:
                faults.append(printable(f"{topic[:_TEXT_LIMIT]}, in its schema or metadata"))
            if found == expected[:2]:
                continue
            numbers = f", {found[0]} where {expected[0][:_TEXT_LIMIT]} were" if expected[0] != found[0] else ""
            here = {number for number, channel in file.channels.items() if channel.topic == topic}
            faults.append(printable(f"{topic[:_TEXT_LIMIT]}, in its messages{numbers}{self._extent(here)}"))
        more = len(faults) - _FAULTS_LIMIT
        return faults if more <= 0 else [*faults[:_FAULTS_LIMIT], f"and so on, {more} more"]

    def _extent(self, channels: set[int]) -> str:
        """From when to when, and in which bytes of the file, the messages of some channels are; '' without one."""
        ends = [self.first[number] for number in channels & self.first.keys()]
        ends += [self.last[number] for number in channels & self.last.keys()]
        if not ends:
            return ""
        times, offsets = [seconds(at_ns) for at_ns, _ in ends], [offset for _, offset in ends]
        place = f"byte {min(offsets)}" if len(set(offsets)) == 1 else f"bytes {min(offsets)} to {max(offsets)}"
        return f" ({min(times):.3f} to {max(times):.3f} s, chunks at {place})"


def _head_matches(file: SessionMetadata, recorded: str | None) -> bool:
    total = 0
    try:
        for index in file.metadata:
            total += head_digest(Metadata(index.name, file.source.metadata(index)))
        for place in file.attachments:
            if is_header_file(place.name):
                total += head_digest(file.source.record(place.offset, place.length, Opcode.ATTACHMENT))
    except SessionError:  # damage, of which the reader says more
        return False
    return recorded == _text(total)
