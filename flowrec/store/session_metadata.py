"""The metadata of a session file: enough to list, describe and replay it, also where its messages can not be read.

Light to import: no numpy, no schemas. channels.py adds what reading the messages needs. What older files state in other
words is turned into today's where it is declared: the outcome here, settings that moved in stages/config.py. A field of
a message, a setting or a fact of the head that came later has a default there, which means "as before".
"""

from __future__ import annotations

import functools
import re
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING

from mcap.records import Attachment, Metadata, Statistics

from flowrec.core import NS_PER_S, Closing, SessionError, __version__, nanoseconds, parse_toml
from flowrec.store.mcap_format import ForeignError, Summary
from flowrec.store.mcap_reader import McapReader

if TYPE_CHECKING:
    from flowrec.physics import Chip
    from flowrec.stages import ResolvedConfig

FORMAT_VERSION = 1  # of the session's file; a reader refuses any other
PROFILE = "flowrec"

# Metadata records.
SESSION = "flowrec.session"
PROVENANCE = "flowrec.provenance"
PARENT = "flowrec.parent"
PART = "flowrec.part"
OUTCOME = "flowrec.outcome"
DIGEST = "flowrec.digest"
# Attachments.
CONFIG_FILE = "config.toml"
CHIP_IMAGE_FILE = "chip.png"
CHIP_FILE = "chip.toml"
_WEIGHTS = "weights/"
_PICTURES = "pictures/"

_METADATA_LIMIT_BYTES = 16 << 20
_ATTACHMENTS_LIMIT_BYTES = 256 << 20
_SHOWN = 40  # characters of a version; int() refuses thousands of digits
_DIGITS = 20  # more than a number of 64 bit has
# Of the outcomes of older files: sentence on the times of the ticks; a second count of dropped images.
_REPEATED = ("duration", "frames_dropped")
_FLOW_ERROR = re.compile(r"(\d{1,6}\.\d) % of the true flow \((\w{1,20})\)")


@dataclass(frozen=True, slots=True)
class Part:
    """Position of this file in its run, where a run has several.

    Every file but the first starts with a keyframe: the full state at the last tick before it, at that tick's stamp.
    It makes the file readable alone; readers of the whole run skip it.
    """

    run: str  # the same random word in all files of a run
    number: int  # from 1
    kind: str = "part"  # "part" of a run that was split, or "snapshot", each of which is complete in itself
    # stamp of the keyframe; None where the run itself begins. Its key in the file is `carried_ns`.
    keyframe_ns: int | None = None
    why: str = ""  # the event that a snapshot was taken for


@dataclass(frozen=True, slots=True)
class SessionHeader:
    """The resolved configuration, the chip and the origin of a session; written before the first message.

    Attributes
    ----------
    config_toml : the resolved configuration.
    chip_png, chip_toml : the mask's image file and the chip's description.
    provenance : version, commit, packages, host, seed, operator, ...: all text.
    parent : name and hash of the session that this one replays; empty for a live run.
    weights : network weights by file name.
    pictures : PNG files by name that show what the run relies on, such as the registration of the chip.
    part : which file of a run this is; None where the run is in one file.
    start_unix_ns : Unix time of stamp 0 of the session clock. In the file, log times, publish times and the timestamps
        of foxglove's messages are Unix times: stamps plus this. 0 in files of the first release: there they are stamps.
        It is the log time of the attachments, because those, unlike metadata, have a checksum.
    """

    config_toml: str
    chip_png: bytes
    chip_toml: str
    provenance: Mapping[str, str]
    parent: Mapping[str, str] = field(default_factory=dict)
    weights: Mapping[str, bytes] = field(default_factory=dict)
    part: Part | None = None
    start_unix_ns: int = 0
    pictures: Mapping[str, bytes] = field(default_factory=dict)

    def config(self, where: str = "config.toml") -> ResolvedConfig:
        """The resolved configuration; UsageError, which begins with `where`, if it is not valid."""
        from flowrec.stages import config_from_toml

        return config_from_toml(self.config_toml, where, self.provenance)

    def chip(self) -> Chip:
        """The chip with its mask (h, w) and openings; ChipError if it is not valid."""
        from flowrec.physics import chip_from_files

        return chip_from_files(self.chip_png, self.chip_toml)

    @property
    def taken_unix_ns(self) -> int:
        """Unix time at which stamp 0 of the images was; 0: not known.

        The clock of an import began at the import; only a movie that flowrec exported says when it was taken.
        """
        from flowrec.stages import MOVIE

        try:
            imported = parse_toml(self.config_toml).get("rig") == MOVIE
        except (ValueError, RecursionError):  # what needs the settings says that they are damaged
            imported = False
        if not imported:
            return self.start_unix_ns
        try:
            began = datetime.fromisoformat(self.provenance["source_started"])
            first_s = float(self.provenance["source_first_image_s"])
        except (KeyError, ValueError):
            return 0
        return round(began.timestamp() * NS_PER_S) + nanoseconds(first_s) if began.tzinfo is not None else 0

    def is_same_run(self, other: SessionHeader) -> bool:
        """True if two headers differ in their part at most."""
        return replace(self, part=None) == replace(other, part=None)


