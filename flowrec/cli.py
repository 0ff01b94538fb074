"""The command line: the verbs record and replay, the entry point, and its errors in one line.

The other verbs are in import_verb.py, doctor_verb.py, session_verbs.py, archive_verbs.py and calibrate_verbs.py. Each
function parses, calls and prints, with late imports.

Exit status: 0 done, 1 failed (also when the goal is unreachable, found before the run or during it), 2 bad usage,
3 done but something was lost or differs, 130 stopped by Ctrl-C or a key, 143 by SIGTERM, 129 by a closed terminal.
A recording that is stopped has ended as it was meant to: 0.
"""

from __future__ import annotations

import io
import json
import os
import sys
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

import flowrec
from flowrec.archive_verbs import catalog, find, push, sweep
from flowrec.bench.verbs import HELP_WIDTH, AsJson, Overwrite, Sets, WholeDescriptions, bench
from flowrec.calibrate_verbs import calibrate
from flowrec.doctor_verb import doctor, look_at_lab
from flowrec.errors import FlowrecError, printable
from flowrec.import_verb import import_movie
from flowrec.session_verbs import (
    HelpWithMethods,
    SessionFile,
    check,
    compare,
    examples,
    export,
    info,
    list_directory,
    methods_of,
    note,
    recover,
    report,
    view,
)
from flowrec.store.traffic import TIMEOUT_KEY, TRAFFIC
from flowrec.system.endings import StoppedError, stopped_in_one_line
from flowrec.units import amounts


class _Verbs(WholeDescriptions):
    """The verbs; a signal that ends one of them is an error in one line, which Typer would swallow."""

    def make_context(self, *args: Any, **named: Any) -> Any:
        with stopped_in_one_line():
            return super().make_context(*args, **named)

    def invoke(self, ctx: Any) -> Any:
        with stopped_in_one_line():
            return super().invoke(ctx)


app = typer.Typer(
    cls=_Verbs,
    name="flowrec",
    help="Record, replay and view missions of magnetic micro-robots in flow.",
    no_args_is_help=True,
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": HELP_WIDTH},
    pretty_exceptions_enable=False,
    rich_markup_mode=None,  # frames around the help would take as long to draw as all the rest
)
app.add_typer(calibrate, name="calibrate")
app.add_typer(bench, name="bench")

DEFAULT_REFINE = "pi_unet"
View = Literal["spawn", "serve", "rrd", "none"]


def _version(asked: bool) -> None:
    if asked:
        typer.echo(f"flowrec {flowrec.__version__}")
        raise typer.Exit


def _timeout(seconds: float | None) -> None:
    if seconds is not None:
        os.environ[TIMEOUT_KEY] = str(seconds)  # processes that a verb starts take it over


@app.callback()
def root(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version.")
    ] = False,
    timeout: Annotated[
        float | None,
        typer.Option(metavar="S", callback=_timeout, help="Time limit of each request for a session at a URL; 30."),
    ] = None,
) -> None:
    """Record, replay and view missions of magnetic micro-robots in flow."""


