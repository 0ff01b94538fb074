"""Parts of a session besides the messages of its ticks, for comparison: head, drawings, other programs' messages.

Items of the head have names with dots, as `provenance.host`; topics have their paths.
"""

from __future__ import annotations

import difflib
import hashlib
import json
from array import array
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from typing import Any, NamedTuple

from flowrec.core import FIXED, Role, TopicTable, UsageError, printable, seconds
from flowrec.store import (
    FRAME_PATH,
    VERDICT,
    Session,
    SessionHeader,
    SessionMetadata,
    is_copy,
    is_header_file,
    toml_table,
)

HEAD = (
    *("configuration", "chip", "provenance", "parent", "outcome"),
    *("weights", "pictures", "start", "part", "digest", "records"),
)
_ROLES = {"inputs": Role.INPUT, "outputs": Role.OUTPUT, "truth": Role.TRUTH, "diagnostics": Role.DIAGNOSTIC}
DRAWINGS = "drawings"
# Words for several topics or parts of the head at a time.
GROUPS = (*_ROLES, DRAWINGS, "head")
_TEXT = ".text"  # of a table: compared where all of its values are the same
_OWN = "flowrec."  # beginning of the names of flowrec's records
_SHOWN = 40  # characters of a value
_NAMED = 4  # items of a part of the head that are named one by one

Item = str | bytes


@dataclass(frozen=True, slots=True)
class Choice:
    """Filter of the topics and head items to compare: names, patterns such as `/robot/*`, and words of GROUPS."""

    only: tuple[str, ...] = ()
    ignore: tuple[str, ...] = ()
    topics: TopicTable = FIXED  # of both sessions

    @classmethod
    def of(cls, only: Sequence[str], ignore: Sequence[str], topics: TopicTable = FIXED) -> Choice:
        """Parse texts, each of which may be several with commas between them."""
        asked = [tuple(name for text in texts for name in text.split(",") if name) for texts in (only, ignore)]
        return cls(asked[0], asked[1], topics)

    def __call__(self, name: str) -> bool:
        """True if something of this name is compared."""
        chosen = not self.only or any(self.means(pattern, name) for pattern in self.only)
        return chosen and not any(self.means(pattern, name) for pattern in self.ignore)

    def means(self, pattern: str, name: str) -> bool:
        """True if a pattern or a word for several means a topic or an item of the head."""
        known, topic = self.topics.by_path, name.startswith("/")
        if pattern in _ROLES:
            return name in known and known[name].role is _ROLES[pattern]
        if pattern in ("head", DRAWINGS):
            return (topic and name not in known) if pattern == DRAWINGS else not topic
        return fnmatchcase(name, pattern) or name.startswith(f"{pattern}{'/' if topic else '.'}")

    @property
    def text(self) -> str:
        """For the verdict: "; only /robot/*; without provenance"; '' where all is compared."""
        parts = [("only", self.only), ("without", self.ignore)]
        return "".join(f"; {word} {', '.join(names)}" for word, names in parts if names)

    def check(self, names: Sequence[str]) -> None:
        """Refuse a pattern that means nothing that is there: UsageError."""
        for option, patterns in (("--only", self.only), ("--ignore", self.ignore)):
            for pattern in patterns:
                known = list(dict.fromkeys((*names, *GROUPS, *HEAD)))
                if pattern in (*GROUPS, *HEAD) or any(self.means(pattern, name) for name in names):
                    continue
                near = difflib.get_close_matches(pattern, known, 3, 0.5)
                meant = f"did you mean {' or '.join(near)}?" if near else f"words for several are {', '.join(GROUPS)}"
                raise UsageError(f"{option} {pattern}: is no topic and no part of the head of the two; {meant}")


class SessionParts(NamedTuple):
    """A session without the messages of its ticks."""

    head: dict[str, Item]  # settings, chip, origin, outcome, and the records of other programs, by name
    # declarations of the channels, by topic: the metadata, and a hash of the schema
    declared: dict[str, dict[str, str]]
    digest: dict[str, str] | None  # of the first file, by topic; None without one

    @classmethod
    def of(cls, session: Session) -> SessionParts:
        """Read those of a session; of a run in several files the first one states them."""
        with SessionMetadata(session.run.files[0].path) as first:
            items = dict(_of_header(first.header, str(session.path)))
            items |= {f"outcome.{key}": text for key, text in session.run.outcome.items()}
            if session.run.part is not None:
                part = session.run.part
                items["part"] = f"{part.kind} {part.number}"
            if first.digest is not None:
                items["digest"] = "there"
            for record in first.metadata:
                if not record.name.startswith(_OWN):
                    content = first.source.metadata(record)
                    items |= {f"records.{record.name}.{key}": text for key, text in content.items()}
            for place in first.attachments:
                if not is_header_file(place.name) and not is_copy(place.name):
                    items[f"records.{place.name}"] = first.source.attachment(place)
            declared = {}
            for channel in first.channels.values():
                schema = first.schemas.get(channel.schema_id)
                text = f"{schema.name} {schema.encoding} ".encode() + schema.data if schema is not None else b""
                hashed = hashlib.blake2b(text, digest_size=8).hexdigest()
                declared[channel.topic] = {**channel.metadata, "schema": hashed}
            return cls(items, declared, first.digest)


