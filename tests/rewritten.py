"""A session written anew with the mcap library alone, as another program would: the same messages, or edited ones."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from mcap.reader import make_reader
from mcap.records import Channel, Message, Schema
from mcap.writer import CompressionType, Writer

Edit = Callable[[Channel, Message, Any], bool]  # edits the decoded message; True where it did


def parser_of(schema: Schema) -> Any:
    """The protobuf class of a schema, by what the file says of it."""
    pool = descriptor_pool.DescriptorPool()
    for file in descriptor_pb2.FileDescriptorSet.FromString(schema.data).file:
        pool.Add(file)
    return message_factory.GetMessageClass(pool.FindMessageTypeByName(schema.name))


def rewrite(source: Path, target: Path, edit: Edit | None = None, chunk_bytes: int = 1 << 20) -> int:
    """Copy a session message by message; returns how many messages were edited."""
    edited = 0
    with source.open("rb") as read, target.open("wb") as write:
        reader = make_reader(read)
        header, summary = reader.get_header(), reader.get_summary()
        assert summary is not None
        writer = Writer(write, chunk_size=chunk_bytes, compression=CompressionType.ZSTD)
        writer.start(header.profile, header.library)
        for attachment in reader.iter_attachments():
            writer.add_attachment(
                attachment.create_time, attachment.log_time, attachment.name, attachment.media_type, attachment.data
            )
        for record in reader.iter_metadata():
            writer.add_metadata(record.name, record.metadata)
        schemas = {n: writer.register_schema(s.name, s.encoding, s.data) for n, s in summary.schemas.items()}
        parsers = {n: parser_of(s) for n, s in summary.schemas.items()}
        channels = {
            n: writer.register_channel(c.topic, c.message_encoding, schemas[c.schema_id], c.metadata)
            for n, c in summary.channels.items()
        }
        for _, channel, message in reader.iter_messages():
            data = message.data
            if edit is not None:
                wire = parsers[channel.schema_id].FromString(data)
                if edit(channel, message, wire):
                    edited += 1
                    data = wire.SerializeToString(deterministic=True)
            writer.add_message(channels[channel.id], message.log_time, data, message.publish_time, message.sequence)
        writer.finish()
    return edited


def array_of(wire: Any) -> np.ndarray:
    """A flowrec.Array as a numpy array that can be changed."""
    return np.frombuffer(wire.data, np.dtype(wire.dtype)).reshape(tuple(wire.shape)).copy()
