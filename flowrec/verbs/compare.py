"""`flowrec compare`: whether two sessions hold the same, in all that a session holds."""

from collections.abc import Callable, Sequence
from contextlib import nullcontext
from typing import TYPE_CHECKING, Annotated

import typer

from flowrec.verbs.command import Told, verb
from flowrec.verbs.options import BAR, Asked, Bar, SessionFile

if TYPE_CHECKING:
    from flowrec.verbs.session_comparison import SessionComparison


def _output_of(asked: Asked, found: "SessionComparison") -> Told:
    return Told.of(found, first_session=asked["first"], second_session=asked["second"])


@verb(
    "flowrec compare a.mcap b.mcap",
    "flowrec compare a.mcap a_replay_001.mcap --ignore provenance,parent,outcome,diagnostics,/camera/frame",
    "flowrec compare a.mcap b.mcap --only '/robot/*,configuration'",
    result=_output_of,
)
def compare(
    first: SessionFile,
    second: SessionFile,
    *,
    only: Annotated[
        list[str] | Sequence[str] | None,
        typer.Option(metavar="NAME,...", help="Only these topics and parts of the head; may be repeated."),
    ] = None,
    ignore: Annotated[
        list[str] | Sequence[str] | None,
        typer.Option(metavar="NAME,...", help="Not these topics and parts of the head; may be repeated."),
    ] = None,
    progress: Callable[[float], None] = lambda _: None,
    bar: Annotated[Bar | None, BAR] = None,
) -> "SessionComparison":
    """Compare all that two sessions hold: head, every topic, drawings too; exit status 3 if anything differs.

    Names of --only and --ignore: topics (/robot/track, '/robot/*'), parts of the head (configuration, chip,
    provenance, parent, outcome, weights, pictures, start, part, digest, records) and their items (provenance.host,
    configuration.plan), and words for several: inputs, outputs, truth, diagnostics, drawings, head.

    Parameters
    ----------
    progress : takes the session time in s since the first tick.
    bar : shows the same, as `core.progress`.

    Notes
    -----
    Ticks are paired by their stamps.

    Raises
    ------
    SessionError : one of the two can not be read.
    UsageError : a name of `only` or `ignore` means nothing that is there.
    Ended : Ctrl-C or a signal; its `result` is what was compared by then.
    """
    from flowrec.store import Session
    from flowrec.verbs.session_comparison import compare_sessions
    from flowrec.verbs.session_parts import Choice

    sessions = Session.of(first), Session.of(second)
    topics = sessions[0].reader.topics.with_types_of(sessions[1].reader.topics)
    choice = Choice.of(only or (), ignore or (), topics)
    length_s = max(session.duration_s for session in sessions)
    what = f"comparing {sessions[0].path.name}"
    with nullcontext(progress) if bar is None else bar(what, max(length_s, 1e-3), "s") as done:
        return compare_sessions(sessions, choice, done)
