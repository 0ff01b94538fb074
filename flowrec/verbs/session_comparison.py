"""Comparison of two sessions in all that a session holds: the engine of `flowrec compare`.

Compared are the head, the messages of every tick, and every other topic (drawings for viewers, other programs'
messages). What only one of the two holds is a difference. Two runs differ by nature in when, where and how quickly they
ran; that is told as every other difference is, with the option that leaves it out.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from heapq import merge
from itertools import groupby, repeat
from typing import Any

from flowrec.core import Coverage, Ended, Role, Tick, printable, seconds
from flowrec.store import Session, open_bytes
from flowrec.verbs.comparison import Comparison, Difference, Side
from flowrec.verbs.session_parts import (
    DRAWINGS,
    HEAD,
    Choice,
    PartOfHead,
    RawTopic,
    SessionParts,
    compared_heads,
    raw_topics,
)

_BLOCK_BYTES = 4 << 20
# What differs between any two runs, and between a recording and its replay: when, where and how quickly they ran.
_BY_NATURE = ("provenance", "parent", "outcome", "start", "diagnostics")
_LONG = ("schema", "declaration")  # of a channel: only named where they differ
_NAMED = 6  # topics and parts of the head that the verdict names


Sessions = tuple[Session, Session]
Raws = tuple[Mapping[str, RawTopic], Mapping[str, RawTopic]]  # of both sessions, by topic


@dataclass(slots=True)
class SessionComparison:
    """The result of comparing two sessions.

    Attributes
    ----------
    names : of the two files.
    choice : what was asked for.
    total : the ticks of the longer one.
    bytes_alike : size of two files that are the same byte for byte, of which nothing else was compared; else None.
    head : its parts.
    comparison : of the messages, tick by tick.
    apart : topics, or fields of topics, that differ as a whole: held by one file only, declared otherwise. A text each.
    raw : topics that are compared as they are in the file: messages that are the same, that differ, and text.
    topics : that were compared.
    by_nature : what differs between any two runs, and does here; as names for --ignore.
    stopped, status : what ended it early, and its exit status; '' if nothing did.
    """

    names: tuple[str, str]
    choice: Choice
    total: int
    bytes_alike: int | None = None
    head: list[PartOfHead] = field(default_factory=list)
    comparison: Comparison = field(default_factory=Comparison)
    apart: dict[str, str] = field(default_factory=dict)
    raw: dict[str, tuple[int, int, str]] = field(default_factory=dict)
    topics: tuple[str, ...] = ()
    by_nature: tuple[str, ...] = ()
    stopped: str = ""
    status: int = 0

    @property
    def ticks(self) -> int:
        """Ticks that were compared."""
        return self.comparison.ticks

    @property
    def covered(self) -> Coverage:
        """The ticks, topics and parts of the head that were compared."""
        if self.bytes_alike is not None:
            return Coverage(self.total, self.total, topics=self.topics, head=HEAD)
        done, head = self.ticks, tuple(dict.fromkeys(part.name for part in self.head))
        covered = Coverage(done, done, topics=self.topics, head=head)
        if not self.stopped:
            return covered
        return replace(covered, total=max(done, self.total), stopped=self.stopped, status=self.status)

    @property
    def first(self) -> Difference | None:
        """The first difference beyond a tolerance in the messages of the ticks."""
        return self.comparison.first

    @property
    def same_so_far(self) -> bool:
        """Nothing that was compared differs beyond its tolerance."""
        return self.comparison.same and not self._different

    @property
    def same(self) -> bool | None:
        """All that was asked for is the same within its tolerance; None if it was stopped before a difference."""
        return None if self.stopped and self.same_so_far else self.same_so_far

    @property
    def identical(self) -> bool | None:
        """True if `same` holds bit for bit; None as of `same`."""
        return self.same if self.comparison.identical else False

    @property
    def exit_status(self) -> int:
        """0 the same, 3 something differs, 130 or 143 stopped."""
        return self.status if self.stopped else 0 if self.same else 3

    def lines(self) -> list[str]:
        """A line for each topic and part of the head, hints, and the verdict."""
        if self.bytes_alike is not None:
            size_mb = self.bytes_alike / 1e6
            return [printable(f"{' and '.join(self.names)}: identical byte for byte ({size_mb:.1f} MB)")]
        width = max(map(len, (*self.comparison.topics, *self.apart, *self.raw, *HEAD)))
        lines = [part.line(width) for part in self.head]
        lines += self.comparison.lines(width)
        for topic, (same, wrong, where) in self.raw.items():
            lines.append(f"{topic:{width}s}  {same} of {same + wrong} identical" + where)
        for topic, text in self.apart.items():
            told = next((number for number, line in enumerate(lines) if line.startswith(f"{topic} ")), None)
            if told is None:
                lines.append(f"{topic:{width}s}  {text}")
            else:
                lines[told] += f"; {text}"
        if self.first is not None:
            lines.append(f"first difference: {self.first}")
        if self.by_nature:
            lines.append(
                f"{', '.join(self.by_nature)}: differ between any two runs and between a recording and its replay; "
                f"--ignore {','.join(self.by_nature)} leaves them out"
            )
        return [printable(line) for line in (*lines, self._verdict)]

    @property
    def _verdict(self) -> str:
        found = "identical" if self.comparison.identical else "the same within tolerance"
        if not self.same_so_far:
            other = self.comparison.other_numerics
            different = self._different
            if len(different) > _NAMED:
                different[_NAMED:] = [f"{len(different) - _NAMED} more"]
            found = f"DIFFERENT in {', '.join(different)}" + (f"; {other}" if other else "")
        covered = self.covered
        what = f"{_count_of(len(covered.topics), 'topic')} and {_count_of(len(covered.head), 'part')} of the head"
        return f"{covered.sentence(found)} ({what}{self.choice.text})"

    @property
    def _different(self) -> list[str]:
        """Names of what differs."""
        topics = [topic for topic, count in self.comparison.topics.items() if count.different]
        topics += [topic for topic, (_, wrong, _) in self.raw.items() if wrong] + list(self.apart)
        lone = ["ticks"] if self.comparison.lone else []
        return [*(part.name for part in self.head if part.differences), *lone, *dict.fromkeys(topics)]

    def as_json(self) -> dict[str, Any]:
        return self.comparison.as_json() | {
            "same": self.same,
            "identical": self.identical,
            "covered": self.covered.as_json(),
            "bytes_alike": self.bytes_alike,
            "different": self._different,
            "head": {part.name: dict(part.differences) for part in self.head},
            "apart": self.apart,
            "raw": {topic: {"identical": same, "different": wrong} for topic, (same, wrong, _) in self.raw.items()},
            "only": list(self.choice.only),
            "ignore": list(self.choice.ignore),
            "by_nature": list(self.by_nature),
        }


def compare_sessions(sessions: Sessions, choice: Choice, progress: Callable[[float], None]) -> SessionComparison:
    """Compare two sessions; parameters and errors as of `flowrec.compare`."""
    names = _names(*sessions)
    found = SessionComparison(names, choice, max(each.reader.counts.get("applied", 0) for each in sessions))
    try:
        found.bytes_alike = None if choice.text else _same_bytes(*sessions)
        if found.bytes_alike is not None:
            found.topics = tuple(sessions[0].topics)
            return found
        parts = SessionParts.of(sessions[0]), SessionParts.of(sessions[1])
        choice.check([name for part in parts for name in (*part.head, *part.declared)])
        found.head = compared_heads([part.head for part in parts], names, choice)
        raw = raw_topics(sessions[0], choice), raw_topics(sessions[1], choice)
        _compare_raw(found, raw)
        _compare_ticks(found, sessions, progress)
        _compare_declared(found, [part.declared for part in parts])
        _compare_unread(found, sessions, raw)
        if found.identical and not choice.text and not any(session.run.in_parts for session in sessions):
            _compare_digests(found, [part.digest for part in parts])
    except KeyboardInterrupt as error:
        ended = Ended.of(error)
        found.stopped, found.status, ended.result = ended.why, ended.status, found
        raise ended from error
    found.by_nature = _by_nature(found)
    return found


def _names(first: Session, second: Session) -> tuple[str, str]:
    """Labels of the two sessions: their file names if these differ."""
    if first.path.name != second.path.name:
        return first.path.name, second.path.name
    return str(first.path), str(second.path)


def _count_of(number: int, noun: str) -> str:
    return f"{number} {noun}{'s' * (number != 1)}"


def _same_bytes(first: Session, second: Session) -> int | None:
    """The size of each of two sessions if their files are the same byte for byte; else None."""
    files = [[file.path for file in session.run.files] for session in (first, second)]
    sizes = [[file.size_bytes for file in session.run.files] for session in (first, second)]
    if sizes[0] != sizes[1]:
        return None
    for one, other in zip(*files, strict=True):
        with open_bytes(one) as here, open_bytes(other) as there:
            for offset in range(0, here.size, _BLOCK_BYTES):
                length = min(_BLOCK_BYTES, here.size - offset)
                if here.read(offset, length) != there.read(offset, length):
                    return None
    return sum(sizes[0])


def _compare_raw(found: SessionComparison, raw: Raws) -> None:
    """Compare the topics that are no field of `Tick`."""
    known = found.choice.topics.by_path
    was, now = ({topic: each for topic, each in side.items() if topic not in known} for side in raw)
    for topic in dict.fromkeys((*was, *now)):
        if topic not in was or topic not in now:
            found.apart[topic] = f"only in {found.names[topic not in was]}"
            continue
        same, wrong, where = was[topic].same_as(now[topic])
        found.raw[topic] = (same, wrong, f", {wrong} DIFFERENT{where}" if wrong else "")
    found.topics = tuple(dict.fromkeys((*was, *now)))


def _compare_declared(found: SessionComparison, declared: Sequence[Mapping[str, Mapping[str, str]]]) -> None:
    """Compare what the topics declare that both hold: encoding, depth, region, role, and the schema."""
    was, now = declared
    for topic in found.topics:
        if topic not in was or topic not in now or topic in found.apart:
            continue
        keys = [key for key in {**was[topic], **now[topic]} if was[topic].get(key) != now[topic].get(key)]
        texts = [f"{key} {was[topic].get(key, '-')}, {now[topic].get(key, '-')}" for key in keys if key not in _LONG]
        if keys:
            found.apart[topic] = f"declared otherwise: {'; '.join(texts) or f'another {keys[0]}'}"


def _compare_unread(found: SessionComparison, sessions: Sessions, raw: Raws) -> None:
    """Messages that are the same in all that flowrec reads, and not in the file: fields of foxglove's schemas."""
    if sessions[0].header.start_unix_ns != sessions[1].header.start_unix_ns:
        return  # the wall clock is in them
    for topic, count in found.comparison.topics.items():
        told = topic in found.apart or count.different or count.within_tolerance
        if not told and topic in raw[0] and topic in raw[1]:
            _, wrong, where = raw[0][topic].same_as(raw[1][topic])
            if wrong:
                found.apart[topic] = f"{wrong} differ in what flowrec does not read{where}"


