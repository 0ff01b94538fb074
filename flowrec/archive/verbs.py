"""The verbs of many sessions: sweep, push, catalog, find. The command line imports this file, so it is light."""

import os
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from flowrec.core import REPLAYED, Ended, StoppedError, printable
from flowrec.verbs import Asked, MisuseError, SetTexts, Told, verb

if TYPE_CHECKING:
    from flowrec.archive.catalog.find import FoundSessions
    from flowrec.archive.catalog.refresh import Refreshed
    from flowrec.archive.push import Pushed
    from flowrec.archive.sweep.sweep import Swept

_SHOWN_ROWS = 200  # of a table that find prints, unless more are asked for


def _sweep_told(asked: Asked, done: "Swept | StoppedError") -> Told:
    out = asked["out"]
    if isinstance(done, StoppedError):
        return Told(lambda: {"out": str(out), **done.as_json()}, None, done.exit_status, lambda: [str(done)])
    return Told(done.as_json, lambda: _show_sweep(done), done.exit_status, done.lines)


def _show_sweep(done: "Swept") -> None:
    from flowrec.core import say, table

    table(f"{done.sessions} sessions", *done.ranking.cells())
    say(done.ranking.note)


@verb(
    "flowrec sweep 'runs/*.mcap' --grid refine=fvm,assimilate --grid observer=kalman,kalman_map -o sweep.parquet",
    "flowrec sweep runs --grid plan=astar_time,time_field --refly -o plans.parquet --scheduler tcp://10.0.0.1:8786",
    "flowrec sweep s3://lab/runs/ --grid observer=kalman,kalman_map -o sweep.parquet",
    result=_sweep_told,
)
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
            help=f"A method ({', '.join(REPLAYED)}) or setting, and its values; all combinations are done.",
        ),
    ],
    out: Annotated[
        Path, typer.Option("--out", "-o", help="Table to write (.parquet), a row a replay; an earlier one goes on.")
    ],
    sets: SetTexts = None,
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
) -> "Swept | StoppedError":
    """Replay many sessions with many settings, on all cores or a cluster, and rank the settings.

    A second call does only what is not done yet. For SLURM, dask-jobqueue has a scheduler, in Python:
    cluster = dask_jobqueue.SLURMCluster(cores=4, processes=4, memory="16GB"); cluster.scale(8); its address is
    cluster.scheduler_address. As many processes as cores: a worker has one thread.

    Notes
    -----
    Long because its parameters are the options of the verb.
    """
    if scheduler is not None and workers is not None:
        raise MisuseError("--workers are those of this machine; it goes without --scheduler")
    memory_bytes = None if memory is None else _bytes(memory)
    from flowrec.archive.sweep.sweep import sweep as run

    try:
        return run(
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
        why = f"what is done is kept in {out}, and the same command goes on"
        return StoppedError(Ended.of(error), why)


def _bytes(text: str) -> int:
    from flowrec.core import amounts

    try:
        (size_mb,) = amounts(text)["mb"]
    except ValueError as error:
        raise MisuseError(f"{text!r} is no size; as in --memory 2GB", "--memory") from error
    return round(size_mb * 1e6)


def _push_told(_asked: Asked, done: "Pushed | StoppedError") -> Told:
    if isinstance(done, StoppedError):  # not after the parts that are being sent, which may take minutes
        return Told(done.as_json, None, done.exit_status, lambda: [str(done)], ends_at_once=True)
    return Told(
        done.as_json,
        exit_status=done.exit_status,
        remarks=lambda: [f"not pushed: {text}" for text in done.failed.values()],
    )


@verb("flowrec push a.mcap s3://lab/runs", "flowrec push runs/*.mcap s3://lab/2026", result=_push_told)
def push(
    sessions: Annotated[
        list[Path],
        typer.Argument(metavar="SESSION...", help="Sessions (.mcap), or runs in parts; their notes go with them."),
    ],
    target: Annotated[str, typer.Argument(metavar="s3://BUCKET/FOLDER", help="Folder in a bucket of S3.")],
) -> "Pushed | StoppedError":
    """Copy sessions into a bucket of S3, checked before and compared after; an interrupted copy goes on.

    Credentials come from the environment (AWS_ACCESS_KEY_ID, ...), the address of another store than Amazon's, too
    (AWS_ENDPOINT_URL). No object is replaced by other content.
    """
    from flowrec.archive.push import push as run

    try:
        return run(sessions, target)
    except KeyboardInterrupt as error:
        return StoppedError(Ended.of(error), "what was sent stays in the bucket, and the same command goes on")


def _catalog_told(asked: Asked, done: "Refreshed") -> Told:
    def after() -> None:
        if asked["serve"] and not done.left:
            from flowrec.archive.catalog.serve import serve

            serve(done.path, asked["where"], asked["port"])

    return Told(done.as_json, None, done.stop_status if done.left else 0, done.lines, after)


@verb(
    "flowrec catalog runs",
    "flowrec catalog runs s3://lab/2026 -o all.parquet",
    "flowrec catalog runs --serve --where \"sweep.place = 1 and sweep.refine = 'pi_unet'\"",
    result=_catalog_told,
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
        bool, typer.Option("--serve", help="Then serve sessions to Rerun's viewer and catalog clients of this machine.")
    ] = False,
    where: Annotated[str, typer.Option(metavar="SQL", help="With --serve: of which sessions, as of find.")] = "",
    port: Annotated[
        int | None, typer.Option(metavar="PORT", min=1, max=65535, help="With --serve; by default a free one.")
    ] = None,
    jobs: Annotated[
        int, typer.Option(metavar="N", min=0, max=64, help="Processes that read sessions; 0: one a core.")
    ] = 1,
) -> "Refreshed":
    """Write one table about all sessions of some places, which find searches; only what has changed is read again."""
    if not serve and (where or port is not None):
        raise MisuseError("--where and --port go with --serve; flowrec find searches a catalog")
    from flowrec.archive.catalog.refresh import refresh
    from flowrec.core import progress

    with progress("reading sessions", 1.0) as done:
        return refresh(places or (), out, done, jobs)


