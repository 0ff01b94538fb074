"""Protobuf schemas: ours derived from the dataclasses of core/messages, the standard ones taken from foxglove-sdk.
Besides them two of ROS 2, whose messages Rerun shows without a layout.

This file defines the wire layout. Fields are numbered in the order of the dataclass:

    int -> sint64    float -> double    bool -> bool    str -> string
    vector -> packed repeated double    array -> flowrec.Array    `X | None` -> the same with presence
"""

from __future__ import annotations

import functools
import re
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import foxglove.messages
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory

from flowrec.core import message_fields

_Field = descriptor_pb2.FieldDescriptorProto
_SCALARS: dict[Any, Any] = {
    int: _Field.TYPE_SINT64,
    float: _Field.TYPE_DOUBLE,
    bool: _Field.TYPE_BOOL,
    str: _Field.TYPE_STRING,
}
_ARRAY_FILE = "flowrec/Array.proto"
_TIMESTAMP_FILE = "google/protobuf/timestamp.proto"

ARRAY_DATA = 3  # number of the field of flowrec.Array that holds the bytes

_pool = descriptor_pool.DescriptorPool()
_files: dict[str, descriptor_pb2.FileDescriptorProto] = {}


@dataclass(frozen=True, slots=True)
class Schema:
    """One message type.

    Attributes
    ----------
    name : full name, `flowrec.Track`.
    data : serialized FileDescriptorSet with everything it depends on; of ROS 2 the text of its definition.
    wire : the class that holds one such message; None of ROS 2.
    encoding, message_encoding : of the schema and of its messages, as MCAP names them.
    """

    name: str
    data: bytes
    wire: Any
    encoding: str = "protobuf"
    message_encoding: str = "protobuf"


@functools.cache
def array_schema() -> Schema:
    """`flowrec.Array`: shape, numpy's name of the little-endian dtype, and the values in C order."""
    file, message = _new("Array")
    message.field.add(name="shape", number=1, type=_Field.TYPE_UINT32, label=_Field.LABEL_REPEATED)
    message.field.add(name="dtype", number=2, type=_Field.TYPE_STRING, label=_Field.LABEL_OPTIONAL)
    message.field.add(name="data", number=ARRAY_DATA, type=_Field.TYPE_BYTES, label=_Field.LABEL_OPTIONAL)
    return _add(file)


def schema_of(message_type: type[Any], path: str = "") -> Schema:
    """The schema derived from a message dataclass; to be called once per type, codec.py caches it.

    `path` : of an extra topic, whose type may be called like another one: its schema has a name and a pool of its own.
    """
    package = re.sub(r"\.(\d)", r"._\1", path.replace("/", "."))  # no name of protobuf begins with a digit
    file, message = _new(message_type.__name__, "flowrec" + (".extra" + package if path else ""))
    for number, form in enumerate(message_fields(message_type), 1):
        field = message.field.add(name=form.name, number=number, label=_Field.LABEL_OPTIONAL)
        if form.kind == "vector":
            field.type, field.label = _Field.TYPE_DOUBLE, _Field.LABEL_REPEATED
        elif form.kind == "array":
            array_schema()
            field.type, field.type_name = _Field.TYPE_MESSAGE, ".flowrec.Array"
            if _ARRAY_FILE not in file.dependency:
                file.dependency.append(_ARRAY_FILE)
        else:
            field.type = _SCALARS[form.kind]
            if form.optional:  # proto3 declares presence as a one-of with a single member
                field.proto3_optional, field.oneof_index = True, len(message.oneof_decl)
                message.oneof_decl.add(name=f"_{form.name}")
    return _add(file, alone=bool(path))


@functools.cache
def foxglove_schema(name: str) -> Schema:
    """A standard schema: `RawImage`, `Log`, `PoseInFrame`, ..."""
    declared = getattr(foxglove.messages, name).get_schema()
    for file in descriptor_pb2.FileDescriptorSet.FromString(declared.data).file:
        if file.name not in _files:
            _files[file.name] = file
            _pool.Add(file)
    return _schema(declared.name, declared.data)


def plot_schema(name: str, numbers: Iterable[str], lists: Iterable[str] = ()) -> Schema:
    """`flowrec.NAME`: `timestamp` as in foxglove's schemas, then floats, and lists of floats."""
    foxglove_schema("Log")  # brings Timestamp
    file, message = _new(name)
    file.dependency.append(_TIMESTAMP_FILE)
    stamp = message.field.add(name="timestamp", number=1, type=_Field.TYPE_MESSAGE, label=_Field.LABEL_OPTIONAL)
    stamp.type_name = ".google.protobuf.Timestamp"
    labels = [(each, _Field.LABEL_OPTIONAL) for each in numbers] + [(each, _Field.LABEL_REPEATED) for each in lists]
    for number, (each, label) in enumerate(labels, 2):
        message.field.add(name=each, number=number, type=_Field.TYPE_FLOAT, label=label)
    return _add(file)


def ros_schema(name: str, definition: str) -> Schema:
    """A schema of ROS 2 with the text of its definition; its messages are encoded as CDR."""
    return Schema(name, definition.encode(), None, "ros2msg", "cdr")


def _new(
    name: str, package: str = "flowrec"
) -> tuple[descriptor_pb2.FileDescriptorProto, descriptor_pb2.DescriptorProto]:
    """A file with one message type, and that type, which has no field yet."""
    file_name = f"{package.replace('.', '/')}/{name}.proto"
    file = descriptor_pb2.FileDescriptorProto(name=file_name, package=package, syntax="proto3")
    return file, file.message_type.add(name=name)


def _add(file: descriptor_pb2.FileDescriptorProto, *, alone: bool = False) -> Schema:
    """The schema in a file; `alone`: in a pool of its own."""
    needed = [_files[each] for each in file.dependency]
    if alone:
        pool = descriptor_pool.DescriptorPool()
        for each in needed:
            pool.Add(each)
    else:
        pool = _pool
        _files[file.name] = file
    pool.Add(file)
    data = descriptor_pb2.FileDescriptorSet(file=[*needed, file]).SerializeToString(deterministic=True)
    return _schema(f"{file.package}.{file.message_type[0].name}", data, pool)


def _schema(name: str, data: bytes, pool: descriptor_pool.DescriptorPool = _pool) -> Schema:
    wire = message_factory.GetMessageClass(pool.FindMessageTypeByName(name))
    return Schema(name, data, wire)
