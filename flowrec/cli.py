"""The command line: one function a verb, which parses, calls and prints. Late imports; errors in one line.

Exit status: 0 done, 1 failed (also when the goal is unreachable, found before the run or during it), 2 bad usage,
3 done but something was lost or differs.
"""

from __future__ import annotations

import importlib
import io
import json
import os
import sys
from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any, Literal

import typer
from typer.core import TyperCommand, TyperOption

import flowrec
from flowrec.bench.verbs import AsJson, Overwrite, Sets, bench
from flowrec.errors import FlowrecError, printable
from flowrec.units import amounts

app = typer.Typer(
    name="flowrec",
    help="Record, replay and look at missions of magnetic micro-robots that swim in flow.",
    no_args_is_help=True,
    context_settings={"help_option_names": ["-h", "--help"]},
    pretty_exceptions_enable=False,
    rich_markup_mode="rich",
)
app.add_typer(bench, name="bench")

DEFAULT_REFINE = "pi_unet"
# Options of replay that choose a method, and the table of its methods.
METHODS = {
    "refine": "flowrec.refine.refiner:REFINERS",
    "plan": "flowrec.planning.planner:PLANNERS",
    "observer": "flowrec.estimation.observer:OBSERVERS",
    "controller": "flowrec.control.controller:CONTROLLERS",
}

View = Literal["spawn", "serve", "rrd", "none"]
SessionFile = Annotated[Path, typer.Argument(metavar="SESSION", help="Session (.mcap).")]
RrdOut = Annotated[
    Path | None,
    typer.Option(help="Where to write the .rrd; by default beside the session, over an .rrd of that session only."),
]


class _HelpWithMethods(TyperCommand):
    """A verb whose help names the methods of its options; the tables are imported when the help is printed."""

    def format_help(self, ctx: Any, formatter: Any) -> None:
        for parameter in self.params:
            if isinstance(parameter, TyperOption) and parameter.name in METHODS:
                module, _, table = METHODS[parameter.name].partition(":")
                rows = getattr(importlib.import_module(module), table).values()
                parameter.help = f"{parameter.help} " + "; ".join(f"{row.name}: {row.summary}" for row in rows) + "."
        super().format_help(ctx, formatter)


def _version(asked: bool) -> None:
    if asked:
        typer.echo(f"flowrec {flowrec.__version__}")
        raise typer.Exit


@app.callback()
def root(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version.")
    ] = False,
) -> None:
    """Record, replay and look at missions of magnetic micro-robots that swim in flow."""


