"""`flowrec catalog`: one table about all sessions of some places, and a server of them."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from flowrec.verbs import Asked, MisuseError, Told, verb

if TYPE_CHECKING:
    from flowrec.archive.catalog.refresh import Refreshed


def _output_of(asked: Asked, done: "Refreshed") -> Told:
    def after() -> None:
        if asked["serve"] and not done.left:
            _serve(done.path, asked["where"], asked["port"])

    return Told(done.as_json, None, done.stop_status if done.left else 0, done.lines, after)


@verb(
    "flowrec catalog runs",
    "flowrec catalog runs s3://lab/2026 -o all.parquet",
    "flowrec catalog runs --serve --where \"sweep.place = 1 and sweep.refine = 'pi_unet'\"",
    result=_output_of,
)
def catalog(
    places: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="[PLACE]...",
            help="Directories with all below them, sessions, URLs; by default those of the catalog, or this directory.",
        ),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(
            "--out", "-o", help="Catalog to write (.parquet); by default flowrec-catalog.parquet in the directory."
        ),
    ] = None,
    serve: Annotated[
        bool,
        typer.Option("--serve", help="Then serve sessions to Rerun's viewer and catalog clients of this machine."),
    ] = False,
    where: Annotated[str, typer.Option(metavar="SQL", help="With --serve: of which sessions, as of find.")] = "",
    port: Annotated[
        int | None, typer.Option(metavar="PORT", min=1, max=65535, help="With --serve; by default a free one.")
    ] = None,
) -> "Refreshed":
    """Write one table about all sessions of some places, which find searches; only what has changed is read again."""
    if not serve and (where or port is not None):
        raise MisuseError("--where and --port go with --serve; flowrec find searches a catalog")
    from flowrec.archive.catalog.refresh import refresh
    from flowrec.core import progress

    with progress("reading sessions", 1.0) as done:
        return refresh(places or (), out, done)


def _serve(catalog: Path, where: str, port: int | None) -> None:
    """Serve until Ctrl-C or a signal to end."""
    import signal
    import threading

    from flowrec.archive.catalog.serve import recordings_of
    from flowrec.core import say
    from flowrec.view import DATASET, serve_recordings

    recordings = recordings_of(catalog, where, say)
    with serve_recordings(recordings, port) as url:
        ended = threading.Event()
        before = {each: signal.signal(each, lambda *_: ended.set()) for each in (signal.SIGINT, signal.SIGTERM)}
        say(f"{url}: dataset {DATASET} of {len(recordings)}; open it with: rerun {url}")
        say("Ctrl-C ends the server")
        ended.wait()
        for each, handler in before.items():
            signal.signal(each, handler)
