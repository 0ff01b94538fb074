"""Topics besides the fields of `Tick`: their table, and their declaration as JSON, from which a reader makes the type.

A package of others declares such a topic; the channel of a session file holds its declaration. So the file can be read,
checked, compared and tabulated where the package is not installed.
"""

from __future__ import annotations

import copyreg
import functools
import json
import keyword
import math
import re
import types
import typing
from collections.abc import Callable, Iterable, Mapping
from dataclasses import MISSING, dataclass, field, fields, is_dataclass, replace
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray

from flowrec.core.declarations import COILS, Message, MessageField, Shape, Source, Topic, message_fields, summary_of
from flowrec.core.errors import UsageError
from flowrec.core.messages import Frame
from flowrec.core.topics import BY_FIELD, BY_PATH, TOPICS, Extra, Tick

SOURCES = (Source.RIG, Source.SIMULATOR, Source.STAGE)  # of a topic that is no field of Tick
_PATH = re.compile(r"(/[A-Za-z][A-Za-z0-9_]*(/[0-9]{1,4})?)+", re.ASCII)
_DRAWINGS = "/view/"
_OWN_TYPES = {topic.type.__name__: topic.type for topic in TOPICS}
_KINDS: dict[str, Any] = {"int": int, "float": float, "bool": bool, "str": str}
_ARRAYS = ("vector", "array")
_DTYPES = ("int8", "int16", "int32", "int64", "uint8", "uint16", "uint32", "uint64", "float32", "float64")
_EMPTY: list[Any] = []  # default of an array in a declaration
# Of a declaration in a file, which may be hostile.
_TEXT_LIMIT, _FIELDS_LIMIT, _NAME_LIMIT, _AXES_LIMIT = 1 << 16, 200, 100, 8


class TopicTable:
    """The fields of `Tick`, and the extra topics of a run or of a file.

    Raises UsageError: a topic that can not be declared, or two of one path.

    Attributes
    ----------
    extra : topics that are no field of `Tick`; their field is their path.
    topics : all, those of `Tick` first.
    by_field, by_path : all, by name.
    """

    __slots__ = ("by_field", "by_path", "extra", "topics")

    def __init__(self, extra: Iterable[Topic] = ()) -> None:
        self.extra = tuple(replace(topic, field=topic.path) for topic in extra)
        for number, topic in enumerate(self.extra):
            _refuse_unfit(topic)
            if topic.path in {other.path for other in self.extra[:number]}:
                raise UsageError(f"{topic.path}: is declared twice; name one of the two otherwise")
        self.topics = (*TOPICS, *self.extra)
        self.by_field: Mapping[str, Topic] = BY_FIELD | self._extra_by_path
        self.by_path: Mapping[str, Topic] = BY_PATH | self._extra_by_path

    def with_messages(self, tick: Tick, stamp_ns: int, new: Mapping[str, Any]) -> Tick:
        """The tick of a later stamp, with new messages by field."""
        if not self.extra:
            return replace(tick, stamp_ns=stamp_ns, **new)
        extra = {name: message for name, message in new.items() if name not in BY_FIELD}
        ours = {name: message for name, message in new.items() if name in BY_FIELD}
        return replace(tick, stamp_ns=stamp_ns, extra=tick.extra.with_messages(extra), **ours)

    def with_types_of(self, other: TopicTable) -> TopicTable:
        """The table with the declarations of another one, where both have a topic, and with its other extra topics."""
        return TopicTable((self._extra_by_path | other._extra_by_path).values()) if self.extra or other.extra else self

    def as_declared(self, message: Message, path: str) -> Message:
        """A message of an extra topic, as a file declares it, in the type that this table declares.

        Raises UsageError: the type has no such field, or one more that has no default.
        """
        kind = self.by_path[path].type
        if type(message) is kind:
            return message
        try:
            return kind(**{each.name: getattr(message, each.name) for each in fields(message)})  # type: ignore[arg-type]
        except TypeError as error:
            raise UsageError(
                f"{path}: was recorded with other fields than {kind.__name__} has now ({error}); install the package "
                "that recorded it"
            ) from error

    def typed_tick(self, tick: Tick) -> Tick:
        """A tick of a file as stages get it: extra messages in the types of this table, without those of a simulator.

        Errors as of `typed`.
        """
        if not tick.extra:
            return tick
        known = [path for path in tick.extra if self.by_path[path].source is not Source.SIMULATOR]
        return replace(tick, extra=Extra({path: self.as_declared(tick.extra[path], path) for path in known}))

    def __reduce__(self) -> tuple[Any, tuple[tuple[Topic, ...]]]:
        return TopicTable, (self.extra,)

    @property
    def _extra_by_path(self) -> dict[str, Topic]:
        return {topic.path: topic for topic in self.extra}


def message_of(tick: Tick, field_name: str) -> Message | None:
    """The latest message of a topic, named by its field; None before the first."""
    found: Message | None
    found = tick.extra.get(field_name) if field_name.startswith("/") else getattr(tick, field_name)
    return found


