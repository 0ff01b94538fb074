"""`flowrec bench ...`: thin verbs, late imports."""

from __future__ import annotations

import contextlib
import json
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from flowrec.system.outputs import FIGURE, JSON, new_file

bench = typer.Typer(help="Measure flowrec itself.", no_args_is_help=True)

Sets = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="KEY=VALUE", help="Change one setting, as in --set control.method=ff_fb."),
]
Overwrite = Annotated[bool, typer.Option("--overwrite", help="Replace an existing output file.")]
AsJson = Annotated[bool, typer.Option("--json", help="Print the result as JSON on stdout.")]
FiguresFile = Annotated[Path | None, typer.Option("--out", metavar="FILE", help="Also write the figures to a file.")]


@bench.command("loop")
def bench_loop(
    as_json: AsJson = False,
    out: FiguresFile = None,
    overwrite: Overwrite = False,
    ticks: Annotated[int, typer.Option(help="Frames per measurement.")] = 900,
) -> None:
    """Time of one tick with recording and viewing on and off, and the speed of a replay."""
    from flowrec.bench.loop import measure, show

    with _outputs(out, overwrite) as to:
        figures = measure(ticks)
        to.tell(figures, show, as_json)


@bench.command("observer")
def bench_observer(
    session: Annotated[
        Path | None, typer.Option(metavar="FILE.mcap", help="Also say which settings suit this recording.")
    ] = None,
    as_json: AsJson = False,
    out: FiguresFile = None,
    overwrite: Overwrite = False,
    figure: Annotated[Path | None, typer.Option(metavar="PNG", help="Draw the flow as told, and the errors.")] = None,
    seed: Annotated[int, typer.Option(help="Of the noise.")] = 0,
) -> None:
    """Error of each observer on the paper's lemniscate, and the tuning of the Kalman filter from a recording."""
    from flowrec.bench.observer import measure, show

    with _outputs(out, overwrite, figure, [session] if session is not None else []) as to:
        figures = measure(session, to.figure, seed)
        to.tell(figures, show, as_json)


@bench.command("flow")
def bench_flow(
    cases: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Vessel cases (*.npz); made up when left out.")
    ] = None,
    methods: Annotated[str | None, typer.Option(metavar="A,B", help="Which methods; all when left out.")] = None,
    noise: Annotated[Literal["00", "02", "05", "10"], typer.Option(help="Noise of the observations in %.")] = "05",
    share: Annotated[Literal["05", "10", "20"], typer.Option(help="Share of the skeleton that is seen in %.")] = "10",
    k: Annotated[int, typer.Option("-k", help="Subcells of the solver per pixel side: 1, 2 or 4.")] = 2,
    outliers: Annotated[float, typer.Option(help="Share of the observations that are nonsense.")] = 0.0,
    mask: Annotated[
        Literal["right", "grown", "shrunk", "shifted"], typer.Option(help="Believed walls, one pixel off.")
    ] = "right",
    observations: Annotated[
        Literal["raw", "trimmed"], typer.Option(help="trimmed: treated as in the paper before they are used.")
    ] = "raw",
    as_json: AsJson = False,
    out: FiguresFile = None,
    overwrite: Overwrite = False,
    fields: Annotated[Path | None, typer.Option(metavar="DIR", help="Keep every field in this folder.")] = None,
    figure: Annotated[Path | None, typer.Option(metavar="PNG", help="Draw one case, and the errors of all.")] = None,
    case: Annotated[
        str | None, typer.Option(metavar="NAME", help="Case of the figure; by default that of median error.")
    ] = None,
) -> None:
    """The paper's Table I and Fig. 4: error of the flow before and after each refinement."""
    from flowrec.bench.flow import Trouble, measure, show

    chosen = methods.split(",") if methods is not None else None
    trouble = Trouble(outliers, mask, observations)
    with _outputs(out, overwrite, figure) as to:
        figures = measure(cases, chosen, noise, share, k, trouble, fields, to.figure, case)
        to.tell(figures, show, as_json)