def _of_header(header: SessionHeader, path: str) -> Iterator[tuple[str, Item]]:
    for name, text in (("configuration", header.config_toml), ("chip", header.chip_toml)):
        yield f"{name}{_TEXT}", text
        for key, value in flat(toml_table(text, f"{path}: {name} inside")):
            yield f"{name}.{key}", value
    yield "chip.mask", header.chip_png
    tables: dict[str, Mapping[str, Item]] = {"provenance": header.provenance, "parent": header.parent}
    tables |= {"weights": header.weights, "pictures": header.pictures}
    for name, items in tables.items():
        for key, item in items.items():
            yield f"{name}.{key}", item
    yield "start", str(header.start_unix_ns)


def flat(tree: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, str]]:
    """Keys with dots and values as text of nested tables."""
    for key, value in tree.items():
        if isinstance(value, dict):
            yield from flat(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", value if isinstance(value, str) else json.dumps(value, default=str)


class PartOfHead(NamedTuple):
    """Comparison of one part of two heads."""

    name: str
    items: int  # that were compared
    differences: Mapping[str, str]  # by item, what differs as text

    def line(self, width: int) -> str:
        if not self.differences:
            return printable(f"{self.name:{width}s}  identical")
        shown = [f"{key} {text}".strip() for key, text in self.differences.items()]
        if len(shown) > _NAMED:
            shown[_NAMED:] = [f"{len(shown) - _NAMED} more"]
        count = f"{len(self.differences)} of {self.items}"
        return printable(f"{self.name:{width}s}  {count} DIFFERENT: {'; '.join(shown)}")


def compared_heads(
    heads: Sequence[dict[str, Item]], names: tuple[str, str], chosen: Callable[[str], bool]
) -> list[PartOfHead]:
    """The heads of two sessions, part by part; `chosen` says of each item whether it is compared."""
    found = []
    for part in HEAD:
        there = [key for key in heads[0] | heads[1] if key.partition(".")[0] == part]
        keys = [key for key in there if chosen(key) and not key.endswith(_TEXT)]
        texts = {key: _difference(heads[0].get(key), heads[1].get(key), names) for key in keys}
        differ = {key.removeprefix(part).removeprefix("."): text for key, text in texts.items() if text}
        text = f"{part}{_TEXT}"
        written = [heads[side].get(text) for side in (0, 1)] if all(map(chosen, there)) else [None, None]
        if not differ and written[0] != written[1]:
            differ["text"] = "(the same values, written otherwise)"
        if keys:
            found.append(PartOfHead(part, len(keys), differ))
    return found


def _difference(was: Item | None, now: Item | None, names: tuple[str, str]) -> str:
    if was == now:
        return ""
    if was is None or now is None:
        return f"only in {names[was is None]}"
    if isinstance(was, bytes) or isinstance(now, bytes):
        return f"({len(was)} and {len(now)} bytes)"
    if "\n" in was or "\n" in now:
        return "(another text)"
    return f"({_short(was)}, {_short(now)})"


def _short(text: str) -> str:
    return text if len(text) <= _SHOWN else f"{text[: _SHOWN - 3]}..."


class RawTopic:
    """The messages of one topic as they are in the file: time and a hash of each, 16 bytes in memory."""

    def __init__(self) -> None:
        self.log_ns = array("q")
        self.hashes = array("Q")

    def add(self, log_ns: int, payload: bytes) -> None:
        self.log_ns.append(log_ns)
        self.hashes.append(int.from_bytes(hashlib.blake2b(payload, digest_size=8).digest(), "little"))

    def same_as(self, other: RawTopic) -> tuple[int, int, str]:
        """Messages that are the same and that differ, and as text when the first does."""
        count = max(len(self.log_ns), len(other.log_ns))
        if self.log_ns == other.log_ns and self.hashes == other.hashes:
            return count, 0, ""
        here, there = (Counter(zip(each.log_ns, each.hashes, strict=True)) for each in (self, other))
        same = (here & there).total()
        apart = [stamp_ns for stamp_ns, _ in ((here - there) + (there - here))]
        return same, count - same, f", the first at {seconds(min(apart)):.3f} s" if apart else ""


def raw_topics(session: Session, chosen: Callable[[str], bool]) -> dict[str, RawTopic]:
    """The topics of a session as they are in the file, but for images, and for the verdict, which tells the outcome.

    The copies with which a part of a run begins are left out, as by a reader.
    """
    found: dict[str, RawTopic] = {}
    for place, file in enumerate(session.run.files):
        with SessionMetadata(file.path) as opened:
            wanted = {
                number: channel.topic
                for number, channel in opened.channels.items()
                if channel.topic not in (FRAME_PATH, VERDICT) and chosen(channel.topic)
            }
            for chunk in opened.chunks:
                if chunk.message_index_offsets and not wanted.keys() & chunk.message_index_offsets.keys():
                    continue
                for record in opened.source.messages(chunk):
                    if record.channel in wanted and (not place or record.log_ns > file.first_ns):
                        assert isinstance(record.payload, memoryview)
                        found.setdefault(wanted[record.channel], RawTopic()).add(record.log_ns, bytes(record.payload))
    return found
