"""`flowrec bench ...`: thin verbs, late imports."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

bench = typer.Typer(help="Measure flowrec itself.", no_args_is_help=True)

Sets = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="KEY=VALUE", help="Change one setting, as in --set control.method=ff_fb."),
]
JsonFile = Annotated[Path | None, typer.Option("--json", metavar="FILE", help="Write the figures here.")]


@bench.command("loop")
def bench_loop(
    json_file: JsonFile = None,
    ticks: Annotated[int, typer.Option(help="Frames per measurement.")] = 900,
) -> None:
    """Time of one tick with recording and viewing on and off, and the speed of a replay."""
    from flowrec.bench.loop import measure, show

    figures = measure(ticks)
    show(figures)
    _keep(figures, json_file)


@bench.command("observer")
def bench_observer(
    session: Annotated[
        Path | None, typer.Option(metavar="FILE.mcap", help="Also say which settings suit this recording.")
    ] = None,
    json_file: JsonFile = None,
    figure: Annotated[Path | None, typer.Option(metavar="PNG", help="Draw the flow as told, and the errors.")] = None,
    seed: Annotated[int, typer.Option(help="Of the noise.")] = 0,
) -> None:
    """Error of each observer on the paper's lemniscate, and the tuning of the Kalman filter from a recording."""
    from flowrec.bench.observer import measure, show

    figures = measure(session, figure, seed)
    show(figures)
    _keep(figures, json_file)


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
    json_file: JsonFile = None,
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
    figures = measure(cases, chosen, noise, share, k, trouble, fields, figure, case)
    show(figures)
    _keep(figures, json_file)


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
    json_file: JsonFile = None,
    figure: Annotated[Path | None, typer.Option(metavar="PNG", help="Draw arrival over optimum.")] = None,
) -> None:
    """Whole missions in the simulated rig: arrivals, wall contacts, time over the optimum, policies in pairs."""
    from flowrec.bench.missions import World, measure, show

    world = World(flow_error, outlet_error, latency, tuple(sets or ()))
    figures = measure(seeds, cases, policies.split(","), world, figure=figure, jobs=jobs)
    show(figures)
    _keep(figures, json_file)


@bench.command("track")
def bench_track(
    json_file: JsonFile = None,
    figure: Annotated[Path | None, typer.Option(metavar="PNG", help="Draw the ways and the errors.")] = None,
    seeds: Annotated[int, typer.Option(min=1, help="Runs with noise per law.")] = 5,
) -> None:
    """The paper's lemniscate in a vortex: how well each control law tracks it."""
    from flowrec.bench.track import measure, show

    figures = measure(seeds, figure)
    show(figures)
    _keep(figures, json_file)