def header_records(header: SessionHeader) -> Iterator[Metadata | Attachment]:
    """The MCAP records of a header, in the order in which they are written."""
    yield Metadata(SESSION, {"format_version": str(FORMAT_VERSION), "flowrec_version": __version__})
    yield Metadata(PROVENANCE, dict(header.provenance))
    yield Metadata(PARENT, dict(header.parent))
    part = header.part
    if part is not None:
        facts = {"run": part.run, "number": str(part.number), "kind": part.kind, "why": part.why}
        if part.keyframe_ns is not None:
            facts["carried_ns"] = str(part.keyframe_ns)
        yield Metadata(PART, facts)
    attachments = [
        (CONFIG_FILE, "application/toml", header.config_toml.encode()),
        (CHIP_IMAGE_FILE, "image/png", header.chip_png),
        (CHIP_FILE, "application/toml", header.chip_toml.encode()),
        *((_WEIGHTS + name, "application/octet-stream", data) for name, data in sorted(header.weights.items())),
        *((_PICTURES + name, "image/png", data) for name, data in sorted(header.pictures.items())),
    ]
    for name, media_type, data in attachments:
        yield Attachment(header.start_unix_ns, header.start_unix_ns, name, media_type, data)


def is_header_file(name: str) -> bool:
    """True if an attachment is part of a session's header."""
    return name in (CONFIG_FILE, CHIP_IMAGE_FILE, CHIP_FILE) or name.startswith((_WEIGHTS, _PICTURES))


