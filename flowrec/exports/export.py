"""`flowrec export`: convert a session to another format. The MCAP file is the archive; an export can be made again."""

from __future__ import annotations

import hashlib
import time
from importlib.metadata import version
from pathlib import Path

from flowrec.core import (
    PACKAGE,
    RRD,
    Coverage,
    Output,
    OutputError,
    OutputFolder,
    UsageError,
    is_as_written,
    named_otherwise,
    note_written,
    progress,
    say,
    warn,
    written_sha256,
)
from flowrec.exports.formats import EXPORTS, Exporter
from flowrec.store import Session, files_behind, input_blamed, named_beside

_MADE_FROM = "made_from"  # in the list of a folder's exports


def export(
    session: Session | Path | str,
    out: Path | str | None = None,
    overwrite: bool = False,
    file_format: str | None = None,
    beside: Session | Path | str | None = None,
) -> Path:
    """Write a session in another format; return the file or folder.

    Parameters
    ----------
    out : the file or folder; by default beside the session, named like it. A format whose name has a suffix is also
        written into an existing folder, under the session's name. An earlier export of the same session is replaced if
        nothing in it was changed since, by its hash; a file only under the default name. Anything else is refused.
    overwrite : any existing file, and any folder that an export made, may be replaced, but nothing that is read.
    file_format : name of a row of EXPORTS; by default that of the ending of `out`, else rrd. In rrd a replay is shown
        beside its parent, if that is in the same folder.
    beside : of rrd: another session of the same chip and camera, shown on the same timeline and scale.

    Raises
    ------
    UsageError : there is no such format, or what it needs is not installed.
    SessionError : the session can not be read, or the output not be written; OutputError if it may not be.
    """
    file_format = file_format or format_of(out)
    exporter: Exporter = EXPORTS[file_format].load()()
    sessions = session, *others = _open_all(session, beside)
    facts = {"format": file_format, "session": session.path.name, "session_key": session.key}
    for second in others:
        exporter = _beside(file_format, session, second)
        facts["beside_key"] = second.key
    target = _target(sessions, exporter.suffixes, file_format, out)
    inputs = _inputs(sessions)
    if exporter.folder:
        output: Output | OutputFolder = OutputFolder(target, facts, exporter.suffixes, inputs, overwrite)
    else:
        before = "" if out is not None else written_sha256(target, facts)
        output = Output(target, exporter.suffixes, inputs, overwrite, before)
    output.check()
    made_from = _made_from(inputs)  # before they are read: who changes them meanwhile gets a new one
    began_s, length_s = time.perf_counter(), max(session.duration_s, 1e-3)
    with (
        progress(f"writing {target.name}", length_s, "s") as done,
        input_blamed(session, None, "exported"),
        output.new_folder() if isinstance(output, OutputFolder) else output.new_file() as part,
    ):
        exporter.write(session, part, done)
        done(length_s)  # it reads to the end or raises, and tells less often how far
    if isinstance(output, Output):
        try:
            note_written(target, facts | {_MADE_FROM: made_from})
        except OSError as error:  # the export itself is whole
            warn(f"{target}: its hash can not be kept ({error.strerror or error}): only --overwrite will replace it")
    took_s, amount = time.perf_counter() - began_s, Coverage(length_s, length_s, "s").amount
    say(f"{target} written in {took_s:.1f} s, {amount} of the session; {exporter.advice} {target}")
    return target


def format_of(out: Path | str | None) -> str:
    """The format that the ending of an output names; rrd of a folder, and without an output.

    Raises UsageError where it names none.
    """
    if out is None or Path(out).is_dir():
        return "rrd"
    ending = Path(out).suffix.removeprefix(".").lower()
    ending = "tiff" if ending == "tif" else ending
    if ending not in EXPORTS.names():
        raise UsageError(f"{out}: its ending names no format; say which with --format: {', '.join(EXPORTS.names())}")
    return ending


def kept_rrd(
    session: Session | Path | str, out: Path | str | None = None, beside: Session | Path | str | None = None
) -> Path | None:
    """The .rrd that `export` made of the same sessions, if neither it, nor they, nor flowrec have changed since."""
    sessions = _open_all(session, beside)
    target = _target(sessions, RRD, "rrd", out)
    made_from = _made_from(_inputs(sessions))
    return target if made_from and is_as_written(target, {_MADE_FROM: made_from}) else None


def _open_all(session: Session | Path | str, beside: Session | Path | str | None) -> tuple[Session, ...]:
    return tuple(Session.of(each) for each in (session, beside) if each is not None)


def _inputs(sessions: tuple[Session, ...]) -> tuple[Path, ...]:
    return tuple(path for each in sessions for path in files_behind(each.path))


def _made_from(inputs: tuple[Path, ...]) -> str:
    """A hash of names, sizes and times of what an export is made of: sessions and code; '' for sessions at a URL."""
    if not inputs:
        return ""
    found = []
    for path in (*inputs, *sorted(PACKAGE.rglob("*.py"))):
        state = path.stat() if path.exists() else None
        found.append((str(path), None if state is None else (state.st_size, state.st_mtime_ns)))
    return hashlib.sha256(repr((version("rerun-sdk"), found)).encode()).hexdigest()


def _beside(file_format: str, session: Session, second: Session) -> Exporter:
    """The exporter of a pair; UsageError for a format that shows one session only."""
    if file_format != "rrd":
        raise UsageError(f"{session.path} and {second.path}: only rrd shows two sessions; export them one by one")
    from flowrec.exports.rrd import RrdExport  # late: it imports Rerun

    return RrdExport.of_pair(session, second)


def _target(sessions: tuple[Session, ...], suffixes: tuple[str, ...], file_format: str, out: Path | str | None) -> Path:
    stems, suffix = [each.path.stem for each in sessions], suffixes[0] or f"_{file_format}"
    if out is None:
        return named_beside(sessions[0].path, "_and_".join(stems) + suffix)
    out = Path(out)
    other = out.suffix.lstrip(".")
    if suffixes[0] and out.suffix not in suffixes and other in EXPORTS and not out.is_dir():
        raise OutputError(f"{named_otherwise(out, suffixes)}, or write that format by flowrec export --format {other}")
    within = suffixes[0] and out.is_dir() and out.suffix not in suffixes
    return out / f"{stems[0]}{suffix}" if within else out