@app.command()
def record(
    config: Annotated[Path | None, typer.Argument(help="Configuration (TOML); --dry-run prints one.")] = None,
    rig: Annotated[str | None, typer.Option(help="Which rig: simulated.")] = None,
    goal: Annotated[str | None, typer.Option(metavar="X,Y", help="Goal in um, or inlet, outlet, outlet:1.")] = None,
    seed: Annotated[int | None, typer.Option(help="Seed of the simulated rig.")] = None,
    out: Annotated[Path | None, typer.Option(help="Session file; by default named by date and sample.")] = None,
    sets: Sets = None,
    view: Annotated[View, typer.Option(help="Watch live (spawn, serve) or write an .rrd at the end.")] = "none",
    realtime: Annotated[bool, typer.Option("--realtime", help="Keep the simulated rig to the wall clock.")] = False,
    duration: Annotated[float | None, typer.Option(metavar="S", help="Stop after so many seconds.")] = None,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Check and print the resolved configuration.")] = False,
    split: Annotated[
        str | None, typer.Option(metavar="SIZE|TIME", help="Go on in another file after as much: 2GB, 10min, or both.")
    ] = None,
    snapshot: Annotated[
        str | None,
        typer.Option(metavar="TIME[,TIME]", help="Only keep the time before and after marks and alarms: 30s,10s."),
    ] = None,
    overwrite: Overwrite = False,
    as_json: AsJson = False,
) -> None:
    """Run a mission (survey, refine, plan, navigate) and record every stage of it."""
    from flowrec.system.toml_file import read_toml

    if config is not None:
        read_toml(config)  # a file that is none is refused before the imports below, which take a second
    from flowrec.config import load_config, to_toml

    settings, flags = _settings(
        [
            ("--rig", rig, lambda name: {"rig": name}, "simulated"),
            ("--goal", goal, _goal, "1200,800"),
            ("--seed", seed, lambda number: {"simulated.seed": number}, "1"),
            ("--duration", duration, lambda time_s: {"duration_s": time_s}, "60"),
            ("--split", split, _split, "2GB,10min"),
            ("--snapshot", snapshot, _snapshot, "30s,10s"),
        ]
    )
    chosen = load_config(config, [*(sets or []), *settings], flags)
    from flowrec.commands.interactive import AtTerminal
    from flowrec.commands.record import prepare
    from flowrec.commands.run_summary import print_summary
    from flowrec.system.stderr import said_within

    if dry_run:
        typer.echo(to_toml(prepare(chosen)[0]))
        return
    inputs = [config] if config is not None else []
    recorded = flowrec.record(chosen, out, view, realtime, overwrite, AtTerminal(), inputs)

    def summarize() -> None:
        if as_json:
            files = [str(file) for file in recorded.files]
            found = {"path": str(recorded.path), **recorded.facts, "derived": dict(recorded.derived), "files": files}
            typer.echo(json.dumps(found))
        else:
            print_summary(recorded)

    if recorded.stopped:
        # The file is whole and the coils are off. A frozen terminal would keep us here for ever, and Python takes half
        # a second to take itself apart.
        said_within(0.3, summarize)
        os._exit(recorded.exit_status)
    summarize()
    raise typer.Exit(recorded.exit_status)


@app.command(cls=_HelpWithMethods)
def replay(
    session: SessionFile,
    refine: Annotated[
        str | None, typer.Option(metavar="[METHOD]", help=f"Refine the flow again; alone: {DEFAULT_REFINE}.")
    ] = None,
    plan: Annotated[str | None, typer.Option(metavar="METHOD", help="Plan with another planner.")] = None,
    observer: Annotated[str | None, typer.Option(metavar="NAME", help="Estimate with another observer.")] = None,
    controller: Annotated[str | None, typer.Option(metavar="NAME", help="Control with another law.")] = None,
    sets: Sets = None,
    from_s: Annotated[float | None, typer.Option("--from", metavar="TIME", help="Resume at this second.")] = None,
    verify: Annotated[bool, typer.Option("--verify", help="Compare with the recording, message by message.")] = False,
    refly: Annotated[
        bool, typer.Option("--refly", help="Fly both plans in a simulator with the refined flow.")
    ] = False,
    out: Annotated[Path | None, typer.Option(help="Session file of the replay.")] = None,
    frames: Annotated[bool, typer.Option("--frames", help="Copy the camera images into the replay's file.")] = False,
    view: Annotated[Literal["rrd", "none"], typer.Option(help="Write an .rrd with both side by side.")] = "none",
    overwrite: Overwrite = False,
    as_json: AsJson = False,
) -> None:
    """Run the pipeline again over a recorded session, the same or with other stages, and compare."""
    from flowrec.commands.interactive import AtTerminal

    change = flowrec.Change(refine, plan, observer, controller, tuple(sets or ()))
    if verify:
        if refly:
            raise typer.BadParameter("--verify only compares; it goes without --refly")
        done = flowrec.replay(session, change, from_s, True, out, overwrite, frames, AtTerminal())
        if as_json:
            typer.echo(json.dumps({"session": str(session), **done.as_json()}))
        else:
            for line in done.lines():
                typer.echo(printable(line))
        raise typer.Exit(0 if done.same else 3)
    from flowrec.commands.replay_report import Outputs, refinement_remarks, replay_and_report
    from flowrec.summary import comparison_for_people
    from flowrec.terminal import say, table

    outputs = Outputs.of(session, out, overwrite, refly=refly, rrd=view == "rrd")
    done, rows = replay_and_report(session, change, outputs, from_s, frames, AtTerminal())
    report, remarks = done.report, refinement_remarks(done)
    if as_json:
        figures = {"wall_s": report.wall_s, "duration_s": report.duration_s, "ticks": report.ticks}
        named = [dict(zip(("quantity", "recorded", "replayed"), row, strict=True)) for row in rows]
        result = {"session": str(session), "out": str(outputs.session), "refinement": remarks, "rows": named}
        typer.echo(json.dumps(result | figures))
        return
    table(f"Replay of {session.name}", ("", "recorded", "replayed"), comparison_for_people(rows))
    say(f"{report.ticks} ticks ({report.duration_s:.1f} s) replayed in {report.wall_s:.1f} s -> {outputs.session}")
    for line in remarks:
        say(line)