def _compare_digests(found: SessionComparison, digests: Sequence[Mapping[str, str] | None]) -> None:
    """Two digests that differ although all is the same: of numbers and order of messages, which no reader returns."""
    was, now = digests
    if was is not None and now is not None and was != now:
        topics = [key for key in {**was, **now} if was.get(key) != now.get(key)]
        told = {"": f"states others for {', '.join(topics)}: the numbers of the messages differ"}
        found.head.append(PartOfHead("digest", 1, told))


def _compare_ticks(found: SessionComparison, sessions: Sessions, progress: Callable[[float], None]) -> None:
    """Compare the messages tick by tick; a topic or a field that one file does not have is told once."""
    left_out, compared = set(), []
    topics = found.choice.topics.topics
    for topic in topics:
        counts = [each.reader.counts.get(topic.field, 0) for each in sessions]
        if not found.choice(topic.path) or not any(counts):
            left_out.add(topic.path)
            continue
        compared.append(topic.path)
        if not all(counts):
            left_out.add(topic.path)
            holder = found.names[not counts[0]]
            found.apart[topic.path] = f"only in {holder}, {_count_of(sum(counts), 'message')}"
            continue
        was, now = (each.reader.recorded_fields.get(topic.field, frozenset()) for each in sessions)
        for holder, lone in zip(found.names, (was - now, now - was), strict=True):
            if lone:
                found.apart[topic.path] = f"{', '.join(sorted(lone))}: only in {holder}"
    found.topics = (*compared, *found.topics)
    sides = Side.of("first", sessions[0]), Side.of("second", sessions[1])
    found.comparison = comparison = Comparison(tuple(Role), sides, frozenset(left_out))
    comparison.not_recorded.clear()  # told above, where one of the two has it
    with_frames = "/camera/frame" not in left_out
    if left_out >= {topic.path for topic in topics}:
        return
    first_ns = min(session.run.first_ns for session in sessions)
    for stamp_ns in _compare_paired_ticks(comparison, sessions, with_frames=with_frames):
        progress(seconds(stamp_ns - first_ns))


