"""Tick by tick, message by message: is a replay the recording, and where does it first differ?"""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from itertools import zip_longest

import numpy as np

from flowrec.messages import Message, Tick
from flowrec.store import SessionReader
from flowrec.topics import TOPICS, Role, Topic
from flowrec.units import seconds


@dataclass(frozen=True, slots=True)
class Difference:
    """The first place where two messages of a topic differ."""

    topic: str
    stamp_ns: int
    field: str
    recorded: str
    replayed: str
    relative: float  # inf where the kinds differ

    def __str__(self) -> str:
        size = "" if not np.isfinite(self.relative) else f", {self.relative:.1e} relative"
        return (
            f"{self.topic} at {seconds(self.stamp_ns):.3f} s: {self.field} was {self.recorded}, "
            f"now {self.replayed}{size}"
        )


@dataclass(slots=True)
class TopicCount:
    """How the messages of one topic compared."""

    identical: int = 0
    within_tolerance: int = 0
    different: int = 0
    first: Difference | None = None


@dataclass(slots=True)
class Comparison:
    """Feed it pairs of ticks; only what is new in either of a pair is compared."""

    ticks: int = 0
    different_ticks: int = 0
    topics: dict[str, TopicCount] = field(default_factory=dict)
    first: Difference | None = None
    roles: tuple[Role, ...] = (Role.OUTPUT,)
    _before: tuple[Tick, Tick] = (Tick(), Tick())

    def add(self, recorded: Tick, replayed: Tick) -> None:
        """Compare all topics of the chosen roles in one tick."""
        self.ticks += 1
        differs = False
        for topic in TOPICS:
            if topic.role not in self.roles:
                continue
            was, now = getattr(recorded, topic.field), getattr(replayed, topic.field)
            new = was is not getattr(self._before[0], topic.field) or now is not getattr(self._before[1], topic.field)
            if new and (was is not None or now is not None):
                differs |= self.add_pair(topic, was, now, recorded.stamp_ns)
        self.different_ticks += differs
        self._before = (recorded, replayed)

    def add_pair(self, topic: Topic, was: Message | None, now: Message | None, stamp_ns: int) -> bool:
        """Compare two messages of a topic; True where they differ beyond its tolerance."""
        count = self.topics.setdefault(topic.path, TopicCount())
        if was is not None and now is not None and was.same_as(now):
            count.identical += 1
            return False
        difference = first_difference(topic, was, now, stamp_ns)
        if difference.relative <= topic.tolerance:
            count.within_tolerance += 1
        else:
            count.different += 1
        if count.first is None:
            count.first = difference
        if self.first is None and difference.relative > topic.tolerance:
            self.first = difference
        return difference.relative > topic.tolerance

    @property
    def identical(self) -> bool:
        """Every message bit for bit."""
        return all(count.within_tolerance == count.different == 0 for count in self.topics.values())

    @property
    def same(self) -> bool:
        """Every message within its topic's tolerance."""
        return all(count.different == 0 for count in self.topics.values())


def first_difference(topic: Topic, was: Message | None, now: Message | None, stamp_ns: int) -> Difference:
    """The largest relative difference between two messages that are not the same."""
    if was is None or now is None:
        return Difference(topic.path, stamp_ns, "message", _said(was), _said(now), float("inf"))
    worst = Difference(topic.path, stamp_ns, "", "", "", -1.0)
    for item in fields(was):  # type: ignore[arg-type]
        mine, theirs = getattr(was, item.name), getattr(now, item.name)
        relative = _relative(mine, theirs)
        if relative > worst.relative:
            worst = Difference(topic.path, stamp_ns, item.name, _said(mine), _said(theirs), relative)
    return worst


def _relative(mine: object, theirs: object) -> float:
    """Largest difference over the largest size; inf where nothing can be subtracted."""
    if mine is None and theirs is None:
        return 0.0
    numbers = (int, float, np.ndarray)
    if not isinstance(mine, numbers) or not isinstance(theirs, numbers) or isinstance(mine, bool):
        return 0.0 if mine == theirs else float("inf")
    a, b = np.asarray(mine, np.float64), np.asarray(theirs, np.float64)
    if a.shape != b.shape or not np.array_equal(np.isnan(a), np.isnan(b)):
        return float("inf")
    if a.size == 0 or np.array_equal(a, b, equal_nan=True):
        return 0.0
    return float(np.nanmax(np.abs(a - b)) / max(float(np.nanmax(np.abs(a))), 1e-12))


def _said(value: object) -> str:
    if value is None:
        return "absent"
    if isinstance(value, Message):
        return type(value).__name__
    if isinstance(value, np.ndarray):
        return np.array2string(value.ravel()[:4], precision=6) + (" ..." if value.size > 4 else "")
    return repr(value)


def compare_sessions(first: SessionReader, second: SessionReader) -> Comparison:
    """Every message of every tick of two sessions, inputs and truth included; timings left out."""
    comparison = Comparison(roles=(Role.INPUT, Role.OUTPUT, Role.TRUTH))
    for was, now in zip_longest(first.ticks(), second.ticks(), fillvalue=Tick()):
        comparison.add(was, now)
    return comparison