@app.command()
def view(
    session: Annotated[Path, typer.Argument(help="Session (.mcap) or recording for Rerun (.rrd).")],
    out: RrdOut = None,
    screenshot: Annotated[
        Path | None, typer.Option(metavar="PNG", help="Save a picture of the viewer instead of opening it.")
    ] = None,
    time: Annotated[float | None, typer.Option(metavar="S", help="Session time of the screenshot.")] = None,
    no_open: Annotated[bool, typer.Option("--no-open", help="Only write the .rrd.")] = False,
    overwrite: Overwrite = False,
    as_json: AsJson = False,
) -> None:
    """Write the .rrd of a session and open it in Rerun."""
    from flowrec.session import files_behind
    from flowrec.system.outputs import PICTURE, check_output
    from flowrec.terminal import say
    from flowrec.view.screenshot import screenshot as take
    from flowrec.view.viewer import open_viewer

    if session.suffix == ".rrd" and not session.exists():
        raise FlowrecError(f"{session}: no such file; flowrec export makes one of a session")
    if screenshot is not None:
        check_output(screenshot, PICTURE, inputs=files_behind(session), overwrite=overwrite)
    rrd = session if session.suffix == ".rrd" else flowrec.export(session, out, overwrite)
    if as_json:
        typer.echo(_rrd_json(session, rrd))
    if screenshot is not None:
        for problem in take(rrd, screenshot, time_s=time, overwrite=overwrite):
            say(problem)
        say(f"{screenshot} written")
    elif not no_open:
        said = open_viewer(rrd)
        if said:
            say(said)


@app.command()
def export(
    session: SessionFile,
    out: RrdOut = None,
    overwrite: Overwrite = False,
    as_json: AsJson = False,
) -> None:
    """Write the .rrd of a session without opening it."""
    rrd = flowrec.export(session, out, overwrite)
    if as_json:
        typer.echo(_rrd_json(session, rrd))


@app.command()
def info(
    session: SessionFile,
    as_json: AsJson = False,
) -> None:
    """What a session is: how it ended, how long, what is in it, where it comes from."""
    opened = flowrec.open(session)
    facts, topics = flowrec.info(opened), opened.topics
    if as_json:
        typer.echo(json.dumps({"session": str(session), "facts": facts, "topics": topics}))
        return
    from flowrec.commands.info import facts_for_people
    from flowrec.terminal import table

    table(session.name, ("", "value"), facts_for_people(facts))
    table("Topics", ("topic", "messages"), [(name, str(count)) for name, count in topics.items()])