def _compare_paired_ticks(comparison: Comparison, sessions: Sessions, *, with_frames: bool) -> Iterator[int]:
    """Compare tick by tick; yields the stamp of each in ns."""
    ticks = [zip(each.ticks(with_frames=with_frames), repeat(side)) for side, each in enumerate(sessions)]

    def stamp_of(tick: tuple[Tick, int]) -> int:
        return tick[0].stamp_ns

    for stamp_ns, there in groupby(merge(*ticks, key=stamp_of), stamp_of):
        (tick, side), *other = there
        if other:
            comparison.add(tick, other[0][0])
        else:
            comparison.add_lone(stamp_ns, side)
        yield stamp_ns


def _by_nature(found: SessionComparison) -> tuple[str, ...]:
    """Names for --ignore of what differs here and differs between any two runs."""
    different = {part.name for part in found.head if part.differences}
    topics = [*(topic for topic, count in found.comparison.topics.items() if count.different), *found.apart]
    names = [
        word for word in _BY_NATURE if word in different or any(found.choice.means(word, topic) for topic in topics)
    ]
    drawn = [topic for topic, (_, wrong, _) in found.raw.items() if wrong]
    if "start" in different and drawn:
        names.append(DRAWINGS)  # their timestamps are of the wall clock
    if any(side.copy for side in found.comparison.sides) and "/camera/frame" in found.apart:
        names.append("/camera/frame")  # flowrec replay --frames copies them
    return tuple(names)
