"""A digest of what a session file holds: per topic over its messages, and over its head.

It finds damage and edits after the recording, also where a replay can not: in inputs, truth, diagnostics, views and
the configuration. It does not find a forger, who can compute it anew.

The digest of a topic is the sum, modulo 2^256, of the SHA-256 of each message: MCAP sequence, log time, and payload. So
it does not depend on the order, the chunks or the compression: a file that another MCAP tool has rewritten with the
same messages keeps it. Of a payload of 64 KiB or more the length and the CRC-32 go into the SHA-256, which takes a
quarter of the time: one edit of 4e9 goes unseen.
"""

from __future__ import annotations

import hashlib
import json
import struct
import zlib
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from mcap.records import Attachment, Metadata

from flowrec.errors import SessionError, printable
from flowrec.store.metadata import DIGEST, belongs

if TYPE_CHECKING:  # both write or read what is hashed here
    from flowrec.store.mcap_reader import Record
    from flowrec.store.session_metadata import Head

_MODULUS = 1 << 256
_MESSAGE = struct.Struct("<IQ")  # sequence, log time
_LARGE_BYTES, _LARGE = 1 << 16, struct.Struct("<QI")  # length, checksum
_HEAD = "head"  # what a digest calls the records that are no messages
_PREFIX = "flowrec."
_FAULTS_LIMIT, _TEXT_LIMIT = 40, 200  # a made-up file may name any number of topics


def of_message(sequence: int, log_ns: int, payload: bytes | memoryview) -> int:
    """What one message adds to the digest of its topic; `log_ns` as in the file."""
    hashed = hashlib.sha256(_MESSAGE.pack(sequence, log_ns))
    hashed.update(payload if len(payload) < _LARGE_BYTES else _LARGE.pack(len(payload), zlib.crc32(payload)))
    return int.from_bytes(hashed.digest(), "little")


def of_record(record: Metadata | Attachment) -> int:
    """What one record outside the chunks adds to the digest of the head; 0 where it is none of flowrec's."""
    if isinstance(record, Metadata):
        if record.name == DIGEST or not record.name.startswith(_PREFIX):
            return 0
        hashed = hashlib.sha256(json.dumps([record.name, sorted(record.metadata.items())]).encode())
    else:
        if not belongs(record.name):
            return 0
        hashed = hashlib.sha256(json.dumps([record.name, record.media_type, record.log_time]).encode())
        hashed.update(record.data)
    return int.from_bytes(hashed.digest(), "little")


def added(total: int, *summands: int) -> int:
    """The digest of several things together."""
    return (total + sum(summands)) % _MODULUS


def record_of(head: int, topics: Iterable[tuple[str, int, int]]) -> Metadata:
    """The digest as a record of the file: of its head, and name, number of messages and digest of each topic."""
    said = {topic: f"{count} {digest:064x}" for topic, count, digest in topics if count}
    return Metadata(DIGEST, {_HEAD: f"{head:064x}", **said})


@dataclass(slots=True)
class Digests:
    """The digests of a file, made while it is read. `start_unix_ns` is what times in the file are later by."""

    start_unix_ns: int = 0
    counts: Counter[int] = field(default_factory=Counter)
    sums: Counter[int] = field(default_factory=Counter)

    def take(self, _offset: int, records: Iterable[Record]) -> None:
        """Add the messages of one chunk."""
        for record in records:
            assert isinstance(record.payload, memoryview)
            self.counts[record.channel] += 1
            digest = of_message(record.sequence, record.log_ns + self.start_unix_ns, record.payload)
            self.sums[record.channel] = added(self.sums[record.channel], digest)

    def faults(self, head: Head) -> list[str] | None:
        """What differs from the digest in a finished file, for people, without advice; None: written without a digest.

        Topics and records that flowrec has not written are passed over.
        """
        said = head.digest
        if said is None:
            # Files of the first release have neither a digest nor a start.
            return ["the digest that was recorded is missing"] if self.start_unix_ns and head.outcome else None
        found: dict[str, tuple[int, int]] = {}
        for number, channel in head.channels.items():
            count, total = found.get(channel.topic, (0, 0))
            found[channel.topic] = count + self.counts[number], added(total, self.sums[number])
        faults = []
        try:
            same = said.get(_HEAD) == f"{_of_head(head):064x}"
        except SessionError:  # damage, of which the reader says more
            same = False
        if not same:
            faults.append("configuration, chip, origin or outcome are not those that were recorded")
        ours = {topic for topic, (count, _) in found.items() if count and _is_ours(head, topic)}
        for topic in sorted((said.keys() | ours) - {_HEAD}):
            count, total = found.get(topic, (0, 0))
            if said.get(topic, "0") == (f"{count} {total:064x}" if count else "0"):
                continue
            recorded = said.get(topic, "0").split(" ")[0]
            numbers = f", {count} where {recorded} were recorded" if recorded != str(count) else ""
            faults.append(printable(f"the messages of {topic} are not those that were recorded{numbers}"[:_TEXT_LIMIT]))
        more = len(faults) - _FAULTS_LIMIT
        return faults if more <= 0 else [*faults[:_FAULTS_LIMIT], f"and so on, {more} more"]


def _is_ours(head: Head, topic: str) -> bool:
    """Whether flowrec has declared a topic: its channels say which role it plays."""
    return any(channel.topic == topic and "role" in channel.metadata for channel in head.channels.values())


def _of_head(head: Head) -> int:
    total = 0
    for index in head.metadata:
        total = added(total, of_record(Metadata(index.name, head.source.metadata(index))))
    for place in head.attachments:
        if belongs(place.name):
            body = head.source.attachment_at(place.offset, place.length)
            total = added(total, of_record(Attachment(0, body.log_ns, body.name, body.media_type, bytes(body.data))))
    return total
