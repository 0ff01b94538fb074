"""Reads all records of a file, finished or damaged, and compares them with its index."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

from mcap.opcode import Opcode
from mcap.records import ChunkIndex, Metadata

from flowrec.core import FIXED, Message, SessionError, TopicTable, printable, seconds
from flowrec.store.channels import SessionContents
from flowrec.store.digest import HEAD, channel_digest, head_digest, sum_text, topic_text
from flowrec.store.lookup import GatheredCopies
from flowrec.store.mcap_format import DamageError, Record, UnfinishedError
from flowrec.store.mcap_reader import McapReader
from flowrec.store.roi import Region
from flowrec.store.run_files import RunFile, files_of
from flowrec.store.scan import Scan, scan
from flowrec.store.session_metadata import SessionHeader, SessionMetadata, is_header_file

_FAULTS_LIMIT, _TEXT_LIMIT = 40, 200  # a made-up file may name any number of topics

See = Callable[[str, int, Message], None]  # field of Tick, time of the tick in ns, message


@dataclass(slots=True)
class Audit:
    """The result of an audit; its texts contain no advice.

    Attributes
    ----------
    path, size_bytes : the file.
    finished : it has a summary, so that other verbs open it.
    why_not : else, what is wrong with its end.
    flowrec_version : of the program that wrote it.
    header : configuration, chip and origin; None where they are incomplete, see `header_fault`.
    outcome : how the run ended; may be empty.
    counts : messages read, by field of Tick.
    first_ns, last_ns : times of the first and the last message of a known topic; both 0 without any.
    contradictions : where the index differs from what was read, so that reading by it fails.
    disagreements : where it differs, and that does no harm.
    lost : damaged bytes that had to be skipped.
    first_lost : offset of the first of them.
    backwards : by field, how often the time of a tick was before that of the message before.
    stamps_backwards : the same of the stamps in the messages.
    undecodable : by field, messages that can not be decoded; `first_undecodable` says why.
    region : which window of most images was recorded (roi.py); None: the images are not cut.
    edits : what differs from the digest that was recorded; None where there is no digest, or no end.
    missing : by field, messages that are missing between others, by their sequence numbers; not of images.
    topics : those that this flowrec knows, and those that the file declares.
    """

    path: Path
    size_bytes: int
    finished: bool = True
    why_not: str = ""
    flowrec_version: str = "?"
    header: SessionHeader | None = None
    header_fault: str = ""
    outcome: dict[str, str] = field(default_factory=dict)
    counts: Counter[str] = field(default_factory=Counter)
    first_ns: int = 0
    last_ns: int = 0
    contradictions: list[str] = field(default_factory=list)
    disagreements: list[str] = field(default_factory=list)
    lost: int = 0
    first_lost: int = 0
    backwards: Counter[str] = field(default_factory=Counter)
    stamps_backwards: Counter[str] = field(default_factory=Counter)
    undecodable: Counter[str] = field(default_factory=Counter)
    first_undecodable: str = ""
    edits: list[str] | None = None
    missing: Counter[str] = field(default_factory=Counter)
    region: Region | None = None
    topics: TopicTable = FIXED

    @property
    def duration_s(self) -> float:
        """From the first message to the last, in s."""
        return seconds(self.last_ns - self.first_ns)

    @property
    def run_file(self) -> RunFile:
        """The file as run_files.py compares it with others."""
        part = self.header.part if self.header is not None else None
        counts = {self.topics.by_field[name].path: count for name, count in self.counts.items()}
        return RunFile(self.path, part, self.first_ns, self.last_ns, counts, self.outcome, self.size_bytes, None)


def audit(
    path: Path, see: See, progress: Callable[[int], None] | None = None, begin: Callable[[Audit], None] | None = None
) -> Audit:
    """Read everything that can be read, in file order; one chunk is in memory at a time.

    Raises SessionError: it is no session, or none that this flowrec can read; its text says what it is.

    Parameters
    ----------
    see : receives every message that can be decoded; those of one tick need not follow each other.
    progress : receives the byte up to which the file has been read.
    begin : receives what the head says, before the first message.
    """
    why_not = ""
    try:
        contents = SessionContents(path)
    except (UnfinishedError, DamageError) as error:
        why_not = _without_advice(error, path)
        with McapReader(path) as source:
            contents = SessionContents(path, scan(source).summary)
    with contents:
        found = Audit(path, contents.source.size, not why_not, why_not, contents.flowrec_version)
        found.outcome, found.region, found.topics = contents.outcome, contents.region, contents.topics
        try:
            found.header = contents.header
        except SessionError as error:
            found.header_fault = _without_advice(error, path)
        if begin is not None:
            begin(found)
        reading = _ChunkAudit(found, contents, see)
        scanned = scan(contents.source, reading.take, progress, digests=found.finished)
        found.lost, found.first_lost = scanned.lost_bytes, scanned.first_lost
        for channel, name in contents.fields.items():
            if name != "frame" and channel in scanned.gaps:  # the camera numbers the images
                gaps = [gap for gap in scanned.gaps[channel] if gap.before_ns > found.first_ns]
                found.missing[name] += sum(gap.messages for gap in gaps)
        if found.finished:
            found.edits = edits_of(contents, scanned)
            for fatal, text in disagreements(contents, scanned):
                (found.contradictions if fatal else found.disagreements).append(text)
    return found


def digest_faults(path: Path) -> dict[Path, list[str] | None]:
    """Read all files of a session and compare them with their digests: what differs by file; None: it has no digest.

    Raises SessionError: a file can not be read.
    """
    found: dict[Path, list[str] | None] = {}
    for file in files_of(path):
        with SessionMetadata(file) as metadata:
            scanned = scan(metadata.source, digests=True) if metadata.digest is not None else Scan(metadata.source)
            found[file] = edits_of(metadata, scanned)
    return found


class _ChunkAudit:
    """Decodes chunk after chunk and counts."""

    def __init__(self, found: Audit, contents: SessionContents, see: See) -> None:
        self._found = found
        self._contents = contents
        self._see = see
        self._last_ns: dict[str, int] = {}
        self._last_stamp_ns: dict[str, int] = {}

    def take(self, place: ChunkIndex, records: list[Record]) -> None:
        found = self._found
        for record in records:
            name = self._contents.fields.get(record.channel)
            if name is None:
                continue
            found.first_ns = min(found.first_ns, record.log_ns) if found.counts else record.log_ns
            found.last_ns = max(found.last_ns, record.log_ns)
            found.counts[name] += 1
            found.backwards[name] += record.log_ns < self._last_ns.get(name, record.log_ns)
            self._last_ns[name] = record.log_ns
            try:
                message = self._contents.decode(record)
            except SessionError as error:
                found.undecodable[name] += 1
                path, offset = found.topics.by_field[name].path, place.chunk_start_offset
                found.first_undecodable = found.first_undecodable or f"{path} in the chunk at byte {offset}: {error}"
                continue
            stamp_ns = message.stamp_ns
            found.stamps_backwards[name] += stamp_ns < self._last_stamp_ns.get(name, stamp_ns)
            self._last_stamp_ns[name] = stamp_ns
            self._see(name, record.log_ns, message)


def disagreements(contents: SessionContents, found: Scan) -> Iterator[tuple[bool, str]]:
    """Differences between the index and what was read, each with whether reading by the index fails."""
    listed = {chunk.chunk_start_offset: chunk for chunk in contents.chunks}
    seen = {chunk.chunk_start_offset: chunk for chunk in found.summary.chunks}
    if listed.keys() - seen:
        yield True, f"{len(listed.keys() - seen)} chunks of the index can not be read"
    if seen.keys() - listed:
        yield True, f"{len(seen.keys() - listed)} chunks are not in the index"
    misled = sum(not _describes(listed[place], seen[place]) for place in listed.keys() & seen.keys())
    if misled:
        yield True, f"{misled} chunks hold something else than the index says"
    declared = contents.statistics.channel_message_counts
    for channel in sorted(contents.channels.keys() | found.counts.keys()):
        announced, read = declared.get(channel, 0), found.counts[channel]
        if announced != read:
            known = contents.channels.get(channel)
            topic = known.topic if known is not None else f"an undeclared channel {channel}"
            yield channel in contents.fields, f"{announced} messages of {topic} are announced, {read} were read"
    for channel, known in contents.channels.items():
        there = found.summary.channels.get(channel)
        if there is not None and (there.topic, there.schema_id) != (known.topic, known.schema_id):
            yield True, f"channel {channel} is {there.topic} in the file and {known.topic} in its index"
    for what, ours, theirs in (
        ("attachments", contents.attachments, found.summary.attachments),
        ("metadata records", contents.metadata, found.summary.metadata),
    ):
        apart = {index.offset for index in ours} ^ {index.offset for index in theirs}
        if apart:
            yield False, f"{len(apart)} {what} are only in the index, or only outside it"
    if not contents.source.lookup_agrees():
        yield True, "the lookup record, which is read at a URL, is not of this file"
    if wrong := GatheredCopies(contents.source.read_summary()).wrong(contents.source.read):
        yield True, f"{wrong} records have other copies at the end of the file, where they are read at a URL"


def _describes(listed: ChunkIndex, seen: ChunkIndex) -> bool:
    """True if the index of a chunk is right for a reader."""
    return (
        listed.message_start_time <= seen.message_start_time
        and seen.message_end_time <= listed.message_end_time
        and (listed.chunk_length, listed.uncompressed_size) == (seen.chunk_length, seen.uncompressed_size)
        and (
            not listed.message_index_offsets or seen.message_index_offsets.keys() <= listed.message_index_offsets.keys()
        )
    )


def _without_advice(error: SessionError, path: Path) -> str:
    return error.what if isinstance(error, DamageError) else str(error).removeprefix(f"{path}: ").split("; ")[0]


def edits_of(file: SessionMetadata, found: Scan) -> list[str] | None:
    """Differences of a finished file from the digest that it contains, by a scan with `digests`; None: it has none.

    Topics and records that flowrec has not written are passed over.
    """
    recorded = file.digest
    if recorded is None:
        # Files of the first release have neither a digest nor a start.
        return ["the digest, which was taken out"] if file.source.start_unix_ns and file.outcome else None
    counts: Counter[str] = Counter()
    sums: Counter[str] = Counter()
    declared: dict[str, set[str]] = {}
    ours: set[str] = set()
    for number, channel in file.channels.items():
        counts[channel.topic] += found.counts[number]
        sums[channel.topic] += found.sums[number]
        if found.counts[number]:  # other programs leave out channels without a message
            of_channel = channel_digest(channel, file.schemas.get(channel.schema_id))
            declared.setdefault(channel.topic, set()).add(of_channel)
        if "role" in channel.metadata:  # flowrec has declared it
            ours.add(channel.topic)
    faults = []
    if not _head_matches(file, recorded.get(HEAD)):
        faults.append("the head (configuration, chip, origin or outcome)")
    for topic in sorted((recorded.keys() | {topic for topic in ours if counts[topic]}) - {HEAD}):
        expected, read = recorded.get(topic, "0").split(" "), topic_text(counts[topic], sums[topic]).split(" ")
        if declared.get(topic, set()) - set(expected[2:]) and expected[2:]:
            faults.append(printable(f"{topic[:_TEXT_LIMIT]}, in its schema or metadata"))
        if read == expected[:2]:
            continue
        numbers = f", {read[0]} where {expected[0][:_TEXT_LIMIT]} were" if expected[0] != read[0] else ""
        here = {number for number, channel in file.channels.items() if channel.topic == topic}
        faults.append(printable(f"{topic[:_TEXT_LIMIT]}, in its messages{numbers}{_extent(found, here)}"))
    more = len(faults) - _FAULTS_LIMIT
    return faults if more <= 0 else [*faults[:_FAULTS_LIMIT], f"and so on, {more} more"]


def _extent(found: Scan, channels: set[int]) -> str:
    """From when to when, and in which bytes of the file, the messages of some channels are; '' without one."""
    ends = [found.first[number] for number in channels & found.first.keys()]
    ends += [found.last[number] for number in channels & found.last.keys()]
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
    return recorded == sum_text(total)
