"""Notes and tags that people add to a session after its run: lines of JSON in a file beside it, X.mcap.notes.jsonl.

The recording is never changed, and a line is never rewritten. Each line names its session by the key of that session:
notes that lie beside another file are not its notes.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path

from flowrec.core import SessionError, UsageError, append_line, refuse_irregular
from flowrec.store.byte_source import open_bytes
from flowrec.store.session_path import on_this_machine
from flowrec.store.traffic import MissingError

NOTES_SUFFIX = ".notes.jsonl"
TEXT_LIMIT = 10_000  # characters of a note
_LINE_LIMIT = 200_000  # bytes; a longer line was not written by flowrec
_FILE_LIMIT = 64 << 20  # bytes that are read
_TAG_LIMIT = 60  # characters


@dataclass(frozen=True, slots=True)
class Note:
    """One note; text and tags are as a person typed them."""

    written: str  # time in UTC, ISO 8601
    author: str  # name of the user on that machine
    text: str
    tags: tuple[str, ...] = ()


def notes_file(session: Path) -> Path:
    """The file of the notes of a session or run X.mcap."""
    return session.with_name(session.name + NOTES_SUFFIX)


def read_notes(session: Path, key: str) -> list[Note]:
    """The notes of the session with a key, in order; lines that are damaged or of another session are left out.

    Raises SessionError: the file can not be read.
    """
    lines = notes_content(notes_file(session)).split(b"\n")
    notes = (_parse(line, key) for line in lines if 0 < len(line) <= _LINE_LIMIT)
    return [note for note in notes if note is not None]


def append_note(session: Path, key: str, text: str, tags: Sequence[str], author: str) -> Note:
    """Write one note behind the others, and onto the disk.

    Raises UsageError: there is neither text nor tag, or one is too long; SessionError: the file can not be written.
    """
    tags = tuple(dict.fromkeys(tag.strip() for tag in tags))
    if not text.strip() and not tags:
        raise UsageError("a note needs a text or a --tag")
    if len(text) > TEXT_LIMIT or any(not 0 < len(tag) <= _TAG_LIMIT for tag in tags):
        raise UsageError(f"a note has at most {TEXT_LIMIT} characters, a tag 1 to {_TAG_LIMIT}")
    note = Note(datetime.now(UTC).isoformat(timespec="seconds"), author, text.strip(), tags)
    line = json.dumps({"session": key, **asdict(note)}).encode()
    path = on_this_machine(notes_file(session), "no note is added to")
    refuse_irregular(path, SessionError)
    try:
        append_line(path, line)
    except OSError as error:
        raise SessionError(f"{path}: the note can not be written ({error.strerror}); check folder and disk") from error
    return note


def notes_content(path: Path) -> bytes:
    """The bytes of a file of notes; none where there is no file. SessionError if it can not be read."""
    try:
        with open_bytes(path) as source:
            return source.read(0, min(source.size, _FILE_LIMIT))
    # Also where access to a URL is refused: S3 does not tell who may not list a bucket what is not there.
    except MissingError:
        return b""


def _parse(line: bytes, key: str) -> Note | None:
    """The note of a line; None if it is damaged or of another session."""
    try:
        found = json.loads(line)
    except (ValueError, RecursionError):
        return None
    if not isinstance(found, dict) or found.get("session") != key:
        return None
    tags = found.get("tags")
    if not isinstance(tags, list):
        return None
    written, author, text = (str(found.get(name, "")) for name in ("written", "author", "text"))
    return Note(written, author, text, tuple(map(str, tags)))
