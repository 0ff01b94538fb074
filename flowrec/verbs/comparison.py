"""Element-wise comparison of the ticks of two sessions, or of a replay with its recording."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, field, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flowrec.core import (
    FIXED,
    NUMERICS_VERSION,
    TOPICS,
    Floats,
    Message,
    Role,
    Source,
    Tick,
    Topic,
    TopicTable,
    message_of,
    printable,
    seconds,
)
from flowrec.store import Session, is_left_out

Fields = Mapping[str, frozenset[str]]  # names of message fields, by field of Tick
_Deviation = tuple[float, tuple[int, ...] | None, object, object]  # excess over the tolerance, index, both values


def _names_of(topic: Topic) -> list[str]:
    return [each.name for each in fields(topic.type)]  # type: ignore[arg-type]


def _fields_of(topics: Iterable[Topic]) -> dict[str, frozenset[str]]:
    return {topic.field: frozenset(_names_of(topic)) for topic in topics}


_ALL = _fields_of(TOPICS)


@dataclass(frozen=True, slots=True)
class Side:
    """One of the two sides of a comparison."""

    word: str  # what its values are called
    name: str  # what it is called as a whole
    recorded: Fields = field(default_factory=lambda: _ALL)  # the fields that it records
    copy: bool = False  # it is a replay, into which images are copied on request only
    numerics: str = field(default_factory=lambda: str(NUMERICS_VERSION))  # version of the numerics that computed it
    topics: TopicTable = FIXED  # those that it can record

    @classmethod
    def of_replay(cls, topics: TopicTable) -> Side:
        """Side of a replay: the topics of its run that it computes anew."""
        return cls("replayed", "the replay", _ALL | _fields_of(topics.extra), topics=topics)

    @classmethod
    def of(cls, word: str, session: Session) -> Side:
        """A session, without the topics that it leaves out and the fields that its schemas do not have."""
        patterns = session.setting("recording", "leave_out")
        left_out = list(map(str, patterns)) if isinstance(patterns, list) else []
        copy, known = bool(session.header.parent), session.reader.topics
        recorded = dict(session.reader.recorded_fields)
        for name in recorded.keys() - session.reader.counts.keys():
            if (copy and name == "frame") or is_left_out(known.by_field[name].path, left_out):
                del recorded[name]
        return cls(word, session.path.name, recorded, copy, session.numerics, known)

    def lacks(self, topic: Topic) -> dict[str, str]:
        """Parts of a topic that this side does not record, as `/topic` or `/topic field`, each with a text about it."""
        if topic.field not in self.recorded:
            copied = self.copy and topic.field == "frame"
            return {topic.path: f"not copied into {self.name}" if copied else f"not recorded in {self.name}"}
        missing = sorted({*_names_of(topic)} - self.recorded[topic.field])
        return {f"{topic.path} {name}": f"not recorded in {self.name}" for name in missing}


@dataclass(frozen=True, slots=True)
class Difference:
    """Largest difference of two messages of a topic: one element of one field."""

    topic: str
    stamp_ns: int  # of the tick
    field: str
    index: tuple[int, ...] | None  # of the element in an array; None for other values
    values: tuple[object, object]  # of the element, or text about a whole message or array; in the order of `words`
    # the difference divided by the tolerance of the field; inf if the tolerance is zero or the values have no
    # difference
    excess: float
    words: tuple[str, str]  # what the two sides are called

    @property
    def beyond(self) -> bool:
        """True if it is larger than the tolerance."""
        return not self.excess <= 1.0

    def __str__(self) -> str:
        place = "" if self.index is None else str(list(self.index))
        values = ", ".join(f"{word} {_text(value)}" for word, value in zip(self.words, self.values, strict=True))
        return printable(f"{self.topic} at {seconds(self.stamp_ns):.3f} s: {self.field}{place} {values}")

    def as_json(self) -> dict[str, Any]:
        """The difference for JSON; values that JSON can not hold are text."""
        infinite = [isinstance(value, float) and not math.isfinite(value) for value in self.values]
        values = [_text(value) if wrong else value for value, wrong in zip(self.values, infinite, strict=True)]
        return {
            "topic": self.topic,
            "stamp_s": seconds(self.stamp_ns),
            "field": self.field,
            "index": None if self.index is None else list(self.index),
            **dict(zip(self.words, values, strict=True)),
        }


@dataclass(slots=True)
class TopicCount:
    """Counts of the compared messages of one topic; `first`: the first difference, beyond the tolerance if any is."""

    identical: int = 0
    within_tolerance: int = 0
    different: int = 0
    first: Difference | None = None

    def see(self, difference: Difference) -> None:
        """Keep a difference if it is the first, or the first beyond the tolerance."""
        if self.first is None or (difference.beyond and not self.first.beyond):
            self.first = difference

    def followed_by(self, later: TopicCount) -> None:
        """Add the counts of later messages."""
        self.identical += later.identical
        self.within_tolerance += later.within_tolerance
        self.different += later.different
        if later.first is not None:
            self.see(later.first)

    def as_json(self) -> dict[str, Any]:
        return asdict(self) | {"first": self.first.as_json() if self.first is not None else None}


@dataclass(slots=True)
class Comparison:
    """Compares pairs of ticks: messages that are new in either tick and recorded on both sides."""

    roles: tuple[Role, ...] = (Role.OUTPUT,)  # of the topics that `add` compares
    sides: tuple[Side, Side] = (Side("recorded", "the recording"), Side("replayed", "the replay"))  # what is compared
    left_out: frozenset[str] = frozenset()  # paths of topics that `add` passes over
    ticks: int = 0
    different_ticks: int = 0
    lone: int = 0  # ticks that only one side has
    topics: dict[str, TopicCount] = field(default_factory=dict)
    # topics, and fields of a topic as `/topic field`, that one side lacks, with the words for it
    not_recorded: dict[str, str] = field(default_factory=dict)
    first: Difference | None = None  # the first difference beyond a tolerance
    _before: tuple[Tick, Tick] = (Tick(), Tick())
    _names: dict[str, list[str]] = field(default_factory=dict)
    _known: TopicTable = FIXED
    _compared: list[Topic] = field(default_factory=list)

    def __post_init__(self) -> None:
        self._known = self.sides[0].topics.with_types_of(self.sides[1].topics)
        topics = self._known.topics
        self._compared = [topic for topic in topics if topic.role in self.roles and topic.path not in self.left_out]
        for topic in topics:
            lacking = self.sides[0].lacks(topic) | self.sides[1].lacks(topic)
            names = [] if topic.path in lacking else _names_of(topic)
            self._names[topic.field] = [name for name in names if f"{topic.path} {name}" not in lacking]
            if topic.role is not Role.DIAGNOSTIC:
                self.not_recorded |= lacking

    @property
    def other_numerics(self) -> str:
        """Text if the two sides were computed by different versions of the numerics, else ''."""
        if self.sides[0].numerics == self.sides[1].numerics:
            return ""
        versions = ", ".join(f"{side.word}: version {side.numerics}" for side in self.sides)
        return printable(f"made by other numerics ({versions})")

    @property
    def different_word(self) -> str:
        """The word for messages beyond their tolerance that numerics compute."""
        return "by other numerics" if self.other_numerics else "DIFFERENT"

    @property
    def words(self) -> tuple[str, str]:
        """The words for the values of the two sides."""
        return self.sides[0].word, self.sides[1].word

    def begin_after(self, recorded: Tick, replayed: Tick) -> None:
        """Take a tick that both sides have in common: its messages are compared elsewhere."""
        self._before = (recorded, replayed)

    def followed_by(self, later: Comparison) -> None:
        """Add what was compared in the ticks that follow."""
        self.ticks += later.ticks
        self.different_ticks += later.different_ticks
        self.first = self.first or later.first
        for path, count in later.topics.items():
            self.topics.setdefault(path, TopicCount()).followed_by(count)

    def add(self, recorded: Tick, replayed: Tick) -> None:
        """Compare all topics of the chosen roles in one tick."""
        self.ticks += 1
        differs = False
        stamp_ns = max(recorded.stamp_ns, replayed.stamp_ns)
        for topic in self._compared:
            was, now = message_of(recorded, topic.field), message_of(replayed, topic.field)
            before = [message_of(tick, topic.field) for tick in self._before]
            new = was is not before[0] or now is not before[1]
            if new and (was is not None or now is not None):
                found = self.add_pair(topic, was, now, stamp_ns)
                differs |= found is not None and found.beyond
        self.different_ticks += differs
        self._before = (recorded, replayed)

    def add_lone(self, stamp_ns: int, side: int) -> None:
        """Count a tick that only one side has (0 or 1)."""
        self.ticks += 1
        self.different_ticks += 1
        self.lone += 1
        values = ("present", "absent") if side == 0 else ("absent", "present")
        if self.first is None:
            self.first = Difference("tick", stamp_ns, "tick", None, values, math.inf, self.words)

    def add_pair(self, topic: Topic, was: Message | None, now: Message | None, stamp_ns: int) -> Difference | None:
        """Compare two messages of a topic: where they differ most; None if they are identical bit for bit."""
        names = self._names[topic.field]
        if not names:
            return None
        count = self.topics.setdefault(topic.path, TopicCount())
        largest = _largest_deviation(topic, was, now, names)
        if largest is None:
            count.identical += 1
            return None
        name, (excess, index, first, second) = largest
        difference = Difference(topic.path, stamp_ns, name, index, (first, second), excess, self.words)
        if difference.beyond:
            count.different += 1
            self.first = self.first or difference
        else:
            count.within_tolerance += 1
        count.see(difference)
        return difference

    @property
    def identical(self) -> bool:
        """Every message bit for bit."""
        return self.same and all(count.within_tolerance == 0 for count in self.topics.values())

    @property
    def same(self) -> bool:
        """Every message within its topic's tolerance."""
        return self.different_ticks == 0 and all(count.different == 0 for count in self.topics.values())

    def lines(self, width: int = 0) -> list[str]:
        """A line of text for each topic; `width` of the names at least."""
        lines = []
        width = max(width, max(map(len, (*self.topics, *self.not_recorded)), default=0))
        for topic, count in self.topics.items():
            total = count.identical + count.within_tolerance + count.different
            computed = self._known.by_path[topic].source in (Source.STAGE, Source.WORKER)
            word = self.different_word if computed else "DIFFERENT"
            lines.append(
                f"{topic:{width}s}  {count.identical} of {total} identical"
                + (f", {count.within_tolerance} within tolerance" if count.within_tolerance else "")
                + (f", {count.different} {word}" if count.different else "")
            )
        return lines + [printable(f"{what:{width}s}  {why}") for what, why in self.not_recorded.items()]

    def as_json(self) -> dict[str, Any]:
        return {
            "same": self.same,
            "identical": self.identical,
            "ticks": self.ticks,
            "different_ticks": self.different_ticks,
            "other_numerics": self.other_numerics,
            "topics": {topic: count.as_json() for topic, count in self.topics.items()},
            "not_recorded": self.not_recorded,
            "first": self.first.as_json() if self.first is not None else None,
        }


