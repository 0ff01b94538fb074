"""The verb sweep: arguments in, exit status out."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from flowrec.bench.verbs import AsJson, Sets
from flowrec.units import amounts


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
    except KeyboardInterrupt:
        say(f"interrupted; what is done is kept in {out}, and the same command goes on")
        raise typer.Exit(130) from None
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
