"""Whether the messages of a session file are those of this flowrec."""

from __future__ import annotations

from dataclasses import fields

from google.protobuf import descriptor_pb2

from flowrec.declarations import defaulted_fields
from flowrec.errors import SessionError
from flowrec.store.codec import codec_of
from flowrec.store.mcap_index import Summary
from flowrec.store.roi import Region, region_from
from flowrec.store.session_metadata import Head
from flowrec.topics import BY_FIELD, BY_PATH
from flowrec.version import __version__


class Contents(Head):
    """The index of a session file whose messages can be read; besides what Head has:

    Attributes
    ----------
    fields : field of Tick by channel number, for the topics that this flowrec knows.
    schemas : name of the schema by channel number, for the same.
    recorded_fields : by field of Tick, the fields that its messages have in this file; an older file lacks some.
    """

    def _open(self, summary: Summary | None) -> None:
        super()._open(summary)
        self.fields = {
            channel.id: BY_PATH[channel.topic].field for channel in self.channels.values() if channel.topic in BY_PATH
        }
        self.schemas: dict[int, str] = {}
        self.recorded_fields: dict[str, frozenset[str]] = {}
        for channel in self.fields:
            self._check_schema(channel)

    @property
    def frame_encoding(self) -> str:
        """Name of the way in which frames travel (frames.py); empty in files that do not say."""
        channels = self._summary.channels.values()
        return next((c.metadata.get("encoding", "") for c in channels if c.topic == BY_FIELD["frame"].path), "")

    @property
    def region(self) -> Region | None:
        """Which part of most images was kept (region.py); None: they are whole."""
        channels = self._summary.channels.values()
        return next((region_from(c.metadata) for c in channels if c.topic == BY_FIELD["frame"].path), None)

    def _check_schema(self, channel_number: int) -> None:
        channel = self._summary.channels[channel_number]
        found = self._summary.schemas[channel.schema_id]
        kind = BY_PATH[channel.topic].type
        expected = codec_of(kind, found.name).schema
        self.schemas[channel_number] = found.name
        ours_all = frozenset(part.name for part in fields(kind))  # type: ignore[arg-type]
        self.recorded_fields[self.fields[channel_number]] = ours_all
        same_kind = (found.name, found.encoding, channel.message_encoding) == (expected.name, "protobuf", "protobuf")
        # The standard schemas may gain fields and comments with a new foxglove-sdk and stay what they are.
        if same_kind and (found.data == expected.data or not expected.name.startswith("flowrec.")):
            return
        with self.source.parsing(0):
            theirs, ours = _fields_of(found.data), _fields_of(expected.data)
        # A field that has come since is empty in an older file; where the message allows for that, it is read.
        if same_kind and theirs <= ours and {name for name, _ in ours - theirs} <= _may_be_missing(channel.topic):
            there = {name.removeprefix(f"{kind.__name__}.") for name, _ in theirs}
            self.recorded_fields[self.fields[channel_number]] = ours_all & there
            return
        differs = sorted({name for name, _ in theirs ^ ours}) or [found.name]
        raise SessionError(
            f"{self.source.path}: {channel.topic} is laid out differently ({', '.join(differs)});"
            f" read it with flowrec {self.flowrec_version}, which wrote it (this is {__version__})"
        )


def _may_be_missing(topic: str) -> set[str]:
    """Fields of the topic's message that have a default, and what only they need."""
    kind = BY_PATH[topic].type
    needed = {part.name for part in fields(kind)} - defaulted_fields(kind)  # type: ignore[arg-type]
    known = _fields_of(codec_of(kind).schema.data)
    return {name for name, _ in known if name.removeprefix(f"{kind.__name__}.") not in needed}


def _fields_of(data: bytes) -> set[tuple[str, bytes]]:
    files = descriptor_pb2.FileDescriptorSet.FromString(data).file
    return {
        (f"{message.name}.{field.name}", field.SerializeToString(deterministic=True))
        for file in files
        for message in file.message_type
        for field in message.field
    }
