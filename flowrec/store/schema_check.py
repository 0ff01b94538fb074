"""Checks that the messages of a session file have the schemas of this flowrec."""

from __future__ import annotations

from dataclasses import fields
from typing import Any

from google.protobuf import descriptor_pb2

from flowrec.declarations import defaulted_fields
from flowrec.errors import SessionError
from flowrec.store.channels import FRAME_PATH, message_codec
from flowrec.store.codec import Codec, decode
from flowrec.store.mcap_format import Record, Summary
from flowrec.store.roi import Region, region_from
from flowrec.store.session_metadata import SessionMetadata
from flowrec.topics import BY_FIELD, BY_PATH
from flowrec.version import __version__


class SessionContents(SessionMetadata):
    """A session file whose messages can be read; besides what SessionMetadata has:

    Attributes
    ----------
    fields : field of Tick by channel number, for the topics that this flowrec knows.
    codecs : how their messages are decoded, by channel number.
    recorded_fields : by field of Tick, the fields that its messages have in this file; an older file lacks some.
    frame_encoding : name of the encoding of frames (frame_encodings.py); empty in files that do not say.
    region : which window of most images was recorded (roi.py); None: they are whole.
    """

    def _open(self, summary: Summary | None) -> None:
        super()._open(summary)
        self.fields: dict[int, str] = {}
        self.codecs: dict[int, Codec] = {}
        self.recorded_fields: dict[str, frozenset[str]] = {}
        self.frame_encoding = ""
        self.region: Region | None = None
        for channel in self.channels.values():
            if channel.topic in BY_PATH:
                self.fields[channel.id] = BY_PATH[channel.topic].field
                self._check_schema(channel.id)
            if channel.topic == FRAME_PATH:
                self.frame_encoding = channel.metadata.get("encoding", "")
                self.region = region_from(channel.metadata)

    def decode(self, record: Record) -> Any:
        """The message in a record of a known topic.

        Raises
        ------
        SessionError : it is damaged.
        """
        kind = BY_FIELD[self.fields[record.channel]].type
        assert isinstance(record.payload, memoryview)
        return decode(kind, self.codecs[record.channel], record.payload, record.sequence, self.source.start_unix_ns)

    def _check_schema(self, channel_number: int) -> None:
        channel = self.channels[channel_number]
        found = self.schemas[channel.schema_id]
        kind = BY_PATH[channel.topic].type
        codec = self.codecs[channel_number] = message_codec(kind, found.name)
        expected = codec.schema
        ours_all = frozenset(part.name for part in fields(kind))  # type: ignore[arg-type]
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
            f"{self.source.path}: {channel.topic} is laid out differently ({', '.join(differs)});"
            f" read it with flowrec {self.flowrec_version}, which wrote it (this is {__version__})"
        )


def _fields_of(data: bytes) -> set[tuple[str, bytes]]:
    """Name, with its message's, and declaration of each field in a FileDescriptorSet."""
    files = descriptor_pb2.FileDescriptorSet.FromString(data).file
    return {
        (f"{message.name}.{field.name}", field.SerializeToString(deterministic=True))
        for file in files
        for message in file.message_type
        for field in message.field
    }
