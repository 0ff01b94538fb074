"""`flowrec cut`: a stretch of a session as a session of its own."""

from pathlib import Path
from typing import Annotated, Any, NamedTuple

import typer

from flowrec.core import shell_word
from flowrec.verbs.command import MisuseError, verb
from flowrec.verbs.options import Overwrite, SessionFile


class CutSession(NamedTuple):
    """A session that was cut out of another.

    Attributes
    ----------
    path : of the file.
    ticks : in it.
    from_s, to_s : times of its first and last tick, on the clock of the session.
    """

    path: Path
    ticks: int
    from_s: float
    to_s: float

    def as_json(self) -> dict[str, Any]:
        return self._asdict() | {"path": str(self.path)}

    def lines(self) -> list[str]:
        stretch = f"{self.ticks} ticks, {self.from_s:g} s to {self.to_s:g} s"
        return [
            f"{self.path}: {stretch}; it replays from its first tick: flowrec replay {shell_word(self.path)} --verify"
        ]


@verb("flowrec cut a.mcap --from 12 --to 30 -o b.mcap")
def cut(
    session: SessionFile,
    from_s: Annotated[
        float | None, typer.Option("--from", metavar="TIME", help="First second; else the first.")
    ] = None,
    to_s: Annotated[float | None, typer.Option("--to", metavar="TIME", help="Last second; else the last.")] = None,
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="Session file; X_cut.mcap beside the session by default.")
    ] = None,
    overwrite: Overwrite = False,
) -> CutSession:
    """Make a session of a stretch of another; it keeps its times, and replays exactly from its first tick.

    Raises
    ------
    UsageError : neither time is given, or there is no tick between them.
    SessionError : the session can not be read, or the output not be written; OutputError if it may not be.
    """
    from flowrec.core import MCAP, Output, UsageError, seconds
    from flowrec.store import Session, cut_session, files_behind

    if from_s is None and to_s is None:
        raise MisuseError("give the first second, or the last one with --to, or both", "--from")
    opened = Session.of(session)
    begin_ns = opened.run.first_ns if from_s is None else opened.stamp_ns(from_s, "--from")
    end_ns = opened.run.last_ns if to_s is None else opened.stamp_ns(to_s, "--to")
    here = [stamp_ns for stamp_ns in opened.reader.stamps("applied") if begin_ns <= stamp_ns <= end_ns]
    if not here:
        there = f"no tick of {opened.path} is there; choose a longer stretch"
        why = "the end is before the begin; exchange them" if end_ns < begin_ns else there
        raise UsageError(f"--from {seconds(begin_ns):g} --to {seconds(end_ns):g}: {why}")
    path = out if out is not None else opened.path.with_name(f"{opened.path.stem}_cut{MCAP[0]}")
    output = Output(path, MCAP, tuple(files_behind(opened.path)), overwrite)
    count = cut_session(opened.reader, output, here[0], here[-1])
    return CutSession(path, count, seconds(here[0]), seconds(here[-1]))
