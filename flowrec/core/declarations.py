"""Annotations of message fields and of the fields of `Tick`: shape, finiteness, meaning, topic, source, tolerances.

messages/ and diagnostics.py declare every record with these, topics.py the fields of `Tick`. A text in an annotation
is the meaning of the field. The wire format
(store/schema.py), the checks of what was read from a file and the table of topics (topics.py) are derived from them.

A number that is NaN or infinite is refused where its record is made, unless its declaration permits it. What a file
holds is read as it is (`as_read`), so that `check` can say what is wrong with it.
"""

from __future__ import annotations

import dataclasses
import functools
import math
import threading
import types
import typing
from collections.abc import Callable, Iterator, Mapping
from dataclasses import MISSING, dataclass, fields
from enum import Enum
from typing import Annotated, Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from flowrec.core.enums import WorkOrder
from flowrec.core.errors import NotFiniteError
from flowrec.core.units import seconds

Result = TypeVar("Result")

Floats = NDArray[np.float64]
Floats32 = NDArray[np.float32]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]

# The annotation is the wire form: a `vector` becomes a repeated double that viewers can plot,
# an `array` keeps its shape and its bytes.
Vector = Annotated[NDArray[np.float64], "vector"]
Matrix = Annotated[NDArray[np.float64], "array"]
Raster = Annotated[NDArray[np.float32], "array"]
Image = Annotated[NDArray[np.uint8 | np.uint16], "array"]  # frames keep either; see messages.Frame

_MAY_BE_EMPTY = "nmoq"
_FEW = 32  # numbers of an array that are looked at one by one: faster than NumPy, whose call alone takes 2 us


@dataclass(frozen=True, slots=True, init=False)
class Shape:
    """Annotation of an array field: its shape, and whether all of its numbers must be finite.

    A letter stands for any length, the same one throughout a message. `n`, `m`, `o`, `q` may be zero, others not.
    `coils` is the number of coils, the same one throughout a run.
    """

    lengths: tuple[int | str, ...]
    finite: bool

    def __init__(self, *lengths: int | str, finite: bool = True) -> None:
        object.__setattr__(self, "lengths", lengths)
        object.__setattr__(self, "finite", finite)


Vector2 = Annotated[Vector, Shape(2)]
COILS = "coils"  # a length that is the number of coils of the run
PerCoil = Annotated[Vector, Shape(COILS)]
NanFloat = Annotated[float, Shape(finite=False)]  # a number for which NaN or infinity has a meaning
NOT_STATED: Any = ()  # default of a vector, which the message makes (0,)


def coil_names(count: int) -> tuple[str, ...]:
    """Names of so many coils, as in columns of tables: x, y and z of two or three, else their numbers from 1."""
    return ("x", "y", "z")[:count] if count in (2, 3) else tuple(str(number) for number in range(1, count + 1))


@dataclass(frozen=True, slots=True)
class MessageField:
    """One field of a message type."""

    name: str
    kind: Any  # int, float, bool, str, "vector" or "array"
    optional: bool  # the field may be None
    dtype: np.dtype[Any] | None  # of an array, else None
    shape: Shape | None  # None where the declaration gives none, as for every plain number
    meaning: str  # in words; that of its message type where the declaration has none

    @property
    def is_float(self) -> bool:
        """True if its numbers are floating-point numbers."""
        return self.kind is float if self.dtype is None else self.dtype.kind == "f"

    @property
    def finite(self) -> bool:
        """True if NaN and infinity are excluded."""
        return self.shape is None or self.shape.finite


def _keep(function: Callable[[type], Result]) -> Callable[[type], Result]:
    """Keep what a function of a message type returns. mypy takes no class without a hash of its own for a key."""
    return functools.cache(function)


@_keep
def message_fields(message_type: type) -> tuple[MessageField, ...]:
    """The fields of a message type, in order. Raises TypeError: an annotation that has no wire form."""
    return tuple(_declared_fields(message_type))


def _declared_fields(message_type: type) -> Iterator[MessageField]:
    hints = typing.get_type_hints(message_type, include_extras=True)
    for each in fields(message_type):
        kind, optional = hints[each.name], False
        notes: list[Any] = []
        while (origin := typing.get_origin(kind)) in (Annotated, typing.Union, types.UnionType):
            if origin is Annotated:
                kind, *more = typing.get_args(kind)
                notes = [*more, *notes]
            else:
                kind = next(option for option in typing.get_args(kind) if option is not types.NoneType)
                optional = True
        shape = next((note for note in notes if isinstance(note, Shape)), None)
        dtype = None
        if alias := getattr(typing.get_origin(kind), "__value__", None):
            kind = alias[typing.get_args(kind)]  # NDArray[...] of numpy 2.5, a `type` statement
        if typing.get_origin(kind) is np.ndarray:
            scalar = typing.get_args(typing.get_args(kind)[1])[0]
            dtype = np.dtype(next(iter(typing.get_args(scalar)), scalar))  # of several the first
            wire, *notes = notes
            kind = "array" if optional else wire  # a repeated field can not be absent
        if kind not in (int, float, bool, str, "vector", "array"):
            raise TypeError(f"{message_type.__name__}.{each.name}: no wire form for {hints[each.name]!r}")
        meaning = next((note for note in notes if isinstance(note, str)), summary_of(message_type))
        yield MessageField(each.name, kind, optional, dtype, shape, meaning)