def _find_told(asked: Asked, found: "FoundSessions") -> Told:
    def as_json() -> Any:
        if asked["paths"]:
            raise MisuseError("--paths and --json: name one")
        return found.as_json()

    if asked["paths"]:
        return Told(as_json, lambda: _print_paths(found.paths(), null=asked["null"]))
    return Told(as_json, lambda: _show_found(found, asked["limit"]))


def _show_found(found: "FoundSessions", limit: int | None) -> None:
    from flowrec.core import say, table, width

    title, count = found.title(), len(found.rows)
    found = replace(found, rows=found.rows[: limit or _SHOWN_ROWS])  # a table of thousands takes seconds
    doubtful = [number for number, row in enumerate(found.rows) if row.get("doubts")]
    columns, cells = found.cells(width())
    table(title, columns, cells, text="notes", amber=doubtful)
    for line in found.remarks():
        say(line)
    if count > len(found.rows):
        say(f"{count - len(found.rows)} rows more: --limit {count}, --paths and --json have all of them")


@verb(
    "flowrec find \"outcome = 'reached' and refined_flow_error < 0.05\" --sort -duration_s",
    "flowrec find \"sweep.place = 1 and sweep.refine = 'pi_unet'\" --paths",
    result=_find_told,
)
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
) -> "FoundSessions":
    """Find sessions in a catalog by an SQL condition (DuckDB); reads the catalog and no other file."""
    if null and not paths:
        raise MisuseError("--null goes with --paths")
    from flowrec.archive.catalog.find import find as search

    return search(where, catalog, sort, limit)


def _print_paths(paths: Sequence[str], *, null: bool) -> None:
    """Print the bytes of paths; on a terminal what it shows, because a name could hold its commands."""
    shown, end = sys.stdout.isatty(), b"\0" if null else b"\n"
    for path in paths:
        typer.echo(printable(path) if shown else os.fsencode(path) + end, nl=shown)
    if not null and any("\n" in path for path in paths):
        from flowrec.core import warn

        warn("a path holds a line feed: --null separates them by zero bytes, for xargs -0")
