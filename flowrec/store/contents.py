"""Whether a file is a session of this flowrec, and what it says about itself."""

from __future__ import annotations

import functools
from collections.abc import Iterable
from dataclasses import fields
from pathlib import Path
from typing import Self

from google.protobuf import descriptor_pb2
from mcap.records import ChunkIndex, Statistics

import flowrec
from flowrec.errors import SessionError
from flowrec.messages import defaulted_fields
from flowrec.store.codec import codec_of
from flowrec.store.header import FORMAT_VERSION, OUTCOME, PROFILE, SESSION, SessionHeader, belongs, header_from
from flowrec.store.index import Summary
from flowrec.store.region import Region, region_from
from flowrec.store.source import ForeignError, Source
from flowrec.topics import BY_FIELD, BY_PATH

_METADATA_LIMIT_BYTES = 16 << 20
_ATTACHMENTS_LIMIT_BYTES = 256 << 20


class Contents:
    """The index of a session file.

    Parameters
    ----------
    path : the file.
    summary : its index where the file's own is not to be used (scan.py makes one).

    Attributes
    ----------
    source : the file.
    fields : field of Tick by channel number, for the topics that this flowrec knows.
    schemas : name of the schema by channel number, for the same.
    chunks : where the messages are.
    statistics : how many there are.
    outcome : how the run ended.
    flowrec_version : of the program that wrote it.
    channels, attachments, metadata : what else is listed.

    Raises
    ------
    SessionError : it is none, or not for this flowrec.
    """

    def __init__(self, path: Path, summary: Summary | None = None) -> None:
        self.source = Source(path)
        try:
            self._open(summary)
        except BaseException:
            self.source.close()
            raise

    def _open(self, summary: Summary | None) -> None:
        path, header = self.source.path, self.source.header
        if header.profile != PROFILE:
            raise ForeignError(
                f"{path}: is an MCAP file of another program (profile {header.profile!r}, library {header.library!r});"
                " flowrec reads what `flowrec record` has written"
            )
        self._summary = summary if summary is not None else self.source.read_summary()
        metadata = self._metadata()
        if SESSION not in metadata:
            raise ForeignError(
                f"{path}: is an MCAP file without the record {SESSION!r}, so not a session;"
                " flowrec reads what `flowrec record` has written"
            )
        self.flowrec_version = metadata[SESSION].get("flowrec_version", "?")
        self._check_version(metadata[SESSION].get("format_version", ""))
        self.outcome = metadata.get(OUTCOME, {})
        self.chunks: list[ChunkIndex] = self._summary.chunks
        self.channels, self.attachments = self._summary.channels, self._summary.attachments
        self.metadata = self._summary.metadata
        assert self._summary.statistics is not None  # Source or Scan has seen to it
        self.statistics: Statistics = self._summary.statistics
        self.fields = {
            channel.id: BY_PATH[channel.topic].field
            for channel in self._summary.channels.values()
            if channel.topic in BY_PATH
        }
        self.schemas: dict[int, str] = {}
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

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.source.close()

    @functools.cached_property
    def header(self) -> SessionHeader:
        """Read when asked for: the network's weights may be large."""
        # Only what a session is made of: whatever else is attached is not even read.
        wanted = [index for index in self._summary.attachments if belongs(index.name)]
        self._bound("attachments", (index.length for index in wanted), _ATTACHMENTS_LIMIT_BYTES)
        attachments = {index.name: self.source.attachment(index) for index in wanted}
        try:
            return header_from(self._metadata(), attachments)
        except KeyError as error:
            raise self.source.damaged(0, f"the record {error} is missing") from error
        except ValueError as error:
            raise self.source.damaged(0, error) from error

    def _metadata(self) -> dict[str, dict[str, str]]:
        self._bound("metadata", (index.length for index in self._summary.metadata), _METADATA_LIMIT_BYTES)
        return {index.name: self.source.metadata(index) for index in self._summary.metadata}

    def _bound(self, what: str, lengths: Iterable[int], limit: int) -> None:
        total = sum(lengths)
        if total > limit:
            raise self.source.damaged(0, f"{total} bytes of {what}, more than {limit}")

    def _check_version(self, version: str) -> None:
        if version == str(FORMAT_VERSION):
            return
        what = f"{self.source.path}: is a session of format {version!r}, written by flowrec {self.flowrec_version}"
        newer = version.isdecimal() and int(version) > FORMAT_VERSION
        need = f"install flowrec {self.flowrec_version} or later" if newer else "it is damaged or was edited"
        raise SessionError(f"{what}; this is flowrec {flowrec.__version__} with format {FORMAT_VERSION}: {need}")

    def _check_schema(self, channel_number: int) -> None:
        channel = self._summary.channels[channel_number]
        found = self._summary.schemas[channel.schema_id]
        expected = codec_of(BY_PATH[channel.topic].type, found.name).schema
        self.schemas[channel_number] = found.name
        same_kind = (found.name, found.encoding, channel.message_encoding) == (expected.name, "protobuf", "protobuf")
        # The standard schemas may gain fields and comments with a new foxglove-sdk and stay what they are.
        if same_kind and (found.data == expected.data or not expected.name.startswith("flowrec.")):
            return
        with self.source.parsing(0):
            theirs, ours = _fields_of(found.data), _fields_of(expected.data)
        # A field that has come since is empty in an older file; where the message allows for that, it is read.
        if same_kind and theirs <= ours and {name for name, _ in ours - theirs} <= _may_be_missing(channel.topic):
            return
        differs = sorted({name for name, _ in theirs ^ ours}) or [found.name]
        raise SessionError(
            f"{self.source.path}: {channel.topic} is laid out differently ({', '.join(differs)});"
            f" read it with flowrec {self.flowrec_version}, which wrote it (this is {flowrec.__version__})"
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
