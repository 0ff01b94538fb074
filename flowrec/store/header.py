"""What a session says about itself before its first message: enough to run it again without any other file."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field

from mcap.records import Attachment, Metadata

import flowrec

FORMAT_VERSION = 1
PROFILE = "flowrec"

SESSION = "flowrec.session"
PROVENANCE = "flowrec.provenance"
PARENT = "flowrec.parent"
OUTCOME = "flowrec.outcome"
VIEW = "flowrec.view"

CONFIG_FILE = "config.toml"
CHIP_IMAGE_FILE = "chip.png"
CHIP_FILE = "chip.toml"
_WEIGHTS = "weights/"


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
    """

    config_toml: str
    chip_png: bytes
    chip_toml: str
    provenance: Mapping[str, str]
    parent: Mapping[str, str] = field(default_factory=dict)
    weights: Mapping[str, bytes] = field(default_factory=dict)


def records_of(header: SessionHeader) -> Iterator[Metadata | Attachment]:
    """The MCAP records of a header, in the order in which they are written."""
    yield Metadata(SESSION, {"format_version": str(FORMAT_VERSION), "flowrec_version": flowrec.__version__})
    yield Metadata(PROVENANCE, dict(header.provenance))
    yield Metadata(PARENT, dict(header.parent))
    yield _attachment(CONFIG_FILE, "application/toml", header.config_toml.encode())
    yield _attachment(CHIP_IMAGE_FILE, "image/png", header.chip_png)
    yield _attachment(CHIP_FILE, "application/toml", header.chip_toml.encode())
    for name, data in sorted(header.weights.items()):
        yield _attachment(_WEIGHTS + name, "application/octet-stream", data)


def header_from(metadata: Mapping[str, Mapping[str, str]], attachments: Mapping[str, bytes]) -> SessionHeader:
    """A header from its records by name.

    Raises
    ------
    KeyError : a record is missing; its argument is the record's name.
    UnicodeDecodeError : text that is not UTF-8.
    """
    return SessionHeader(
        config_toml=attachments[CONFIG_FILE].decode(),
        chip_png=attachments[CHIP_IMAGE_FILE],
        chip_toml=attachments[CHIP_FILE].decode(),
        provenance=dict(metadata[PROVENANCE]),
        parent=dict(metadata.get(PARENT, {})),
        weights={name.removeprefix(_WEIGHTS): data for name, data in attachments.items() if name.startswith(_WEIGHTS)},
    )


def belongs(name: str) -> bool:
    """Whether an attachment is part of a session's header."""
    return name in (CONFIG_FILE, CHIP_IMAGE_FILE, CHIP_FILE) or name.startswith(_WEIGHTS)


def _attachment(name: str, media_type: str, data: bytes) -> Attachment:
    # No time of its own: an attachment's time would stretch the time line of a viewer.
    return Attachment(create_time=0, log_time=0, name=name, media_type=media_type, data=data)
