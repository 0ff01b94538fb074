"""`flowrec export`: write a session in another format."""

from pathlib import Path
from typing import Annotated, Any

import typer

from flowrec.core import UsageError
from flowrec.verbs.command import MethodsOf, Told, verb
from flowrec.verbs.options import AnySession, Asked, Overwrite, SessionFile


def export_json(session: AnySession, made: Path, file_format: str = "rrd") -> dict[str, Any]:
    """The file or the folder of an export for JSON, with its size."""
    files = [made] if made.is_file() else [file for file in made.rglob("*") if file.is_file()]
    return {"session": str(session), file_format: str(made), "bytes": sum(file.stat().st_size for file in files)}


def _export_told(asked: Asked, made: Path) -> Told:
    from flowrec.core import looked_at

    covered = {"covered": looked_at()[-1].as_json()}
    from flowrec.exports import format_of

    file_format = asked["file_format"] or format_of(asked["out"] or asked["directory"])
    return Told(lambda: export_json(asked["session"], made, file_format) | covered)


@verb("flowrec export a.mcap", "flowrec export a.mcap tables --format parquet", result=_export_told)
def export(
    session: SessionFile,
    out: Annotated[
        Path | str | None,
        typer.Option(
            "--out",
            "-o",
            help="The same as OUT; by default beside the session, where it replaces an export of that session.",
        ),
    ] = None,
    overwrite: Overwrite = False,
    file_format: Annotated[
        str | None,
        typer.Option("--format", metavar="FORMAT", help="Format of the output; else by the ending of OUT, or rrd."),
        MethodsOf("flowrec.exports.formats:EXPORTS"),
    ] = None,
    beside: AnySession | None = None,
    directory: Annotated[
        Path | str | None, typer.Argument(metavar="[OUT]", help="File or folder to write, or a folder for the file.")
    ] = None,
) -> Path:
    """Convert a session to another format, such as a recording for Rerun (.rrd).

    Parameters
    ----------
    beside : of rrd: another session of the same chip and camera, shown on the same timeline and scale.

    Returns
    -------
    The file or folder. A format whose name has a suffix is also written into an existing folder, under the session's
    name. An earlier export of the same session is replaced if nothing in it was changed since, by its hash; a file only
    under the default name. `overwrite` replaces any existing file, and any folder that an export made, but nothing that
    is read.

    Raises
    ------
    UsageError : there is no such format, or what it needs is not installed.
    SessionError : the session can not be read, or the output not be written; OutputError if it may not be.
    """
    if out is not None and directory is not None:
        raise UsageError(f"{directory} and --out {out}: name the output once")
    from flowrec.exports import export as write

    return write(session, out if out is not None else directory, overwrite, file_format, beside)
