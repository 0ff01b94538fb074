"""`flowrec note`: add a note to a recorded session, or print its notes."""

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from flowrec.verbs.command import verb
from flowrec.verbs.options import SessionFile

if TYPE_CHECKING:
    from flowrec.store import Note


class Notes(tuple["Note", ...]):
    """All notes of a session, in the order in which they were added; `added`: one was added just now."""

    path: Path
    added: bool

    def as_json(self) -> dict[str, Any]:
        return {"session": str(self.path), "notes": [asdict(each) for each in self]}

    def lines(self) -> list[str]:
        """A line for each note; none if one was added."""
        return [] if self.added else [_note_line(each) for each in self]


@verb('flowrec note a.mcap "bubble at the outlet" --tag bubble', "flowrec note a.mcap")
def note(
    session: SessionFile,
    text: Annotated[str, typer.Argument(metavar="[TEXT]", help="The note; without one, notes are printed.")] = "",
    tags: Annotated[list[str] | None, typer.Option("--tag", metavar="WORD", help="Add a tag; may be repeated.")] = None,
) -> Notes:
    """Add a note or tags to a recorded session, in a file beside it, or print them.

    Raises
    ------
    SessionError : there is no session, or no note can be written beside it.
    """
    from flowrec.store import Session

    session = Session.of(session)
    if text or tags:
        session.add_note(text, tags or [])
    notes = Notes(session.notes)
    notes.path, notes.added = session.path, bool(text or tags)
    return notes


def _note_line(note: "Note") -> str:
    words = " ".join([*(f"#{tag}" for tag in note.tags), note.text])
    return f"{note.written[:16].replace('T', ' ')} {note.author}: {words}"