@app.command("ls")
def list_directory(
    directory: Annotated[Path, typer.Argument(metavar="DIR", help="Where to look.")] = Path(),
    as_json: AsJson = False,
) -> None:
    """The sessions in a directory, one row each; unfinished and unreadable ones as such."""
    from flowrec.commands.info import list_sessions

    rows = list_sessions(directory)
    if as_json:
        typer.echo(json.dumps([asdict(row) for row in rows]))
        return
    from flowrec.terminal import say, table

    columns = ("name", "outcome", "duration", "size", "chip", "recorded")
    table(
        str(directory),
        columns,
        [
            (
                row.name + (f" ({row.parts} parts)" if row.parts else ""),
                row.outcome,
                "" if row.duration_s is None else f"{row.duration_s:.1f} s",
                f"{row.size_bytes / 1e6:.1f} MB",
                row.chip,
                row.recorded[:16].replace("T", " "),
            )
            for row in rows
        ],
    )
    for row in rows:
        if row.duration_s is None:
            say(f"{row.name}: {row.note}")


@app.command()
def check(
    session: Annotated[Path, typer.Argument(metavar="FILE", help="Session (.mcap), or the remains of one (.partial).")],
    as_json: AsJson = False,
) -> None:
    """Read a whole session and judge it; exit status 0 good, 3 something was lost or is odd, 1 not usable."""
    from flowrec.commands.check import files_to_check
    from flowrec.terminal import progress

    nbytes = sum(file.stat().st_size for file in files_to_check(session) if file.is_file())
    try:
        with progress(f"reading {session.name}", max(nbytes, 1)) as done:
            verdict = flowrec.check(session, done)
    except FlowrecError as error:
        if not as_json:
            raise
        finding = {"level": "bad", "about": "file", "text": str(error)}
        typer.echo(json.dumps({"session": str(session), "verdict": "bad", "exit_status": 1, "findings": [finding]}))
        raise typer.Exit(1) from error
    if as_json:
        typer.echo(json.dumps(verdict.as_json()))
    else:
        for line in verdict.lines():
            typer.echo(line)
    raise typer.Exit(verdict.exit_status)