@app.command(epilog=examples("record"))
def record(
    config: Annotated[Path | None, typer.Argument(help="Configuration (TOML); --dry-run prints one.")] = None,
    rig: Annotated[str | None, typer.Option(help="Rig to use: simulated, movie, lab.")] = None,
    goal: Annotated[str | None, typer.Option(metavar="X,Y", help="Goal in um, or inlet, outlet, outlet:1.")] = None,
    seed: Annotated[int | None, typer.Option(help="Seed of the simulated rig.")] = None,
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="Session file; by default named by date and sample.")
    ] = None,
    sets: Sets = None,
    view: Annotated[View, typer.Option(help="Watch live (spawn, serve) or write an .rrd at the end.")] = "none",
    console: Annotated[
        bool, typer.Option("--console", help="Serve a page on this machine: buttons, goal by a click, large stop.")
    ] = False,
    realtime: Annotated[bool, typer.Option("--realtime", help="Run the simulated rig in real time.")] = False,
    duration: Annotated[float | None, typer.Option(metavar="S", help="Stop after this many seconds.")] = None,
    dry_run: Annotated[
        bool,
        typer.Option(
            "--dry-run", help="Energise nothing: check mission and devices, print the resolved configuration."
        ),
    ] = False,
    split: Annotated[
        str | None,
        typer.Option(metavar="SIZE|TIME", help="Begin another file after this size or time, or both: 2GB,10min."),
    ] = None,
    snapshot: Annotated[
        str | None,
        typer.Option(metavar="TIME[,TIME]", help="Record only the time before and after marks and alarms: 30s,10s."),
    ] = None,
    accept_losses: Annotated[
        bool, typer.Option("--accept-losses", help="Record in real time also where images will be lost.")
    ] = False,
    overwrite: Overwrite = False,
    as_json: AsJson = False,
) -> None:
    """Run a mission (survey, refine, plan, navigate) and record every stage."""
    from flowrec.system.toml_file import read_toml

    if config is not None:
        read_toml(config)  # a file that is no TOML is refused before the imports below, which take a second
    from flowrec.config import load_config, to_toml

    settings, flags = _settings(
        [
            ("--rig", rig, lambda name: {"rig": name}, "simulated"),
            ("--goal", goal, _goal, "1200,800"),
            ("--seed", seed, lambda number: {"simulated.seed": number}, "1"),
            ("--duration", duration, lambda time_s: {"duration_s": time_s}, "60"),
            ("--split", split, _split, "2GB,10min"),
            ("--snapshot", snapshot, _snapshot, "30s,10s"),
            ("--accept-losses", accept_losses or None, lambda _: {"recording.accept_losses": "true"}, ""),
        ]
    )
    chosen = load_config(config, [*(sets or []), *settings], flags)
    from flowrec.commands.interactive import AtTerminal
    from flowrec.commands.record import prepare
    from flowrec.commands.run_summary import print_summary
    from flowrec.rig_settings import MOVIE
    from flowrec.system.stderr import said_within

    if dry_run:
        resolved = prepare(chosen).config
        typer.echo(to_toml(resolved))
        failed = chosen.rig == "lab" and look_at_lab(chosen, config, out)  # last: 300 lines of settings would hide it
        raise typer.Exit(int(failed))
    inputs = [config] if config is not None else []
    realtime = realtime or chosen.rig == MOVIE  # `import` takes a movie as fast as it can be read
    recorded = flowrec.record(chosen, out, view, realtime, overwrite, AtTerminal(), inputs, console=console)

    def summarize() -> None:
        if as_json:
            files = [str(file) for file in recorded.files]
            found = {"path": str(recorded.path), **recorded.facts, "derived": dict(recorded.derived), "files": files}
            typer.echo(json.dumps(found))
        else:
            print_summary(recorded)

    if recorded.stopped:
        # The file is complete and the coils are off. A frozen terminal must not delay the exit, and the shutdown of
        # Python takes half a second.
        said_within(0.3, summarize)
        os._exit(recorded.exit_status)
    summarize()
    raise typer.Exit(recorded.exit_status)