def summary_of(message_type: type) -> str:
    """The first sentence of the docstring of a message type."""
    text = " ".join((message_type.__doc__ or "").split("\n\n")[0].split())
    return text.split(". ")[0].rstrip(".")


@_keep
def array_fields(message_type: type) -> tuple[tuple[str, np.dtype[Any]], ...]:
    """Name and dtype of each array field of a message type, in order."""
    return tuple((each.name, each.dtype) for each in message_fields(message_type) if each.dtype is not None)


@_keep
def array_shapes(message_type: type) -> tuple[tuple[str, tuple[int | str, ...]], ...]:
    """Name and lengths of each array field of a message type whose declaration gives a shape, in order."""
    return tuple(
        (each.name, each.shape.lengths)
        for each in message_fields(message_type)
        if each.dtype is not None and each.shape is not None
    )


def defaulted_fields(message_type: type) -> frozenset[str]:
    """Names of the fields with a default. A file made before such a field existed does not have it.

    The default must be what the absence of the field means on the wire: None, an empty vector, 0, False or "".
    """
    return frozenset(
        each.name for each in fields(message_type) if each.default is not MISSING or each.default_factory is not MISSING
    )


class _Reading(threading.local):
    depth = 0


_READING = _Reading()


class as_read:  # noqa: N801 - a context
    """Within it, records of this thread may hold any number: they come from a file, and readers say what it holds."""

    def __enter__(self) -> None:
        _READING.depth += 1

    def __exit__(self, *error: object) -> None:
        _READING.depth -= 1


class Message:
    """Base of all records: sets the dtype of the arrays, makes them read-only, and refuses numbers that are not finite.

    Raises NotFiniteError: NaN or infinity in a field whose declaration does not permit it, outside of `as_read`.
    """

    __slots__ = ()

    stamp_ns: int

    def __post_init__(self) -> None:
        for name, dtype, must_be_finite in _checked_fields(type(self)):
            value = getattr(self, name)
            if value is None:
                continue
            if dtype is not None:
                value = np.ascontiguousarray(value, dtype)
                if value.flags.writeable:
                    value = value.view()
                    value.flags.writeable = False
                object.__setattr__(self, name, value)
            if not must_be_finite or _READING.depth:
                continue
            # Looked at here: a function would be called for each of some hundred numbers a tick.
            if dtype is None:
                finite = math.isfinite(value)
            elif value.size <= _FEW:
                finite = all(map(math.isfinite, value.ravel().tolist()))
            else:
                finite = bool(np.isfinite(value).all())
            if not finite:
                raise NotFiniteError(_refusal(self))

    def refuse_not_finite(self) -> None:
        """Raise NotFiniteError as a new message would; one that was read from a file may hold any number."""
        self.__post_init__()

    def since_s(self, earlier: Message | None) -> float:
        """Time in s from the stamp of an earlier record to that of this one; 0 where there is none."""
        return 0.0 if earlier is None else seconds(self.stamp_ns - earlier.stamp_ns)

    def same_as(self, other: object) -> bool:
        """True if the other record is the same bit for bit (NaN equals NaN)."""
        if type(other) is not type(self):
            return False
        for part in fields(self):  # type: ignore[arg-type]
            mine, theirs = getattr(self, part.name), getattr(other, part.name)
            if isinstance(mine, np.ndarray) and isinstance(theirs, np.ndarray):
                if mine.shape != theirs.shape or mine.tobytes() != theirs.tobytes():
                    return False
            elif mine != theirs and not (mine != mine and theirs != theirs):
                return False
        return True


@_keep
def _checked_fields(message_type: type) -> tuple[tuple[str, np.dtype[Any] | None, bool], ...]:
    """Name, dtype of an array, and whether its numbers must be finite, of each field of arrays or of finite numbers."""
    found = ((each.name, each.dtype, each.is_float and each.finite) for each in message_fields(message_type))
    return tuple((name, dtype, finite) for name, dtype, finite in found if dtype is not None or finite)


