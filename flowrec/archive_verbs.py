"""Verbs about many sessions: sweep, push, catalog, find. Arguments in, exit status out."""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from flowrec.bench.verbs import AsJson, Sets
from flowrec.errors import printable
from flowrec.system.endings import Ended, StoppedError
from flowrec.units import amounts

_SHOWN_ROWS = 200  # of a table that find prints, unless more are asked for


def sweep(
    sessions: Annotated[
        list[str],
        typer.Argument(
            metavar="SESSION...", help="Sessions, URLs of sessions, folders, and patterns such as 'runs/*.mcap'."
        ),
    ],
    grid: Annotated[
        list[str],
        typer.Option(
            "--grid",
            metavar="KEY=VALUE,...",
            help="A method (refine, plan, observer, controller) or setting, and its values; all combinations are done.",
        ),
    ],
    out: Annotated[
        Path, typer.Option("--out", "-o", help="Table to write (.parquet), a row a replay; an earlier one goes on.")
    ],
    sets: Sets = None,
    refly: Annotated[bool, typer.Option("--refly", help="Fly both plans in a simulator, as replay --refly.")] = False,
    by: Annotated[str | None, typer.Option(metavar="FIGURE", help="Rank the settings by this figure.")] = None,
    retry: Annotated[bool, typer.Option("--retry", help="Do replays that have failed again.")] = False,
    scheduler: Annotated[
        str | None,
        typer.Option(
            metavar="URL",
            help="Scheduler of a Dask cluster, tcp://HOST:PORT, whose workers see the same files; "
            "by default workers of this machine.",
        ),
    ] = None,
    workers: Annotated[
        int | None, typer.Option(min=1, metavar="N", help="Workers of this machine; by default one a core.")
    ] = None,
    timeout_s: Annotated[
        float | None, typer.Option("--timeout", min=0.1, metavar="S", help="End a replay that takes longer.")
    ] = None,
    memory: Annotated[
        str | None,
        typer.Option(metavar="SIZE", help="End a replay that needs more, such as 2GB; by default a worker's share."),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Replay many sessions with many settings, on all cores or a cluster, and rank the settings.

    A second call does only what is not done yet. For SLURM, dask-jobqueue has a scheduler, in Python:
    cluster = dask_jobqueue.SLURMCluster(cores=4, processes=4, memory="16GB"); cluster.scale(8); its address is
    cluster.scheduler_address. As many processes as cores: a worker has one thread.
    """
    if scheduler is not None and workers is not None:
        raise typer.BadParameter("--workers are those of this machine; it goes without --scheduler")
    memory_bytes = None if memory is None else _bytes(memory)
    from flowrec.sweeping.sweep import sweep as run
    from flowrec.terminal import say, table

    try:
        done = run(
            sessions,
            grid,
            out,
            sets or (),
            refly=refly,
            by=by,
            retry=retry,
            scheduler=scheduler,
            workers=workers,
            timeout_s=timeout_s,
            memory_bytes=memory_bytes,
        )
    except KeyboardInterrupt as error:
        stopped = StoppedError(Ended.of(error), f"what is done is kept in {out}, and the same command goes on")
        if as_json:
            typer.echo(json.dumps({"out": str(out), **stopped.as_json()}))
        say(str(stopped))
        raise typer.Exit(stopped.exit_status) from None
    if as_json:
        typer.echo(json.dumps(done.as_json()))
    else:
        table(f"{done.sessions} sessions", *done.ranking.cells())
        say(done.ranking.note)
    for line in done.lines():
        say(line)
    raise typer.Exit(done.exit_status)


def _bytes(text: str) -> int:
    try:
        (size_mb,) = amounts(text)["mb"]
    except ValueError as error:
        raise typer.BadParameter(f"{text!r} is no size; as in --memory 2GB", param_hint="--memory") from error
    return round(size_mb * 1e6)


def push(
    sessions: Annotated[
        list[Path],
        typer.Argument(metavar="SESSION...", help="Sessions (.mcap), or runs in parts; their notes go with them."),
    ],
    target: Annotated[str, typer.Argument(metavar="s3://BUCKET/FOLDER", help="Folder in a bucket of S3.")],
    as_json: AsJson = False,
) -> None:
    """Copy sessions into a bucket of S3, checked before and compared after; an interrupted copy goes on.

    Credentials come from the environment (AWS_ACCESS_KEY_ID, ...), the address of another store than Amazon's, too
    (AWS_ENDPOINT_URL). No object is replaced by other content.
    """
    from flowrec.commands.push import push as run
    from flowrec.terminal import say

    try:
        done = run(sessions, target)
    except KeyboardInterrupt as error:
        stopped = StoppedError(Ended.of(error), "what was sent stays in the bucket, and the same command goes on")
        say(str(stopped))
        sys.stdout.flush()
        os._exit(stopped.exit_status)  # not after the parts that are being sent, which may take minutes
    if as_json:
        typer.echo(json.dumps(done.as_json()))
    for text in done.failed.values():
        say(f"not pushed: {text}")
    raise typer.Exit(done.exit_status)


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
    as_json: AsJson = False,
) -> None:
    """Write one table about all sessions of some places, which find searches; only what has changed is read again."""
    if not serve and (where or port is not None):
        raise typer.BadParameter("--where and --port go with --serve; flowrec find searches a catalog")
    from flowrec.cataloguing.refresh import refresh
    from flowrec.terminal import progress, say

    with progress("reading sessions", 1.0) as done:
        refreshed = refresh(places or (), out, done)
    if as_json:
        typer.echo(json.dumps(refreshed.as_json()))
    for line in refreshed.lines():
        say(line)
    if refreshed.left:
        raise typer.Exit(refreshed.stop_status)
    if serve:
        _serve(refreshed.path, where, port)


def find(
    where: Annotated[
        str,
        typer.Argument(
            metavar="[SQL]",
            help="What must hold, of the facts of flowrec info, of sweep.* and events.*; by default all.",
        ),
    ] = "",
    catalog: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Catalog; by default that of this directory or the next above.")
    ] = None,
    sort: Annotated[str, typer.Option(metavar="FACT", help="Sort by this fact; -FACT: the largest first.")] = "",
    limit: Annotated[
        int | None, typer.Option(metavar="N", min=1, help="Only the first N rows; a table has 200 unless stated.")
    ] = None,
    paths: Annotated[
        bool, typer.Option("--paths", help="Only the paths, one a line, as for xargs -d '\\n' flowrec check.")
    ] = False,
    null: Annotated[
        bool, typer.Option("--null", "-0", help="With --paths: a zero byte after each, as for xargs -0.")
    ] = False,
    as_json: AsJson = False,
) -> None:
    """Find sessions in a catalog by an SQL condition (DuckDB); reads the catalog and no other file."""
    if paths and as_json:
        raise typer.BadParameter("--paths and --json: name one")
    if null and not paths:
        raise typer.BadParameter("--null goes with --paths")
    from flowrec.cataloguing.bounds import process_bounds
    from flowrec.cataloguing.find import find as search
    from flowrec.cataloguing.sql import TIMEOUT_S, too_slow

    with process_bounds(TIMEOUT_S + 2.0, str(too_slow(where))):
        found = search(where, catalog, sort, limit)
    if as_json:
        typer.echo(json.dumps(found.as_json()))
    elif paths:
        _print_paths(found.paths(), null=null)
    else:
        from flowrec.terminal import say, table, width

        title, count = found.title(), len(found.rows)
        found = replace(found, rows=found.rows[: limit or _SHOWN_ROWS])  # a table of thousands takes seconds
        doubtful = [number for number, row in enumerate(found.rows) if row.get("doubts")]
        table(title, *found.cells(width()), text="notes", amber=doubtful)
        for line in found.remarks():
            say(line)
        if count > len(found.rows):
            say(f"{count - len(found.rows)} rows more: --limit {count}, --paths and --json have all of them")


def _print_paths(paths: Sequence[str], *, null: bool) -> None:
    """Print the bytes of paths; on a terminal what it shows, because a name could hold its commands."""
    shown, end = sys.stdout.isatty(), b"\0" if null else b"\n"
    for path in paths:
        typer.echo(printable(path) if shown else os.fsencode(path) + end, nl=shown)
    if not null and any("\n" in path for path in paths):
        from flowrec.terminal import warn

        warn("a path holds a line feed: --null separates them by zero bytes, for xargs -0")


def _serve(catalog: Path, where: str, port: int | None) -> None:
    """Serve until Ctrl-C or a signal to end."""
    import signal
    import threading

    from flowrec.cataloguing.serve import recordings_of
    from flowrec.terminal import say
    from flowrec.view.catalog_server import DATASET, served

    recordings = recordings_of(catalog, where, say)
    with served(recordings, port) as url:
        ended = threading.Event()
        before = {each: signal.signal(each, lambda *_: ended.set()) for each in (signal.SIGINT, signal.SIGTERM)}
        say(f"{url}: dataset {DATASET} of {len(recordings)}; open it with: rerun {url}")
        say("Ctrl-C ends the server")
        ended.wait()
        for each, handler in before.items():
            signal.signal(each, handler)