def _refuse_unfit(topic: Topic) -> None:
    """Raise UsageError, in one line, for a topic that can be none besides the fields of `Tick`."""
    path = topic.path[:_NAME_LIMIT]
    kind: Any = topic.type
    if not _PATH.fullmatch(topic.path) or len(topic.path) > _NAME_LIMIT or f"{path}/".startswith(_DRAWINGS):
        raise UsageError(
            f"{path!r}: is no path of a topic; write it as /pump/pressure, with letters, digits and _, but not below "
            "/view, in at most 100 characters"
        )
    if path in BY_PATH:
        raise UsageError(f"{path}: is a topic of flowrec; choose another path")
    if topic.source not in SOURCES or topic.made_by is not None:
        able = ", ".join(f"Source.{source.name}" for source in SOURCES)
        raise UsageError(f"{path}: its source is {topic.source.name}; an extra topic is of {able}")
    is_message = isinstance(kind, type) and issubclass(kind, Message) and is_dataclass(kind)
    if not is_message or issubclass(kind, Frame):  # whose encodings belong to its channel
        name = getattr(kind, "__name__", kind)
        raise UsageError(f"{path}: its type {name} is no dataclass that derives from Message, or it is Frame")
    try:
        declared = message_fields(kind)
        shapeless = [each.name for each in declared if each.dtype is not None and each.shape is None]
        if shapeless:
            raise TypeError(f"{shapeless[0]} has no shape: Annotated[Vector, Shape(2)]")
        if not declared or (declared[0].name, declared[0].kind, declared[0].optional) != ("stamp_ns", int, False):
            raise TypeError("its first field has to be stamp_ns: int")
        tolerances = (topic.rtol, *topic.atols.values())
        if topic.atols.keys() - {each.name for each in declared} or not all(
            0 <= each < math.inf for each in tolerances
        ):
            raise TypeError("its tolerances are of no field, negative or not finite")
        for each in fields(kind):
            _default_as_json(each)
    except (TypeError, NameError) as error:
        raise UsageError(f"{path}: {kind.__name__} can not be recorded: {error}") from error


def declaration(topic: Topic) -> str:
    """The declaration of an extra topic as JSON: source, tolerances, and all fields of its message type."""
    kind: Any = topic.type
    stated = [_field_as_json(*pair) for pair in zip(message_fields(kind), fields(kind), strict=True)]
    return json.dumps(
        {
            "type": kind.__name__,
            "meaning": summary_of(kind),
            "source": topic.source.name,
            "rtol": topic.rtol,
            "atols": dict(topic.atols),
            "fields": stated,
        }
    )


def _field_as_json(each: MessageField, of_type: Any) -> dict[str, Any]:
    kind = getattr(each.kind, "__name__", each.kind)
    stated: dict[str, Any] = {"name": each.name, "kind": kind, "meaning": each.meaning}
    if each.dtype is not None and each.shape is not None:
        stated |= {"dtype": each.dtype.name, "shape": list(each.shape.lengths)}
    if not each.finite:
        stated["finite"] = False
    if each.optional:
        stated["optional"] = True
    if (default := _default_as_json(of_type)) is not MISSING:
        stated["default"] = default
    return stated


def _default_as_json(each: Any) -> Any:
    """The default of a field for a declaration; MISSING without one. An array can be empty by default, or None."""
    made = each.default_factory() if each.default_factory is not MISSING else each.default
    if made is MISSING or made is None or isinstance(made, bool | int | str):
        return made
    if isinstance(made, float):
        return made if math.isfinite(made) else repr(made)
    if np.size(made) == 0:
        return _EMPTY
    raise TypeError(f"the default of {each.name} is neither a number, a text, None nor an empty array")


class MadeType(type):
    """The type of classes that are made while the program runs: where one is unpickled, it is made again."""


_CALLS: dict[type, tuple[Callable[..., Any], tuple[Any, ...]]] = {}  # function and arguments that made each of them
copyreg.pickle(MadeType, _CALLS.__getitem__)


def remember_call(made: type, function: Callable[..., Any], *arguments: Any) -> None:
    """Note the call that makes a class of MadeType; the function is one of a module, the arguments can be pickled."""
    _CALLS[made] = function, arguments


def arguments_of(made: type) -> tuple[Any, ...]:
    """Arguments of the call that made a class; () for a class that is declared in a module."""
    return _CALLS[made][1] if made in _CALLS else ()


def _type_of(path: str, text: str) -> type[Message]:
    return declared_topic(path, text).type