@app.command(cls=HelpWithMethods, epilog=examples("replay"))
def replay(
    session: SessionFile,
    refine: Annotated[
        str | None,
        typer.Option(
            autocompletion=methods_of("refine"),
            metavar="[METHOD]",
            help=f"Refine the flow again; without a method: {DEFAULT_REFINE}.",
        ),
    ] = None,
    plan: Annotated[
        str | None, typer.Option(autocompletion=methods_of("plan"), metavar="METHOD", help="Plan with another planner.")
    ] = None,
    observer: Annotated[
        str | None,
        typer.Option(autocompletion=methods_of("observer"), metavar="NAME", help="Estimate with another observer."),
    ] = None,
    controller: Annotated[
        str | None,
        typer.Option(autocompletion=methods_of("controller"), metavar="NAME", help="Control with another control law."),
    ] = None,
    sets: Sets = None,
    from_s: Annotated[float | None, typer.Option("--from", metavar="TIME", help="Resume at this second.")] = None,
    verify: Annotated[bool, typer.Option("--verify", help="Compare with the recording, message by message.")] = False,
    refly: Annotated[
        bool, typer.Option("--refly", help="Fly both plans in a simulator with the refined flow.")
    ] = False,
    jobs: Annotated[int, typer.Option(metavar="N", help="Processes of --verify; 0: one a core.")] = 1,
    out: Annotated[Path | None, typer.Option("--out", "-o", help="Session file of the replay.")] = None,
    frames: Annotated[bool, typer.Option("--frames", help="Copy the camera images into the replay's file.")] = False,
    view: Annotated[Literal["rrd", "none"], typer.Option(help="Write an .rrd of both, side by side.")] = "none",
    overwrite: Overwrite = False,
    as_json: AsJson = False,
) -> None:
    """Run the pipeline again on a recorded session, with the same or other methods, and compare."""
    from flowrec.commands.interactive import AtTerminal

    change = flowrec.Change(refine, plan, observer, controller, tuple(sets or ()))
    if jobs != 1 and not verify:
        raise typer.BadParameter("--jobs goes with --verify: in a changed replay each tick depends on those before")
    if verify:
        if refly:
            raise typer.BadParameter("--verify only compares; it goes without --refly")
        if jobs == 1:
            from flowrec.commands.replay import replay as replay_verb

            done = replay_verb(session, change, from_s, True, out, overwrite, frames, AtTerminal())
        else:
            from flowrec.commands.replay_segments import verify as verify_in_segments

            if change != flowrec.Change() or out is not None:
                raise typer.BadParameter("--verify --jobs only compares: it goes without --refine, --set, --out ...")
            done = verify_in_segments(session, jobs, from_s, AtTerminal())
        if as_json:
            typer.echo(json.dumps({"session": str(session), **done.as_json()}))
        else:
            for line in done.lines():
                typer.echo(printable(line))
        raise typer.Exit(done.exit_status)
    from flowrec.commands.replay_report import Outputs, refinement_remarks, replay_and_report
    from flowrec.summary import comparison_for_people
    from flowrec.terminal import say, table, warn

    outputs = Outputs.of(session, out, overwrite, refly=refly, rrd=view == "rrd")
    done, rows = replay_and_report(session, change, outputs, from_s, frames, AtTerminal())
    report, remarks = done.report, refinement_remarks(done)
    if as_json:
        figures = {"wall_s": report.wall_s, "duration_s": report.duration_s, "ticks": report.ticks}
        named = [dict(zip(("quantity", "recorded", "replayed"), row, strict=True)) for row in rows]
        result = {"session": str(session), "out": str(outputs.session.path), "refinement": remarks, "rows": named}
        doubts = {"doubts": "; ".join(done.doubts)} if done.doubts else {}
        typer.echo(json.dumps(result | figures | {"covered": done.covered.as_json()} | doubts))
    else:
        table(f"Replay of {session.name}", ("", "recorded", "replayed"), comparison_for_people(rows))
        length = f"({report.duration_s:.1f} s) replayed in {report.wall_s:.1f} s"
        of_these = "; the figures are of those" if done.covered.stopped else ""
        say(f"{done.covered.text} {length}{of_these} -> {outputs.session.path}")
        for line in remarks:
            say(line)
        for doubt in done.doubts:
            warn(f"doubtful: {doubt}")
    if done.covered.stopped:
        raise typer.Exit(done.covered.status)
    raise typer.Exit(3 if done.doubts else 0)


app.command("import", epilog=examples("import"))(import_movie)
app.command("sweep", epilog=examples("sweep"))(sweep)
app.command("push", epilog=examples("push"))(push)
app.command("catalog", epilog=examples("catalog"))(catalog)
app.command("find", epilog=examples("find"))(find)
for _verb in (doctor, view, export, report, info, list_directory, note, check, recover, compare):
    _name = "ls" if _verb is list_directory else _verb.__name__
    app.command(_name, cls=HelpWithMethods, epilog=examples(_name))(_verb)


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
    """Insert the default method after a `--refine` without one, so that a session path is not taken for the method."""
    full: list[str] = []
    for number, word in enumerate(words):
        full.append(word)
        following = words[number + 1] if number + 1 < len(words) else "-"
        without_method = following.startswith("-") or following.endswith(".mcap")
        if word == "--refine" and without_method:
            full.append(DEFAULT_REFINE)
    return full


def main() -> None:
    """Entry point: run the command line, turn our errors into one line and an exit status."""
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="backslashreplace")  # the locale's encoding may not have every character
    TRAFFIC.reasons.clear()  # of a call before, in the same process
    # click's class, which typer has in its own package since 0.29.
    usage_error: Any = typer.BadParameter.__base__
    try:
        sys.exit(app(args=with_default_refine(sys.argv[1:]), prog_name="flowrec", standalone_mode=False) or 0)
    except usage_error as error:
        if type(error).__name__ == "NoArgsIsHelpError":  # typer has moved the class from version to version
            typer.echo(error.ctx.get_help())
            sys.exit(0)
        message = printable(error.format_message()).rstrip(".")
        if message:  # empty if the help was printed
            verb = error.ctx.command_path if error.ctx is not None else "flowrec"
            sys.stderr.write(f"flowrec: {message}; see {verb} --help\n")
        sys.exit(error.exit_code)
    except FlowrecError as error:
        if isinstance(error, StoppedError) and "--json" in sys.argv:
            print(json.dumps(error.as_json()))
        sys.stderr.write(f"flowrec: {error}\n")
        sys.exit(error.exit_status)
    except BrokenPipeError:
        # The reader of the output has ended (flowrec info ... | head).
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(1)
    finally:
        if TRAFFIC.line:
            sys.stderr.write(f"{TRAFFIC.line}\n")


if __name__ == "__main__":
    main()