@bench.command("store")
def bench_store(
    json_file: JsonFile = None,
    quick: Annotated[bool, typer.Option("--quick", help="Fewer messages and rounds, half a minute.")] = False,
    minutes: Annotated[float, typer.Option(min=0.0, help="Only watch memory while recording for so long.")] = 0.0,
    kills: Annotated[int, typer.Option(min=0, help="Only kill so many recordings and recover them.")] = 0,
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

        rows = store_equal.measure(1 if quick else 3, 0.1 if quick else 1.0, 0.5 if quick else 3.0)
        store_equal.show(rows)
        _keep({"equal": rows}, json_file)
        return
    from flowrec.bench.store import measure, show

    figures = measure(folder, quick, minutes, kills, split)
    show(figures)
    _keep(figures, json_file)


@bench.command("clocks")
def bench_clocks(
    seconds: Annotated[float, typer.Option(min=60.0, help="Length of each series.")] = 300.0,
    seed: Annotated[int, typer.Option(min=0, help="Of delays.")] = 0,
    json_file: JsonFile = None,
) -> None:
    """A camera's clock fitted to the host's in five ways: errors of the dates, whatever goes wrong."""
    from flowrec.bench.clocks import measure, show

    figures = measure(seconds, seed)
    show(figures)
    _keep(figures, json_file)


@bench.command("solver")
def bench_solver(
    json_file: JsonFile = None,
    quick: Annotated[bool, typer.Option("--quick", help="Small cases only, a few seconds.")] = False,
) -> None:
    """The flow solver beside exact and published solutions, its speed and its memory."""
    from flowrec.bench.solver import measure, show

    figures = measure(quick)
    show(figures)
    _keep(figures, json_file)


@bench.command("fuzz")
def bench_fuzz(
    files: Annotated[int, typer.Option(min=1, help="How many spoiled sessions.")] = 2000,
    seed: Annotated[int, typer.Option(min=0, help="Of the first; the others follow it.")] = 0,
    json_file: JsonFile = None,
) -> None:
    """Spoil sessions in every way and read them with every verb; exit status 1 when anything but our errors came."""
    from flowrec.bench.fuzz import measure, show

    figures = measure(files, seed)
    show(figures)
    _keep(figures, json_file)
    raise typer.Exit(1 if figures["fault_count"] else 0)


@bench.command("large")
def bench_large(
    gigabytes: Annotated[float, typer.Option("--gb", min=0.01, help="Size of the sessions (sparse files).")] = 10.0,
    folder: Annotated[Path | None, typer.Option(metavar="DIR", help="Where to make them; they are removed.")] = None,
    json_file: JsonFile = None,
) -> None:
    """Opening a session of many gigabytes, and what is read of it to get at its poses."""
    from flowrec.bench.large import measure, show

    figures = measure(gigabytes, folder)
    show(figures)
    _keep(figures, json_file)


@bench.command("grid")
def bench_grid(
    cases: Annotated[Path, typer.Argument(metavar="DIR", help="Vessel cases (*.npz) with a truth on a fine grid.")],
    k: Annotated[int, typer.Option("-k", help="Subcells of the solver per pixel side: 2 or 4.")] = 2,
) -> None:
    """Fit the settings of refine.assimilate.model anew, for when the solver has changed."""
    from flowrec.bench.grid_error import measure, show

    show(measure(cases, k))


@bench.command("train")
def bench_train(
    lessons: Annotated[Path, typer.Argument(metavar="DIR", help="Folder of lessons; missing ones are made.")],
    out: Annotated[Path, typer.Argument(metavar="FILE", help="Weights to write (*.safetensors).")],
    network: Annotated[Literal["pi_unet", "unet"], typer.Option(help="Which network.")] = "pi_unet",
    count: Annotated[int, typer.Option(min=4, help="Number of lessons.")] = 1800,
    steps: Annotated[int, typer.Option(min=1, help="Steps of four lessons each.")] = 4500,
    device: Annotated[Literal["cpu", "cuda"], typer.Option(help="Where to train.")] = "cpu",
    seed: Annotated[int, typer.Option(min=0, help="Of lessons and weights.")] = 0,
) -> None:
    """Train a network's shipped weights on vessels drawn at random, with our own solver as the teacher."""
    from flowrec.bench.train import Training, show, train

    show(train(lessons, out, Training(network, count, steps, device=device, seed=seed)))


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
    json_file: JsonFile = None,
    figure: Annotated[Path | None, typer.Option(metavar="PNG", help="Draw two channels, and all trips.")] = None,
) -> None:
    """Path length and travel time of every planner, up and down, beside the least time that is possible."""
    from flowrec.bench.plan import measure, show

    chosen = methods.split(",") if methods is not None else None
    figures = measure(cases, trips, trees, iterations, figure, methods=chosen, seed=seed)
    show(figures)
    _keep(figures, json_file)


def _keep(figures: dict[str, Any], json_file: Path | None) -> None:
    """Write the figures of a bench where they are wanted."""
    if json_file is not None:
        json_file.write_text(json.dumps(figures, indent=1) + "\n", encoding="utf-8")