class SessionMetadata(Closing):
    """The index and the metadata of a session file.

    Raises SessionError: it is no session file, or not one for this flowrec.

    Parameters
    ----------
    path : the file.
    summary : an index to be used instead of the file's own: scan.py makes one, another reader of the file has one.

    Attributes
    ----------
    source : the file.
    index : its summary, with the times on the session clock.
    chunks : where the messages are.
    statistics : how many there are.
    outcome : how the run ended.
    part : which file of a run it is; None where the run is in one file.
    flowrec_version : of the program that wrote it.
    digest : of the content, as it was recorded (digest.py); None in files of the first release.
    channels, schemas, attachments, metadata : what else is listed.
    """

    def __init__(self, path: Path, summary: Summary | None = None) -> None:
        self.source = McapReader(path)
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
        if summary is not None and summary.file_bytes not in (0, self.source.size):
            raise SessionError(f"{path}: has changed since it was opened; open the session again")
        self.index = found = self.source.read_summary(summary)
        self.channels, self.schemas, self.chunks = found.channels, found.schemas, found.chunks
        self.attachments, self.metadata = found.attachments, found.metadata
        records = self._records()
        if SESSION not in records:
            raise ForeignError(
                f"{path}: is an MCAP file without the record {SESSION!r}, so not a session;"
                " flowrec reads what `flowrec record` has written"
            )
        self.flowrec_version = records[SESSION].get("flowrec_version", "?")[:_SHOWN]
        self._check_version(records[SESSION].get("format_version", ""))
        self.outcome = outcome_of_today(records.get(OUTCOME, {}))
        self.digest = records.get(DIGEST)
        with self.source.parsing(0):
            self.part = _part_of(records)
            for index in self.attachments:
                if index.name == CONFIG_FILE:
                    self.source.set_start(index.log_time)
            if summary is None:  # one that is given is on the session clock
                found.to_session_clock(self.source.start_unix_ns)
                found.file_bytes = self.source.size
        assert found.statistics is not None  # McapReader or scan.py has checked it
        self.statistics: Statistics = found.statistics

    @property
    def counts(self) -> dict[str, int]:
        """Number of messages by topic, for the topics that have any, without the viewer topics."""
        return self._by_topic(self.statistics.channel_message_counts)

    def counts_until(self, stamp_ns: int) -> dict[str, int]:
        """Count the messages of each topic at or before a stamp; reads the chunks that begin by then."""
        counts: Counter[int] = Counter()
        for chunk in self.chunks:
            if chunk.message_start_time <= stamp_ns:
                counts.update(record.channel for record in self.source.messages(chunk) if record.log_ns <= stamp_ns)
        return self._by_topic(counts)

    def close(self) -> None:
        """Close the file; a forgotten one is closed when it is collected."""
        self.source.close()

    @functools.cached_property
    def header(self) -> SessionHeader:
        """Read on first use: the network's weights may be large."""
        # Attachments of other programs are not read.
        wanted = [index for index in self.attachments if is_header_file(index.name)]
        self._limit("attachments", (index.length for index in wanted), _ATTACHMENTS_LIMIT_BYTES)
        files = {index.name: self.source.attachment(index) for index in wanted}
        records = self._records()

        def files_with(prefix: str) -> dict[str, bytes]:
            return {name.removeprefix(prefix): data for name, data in files.items() if name.startswith(prefix)}

        try:
            return SessionHeader(
                config_toml=files[CONFIG_FILE].decode(),
                chip_png=files[CHIP_IMAGE_FILE],
                chip_toml=files[CHIP_FILE].decode(),
                provenance=records[PROVENANCE],
                parent=records.get(PARENT, {}),
                weights=files_with(_WEIGHTS),
                part=self.part,
                start_unix_ns=self.source.start_unix_ns,
                pictures=files_with(_PICTURES),
            )
        except KeyError as error:
            raise self.source.damage_error(0, f"the record {error} is missing") from error
        except ValueError as error:
            raise self.source.damage_error(0, error) from error

    def _records(self) -> dict[str, dict[str, str]]:
        """The metadata records by name."""
        self._limit("metadata", (index.length for index in self.metadata), _METADATA_LIMIT_BYTES)
        return {index.name: self.source.metadata(index) for index in self.metadata}

    def _limit(self, what: str, lengths: Iterable[int], limit: int) -> None:
        total = sum(lengths)
        if total > limit:
            raise self.source.damage_error(0, f"{total} bytes of {what}, more than {limit}")

    def _check_version(self, version: str) -> None:
        if version == str(FORMAT_VERSION):
            return
        version = version[:_SHOWN]
        what = f"{self.source.path}: is a session of format {version!r}, written by flowrec {self.flowrec_version}"
        newer = version.isdecimal() and int(version) > FORMAT_VERSION
        need = f"install flowrec {self.flowrec_version} or later" if newer else "it is damaged or was edited"
        raise SessionError(f"{what}; this is flowrec {__version__} with format {FORMAT_VERSION}: {need}")

    def _by_topic(self, counts: Mapping[int, int]) -> dict[str, int]:
        found: Counter[str] = Counter()
        for number, count in counts.items():
            channel = self.channels.get(number)
            if count and channel is not None and channel.metadata.get("role") != "view":
                found[channel.topic] += count
        return dict(found)


def outcome_of_today(recorded: Mapping[str, str]) -> dict[str, str]:
    """The outcome of a file with the keys and values of today's; other sentences of the first release stay text.

    The first release counted dropped images under two names, of which the larger count is complete.
    """
    found = {key: text for key, text in recorded.items() if key not in _REPEATED}
    counts = [recorded[key] for key in ("dropped_frames", "frames_dropped") if key in recorded]
    if "frames_dropped" in recorded and all(map(is_count, counts)):
        found["dropped_frames"] = str(max(map(int, counts)))
    for name in ("assumed", "refined"):
        stated = _FLOW_ERROR.fullmatch(found.get(f"{name}_flow_error", ""))
        if stated is not None:
            found |= {f"{name}_flow_error": repr(float(stated[1]) / 100), f"{name}_method": stated[2]}
    return found


def is_count(text: str) -> bool:
    """True for the digits of a number that a file of flowrec can have."""
    return text.isdecimal() and len(text) < _DIGITS


def _part_of(records: Mapping[str, Mapping[str, str]]) -> Part | None:
    """Position of a file in its run, from its metadata records.

    Raises ValueError: the values of the record are invalid.
    """
    facts = records.get(PART)
    if facts is None:
        return None
    number, kind, keyframe = facts.get("number", ""), facts.get("kind", ""), facts.get("carried_ns", "")
    are_numbers = is_count(number) and (is_count(keyframe) or not keyframe)
    if kind not in ("part", "snapshot") or not are_numbers:
        what = f"{kind[:40]!r} {number[:40]!r}, carried from {keyframe[:40]!r}"
        raise ValueError(f"a record of a part with invalid values: {what}")
    return Part(facts.get("run", ""), int(number), kind, int(keyframe) if keyframe else None, facts.get("why", ""))