@functools.lru_cache(maxsize=256)
def declared_topic(path: str, text: str) -> Topic:
    """The topic of a path by its declaration as JSON, as a file holds it; the same type for the same text.

    Raises UsageError: one line; it is damaged, too large, or declares what can not be recorded.
    """
    try:
        if len(text) > _TEXT_LIMIT:
            raise ValueError(f"{len(text)} characters, more than {_TEXT_LIMIT}")
        stated = json.loads(text, parse_constant=_refuse_constant)
        source = Source[_of(stated, "source", str)]
        rtol, atols = float(_of(stated, "rtol", (int, float))), _of(stated, "atols", dict)
        kind = _message_type(stated)
        topic = Topic(
            path, source, rtol, {str(name): float(each) for name, each in atols.items()}, field=path, type=kind
        )
        if isinstance(kind, MadeType):
            remember_call(kind, _type_of, path, text)
    except (ValueError, TypeError, KeyError, RecursionError, OverflowError) as error:
        told = str(error).partition("\n")[0][:200]
        raise UsageError(f"the declaration of {path[:_NAME_LIMIT]!r} is damaged: {told}") from error
    _refuse_unfit(topic)
    return topic


def _refuse_constant(name: str) -> Any:
    raise ValueError(f"{name} is no number of a declaration")


def _of(stated: Any, name: str, kind: Any) -> Any:
    """An entry of a JSON object that must be of a type."""
    if not isinstance(stated, dict) or not isinstance(stated.get(name), kind):
        raise ValueError(f"{name} is missing, or of another type")
    return stated[name]


def _message_type(stated: Any) -> type[Message]:
    """The message type of a declaration: ours, if it is declared as one of ours."""
    name, meaning, listed = _name(stated, "type"), _of(stated, "meaning", str), _of(stated, "fields", list)
    if len(listed) > _FIELDS_LIMIT:
        raise ValueError(f"{len(listed)} fields, more than {_FIELDS_LIMIT}")
    ours = _OWN_TYPES.get(name)
    if ours is not None and json.loads(declaration(Topic("", Source.RIG, type=ours)))["fields"] == listed:
        return ours
    names = [_name(each, "name") for each in listed]
    taken = {each for each in names if names.count(each) > 1 or hasattr(Message, each)}
    if taken:
        raise ValueError(f"{sorted(taken)[0]} is declared twice, or a word of its own")
    annotations = dict(zip(names, map(_annotation, listed), strict=True))
    defaults = {each["name"]: _default(each) for each in listed if "default" in each}

    def fill(namespace: dict[str, Any]) -> None:
        namespace |= {"__doc__": meaning, "__module__": __name__, "__annotations__": annotations, **defaults}

    made = types.new_class(name, (Message,), {"metaclass": MadeType}, fill)
    return typing.cast("type[Message]", dataclass(frozen=True, slots=True, eq=False)(made))


def _name(stated: Any, key: str) -> str:
    name: str = _of(stated, key, str)
    sound = name.isascii() and name.isidentifier() and not keyword.iskeyword(name) and not name.startswith("_")
    if not sound or len(name) > _NAME_LIMIT:
        raise ValueError(f"{name[:_NAME_LIMIT]!r} is no name")
    return name


def _annotation(stated: dict[str, Any]) -> Any:
    """The annotation of a field, as declarations.py has them."""
    name, kind, meaning = stated["name"], _of(stated, "kind", str), _of(stated, "meaning", str)
    optional, finite = stated.get("optional", False), stated.get("finite", True)
    if not isinstance(optional, bool) or not isinstance(finite, bool):
        raise ValueError(f"{name}: optional and finite are true or false")
    made: Any
    if kind in _ARRAYS:
        dtype, lengths = _of(stated, "dtype", str), _of(stated, "shape", list)
        if dtype not in _DTYPES or (kind == "vector" and (dtype != "float64" or optional or len(lengths) != 1)):
            raise ValueError(f"{name}: no {kind} of {dtype[:_NAME_LIMIT]!r}")
        if not 0 < len(lengths) <= _AXES_LIMIT or not all(map(_is_length, lengths)):
            raise ValueError(f"{name}: no shape of an array")
        made = Annotated[NDArray[np.dtype(dtype).type], kind, Shape(*lengths, finite=finite), meaning]  # type: ignore[misc]
    elif kind in _KINDS:
        made = Annotated[_KINDS[kind], *([] if finite else [Shape(finite=False)]), meaning]
    else:
        raise ValueError(f"{name}: no kind {kind[:_NAME_LIMIT]!r}")
    return made | None if optional else made


def _is_length(length: Any) -> bool:
    if isinstance(length, str):
        return length == COILS or (len(length) == 1 and "a" <= length <= "z")
    return isinstance(length, int) and not isinstance(length, bool) and 0 <= length < 1 << 31


def _default(stated: dict[str, Any]) -> Any:
    """The default of a field, or its factory."""
    default, kind, name = stated["default"], stated["kind"], stated["name"]
    if default is None and stated.get("optional"):
        return None
    if kind in _ARRAYS and default == _EMPTY:
        shape = (0,) * len(stated["shape"])
        return field(default_factory=functools.partial(np.zeros, shape, stated["dtype"]))
    if kind == "float" and default in ("nan", "inf", "-inf"):
        return float(default)
    if kind in _KINDS and type(default) is _KINDS[kind]:
        return default
    raise ValueError(f"{name}: its default is of another kind")


FIXED = TopicTable()