def _largest_deviation(
    topic: Topic, was: Message | None, now: Message | None, names: Iterable[str]
) -> tuple[str, _Deviation] | None:
    """The field in which two messages of a topic differ most, relative to its tolerance; None if they are identical."""
    if was is None or now is None:
        first, second = ("absent" if message is None else "present" for message in (was, now))
        return "message", (math.inf, None, first, second)
    worst: tuple[str, _Deviation] | None = None
    for name in names:
        before, after = getattr(was, name), getattr(now, name)
        if type(before) is type(after) and not isinstance(before, np.ndarray) and before == after:
            continue  # most fields of a replay, without the search for the tolerance
        deviation = _deviation(before, after, topic.rtol, topic.atol_of(name))
        if deviation is not None and (worst is None or deviation[0] > worst[1][0]):
            worst = name, deviation
    return worst


def _deviation(was: object, now: object, rtol: float, atol: float) -> _Deviation | None:
    """Deviation of two values relative to the tolerance, by |was - now| <= atol + rtol |was|; None if bit-identical."""
    if isinstance(was, np.ndarray) and isinstance(now, np.ndarray):
        if was.shape == now.shape and was.dtype.kind == now.dtype.kind:
            if was.dtype == now.dtype and was.tobytes() == now.tobytes():
                return None
            excess = _excess(was, now, rtol, atol)
            index = tuple(int(i) for i in np.unravel_index(int(np.argmax(excess)), excess.shape))
            return float(excess[index]), index, was[index].item(), now[index].item()
    elif isinstance(was, float) and isinstance(now, float | int) and not isinstance(now, bool):
        if was == now or (was != was and now != now):
            return None
        return float(_excess(np.array(was), np.array(now), rtol, atol)), None, was, now
    elif not isinstance(was, np.ndarray) and not isinstance(now, np.ndarray) and was == now:
        return None
    return math.inf, None, _form(was), _form(now)


def _excess(was: NDArray[Any], now: NDArray[Any], rtol: float, atol: float) -> Floats:
    """|was - now| / (atol + rtol |was|) per element; values that are not finite equal only the same value."""
    a, b = np.asarray(was, np.float64), np.asarray(now, np.float64)
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        same = (a == b) | (np.isnan(a) & np.isnan(b))
        ratio = np.abs(a - b) / (atol + rtol * np.abs(a))
    return np.where(same, 0.0, np.where(np.isfinite(a) & np.isfinite(b), ratio, np.inf))


def _form(value: object) -> object:
    return f"{value.dtype} of shape {value.shape}" if isinstance(value, np.ndarray) else value


def _text(value: object) -> str:
    return "absent" if value is None else str(value) if value in ("absent", "present") else repr(value)
