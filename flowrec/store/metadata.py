"""What a session says about itself before its first message: enough to run it again without any other file."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Literal

from mcap.records import Attachment, Metadata

from flowrec.version import __version__

FORMAT_VERSION = 1
PROFILE = "flowrec"

SESSION = "flowrec.session"
PROVENANCE = "flowrec.provenance"
PARENT = "flowrec.parent"
PART = "flowrec.part"
OUTCOME = "flowrec.outcome"
VIEW = "flowrec.view"
DIGEST = "flowrec.digest"

CONFIG_FILE = "config.toml"
CHIP_IMAGE_FILE = "chip.png"
CHIP_FILE = "chip.toml"
_WEIGHTS = "weights/"


@dataclass(frozen=True, slots=True)
class Part:
    """Which piece of a run a file is.

    A piece that does not begin with the run begins with one tick more than it recorded: the last one before, with
    everything known by then, at its own stamp. So it can be read alone, and readers of a whole run pass over it.

    Attributes
    ----------
    run : the same random word in all pieces of a run.
    number : from 1.
    kind : "part" of a run that was split, or "snapshot", of which each is whole in itself.
    carried_ns : stamp of the tick that is repeated at the beginning; None where the run itself begins.
    why : what a snapshot was taken for.
    """

    run: str
    number: int
    kind: Literal["part", "snapshot"] = "part"
    carried_ns: int | None = None
    why: str = ""


@dataclass(frozen=True, slots=True)
class SessionHeader:
    """The resolved configuration, the chip and where the session comes from.

    Attributes
    ----------
    config_toml : the resolved configuration.
    chip_png, chip_toml : the mask's image file and the chip's description.
    provenance : version, commit, packages, host, seed, operator, ...: all text.
    parent : name and hash of the session that this one replays; empty for a live run.
    weights : network weights by file name.
    part : which piece of a run this is; None where the run is in one file.
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


def records_of(header: SessionHeader) -> Iterator[Metadata | Attachment]:
    """The MCAP records of a header, in the order in which they are written."""
    yield Metadata(SESSION, {"format_version": str(FORMAT_VERSION), "flowrec_version": __version__})
    yield Metadata(PROVENANCE, dict(header.provenance))
    yield Metadata(PARENT, dict(header.parent))
    if header.part is not None:
        yield Metadata(PART, _said(header.part))
    attachments = [
        (CONFIG_FILE, "application/toml", header.config_toml.encode()),
        (CHIP_IMAGE_FILE, "image/png", header.chip_png),
        (CHIP_FILE, "application/toml", header.chip_toml.encode()),
        *((_WEIGHTS + name, "application/octet-stream", data) for name, data in sorted(header.weights.items())),
    ]
    for name, media_type, data in attachments:
        start = header.start_unix_ns
        yield Attachment(create_time=start, log_time=start, name=name, media_type=media_type, data=data)


def header_from(
    metadata: Mapping[str, Mapping[str, str]], attachments: Mapping[str, bytes], start_unix_ns: int = 0
) -> SessionHeader:
    """A header from its records by name, and the log time of its attachment CONFIG_FILE.

    Raises
    ------
    KeyError : a record is missing; its argument is the record's name.
    UnicodeDecodeError : text that is not UTF-8.
    ValueError : a part that makes no sense.
    """
    return SessionHeader(
        config_toml=attachments[CONFIG_FILE].decode(),
        chip_png=attachments[CHIP_IMAGE_FILE],
        chip_toml=attachments[CHIP_FILE].decode(),
        provenance=dict(metadata[PROVENANCE]),
        parent=dict(metadata.get(PARENT, {})),
        weights={name.removeprefix(_WEIGHTS): data for name, data in attachments.items() if name.startswith(_WEIGHTS)},
        part=part_from(metadata),
        start_unix_ns=start_unix_ns,
    )


def part_from(metadata: Mapping[str, Mapping[str, str]]) -> Part | None:
    """Which piece of a run a file is, from its records by name.

    Raises
    ------
    ValueError : it makes no sense.
    """
    said = metadata.get(PART)
    if said is None:
        return None
    number, kind, carried = said.get("number", ""), said.get("kind", ""), said.get("carried_ns", "")
    numbers = number.isdecimal() and (carried.isdecimal() or not carried) and max(len(number), len(carried)) < 20
    if kind not in ("part", "snapshot") or not numbers:
        called = f"{kind[:40]!r} {number[:40]!r}, carried from {carried[:40]!r}"
        raise ValueError(f"a piece of a run that is called {called}")
    return Part(
        said.get("run", ""),
        int(number),
        "part" if kind == "part" else "snapshot",
        int(carried) if carried else None,
        said.get("why", ""),
    )


def belongs(name: str) -> bool:
    """Whether an attachment is part of a session's header."""
    return name in (CONFIG_FILE, CHIP_IMAGE_FILE, CHIP_FILE) or name.startswith(_WEIGHTS)


def _said(part: Part) -> dict[str, str]:
    said = {"run": part.run, "number": str(part.number), "kind": part.kind, "why": part.why}
    return said if part.carried_ns is None else said | {"carried_ns": str(part.carried_ns)}
