"""`flowrec sweep`: many sessions replayed with many settings."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from flowrec.core import REPLAYED, Ended, StoppedError
from flowrec.verbs import Asked, MisuseError, SetTexts, Told, verb

if TYPE_CHECKING:
    from flowrec.archive.sweep.sweep import Swept


def _output_of(asked: Asked, done: "Swept | StoppedError") -> Told:
    out = asked["out"]
    if isinstance(done, StoppedError):
        return Told(lambda: {"out": str(out), **done.as_json()}, None, done.exit_status, lambda: [str(done)])
    return Told(done.as_json, lambda: _show(done), done.exit_status, done.lines)


def _show(done: "Swept") -> None:
    from flowrec.core import say, table

    table(f"{done.sessions} sessions", *done.ranking.cells())
    say(done.ranking.note)


@verb(
    "flowrec sweep 'runs/*.mcap' --grid refine=fvm,assimilate --grid observer=kalman,kalman_map -o sweep.parquet",
    "flowrec sweep runs --grid plan=astar_time,time_field --refly -o plans.parquet --scheduler tcp://10.0.0.1:8786",
    "flowrec sweep s3://lab/runs/ --grid observer=kalman,kalman_map -o sweep.parquet",
    result=_output_of,
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
