"""The MCAP channel, codec and chunk group of each topic, and which topics a recording leaves out.

There are three groups of chunks: frames, state, and the views for other programs. So reading all poses decompresses
neither images nor previews. Channel numbers depend on the tables only: the same ticks make the same records.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from fnmatch import fnmatchcase
from typing import Any

from mcap.records import Channel
from mcap.records import Schema as SchemaRecord

from flowrec.declarations import Role
from flowrec.errors import UsageError
from flowrec.messages import Frame
from flowrec.store.codec import Codec, codec_of
from flowrec.store.frame_encodings import ENCODINGS, FRAME_CODECS, FrameEncoding
from flowrec.store.roi import Region
from flowrec.store.schema import Schema, foxglove_schema
from flowrec.store.viewer_topics import VIEWER_TOPICS
from flowrec.topics import BY_FIELD, TOPICS

FRAMES, STATE, VIEW = "frames", "state", "view"
GROUPS = (FRAMES, STATE, VIEW)
FRAME_PATH = BY_FIELD["frame"].path

# A replay continues from what the stages recorded; without images it takes the tracks as they were recorded.
_NEEDED = {topic.path for topic in TOPICS if topic.role in (Role.INPUT, Role.OUTPUT)} - {FRAME_PATH}


@dataclass(frozen=True, slots=True)
class Slot:
    """Channel number, chunk group, schema and channel metadata of one topic."""

    channel: int
    group: str
    schema: Schema
    metadata: dict[str, str]


def message_codec(message_type: type[Any], schema_name: str = "") -> Codec:
    """The codec of any message type; of a Frame that of the schema, foxglove.RawImage where it is none of a Frame."""
    if message_type is Frame:
        return FRAME_CODECS.get(schema_name, ENCODINGS["raw"].codec)
    return codec_of(message_type)


def _slots() -> Iterator[tuple[str, Slot]]:
    for number, topic in enumerate(TOPICS, 1):
        group = FRAMES if topic.field == "frame" else STATE
        yield topic.path, Slot(number, group, message_codec(topic.type).schema, {"role": topic.role.value})
    for number, view in enumerate(VIEWER_TOPICS, len(TOPICS) + 1):
        metadata = {"role": "view", "made_from": view.source}
        yield view.path, Slot(number, VIEW, foxglove_schema(view.schema), metadata)


SLOTS: dict[str, Slot] = dict(_slots())


def declarations(frames: FrameEncoding, region: Region | None = None) -> Iterator[SchemaRecord | Channel]:
    """The schema and channel records of a file, each schema before the first channel that uses it."""
    schemas: dict[str, int] = {}
    for path, slot in SLOTS.items():
        schema, metadata = slot.schema, slot.metadata
        if path == FRAME_PATH:
            schema = frames.codec.schema
            metadata = metadata | {"encoding": frames.name, "lossless": "yes" if frames.lossless else "no"}
            metadata |= region.notes if region is not None else {}
        if schema.name not in schemas:
            schemas[schema.name] = len(schemas) + 1
            yield SchemaRecord(id=schemas[schema.name], data=schema.data, encoding="protobuf", name=schema.name)
        yield Channel(slot.channel, path, "protobuf", metadata, schemas[schema.name])


def is_left_out(path: str, patterns: Iterable[str]) -> bool:
    """Whether a topic matches one of the patterns."""
    return any(fnmatchcase(path, pattern) for pattern in patterns)


def left_out(patterns: Iterable[str]) -> frozenset[str]:
    """The topics, views for other programs included, that match names or patterns such as `/view/*`.

    Raises
    ------
    UsageError : a pattern matches no topic, or one without which the session could not be replayed.
    """
    chosen: set[str] = set()
    for pattern in patterns:
        found = {path for path in SLOTS if is_left_out(path, [pattern])}
        if not found:
            raise UsageError(
                f"recording.leave_out: no topic is called {pattern!r}; flowrec info lists those of a session"
            )
        if needed := sorted(found & _NEEDED):
            free = ", ".join(path for path in SLOTS if path not in _NEEDED and not path.startswith("/view/"))
            raise UsageError(
                f"recording.leave_out: a replay needs {needed[0]}; what can be left out is {free} and /view/*"
            )
        chosen |= found
    return frozenset(chosen)