@bench.command("missions")
def bench_missions(
    seeds: Annotated[int, typer.Option(min=1, help="Worlds; every policy flies all of them, both ways.")] = 40,
    cases: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Vessel cases (*.npz) to fly in beside the built-in chips.")
    ] = None,
    policies: Annotated[
        str, typer.Option(metavar="A,B", help="Of policy, vector, astar, plain, paper.")
    ] = "policy,vector,paper",
    flow_error: Annotated[float, typer.Option(help="Share by which each true inlet flow is off.")] = 0.1,
    outlet_error: Annotated[float, typer.Option(help="Same of outlet pressures, of the drop across the chip.")] = 0.0,
    latency: Annotated[
        float | None, typer.Option(metavar="S", help="From command to motion; 0.04, less in swift channels.")
    ] = None,
    sets: Sets = None,
    jobs: Annotated[int, typer.Option(min=1, help="Processes.")] = 1,
    as_json: AsJson = False,
    out: FiguresFile = None,
    overwrite: Overwrite = False,
    figure: Annotated[Path | None, typer.Option(metavar="PNG", help="Draw arrival over optimum.")] = None,
) -> None:
    """Whole missions in the simulated rig: arrivals, wall contacts, time over the optimum, policies in pairs."""
    from flowrec.bench.missions import World, measure, show

    world = World(flow_error, outlet_error, latency, tuple(sets or ()))
    with _outputs(out, overwrite, figure) as to:
        figures = measure(seeds, cases, policies.split(","), world, figure=to.figure, jobs=jobs)
        to.tell(figures, show, as_json)


@bench.command("track")
def bench_track(
    as_json: AsJson = False,
    out: FiguresFile = None,
    overwrite: Overwrite = False,
    figure: Annotated[Path | None, typer.Option(metavar="PNG", help="Draw the ways and the errors.")] = None,
    seeds: Annotated[int, typer.Option(min=1, help="Runs with noise per law.")] = 5,
) -> None:
    """The paper's lemniscate in a vortex: how well each control law tracks it."""
    from flowrec.bench.track import measure, show

    with _outputs(out, overwrite, figure) as to:
        figures = measure(seeds, to.figure)
        to.tell(figures, show, as_json)


@bench.command("store")
def bench_store(
    as_json: AsJson = False,
    out: FiguresFile = None,
    overwrite: Overwrite = False,
    quick: Annotated[bool, typer.Option("--quick", help="Fewer messages and rounds, half a minute.")] = False,
    minutes: Annotated[float, typer.Option(min=0.0, help="Only watch memory while recording for so long.")] = 0.0,
    kills: Annotated[int, typer.Option(min=0, help="Only kill so many recordings of each kind and recover them.")] = 0,
    split: Annotated[
        float, typer.Option(min=0.0, metavar="S", help="Only split runs after so long: what it does to the loop.")
    ] = 0.0,
    equal: Annotated[
        bool, typer.Option("--equal", help="Only our writer and encoder beside the libraries' own, at equal terms.")
    ] = False,
    folder: Annotated[
        Path | None, typer.Option("--at", metavar="DIR", help="On which disk; by default that of temporary files.")
    ] = None,
) -> None:
    """Recording beside a bare mcap and a bare foxglove-sdk writer: speed, stall of the control loop, reading."""
    if equal:
        from flowrec.bench import store_equal

        with _outputs(out, overwrite) as to:
            rows = store_equal.measure(1 if quick else 3, 0.1 if quick else 1.0, 0.5 if quick else 3.0)
            to.tell({"equal": rows}, lambda figures: store_equal.show(figures["equal"]), as_json)
        return
    from flowrec.bench.store import measure, show

    with _outputs(out, overwrite) as to:
        figures = measure(folder, quick, minutes, kills, split)
        to.tell(figures, show, as_json)


@bench.command("clocks")
def bench_clocks(
    seconds: Annotated[float, typer.Option(min=60.0, help="Length of each series.")] = 300.0,
    seed: Annotated[int, typer.Option(min=0, help="Of delays.")] = 0,
    as_json: AsJson = False,
    out: FiguresFile = None,
    overwrite: Overwrite = False,
) -> None:
    """A camera's clock fitted to the host's in five ways: errors of the dates, whatever goes wrong."""
    from flowrec.bench.clocks import measure, show

    with _outputs(out, overwrite) as to:
        figures = measure(seconds, seed)
        to.tell(figures, show, as_json)


@bench.command("solver")
def bench_solver(
    as_json: AsJson = False,
    out: FiguresFile = None,
    overwrite: Overwrite = False,
    quick: Annotated[bool, typer.Option("--quick", help="Small cases only, a few seconds.")] = False,
) -> None:
    """The flow solver beside exact and published solutions, its speed and its memory."""
    from flowrec.bench.solver import measure, show

    with _outputs(out, overwrite) as to:
        figures = measure(quick)
        to.tell(figures, show, as_json)


