"""`flowrec export`: convert a session to another format. The MCAP file is the archive; an export can be made again."""

from __future__ import annotations

import time
from pathlib import Path

from flowrec.core import Coverage, Output, OutputFolder, UsageError, note_written, progress, say, warn, written_sha256
from flowrec.exports.formats import EXPORTS, Exporter
from flowrec.store import Session, files_behind, input_blamed, named_beside


def export(
    session: Session | Path | str,
    out: Path | str | None = None,
    overwrite: bool = False,
    file_format: str = "rrd",
    beside: Session | Path | str | None = None,
) -> Path:
    """Write a session in another format; return the file or folder.

    Parameters
    ----------
    out : the file or folder; by default beside the session, named like it. A format whose name has a suffix is also
        written into an existing folder, under the session's name. An earlier export of the same session is replaced if
        nothing in it was changed since, by its hash; a file only under the default name. Anything else is refused.
    overwrite : any existing file, and any folder that an export made, may be replaced, but nothing that is read.
    file_format : name of a row of EXPORTS. In rrd a replay is shown beside its parent, if that is in the same folder.
    beside : of rrd: another session of the same chip and camera, shown on the same timeline and scale.

    Raises
    ------
    UsageError : there is no such format, or what it needs is not installed.
    SessionError : the session can not be read, or the output not be written; OutputError if it may not be.
    """
    exporter: Exporter = EXPORTS[file_format].load()()
    session = Session.of(session)
    named = out is not None
    second = None if beside is None else Session.of(beside)
    if second is not None:
        exporter = _beside(file_format, session, second)
        if out is None:
            out = named_beside(session.path, f"{session.path.stem}_and_{second.path.stem}{exporter.suffixes[0]}")
    target = _target(session, exporter, file_format, None if out is None else Path(out))
    facts = {"format": file_format, "session": session.path.name, "session_key": session.key}
    inputs = tuple(files_behind(session.path))
    if second is not None:
        facts["beside_key"] = second.key
        inputs += tuple(files_behind(second.path))
    if exporter.folder:
        output: Output | OutputFolder = OutputFolder(target, facts, exporter.suffixes, inputs, overwrite)
    else:
        before = "" if named else written_sha256(target, facts)
        output = Output(target, exporter.suffixes, inputs, overwrite, before)
    output.check()
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
            note_written(target, facts)
        except OSError as error:  # the export itself is whole
            warn(f"{target}: its hash can not be kept ({error.strerror or error}): only --overwrite will replace it")
    took_s, amount = time.perf_counter() - began_s, Coverage(length_s, length_s, "s").amount
    say(f"{target} written in {took_s:.1f} s, {amount} of the session; {exporter.advice} {target}")
    return target


def _beside(file_format: str, session: Session, second: Session) -> Exporter:
    """The exporter of a pair; UsageError for a format that shows one session only."""
    if file_format != "rrd":
        raise UsageError(f"{session.path} and {second.path}: only rrd shows two sessions; export them one by one")
    from flowrec.exports.rrd import RrdExport  # late: it imports Rerun

    return RrdExport.of_pair(session, second)


def _target(session: Session, exporter: Exporter, file_format: str, out: Path | None) -> Path:
    suffix = exporter.suffixes[0]
    name = session.path.stem + (suffix or f"_{file_format}")
    if out is None:
        return named_beside(session.path, name)
    within = suffix and out.is_dir() and out.suffix not in exporter.suffixes
    return out / name if within else out
