"""A session written anew with the mcap library alone, as another program would: the same messages, or edited ones."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from mcap.reader import make_reader
from mcap.records import Attachment, Channel, Message, Metadata, Schema
from mcap.writer import CompressionType, Writer

from flowrec.core import TOPICS
from flowrec.store.digest import channel_digest, digest_record, head_digest, message_digest
from flowrec.store.viewer_topics import VIEWER_TOPICS

Edit = Callable[[Channel, Message, Any], bool]  # edits the decoded message; True where it did
EditHead = Callable[[Attachment | Metadata | Schema | Channel], None]


def parser_of(schema: Schema) -> Any:
    """The protobuf class of a schema, by what the file says of it."""
    return _class_of(schema.name, schema.data)


@cache
def _class_of(name: str, descriptors: bytes) -> Any:
    pool = descriptor_pool.DescriptorPool()
    for file in descriptor_pb2.FileDescriptorSet.FromString(descriptors).file:
        pool.Add(file)
    return message_factory.GetMessageClass(pool.FindMessageTypeByName(name))


def rewrite(
    source: Path,
    target: Path,
    edit: Edit | None = None,
    edit_head: EditHead = lambda _: None,
    *,
    keep_digest: bool = True,
    redigest: bool = False,
    drop: str = "",
    until: float | None = None,
    notes: dict[str, str] | None = None,
) -> int:
    """Copy a session message by message; returns how many messages were edited.

    `drop` names a topic of which nothing is left, `until` is the share of its time after which nothing is left, `notes`
    are added as a metadata record of another program. `redigest`: the digest is made again, as whoever can write the
    file can.
    """
    edited, head = 0, 0
    counts, sums = Counter[int](), Counter[int]()
    with source.open("rb") as read, target.open("wb") as write:
        reader = make_reader(read)
        header, summary = reader.get_header(), reader.get_summary()
        assert summary is not None and summary.statistics is not None
        first_ns, last_ns = summary.statistics.message_start_time, summary.statistics.message_end_time
        until_ns = last_ns if until is None else first_ns + int(until * (last_ns - first_ns))
        writer = Writer(write, chunk_size=1 << 20, compression=CompressionType.ZSTD)
        writer.start(header.profile, header.library)
        for attachment in reader.iter_attachments():
            edit_head(attachment)
            head += head_digest(attachment)
            writer.add_attachment(
                attachment.create_time, attachment.log_time, attachment.name, attachment.media_type, attachment.data
            )
        for record in reader.iter_metadata():
            edit_head(record)
            head += head_digest(record)
            if record.name != "flowrec.digest" or (keep_digest and not redigest):
                writer.add_metadata(record.name, record.metadata)
        for declared in (*summary.schemas.values(), *summary.channels.values()):
            edit_head(declared)
        schemas = {n: writer.register_schema(s.name, s.encoding, s.data) for n, s in summary.schemas.items()}
        parsers = {n: parser_of(s) if s.encoding == "protobuf" else None for n, s in summary.schemas.items()}
        channels = {
            n: writer.register_channel(c.topic, c.message_encoding, schemas[c.schema_id], c.metadata)
            for n, c in summary.channels.items()
            if c.topic != drop
        }
        if notes is not None:
            writer.add_metadata("lab.notes", notes)
        for _, channel, message in reader.iter_messages():
            if channel.topic == drop or message.log_time > until_ns:
                continue
            data = message.data
            if edit is not None:
                parser = parsers[channel.schema_id]
                wire = parser.FromString(data) if parser is not None else None
                if edit(channel, message, wire):
                    edited += 1
                    data = wire.SerializeToString(deterministic=True)
            counts[channel.id] += 1
            sums[channel.id] += message_digest(message.sequence, message.log_time, data)
            writer.add_message(channels[channel.id], message.log_time, data, message.publish_time, message.sequence)
        if redigest:
            topics = [
                (c.topic, counts[n], sums[n], channel_digest(c, summary.schemas[c.schema_id]))
                for n, c in summary.channels.items()
            ]
            record = digest_record(head, topics)
            writer.add_metadata(record.name, record.metadata)
        writer.finish()
    return edited


def edit_of_head(name: str, **values: str) -> EditHead:
    """Sets values of a metadata record, or appends an empty line to an attachment."""

    def edit(record: Attachment | Metadata | Schema | Channel) -> None:
        if isinstance(record, Metadata) and record.name == name:
            record.metadata.update(values)
        elif isinstance(record, Attachment) and record.name == name:
            record.data += b"\n"

    return edit


def leaves_of(wire: Any, path: str = "") -> list[tuple[str, Callable[[], None]]]:
    """Each single value in a message, by its name, with something that changes it."""
    found: list[tuple[str, Callable[[], None]]] = []
    for field in wire.DESCRIPTOR.fields:
        name = f"{path}{field.name}"
        if field.is_repeated:
            if field.message_type is not None:
                found += leaves_of(getattr(wire, field.name)[0], f"{name}[0].") if getattr(wire, field.name) else []
            else:
                found.append((name, lambda field=field: _change_first(getattr(wire, field.name), field)))
        elif field.message_type is not None:
            found += leaves_of(getattr(wire, field.name), f"{name}.") if wire.HasField(field.name) else []
        else:
            found.append(
                (name, lambda field=field: setattr(wire, field.name, _other(getattr(wire, field.name), field)))
            )
    return found


def _change_first(values: Any, field: Any) -> None:
    if len(values):
        values[0] = _other(values[0], field)
    else:
        values.append(_other(field.default_value or 0, field))


def _other(value: Any, field: Any) -> Any:
    """Another value of the same kind, close to the first."""
    if isinstance(value, str):
        return value + "x"
    if isinstance(value, bytes):
        return bytes([value[0] ^ 1]) + value[1:] if value else b"x"
    if isinstance(value, bool):
        return not value
    if field.enum_type is not None:
        return next(one.number for one in field.enum_type.values if one.number != value)
    if isinstance(value, int):
        return value + 1
    return value * 1.001 + 0.001 if value == value else 0.5


def edit_of_value(topic: str) -> Edit:
    """Changes one value of the first message of a topic."""
    todo = [topic]

    def edit(channel: Channel, _: Message, wire: Any) -> bool:
        if channel.topic not in todo:
            return False
        todo.clear()
        # Of an array the last bit of a byte may be within the tolerance, and another shape can not be read.
        leaves = leaves_of(wire)
        changes = [change for name, change in leaves if "." not in name] or [change for _, change in leaves]
        changes[-1]()
        return True

    return edit


def edit_of_number(attribute: str) -> Edit:
    """Adds one to the time or the number of each image."""

    def edit(channel: Channel, message: Message, _: Any) -> bool:
        if channel.topic == "/camera/frame":
            setattr(message, attribute, getattr(message, attribute) + 1)
        return False

    return edit


def edit_of_declaration(what: str) -> EditHead:
    """Another role, depth or schema of the images."""

    def edit(record: Attachment | Metadata | Schema | Channel) -> None:
        if isinstance(record, Channel) and record.topic == "/camera/frame" and what != "schema":
            record.metadata.update({what: "8" if what == "bits" else "output"})
        elif isinstance(record, Schema) and what == "schema":
            record.data = record.data.replace(b"frame_id", b"frame_it")

    return edit


# Every way to edit a session that we know, by name: arguments of `rewrite`, and what `compare` says is different.
EDITS: dict[str, tuple[Callable[[], dict[str, Any]], str]] = {
    **{
        f"a value of {path}": (lambda path=path: {"edit": edit_of_value(path)}, path)
        for path in (*(topic.path for topic in TOPICS), *(view.path for view in VIEWER_TOPICS if view.schema.wire))
    },
    **{
        f"{name} of the head": (lambda name=name: {"edit_head": edit_of_head(name, operator="somebody else")}, part)
        for name, part in (
            ("flowrec.provenance", "provenance"),
            ("flowrec.parent", "parent"),
            ("flowrec.outcome", "outcome"),
            ("config.toml", "configuration"),
            ("chip.toml", "chip"),
            ("chip.png", "chip"),
        )
    },
    **{
        f"{what} of the images": (lambda what=what: {"edit_head": edit_of_declaration(what)}, "/camera/frame")
        for what in ("bits", "role", "schema")
    },
    "time of the images": (lambda: {"edit": edit_of_number("log_time")}, "ticks"),
    "number of the images": (lambda: {"edit": edit_of_number("sequence")}, "/camera/frame"),
    "the appearance taken out": (lambda: {"drop": "/robot/appearance"}, "/robot/appearance"),
    "the truth taken out": (lambda: {"drop": "/truth/robot"}, "/truth/robot"),
    "the drawn path taken out": (lambda: {"drop": "/view/path"}, "/view/path"),
    "the end cut off": (lambda: {"until": 0.9}, "ticks"),
}
