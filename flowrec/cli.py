"""The command line: thin verbs, late imports, errors in one line.

Exit status: 0 done, 1 failed (also when the goal is unreachable, found before the run or during it), 2 bad usage,
3 done but something was lost or differs.
"""

from __future__ import annotations

import io
import json
import os
import sys
from pathlib import Path
from typing import Annotated, Literal

import typer

import flowrec
from flowrec.bench.verbs import AsJson, Overwrite, Sets, bench
from flowrec.errors import FlowrecError, printable

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

View = Literal["spawn", "serve", "rrd", "none"]
RrdOut = Annotated[
    Path | None,
    typer.Option(help="Where to write the .rrd; by default beside the session, over an .rrd of that session only."),
]


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

    typed = {
        "rig": ("--rig", rig),
        "mission.goal": ("--goal", None if goal is None else _point(goal)),
        "simulated.seed": ("--seed", seed),
        "duration_s": ("--duration", duration),
        **_pieces(split, snapshot),
    }
    given = {key: (flag, value) for key, (flag, value) in typed.items() if value is not None}
    settings = [*(sets or []), *(f"{key}={value}" for key, (_, value) in given.items())]
    chosen = load_config(config, settings, {key: flag for key, (flag, _) in given.items()})
    from flowrec.commands.interactive import AtTerminal
    from flowrec.commands.record import prepare, print_summary
    from flowrec.commands.record import record as run_record
    from flowrec.system.stderr import said_within

    if dry_run:
        typer.echo(to_toml(prepare(chosen)[0]))
        return
    read = [config] if config is not None else []
    recorded = run_record(chosen, out, view, realtime, overwrite, AtTerminal(), read)

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


@app.command()
def replay(
    session: Annotated[Path, typer.Argument(help="Session to replay (.mcap).")],
    refine: Annotated[
        str | None, typer.Option(metavar="[METHOD]", help=f"Refine the flow anew; alone: {DEFAULT_REFINE}.")
    ] = None,
    plan: Annotated[str | None, typer.Option(metavar="METHOD", help="Plan with another planner.")] = None,
    observer: Annotated[str | None, typer.Option(metavar="NAME", help="Observe with another filter.")] = None,
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
    from flowrec.commands.replay_report import Outputs, refinement_remarks, replay_and_report
    from flowrec.summary import comparison_for_people
    from flowrec.terminal import say, table

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
    from flowrec.commands.export import export as write
    from flowrec.session import files_behind
    from flowrec.system.outputs import PICTURE, check_output
    from flowrec.terminal import say
    from flowrec.view.screenshot import screenshot as take
    from flowrec.view.viewer import open_viewer

    if session.suffix == ".rrd" and not session.exists():
        raise FlowrecError(f"{session}: no such file; flowrec export makes one of a session")
    if screenshot is not None:
        check_output(screenshot, PICTURE, inputs=files_behind(session), overwrite=overwrite)
    rrd = session if session.suffix == ".rrd" else write(session, out, overwrite)
    if as_json:
        typer.echo(_rrd_told(session, rrd))
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
    session: Annotated[Path, typer.Argument(help="Session (.mcap).")],
    out: RrdOut = None,
    overwrite: Overwrite = False,
    as_json: AsJson = False,
) -> None:
    """Write the .rrd of a session without opening it."""
    from flowrec.commands.export import export as write

    rrd = write(session, out, overwrite)
    if as_json:
        typer.echo(_rrd_told(session, rrd))


@app.command()
def info(
    session: Annotated[Path, typer.Argument(help="Session (.mcap).")],
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
    from dataclasses import asdict

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
    from flowrec.commands.check import check as judge
    from flowrec.commands.check import files_to_check
    from flowrec.terminal import progress

    nbytes = sum(file.stat().st_size for file in files_to_check(session) if file.is_file())
    try:
        with progress(f"reading {session.name}", max(nbytes, 1)) as done:
            verdict = judge(session, done)
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
    from dataclasses import asdict

    from flowrec.store import recover_run
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
    first: Annotated[Path, typer.Argument(help="Session (.mcap).")],
    second: Annotated[Path, typer.Argument(help="Session to compare it with.")],
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
        same = "identical" if comparison.identical else "the same within tolerance"
        typer.echo(
            f"{comparison.ticks} ticks: "
            + (same if comparison.same else f"{comparison.different_ticks} of them differ")
        )
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


def _rrd_told(session: Path, rrd: Path) -> str:
    """What was written of a session, as JSON."""
    return json.dumps({"session": str(session), "rrd": str(rrd), "bytes": rrd.stat().st_size})


def _pieces(split: str | None, snapshot: str | None) -> dict[str, tuple[str, float]]:
    """`--split` and `--snapshot` as settings: flag and value by key."""
    from flowrec.units import amounts

    settings: dict[str, tuple[str, float]] = {}
    try:
        if split is not None:
            asked = amounts(split)
            if len(asked["s"]) > 1 or len(asked["mb"]) > 1:
                raise ValueError("one size, one time, or both")
            for unit, values in asked.items():
                settings |= {f"recording.split_{unit}": ("--split", value) for value in values}
    except ValueError as error:
        raise typer.BadParameter(f"{error}; as in --split 2GB,10min", param_hint="--split") from error
    try:
        if snapshot is not None:
            asked = amounts(snapshot)
            if asked["mb"] or not 1 <= len(asked["s"]) <= 2:
                raise ValueError("the time before and, if 10 s is not it, the time after")
            keys = ("recording.snapshot_before_s", "recording.snapshot_after_s")
            settings |= {key: ("--snapshot", value) for key, value in zip(keys, asked["s"], strict=False)}
    except ValueError as error:
        raise typer.BadParameter(f"{error}; as in --snapshot 30s,10s", param_hint="--snapshot") from error
    return settings


def _point(text: str) -> str:
    """`1200,800` as a TOML pair; a name stays a name."""
    parts = text.split(",")
    try:
        numbers = [float(part) for part in parts]
    except ValueError:
        return text
    if len(numbers) != 2:
        raise typer.BadParameter(f"{text!r}: a point is two numbers in um, as in --goal 1200,800", param_hint="--goal")
    return f"[{numbers[0]}, {numbers[1]}]"


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
    try:
        app(args=with_default_refine(sys.argv[1:]), prog_name="flowrec")
    except FlowrecError as error:
        sys.stderr.write(f"flowrec: {error}\n")
        sys.exit(error.exit_status)
    except BrokenPipeError:
        # The reader of our output has gone (flowrec info ... | head); nothing left to say.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(1)


if __name__ == "__main__":
    main()