@bench.command("fuzz")
def bench_fuzz(
    files: Annotated[int, typer.Option(min=1, help="How many spoiled sessions.")] = 2000,
    seed: Annotated[int, typer.Option(min=0, help="Of the first; the others follow it.")] = 0,
    as_json: AsJson = False,
    out: FiguresFile = None,
    overwrite: Overwrite = False,
) -> None:
    """Spoil sessions in every way and read them with every verb; exit status 1 when anything but our errors came."""
    from flowrec.bench.fuzz import measure, show

    with _outputs(out, overwrite) as to:
        figures = measure(files, seed)
        to.tell(figures, show, as_json)
    raise typer.Exit(1 if figures["fault_count"] else 0)


@bench.command("large")
def bench_large(
    gigabytes: Annotated[float, typer.Option("--gb", min=0.01, help="Size of the sessions (sparse files).")] = 10.0,
    folder: Annotated[Path | None, typer.Option(metavar="DIR", help="Where to make them; they are removed.")] = None,
    as_json: AsJson = False,
    out: FiguresFile = None,
    overwrite: Overwrite = False,
) -> None:
    """Opening a session of many gigabytes, and what is read of it to get at its poses."""
    from flowrec.bench.large import measure, show

    with _outputs(out, overwrite) as to:
        figures = measure(gigabytes, folder)
        to.tell(figures, show, as_json)


@bench.command("grid")
def bench_grid(
    cases: Annotated[Path, typer.Argument(metavar="DIR", help="Vessel cases (*.npz) with a truth on a fine grid.")],
    k: Annotated[int, typer.Option("-k", help="Subcells of the solver per pixel side: 2 or 4.")] = 2,
) -> None:
    """Fit the settings of refine.assimilate.model anew, for when the solver has changed."""
    from flowrec.bench.grid_error import measure, show

    show(measure(cases, k))


@bench.command("plan")
def bench_plan(
    cases: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Vessel cases (*.npz); made up when left out.")
    ] = None,
    trips: Annotated[int, typer.Option(min=1, help="Channels, one trip through each, down and up.")] = 40,
    methods: Annotated[str | None, typer.Option(metavar="A,B", help="Which planners; all when left out.")] = None,
    trees: Annotated[int, typer.Option(help="Channels in which rrt and rrt_star plan.")] = 10,
    iterations: Annotated[int, typer.Option(min=1, help="Of rrt and rrt_star.")] = 4000,
    seed: Annotated[int, typer.Option(min=0, help="Of channels and trips.")] = 0,
    as_json: AsJson = False,
    out: FiguresFile = None,
    overwrite: Overwrite = False,
    figure: Annotated[Path | None, typer.Option(metavar="PNG", help="Draw two channels, and all trips.")] = None,
) -> None:
    """Path length and travel time of every planner, up and down, beside the least time that is possible."""
    from flowrec.bench.plan import measure, show

    chosen = methods.split(",") if methods is not None else None
    with _outputs(out, overwrite, figure) as to:
        figures = measure(cases, trips, trees, iterations, to.figure, methods=chosen, seed=seed)
        to.tell(figures, show, as_json)


@dataclass
class _Outputs:
    """Where a bench writes to; None: nowhere."""

    json: Path | None = None
    figure: Path | None = None

    def tell(self, figures: dict[str, Any], show: Callable[[Any], None], as_json: bool) -> None:
        """Print the figures for people or as JSON, and write them where they are wanted."""
        if as_json:
            typer.echo(json.dumps(figures))
        else:
            show(figures)
        if self.json is not None:
            self.json.write_text(json.dumps(figures, indent=1) + "\n", encoding="utf-8")


@contextlib.contextmanager
def _outputs(
    json_file: Path | None, overwrite: bool, figure: Path | None = None, inputs: Iterable[Path] = ()
) -> Iterator[_Outputs]:
    """The output files of a bench: refused at its beginning, under their names when it has ended well."""
    with contextlib.ExitStack() as stack:
        outputs = _Outputs()
        read = list(inputs)
        if json_file is not None:
            outputs.json = stack.enter_context(new_file(json_file, JSON, inputs=read, overwrite=overwrite))
        if figure is not None:
            outputs.figure = stack.enter_context(new_file(figure, FIGURE, inputs=read, overwrite=overwrite))
        yield outputs