def _refusal(message: Message) -> str:
    said = []
    for name in invalid_numbers(message):
        value = np.asarray(getattr(message, name))
        wrong = value.size - int(np.count_nonzero(np.isfinite(value)))
        said.append(name if value.ndim == 0 else f"{name} ({wrong} of {value.size} numbers)")
    at_s = seconds(message.stamp_ns)
    return (
        f"{type(message).__name__} at {at_s:.3f} s refused: NaN or infinity in {', '.join(said)}; look at the settings "
        "and the inputs that it was made from"
    )


def shape_error(message: Message) -> str:
    """Error text for an array of a message whose shape differs from its declaration; '' if none differs.

    The wire keeps any shape, so a damaged or forged file is refused here, before its arrays are used.
    """
    return shape_fault(type(message), functools.partial(getattr, message))


def shape_fault(message_type: type, array_of: Callable[[str], NDArray[Any] | tuple[float, ...] | None]) -> str:
    """Error text as `shape_error`, for arrays by the name of the field: tuples for vectors, None for missing ones."""
    lengths: dict[str, int] = {}
    for name, wanted in array_shapes(message_type):
        array = array_of(name)
        if array is None:
            continue
        shape = (len(array),) if isinstance(array, tuple) else array.shape
        fits = len(shape) == len(wanted)
        for found, length in zip(shape, wanted, strict=False):
            if isinstance(length, int):
                fits = fits and found == length
            else:
                fits = fits and lengths.setdefault(length, found) == found and (found > 0 or length in _MAY_BE_EMPTY)
        if not fits:
            return f"{name} has the shape {shape} where ({', '.join(map(str, wanted))}) belongs"
    return ""


def invalid_numbers(message: Message, limit: float | None = None) -> tuple[str, ...]:
    """Names of the fields that hold NaN or infinity where these are excluded, or a finite number of `limit` or more."""
    found = []
    for each in message_fields(type(message)):
        value = getattr(message, each.name)
        if value is None or not each.is_float:
            continue
        finite = np.isfinite(value)
        if (each.finite and not finite.all()) or (limit is not None and (np.abs(value)[finite] >= limit).any()):
            found.append(each.name)
    return tuple(found)


class Role(Enum):
    """Use of a topic by replay."""

    INPUT = "input"  # fed in again: enough to replay
    OUTPUT = "output"  # computed again and compared
    DIAGNOSTIC = "diagnostic"  # timings and losses: never compared
    TRUTH = "truth"  # known to a simulator only: kept for evaluation, no stage reads it


class Source(Enum):
    """Origin of the messages of a topic."""

    CAMERA = Role.INPUT, "the image of this tick; never held from one tick to the next"
    RIG = Role.INPUT, "read back from the rig with each frame"
    OPERATOR = Role.INPUT, "asked by a person; held until the next one"
    WORKER = Role.INPUT, "the result of a slow stage; held until the next one"
    STAGE = Role.OUTPUT, "computed in pipeline.step"
    LOOP = Role.DIAGNOSTIC, "measured by the loop or by the writer"
    SIMULATOR = Role.TRUTH, "the simulated world; never held from one tick to the next"

    def __init__(self, role: Role, _meaning: str) -> None:
        self.role = role


@dataclass(frozen=True, slots=True)
class SlowStage:
    """Dependencies of a result of the worker."""

    # the work orders (`Mission.wanted`) that it answers, each with the settings that its computation reads itself:
    # sections of the configuration, or one setting of a section as `section.name`
    orders: Mapping[WorkOrder, tuple[str, ...]]
    reads: tuple[str, ...]  # fields of the ordering tick that are needed, besides its stamp and the mission
    # sections of the configuration on which it depends, besides those on which what it reads depends
    settings: tuple[str, ...]


# Absolute tolerance of a field unless stated otherwise, in the field's unit: rounding of values up to 1e4.
_ATOL = 1e-8


@dataclass(frozen=True, slots=True)
class Topic:
    """Annotation of a field of `Tick`: what is recorded there.

    Two floats are the same when |recorded - replayed| <= atol + rtol |recorded|, element by element. The tolerances
    are for files made on another machine; on the same one a replay is exact. Everything but floats is compared exactly.

    Attributes
    ----------
    path : of the topic in the session file.
    rtol : relative tolerance; 0: all of the topic is compared exactly.
    atols : absolute tolerances by field of the message, in the field's unit, where they are not the default.
    made_by : how the worker makes it; for `Source.WORKER` only.
    field, type : name and message type of the field; topics.py fills them in from `Tick`.
    """

    path: str
    source: Source
    rtol: float = 0.0
    atols: Mapping[str, float] = dataclasses.field(default_factory=dict)
    made_by: SlowStage | None = None
    field: str = ""
    type: type[Message] = Message

    @property
    def role(self) -> Role:
        """Use of the topic by replay."""
        return self.source.role

    def atol_of(self, name: str) -> float:
        """Absolute tolerance of a field of the message, in the field's unit."""
        return self.atols.get(name, _ATOL if self.rtol else 0.0)
