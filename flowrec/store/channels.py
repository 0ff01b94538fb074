"""The MCAP channels: as flowrec declares them in a new file, and as a session file declares them.

A channel has a codec and a chunk group. A session file is refused when its schemas are not those of this flowrec.

There are three groups of chunks: frames, state, and the viewer topics. So reading all poses decompresses
neither images nor previews. Channel numbers depend on the tables only: the same ticks make the same records.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from fnmatch import fnmatchcase
from operator import attrgetter
from typing import Any

from google.protobuf import descriptor_pb2
from mcap.records import Channel
from mcap.records import Schema as SchemaRecord

from flowrec.core import (
    BY_FIELD,
    FIXED,
    PIXEL_BITS,
    TOPICS,
    Frame,
    Role,
    SessionError,
    Topic,
    TopicTable,
    UsageError,
    __version__,
    array_shapes,
    declaration,
    declared_topic,
    defaulted_fields,
    message_fields,
    shape_error,
    shape_fault,
)
from flowrec.store.codec import Codec, codec_of, decode, unpackers
from flowrec.store.frame_encodings import FrameEncoding, frame_codec
from flowrec.store.mcap_format import Record, Summary
from flowrec.store.roi import Region, region_from
from flowrec.store.schema import Schema
from flowrec.store.session_metadata import SessionMetadata
from flowrec.store.viewer_scene import LENGTHS, UNIT
from flowrec.store.viewer_topics import VIEWER_TOPICS

FRAMES, STATE, VIEW = "frames", "state", "view"
GROUPS = (FRAMES, STATE, VIEW)
FRAME_PATH = BY_FIELD["frame"].path

# The values of a message in order of its fields: int, float, bool, str, tuple for a vector, array, or None.
Row = tuple[Any, ...]
_SMALL_BYTES = 1 << 14  # of a payload that is parsed as a whole

_OWN_TYPES = frozenset(topic.type for topic in TOPICS)
_DECLARATION = "declaration"  # in the metadata of the channel of an extra topic
_BITS = "bits"  # in the metadata of the frames' channel: depth of the images; 8 where it is not stated


@dataclass(frozen=True, slots=True)
class Slot:
    """Channel number, chunk group, schema and channel metadata of one topic."""

    channel: int
    group: str
    schema: Schema
    metadata: dict[str, str]


def message_codec(message_type: type[Any], schema_name: str = "", bits: int = 8, path: str = "") -> Codec:
    """The codec of any message type; of a Frame that of the schema, foxglove.RawImage where it is none of a Frame.

    `bits` is the depth of the frames, `path` that of an extra topic, because packages may name types alike.
    """
    if message_type is Frame:
        return frame_codec(schema_name, bits)
    return codec_of(message_type, "" if message_type in _OWN_TYPES else path)


def _own_slots() -> Iterator[tuple[str, Slot]]:
    for number, topic in enumerate(TOPICS, 1):
        group = FRAMES if topic.type is Frame else STATE
        yield topic.path, Slot(number, group, message_codec(topic.type).schema, {"role": topic.role.value})
    for number, view in enumerate(VIEWER_TOPICS, len(TOPICS) + 1):
        yield view.path, Slot(number, VIEW, view.schema, {"role": "view", "made_from": view.source, LENGTHS: UNIT})


SLOTS: dict[str, Slot] = dict(_own_slots())
VIEWED = frozenset(view.path for view in VIEWER_TOPICS)


def slots_of(topics: TopicTable) -> dict[str, Slot]:
    """The slots of all topics of a file by path; those of extra topics follow ours.

    Raises UsageError: an extra topic has the path of a viewer topic.
    """
    slots = dict(SLOTS)
    for number, topic in enumerate(topics.extra, len(SLOTS) + 1):
        if topic.path in SLOTS:
            raise UsageError(f"{topic.path}: is a topic of flowrec; choose another path")
        metadata = {"role": topic.role.value, _DECLARATION: declaration(topic)}
        slots[topic.path] = Slot(number, STATE, message_codec(topic.type, path=topic.path).schema, metadata)
    return slots


def declarations(
    frames: FrameEncoding, region: Region | None = None, topics: TopicTable = FIXED
) -> Iterator[SchemaRecord | Channel]:
    """The schema and channel records of a file, each schema before the first channel that uses it."""
    schemas: dict[str, int] = {}
    for path, slot in slots_of(topics).items():
        schema, metadata = slot.schema, slot.metadata
        if path == FRAME_PATH:
            schema = frames.codec.schema
            metadata = metadata | {"encoding": frames.name, "lossless": "yes" if frames.lossless else "no"}
            metadata |= {_BITS: str(frames.bits)} if frames.bits != 8 else {}
            metadata |= region.notes if region is not None else {}
        if schema.name not in schemas:
            schemas[schema.name] = len(schemas) + 1
            yield SchemaRecord(id=schemas[schema.name], data=schema.data, encoding=schema.encoding, name=schema.name)
        yield Channel(slot.channel, path, schema.message_encoding, metadata, schemas[schema.name])


def is_left_out(path: str, patterns: Iterable[str]) -> bool:
    """True if a topic matches one of the patterns."""
    return any(fnmatchcase(path, pattern) for pattern in patterns)


def left_out(patterns: Iterable[str], topics: TopicTable = FIXED) -> frozenset[str]:
    """The topics that match names or patterns; `/view/*` matches all viewer topics, also those under the images' topic.

    Raises UsageError: a pattern matches no topic, or one without which the session could not be replayed.
    """
    chosen: set[str] = set()
    # A replay continues from what the stages recorded; without images it takes the tracks as they were recorded.
    needed_ones = {topic.path for topic in topics.topics if topic.role in (Role.INPUT, Role.OUTPUT)} - {FRAME_PATH}
    for pattern in patterns:
        found = {path for path in slots_of(topics) if is_left_out(path, [pattern])}
        found |= {path for path in VIEWED if is_left_out(f"/view{path}", [pattern])}
        if not found:
            raise UsageError(
                f"recording.leave_out: no topic is called {pattern!r}; flowrec info lists those of a session"
            )
        if needed := sorted(found & needed_ones):
            free = ", ".join(path for path in slots_of(topics) if path not in needed_ones | VIEWED)
            raise UsageError(
                f"recording.leave_out: a replay needs {needed[0]}; what can be left out is {free} and /view/*"
            )
        chosen |= found
    return frozenset(chosen)


class SessionContents(SessionMetadata):
    """A session file whose messages can be read; besides what SessionMetadata has:

    Attributes
    ----------
    topics : those that this flowrec knows and those that the file declares.
    fields : field of Tick by channel number, for these topics; of an extra one its path.
    codecs : how their messages are decoded, by channel number.
    recorded_fields : by field of Tick, the fields that its messages have in this file; an older file lacks some.
    frame_encoding : name of the encoding of frames (frame_encodings.py); empty in files that do not say.
    frame_bits : depth of the images.
    region : which window of most images was recorded (roi.py); None: the images are not cut.
    """

    def _open(self, summary: Summary | None) -> None:
        super()._open(summary)
        self.topics = self._topics()
        self.fields: dict[int, str] = {}
        self.codecs: dict[int, Codec] = {}
        self.recorded_fields: dict[str, frozenset[str]] = {}
        self.frame_encoding = ""
        self.frame_bits = 8
        self.region: Region | None = None
        for channel in self.channels.values():
            if channel.topic == FRAME_PATH:
                self.frame_encoding = channel.metadata.get("encoding", "")
                self.frame_bits = bits_from(channel.metadata)
                self.region = region_from(channel.metadata)
            if channel.topic in self.topics.by_path:
                self.fields[channel.id] = self.topics.by_path[channel.topic].field
                self._check_schema(channel.id)

    def _topics(self) -> TopicTable:
        declared: dict[str, Topic] = {}
        for channel in self.channels.values():
            text = channel.metadata.get(_DECLARATION)
            if text is None:
                continue
            try:
                topic = declared_topic(channel.topic, text)
                if declared.setdefault(topic.path, topic) != topic:
                    raise UsageError(f"{topic.path}: is declared twice, and not alike")
            except UsageError as error:
                raise SessionError(f"{self.source.path}: {error}; the file was damaged or edited") from error
        return TopicTable(declared.values()) if declared else FIXED

    def decode(self, record: Record) -> Any:
        """The message in a record of a known topic. Raises SessionError: it is damaged."""
        kind = self.topics.by_field[self.fields[record.channel]].type
        codec, start_unix_ns = self.codecs[record.channel], self.source.start_unix_ns
        message = decode(kind, codec, record.payload, record.sequence, start_unix_ns)
        if fault := shape_error(message):
            raise SessionError(fault)
        return message

    def row_decoder(self, channel: int) -> Callable[[Record], Row]:
        """Function from a record of a channel, not of images, to its row; it raises SessionError for a damaged record.

        It takes a fifth of the time that messages with their arrays take.
        """
        kind: Any = self.topics.by_field[self.fields[channel]].type
        codec = self.codecs[channel]
        names = [each.name for each in message_fields(kind)]

        def whole(record: Record) -> Row:
            message = self.decode(record)
            return tuple(getattr(message, name) for name in names)

        if codec.has_unix_time:
            return whole
        parse = codec.schema.wire.FromString
        unpack_all = unpackers(kind, tuple)  # no lists, which the garbage collector visits again and again
        arrays = {name: names.index(name) for name, _ in array_shapes(kind)}

        def small(record: Record) -> Row:
            payload = record.payload
            if len(payload) > _SMALL_BYTES:
                return whole(record)
            try:
                parsed = parse(payload)
                row = tuple([unpack(parsed) for unpack in unpack_all])
            except Exception:  # noqa: BLE001 - the careful decoder says what is wrong with it, as for every reader
                return whole(record)
            if arrays and (fault := shape_fault(kind, lambda name: row[arrays[name]])):
                raise SessionError(fault)
            return row

        return small

    def _check_schema(self, channel_number: int) -> None:
        channel = self.channels[channel_number]
        found = self.schemas[channel.schema_id]
        topic = self.topics.by_path[channel.topic]
        kind = topic.type
        codec = self.codecs[channel_number] = message_codec(kind, found.name, self.frame_bits, topic.path)
        expected = codec.schema
        ours_all = frozenset(map(attrgetter("name"), message_fields(kind)))
        self.recorded_fields[self.fields[channel_number]] = ours_all
        same_kind = (found.name, found.encoding, channel.message_encoding) == (expected.name, "protobuf", "protobuf")
        # The standard schemas may gain fields and comments with a new foxglove-sdk and stay compatible.
        if same_kind and (found.data == expected.data or not expected.name.startswith("flowrec.")):
            return
        with self.source.parsing(0):
            theirs, ours = _fields_of(found.data), _fields_of(expected.data)
        # A field that was added since is empty in an older file; where the message allows for that, it is read.
        missing = {name.removeprefix(f"{kind.__name__}.") for name, _ in ours - theirs}
        if same_kind and theirs <= ours and not missing & (ours_all - defaulted_fields(kind)):
            there = {name.removeprefix(f"{kind.__name__}.") for name, _ in theirs}
            self.recorded_fields[self.fields[channel_number]] = ours_all & there
            return
        differs = sorted({name for name, _ in theirs ^ ours}) or [found.name]
        raise SessionError(
            f"{self.source.path}: {channel.topic} has another schema ({', '.join(differs)});"
            f" read it with flowrec {self.flowrec_version}, which wrote it (this is {__version__})"
        )


def bits_from(metadata: Mapping[str, str]) -> int:
    """Depth of the images, from the metadata of their channel."""
    text = metadata.get(_BITS, "8")
    return int(text) if text in map(str, PIXEL_BITS) else PIXEL_BITS[-1]


def _fields_of(data: bytes) -> set[tuple[str, bytes]]:
    """Name, with its message's, and declaration of each field in a FileDescriptorSet."""
    files = descriptor_pb2.FileDescriptorSet.FromString(data).file
    return {
        (f"{message.name}.{field.name}", field.SerializeToString(deterministic=True))
        for file in files
        for message in file.message_type
        for field in message.field
    }
