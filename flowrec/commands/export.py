"""`flowrec export`: convert a session to another format. The MCAP file is the archive; an export can be made again."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Protocol

from flowrec.methods import Method, Methods
from flowrec.session import Session, files_behind, input_blamed
from flowrec.system.outputs import Output
from flowrec.terminal import progress, say

EXPORTS = Methods(
    "--format",
    Method("rrd", "flowrec.commands.export_rrd:RrdExport", "a recording for Rerun, what flowrec view opens"),
)


class Exporter(Protocol):
    """What a row of EXPORTS implements.

    Attributes
    ----------
    suffixes : of the files, the usual one first.
    advice : how to open a file, as words before its name.
    """

    suffixes: tuple[str, ...]
    advice: str

    def is_export_of(self, path: Path, session: Session) -> bool:
        """Whether a file is an earlier export of this session, which may be replaced without being asked for."""

    def write(self, session: Session, output: Output, progress: Callable[[float], None]) -> None:
        """Write the file; `progress` takes the session time in s since the first tick."""


def export(
    session: Session | Path | str, out: Path | None = None, overwrite: bool = False, file_format: str = "rrd"
) -> Path:
    """Write a session in another format.

    Parameters
    ----------
    out : the file; by default beside the session, with the suffix of the format, where an earlier export of the same
        session is replaced. Any other existing file is refused.
    overwrite : any existing file may be replaced, but none that is read.
    file_format : name of a row of EXPORTS. In rrd a replay is shown beside its parent, if that is in the same folder.

    Raises
    ------
    UsageError : there is no such format.
    SessionError : the session can not be read, or the file not be written; OutputError if it may not be.
    """
    exporter: Exporter = EXPORTS[file_format].load()()
    session = Session.of(session)
    path = session.path
    target = out if out is not None else path.with_suffix(exporter.suffixes[0])
    overwrite = overwrite or (out is None and exporter.is_export_of(target, session))
    output = Output(target, exporter.suffixes, tuple(files_behind(path)), overwrite)
    output.check()
    config = session.config
    began_s = time.perf_counter()
    with (
        progress(f"writing {target.name}", max(session.duration_s, 1e-3)) as done,
        input_blamed(session, config, "exported"),
    ):
        exporter.write(session, output, done)
    say(f"{target} written in {time.perf_counter() - began_s:.1f} s; {exporter.advice} {target}")
    return target