@app.command()
def recover(
    session: Annotated[
        Path, typer.Argument(metavar="FILE", help="Unfinished (.mcap.partial), cut or damaged file, or a run in parts.")
    ],
    out: Annotated[
        Path | None, typer.Option(help="Session file to make; X.mcap or X_recovered.mcap by default.")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Make a whole session of one that was killed or cut off; exit status 3 where something was lost."""
    from flowrec.store.recovery import recover_run
    from flowrec.terminal import say

    saved = recover_run(session, out)
    if as_json:
        typer.echo(json.dumps([asdict(done) | {"path": str(done.path)} for done in saved]))
    for done in saved:
        lost = f"; lost: {done.lost}" if done.lost else ""
        said = f"{done.ticks} ticks, {done.duration_s:.1f} s{lost}" if done.changed else "is whole; nothing to do"
        say(f"{done.path}: {said}")
    raise typer.Exit(0 if all(done.complete for done in saved) else 3)


@app.command()
def compare(
    first: SessionFile,
    second: SessionFile,
    as_json: AsJson = False,
) -> None:
    """Compare two sessions, every message of every tick; exit status 3 where they differ."""
    comparison = flowrec.compare(first, second)
    if as_json:
        typer.echo(json.dumps({"first_session": str(first), "second_session": str(second)} | comparison.as_json()))
    else:
        for line in comparison.lines():
            typer.echo(printable(line))
        if comparison.first is not None:
            typer.echo(printable(f"first difference: {comparison.first}"))
        conclusion = "identical" if comparison.identical else "the same within tolerance"
        if not comparison.same:
            conclusion = comparison.other_numerics or f"{comparison.different_ticks} of them differ"
        typer.echo(f"{comparison.ticks} ticks: {conclusion}")
    raise typer.Exit(0 if comparison.same else 3)


@app.command()
def calibrate(
    file: Annotated[Path, typer.Argument(metavar="FILE.csv", help="Rows of i_x_a,i_y_a,i_z_a,b_x_mt,b_y_mt,b_z_mt.")],
    out: Annotated[
        Path | None, typer.Option(metavar="TOML", help="Write the coils section of a configuration.")
    ] = None,
    overwrite: Overwrite = False,
    as_json: AsJson = False,
) -> None:
    """Fit the coils' field per ampere and the bias to measured fields, and say how far they are to be trusted."""
    from flowrec.commands import calibrate as verb

    fit = verb.calibrate(file, out, overwrite)
    if as_json:
        typer.echo(json.dumps(verb.figures(fit)))
    else:
        verb.show(fit, out)


def _rrd_json(session: Path, rrd: Path) -> str:
    return json.dumps({"session": str(session), "rrd": str(rrd), "bytes": rrd.stat().st_size})


def _split(text: str) -> dict[str, float]:
    """`2GB`, `10min` or both, as settings."""
    asked = amounts(text)
    if max(map(len, asked.values())) > 1:
        raise ValueError("one size, one time, or both")
    return {f"recording.split_{unit}": values[0] for unit, values in asked.items() if values}


def _snapshot(text: str) -> dict[str, float]:
    """`30s,10s` as settings: the time before and, if given, the time after."""
    asked = amounts(text)
    if asked["mb"] or not 1 <= len(asked["s"]) <= 2:
        raise ValueError("the time before and, if 10 s is not it, the time after")
    keys = ("recording.snapshot_before_s", "recording.snapshot_after_s")
    return dict(zip(keys, asked["s"], strict=False))


def _goal(text: str) -> dict[str, str]:
    """`1200,800` as a setting, a TOML pair; a name stays a name."""
    try:
        numbers = [float(part) for part in text.split(",")]
    except ValueError:
        return {"mission.goal": text}
    if len(numbers) != 2:
        raise ValueError(f"{text!r}: a point is two numbers in um")
    return {"mission.goal": str(numbers)}


def _settings(
    given: Iterable[tuple[str, Any, Callable[[Any], Mapping[str, Any]], str]],
) -> tuple[list[str], dict[str, str]]:
    """Options of `record` as `key=value`, and the option that set each key: (option, value, parser, example)."""
    settings: list[str] = []
    flags: dict[str, str] = {}
    for flag, value, parse, example in given:
        if value is None:
            continue
        try:
            found = parse(value)
        except ValueError as error:
            raise typer.BadParameter(f"{error}; as in {flag} {example}", param_hint=flag) from error
        settings += [f"{key}={setting}" for key, setting in found.items()]
        flags |= dict.fromkeys(found, flag)
    return settings, flags


def with_default_refine(words: list[str]) -> list[str]:
    """`--refine` may stand alone: give it its method, so that a session path after it is not taken for one."""
    full: list[str] = []
    for number, word in enumerate(words):
        full.append(word)
        following = words[number + 1] if number + 1 < len(words) else "-"
        alone = following.startswith("-") or following.endswith(".mcap")
        if word == "--refine" and alone:
            full.append(DEFAULT_REFINE)
    return full


def main() -> None:
    """Entry point: run the command line, turn our errors into one line and an exit status."""
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="backslashreplace")  # the locale's encoding may not have every character
    # click's class, which typer has in its own package since 0.29.
    usage_error: Any = typer.BadParameter.__base__
    try:
        sys.exit(app(args=with_default_refine(sys.argv[1:]), prog_name="flowrec", standalone_mode=False) or 0)
    except usage_error as error:
        message = printable(error.format_message()).rstrip(".")
        if message:  # else the help has been printed
            verb = error.ctx.command_path if error.ctx is not None else "flowrec"
            sys.stderr.write(f"flowrec: {message}; see {verb} --help\n")
        sys.exit(error.exit_code)
    except FlowrecError as error:
        sys.stderr.write(f"flowrec: {error}\n")
        sys.exit(error.exit_status)
    except BrokenPipeError:
        # The reader of our output has gone (flowrec info ... | head); nothing left to say.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(1)


if __name__ == "__main__":
    main()
