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
from collections.abc import Iterable

from mcap.records import Attachment, Channel, Metadata, Schema

from flowrec.store.session_metadata import DIGEST, is_header_file

_MODULUS = 1 << 256  # of a sum of SHA-256
_MESSAGE = struct.Struct("<IQ")  # sequence, log time
_LARGE_BYTES, _LARGE = 1 << 16, struct.Struct("<QI")  # length, checksum
HEAD = "head"  # key of the digest of the records that are no messages
_PREFIX = "flowrec."


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
    of_topics = {topic: f"{topic_text(count, total)} {declared}" for topic, count, total, declared in topics if count}
    return Metadata(DIGEST, {HEAD: sum_text(head), **of_topics})


def sum_text(total: int) -> str:
    """A sum as it stands in the record."""
    return f"{total % _MODULUS:064x}"


def topic_text(count: int, total: int) -> str:
    """Number and sum of the messages of a topic, as they stand in the record."""
    return f"{count} {sum_text(total)}" if count else "0"
