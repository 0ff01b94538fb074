"""Which topic has which MCAP channel and shares chunks with whom.

Three groups of chunks: frames, state, and the views for other programs; so that reading all poses decompresses
neither images nor previews. Identifiers depend on the tables only: the same ticks make the same records.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

from mcap.records import Channel
from mcap.records import Schema as SchemaRecord

from flowrec.store.codec import codec_of
from flowrec.store.frame_encodings import FrameEncoding
from flowrec.store.roi import Region
from flowrec.store.schema import Schema, foxglove_schema
from flowrec.store.viewer_topics import MIRRORS
from flowrec.topics import BY_FIELD, TOPICS

FRAMES, STATE, VIEW = "frames", "state", "view"
GROUPS = (FRAMES, STATE, VIEW)


@dataclass(frozen=True, slots=True)
class Slot:
    """Channel number and chunk group of one path."""

    channel: int
    group: str
    schema: Schema
    notes: dict[str, str]


def _slots() -> Iterator[tuple[str, Slot]]:
    number = 0
    for topic in TOPICS:
        number += 1
        group = FRAMES if topic.field == "frame" else STATE
        yield topic.path, Slot(number, group, codec_of(topic.type).schema, {"role": topic.role.value})
    for mirror in MIRRORS:
        number += 1
        notes = {"role": "view", "made_from": mirror.source}
        yield mirror.path, Slot(number, VIEW, foxglove_schema(mirror.schema), notes)


SLOTS: dict[str, Slot] = dict(_slots())


FRAME_PATH = BY_FIELD["frame"].path


def declarations(frames: FrameEncoding, region: Region | None = None) -> Iterator[SchemaRecord | Channel]:
    """Every schema, each before the first channel that uses it, and every channel."""
    schemas: dict[str, int] = {}
    for path, usual in SLOTS.items():
        slot = usual
        if path == FRAME_PATH:
            notes = {"encoding": frames.name, "lossless": "yes" if frames.lossless else "no"}
            notes |= region.notes if region is not None else {}
            slot = replace(usual, schema=frames.codec.schema, notes=usual.notes | notes)
        name = slot.schema.name
        if name not in schemas:
            schemas[name] = len(schemas) + 1
            yield SchemaRecord(id=schemas[name], data=slot.schema.data, encoding="protobuf", name=name)
        yield Channel(
            id=slot.channel,
            topic=path,
            message_encoding="protobuf",
            metadata=slot.notes,
            schema_id=schemas[name],
        )
