"""The verbs for existing files: each function parses, calls and prints, and imports what it needs when it runs."""

from __future__ import annotations

import importlib
import json
from collections.abc import Callable, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

import typer
from typer.core import TyperCommand, TyperOption

import flowrec
from flowrec.bench.verbs import AsJson, Overwrite
from flowrec.errors import FlowrecError, UsageError, printable
from flowrec.store.session_path import session_path
from flowrec.system.endings import Ended

# Options that select a method, and the table of its methods.
METHODS = {
    "refine": "flowrec.refine.refiner:REFINERS",
    "plan": "flowrec.planning.planner:PLANNERS",
    "observer": "flowrec.estimation.observer:OBSERVERS",
    "controller": "flowrec.control.controller:CONTROLLERS",
    "file_format": "flowrec.exports.formats:EXPORTS",
}

# What a person may type, at the end of the help of each verb.
EXAMPLES = {
    "record": (
        "flowrec record --goal 5200,1400",
        "flowrec record lab.toml -o run.mcap --split 2GB,10min",
        "flowrec record --console --realtime --set mission.wait_at_goal_s=600",
    ),
    "replay": ("flowrec replay a.mcap --refine", "flowrec replay a.mcap --plan astar_time --refly -o b.mcap"),
    "sweep": (
        "flowrec sweep 'runs/*.mcap' --grid refine=fvm,assimilate --grid observer=kalman,kalman_map -o sweep.parquet",
        "flowrec sweep runs --grid plan=astar_time,time_field --refly -o plans.parquet --scheduler tcp://10.0.0.1:8786",
        "flowrec sweep s3://lab/runs/ --grid observer=kalman,kalman_map -o sweep.parquet",
    ),
    "push": ("flowrec push a.mcap s3://lab/runs", "flowrec push runs/*.mcap s3://lab/2026"),
    "catalog": (
        "flowrec catalog runs",
        "flowrec catalog runs s3://lab/2026 -o all.parquet",
        "flowrec catalog runs --serve --where \"sweep.place = 1 and sweep.refine = 'pi_unet'\"",
    ),
    "find": (
        "flowrec find \"outcome = 'reached' and refined_flow_error < 0.05\" --sort -duration_s",
        "flowrec find \"sweep.place = 1 and sweep.refine = 'pi_unet'\" --paths",
    ),
    "import": ("flowrec import movie.avi lab.toml --coils coils.csv -o a.mcap",),
    "doctor": ("flowrec doctor lab.toml",),
    "view": (
        "flowrec view a.mcap",
        "flowrec view a.mcap --screenshot a.png --time 12",
        "flowrec view a.mcap --layout .",
    ),
    "export": ("flowrec export a.mcap", "flowrec export a.mcap tables --format parquet"),
    "report": (
        "flowrec report a.mcap",
        "flowrec report a.mcap a_replay_001.mcap -o report.html --figures figures",
        "flowrec report sweep.parquet -o sweep.html",
    ),
    "info": ("flowrec info a.mcap --json", "flowrec info s3://lab/runs/a.mcap"),
    "ls": (
        "flowrec ls runs",
        "flowrec ls s3://lab/runs/",
        'flowrec ls runs/*.mcap --where "refined_flow_error < 0.05" --sort -duration_s',
    ),
    "note": ('flowrec note a.mcap "bubble at the outlet" --tag bubble', "flowrec note a.mcap"),
    "check": ("flowrec check a.mcap",),
    "recover": ("flowrec recover a.mcap.partial",),
    "compare": (
        "flowrec compare a.mcap b.mcap",
        "flowrec compare a.mcap a_replay_001.mcap --ignore provenance,parent,outcome,diagnostics,/camera/frame",
        "flowrec compare a.mcap b.mcap --only '/robot/*,configuration'",
    ),
}

SessionFile = Annotated[
    Path, typer.Argument(metavar="SESSION", callback=session_path, help="Session (.mcap), or its URL.")
]
RrdOut = Annotated[
    Path | None,
    typer.Option(
        "--out", "-o", help="File to write; by default beside the session, where it replaces an .rrd of that session."
    ),
]


def _places(named: list[Path] | None) -> list[Path]:
    return [session_path(place) for place in named or [Path()]]


def examples(verb: str) -> str:
    """The examples of a verb as the end of its help."""
    return "\n\n".join(["Examples:", *EXAMPLES[verb]])


def methods_of(parameter: str) -> Callable[[str], list[str]]:
    """What a shell offers to complete an option that selects a method."""

    def complete(incomplete: str) -> list[str]:
        return [name for name in _table(parameter) if name.startswith(incomplete)]

    return complete


def _table(parameter: str) -> Mapping[str, Any]:
    module, _, table = METHODS[parameter].partition(":")
    found: Mapping[str, Any] = getattr(importlib.import_module(module), table)
    return found


class HelpWithMethods(TyperCommand):
    """A verb whose help names the methods of its options; the tables are imported when the help is printed."""

    def format_help(self, ctx: Any, formatter: Any) -> None:
        for parameter in self.params:
            if isinstance(parameter, TyperOption) and parameter.name in METHODS:
                rows = _table(parameter.name).values()
                parameter.help = f"{parameter.help} " + "; ".join(f"{row.name}: {row.summary}" for row in rows) + "."
        super().format_help(ctx, formatter)


def view(
    session: Annotated[Path, typer.Argument(help="Session (.mcap) or recording for Rerun (.rrd).")],
    beside: Annotated[
        Path | None, typer.Argument(metavar="[OTHER]", help="Another session of the same chip, in the same view.")
    ] = None,
    out: RrdOut = None,
    screenshot: Annotated[
        Path | None, typer.Option(metavar="PNG", help="Save a picture of the viewer instead of opening it.")
    ] = None,
    time: Annotated[float | None, typer.Option(metavar="S", help="Session time of the screenshot.")] = None,
    layout: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR",
            help="Write layouts into this folder by which Foxglove (.json) and Rerun (.rbl) show the .mcap itself.",
        ),
    ] = None,
    no_open: Annotated[bool, typer.Option("--no-open", help="Only write the .rrd.")] = False,
    overwrite: Overwrite = False,
    as_json: AsJson = False,
) -> None:
    """Write the .rrd of a session and open it in Rerun."""
    from flowrec.session import files_behind
    from flowrec.system.outputs import PICTURE, Output
    from flowrec.terminal import say
    from flowrec.view.screenshot import screenshot as take
    from flowrec.view.viewer import open_viewer

    if session.suffix == ".rrd" and not session.exists():
        raise FlowrecError(f"{session}: no such file; flowrec export makes one of a session")
    if beside is not None and ".rrd" in (session.suffix, beside.suffix):
        raise UsageError(f"{session} and {beside}: two sessions (.mcap) are shown in one view, not .rrd files")
    if layout is not None:
        if session.suffix == ".rrd" or any(value is not None for value in (beside, out, screenshot, time)):
            raise UsageError(f"--layout {layout}: is for one session (.mcap) and goes with no other output")
        _write_layouts(session, layout, overwrite, as_json)
        return
    if screenshot is not None:
        Output(screenshot, PICTURE, tuple(files_behind(session)), overwrite).check()
    rrd = session if session.suffix == ".rrd" else flowrec.export(session, out, overwrite, beside=beside)
    if as_json:
        typer.echo(_export_json(session, rrd))
    if screenshot is not None:
        for problem in take(rrd, screenshot, time_s=time, overwrite=overwrite):
            say(problem)
        say(f"{screenshot} written")
    elif not no_open:
        message = open_viewer(rrd)
        if message:
            say(message)


def export(
    session: SessionFile,
    directory: Annotated[
        Path | None, typer.Argument(metavar="[OUT]", help="File or folder to write, or a folder for the file.")
    ] = None,
    file_format: Annotated[
        str,
        typer.Option(
            "--format", metavar="FORMAT", help="Format of the output.", autocompletion=methods_of("file_format")
        ),
    ] = "rrd",
    out: Annotated[
        Path | None,
        typer.Option(
            "--out",
            "-o",
            help="The same as OUT; by default beside the session, where it replaces an export of that session.",
        ),
    ] = None,
    overwrite: Overwrite = False,
    as_json: AsJson = False,
) -> None:
    """Convert a session to another format, such as a recording for Rerun (.rrd)."""
    if out is not None and directory is not None:
        raise UsageError(f"{directory} and --out {out}: name the output once")
    from flowrec.commands.export import exported

    made, covered = exported(session, out or directory, overwrite, file_format)
    if as_json:
        typer.echo(_export_json(session, made, file_format, covered=covered.as_json()))


def report(
    session: SessionFile,
    replays: Annotated[
        list[Path] | None, typer.Argument(metavar="[REPLAY]...", help="Replays of it (.mcap), compared with it.")
    ] = None,
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="Page to write (.html); SESSION_report.html by default.")
    ] = None,
    figures: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Write the figures, too, as SVG and PDF of 88 and 180 mm.")
    ] = None,
    overwrite: Overwrite = False,
    as_json: AsJson = False,
) -> None:
    """Write one page (HTML) about a session, to read, print or send: outcome, path, flow before and after, losses.

    Of a table of flowrec sweep (.parquet): the ranking of its settings.
    """
    if session.suffix == ".parquet":
        if replays or figures is not None:
            raise UsageError(f"{session}: the page of a sweep goes without replays and --figures")
        from flowrec.sweeping.sweep_report import report_sweep

        page = report_sweep(session, out, overwrite)
    else:
        page = flowrec.report(session, replays or (), out, figures, overwrite)
    if as_json:
        found = {"session": str(session), "html": str(page), "bytes": page.stat().st_size}
        typer.echo(json.dumps(found | ({"figures": str(figures)} if figures is not None else {})))


def info(
    session: SessionFile,
    as_json: AsJson = False,
) -> None:
    """Show how a session ended, its length, content, settings and provenance."""
    opened = flowrec.open(session)
    facts, topics = flowrec.info(opened), opened.topics
    if as_json:
        typer.echo(json.dumps({"session": str(session), "facts": facts, "topics": topics}))
        return
    from flowrec.commands.info import facts_for_people
    from flowrec.terminal import table

    rows = facts_for_people(facts)
    table(session.name, ("", "value"), rows, amber=[n for n, (name, _) in enumerate(rows) if name == "doubts"])
    table("Topics", ("topic", "messages"), [(name, str(count)) for name, count in topics.items()])


def list_directory(
    places: Annotated[
        list[Path] | None,
        typer.Argument(
            metavar="[PLACE]...",
            callback=_places,
            help="Directories and sessions, also in a bucket (s3://lab/runs/); by default this one.",
        ),
    ] = None,
    where: Annotated[
        str, typer.Option(metavar="SQL", help="Only sessions for which this holds, of the facts of flowrec info.")
    ] = "",
    sort: Annotated[str, typer.Option(metavar="FACT", help="Sort by this fact; -FACT: the largest first.")] = "",
    as_json: AsJson = False,
) -> None:
    """List sessions, unfinished and unreadable ones included."""
    from flowrec.commands.listed import columns_for_people, is_doubtful
    from flowrec.commands.ls import list_sessions

    rows = list_sessions(*(places or ()), where=where, sort=sort)
    if as_json:
        typer.echo(json.dumps([row.as_json() for row in rows]))
        return
    from flowrec.terminal import say, table, width

    doubtful = [number for number, row in enumerate(rows) if is_doubtful(row)]
    table(", ".join(map(str, places or ())), *columns_for_people(rows, width()), text="notes", amber=doubtful)
    for row in rows:
        if row.duration_s is None:
            say(f"{row.name}: {row.note}")


def note(
    session: SessionFile,
    text: Annotated[str, typer.Argument(metavar="[TEXT]", help="The note; without one, notes are printed.")] = "",
    tags: Annotated[list[str] | None, typer.Option("--tag", metavar="WORD", help="Add a tag; may be repeated.")] = None,
    as_json: AsJson = False,
) -> None:
    """Add a note or tags to a recorded session, in a file beside it, or print them."""
    opened = flowrec.open(session)
    if text or tags:
        opened.add_note(text, tags or [])
    if as_json:
        typer.echo(json.dumps({"session": str(session), "notes": [asdict(each) for each in opened.notes]}))
    elif not text and not tags:
        for each in opened.notes:
            words = " ".join([*(f"#{tag}" for tag in each.tags), each.text])
            typer.echo(printable(f"{each.written[:16].replace('T', ' ')} {each.author}: {words}"))


def check(
    session: Annotated[
        Path,
        typer.Argument(
            metavar="FILE", callback=session_path, help="Session (.mcap) or its URL, or an unfinished one (.partial)."
        ),
    ],
    as_json: AsJson = False,
) -> None:
    """Validate a session; exit status 0: good, 3: usable with losses or anomalies, 1: not usable.

    It finds damage, and edits that leave the digest as it was. Sessions are not signed: whoever can edit the file can
    edit the digest.
    """
    from flowrec.commands.check import files_to_check
    from flowrec.store.byte_source import size_of
    from flowrec.terminal import progress

    try:
        nbytes = sum(map(size_of, files_to_check(session)))
        with progress(f"reading {session.name}", max(nbytes, 1), "bytes") as done:
            verdict = flowrec.check(session, done)
    except Ended as ended:
        if ended.result is None:
            raise
        verdict = ended.result
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


def recover(
    session: Annotated[
        Path,
        typer.Argument(metavar="FILE", help="Unfinished (.mcap.partial), cut-off or damaged file, or a run."),
    ],
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="Session file to make; X.mcap or X_recovered.mcap by default.")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Make a complete session from one that was killed or cut off; exit status 3 if something was lost.

    Temporary files that killed processes have left beside it are removed.
    """
    from flowrec.store.recovery import recover_run
    from flowrec.store.session_path import on_this_machine
    from flowrec.system.leftovers import remove_leftovers
    from flowrec.terminal import say

    for left in remove_leftovers(on_this_machine(session, "nothing is recovered from").absolute().parent):
        say(f"{left}: removed, a killed process has left it")
    saved = recover_run(session, out)
    if as_json:
        typer.echo(json.dumps([asdict(done) | {"path": str(done.path)} for done in saved]))
    for done in saved:
        lost = f"; lost: {done.lost}" if done.lost else ""
        result = f"{done.ticks} ticks, {done.duration_s:.1f} s{lost}" if done.changed else "is whole; nothing to do"
        say(f"{done.path}: {result}")
    raise typer.Exit(0 if all(done.complete for done in saved) else 3)


def compare(
    first: SessionFile,
    second: SessionFile,
    only: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME,...", help="Only these topics and parts of the head; may be repeated."),
    ] = None,
    ignore: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME,...", help="Not these topics and parts of the head; may be repeated."),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Compare all that two sessions hold: head, every topic, drawings too; exit status 3 if anything differs.

    Names of --only and --ignore: topics (/robot/track, '/robot/*'), parts of the head (configuration, chip,
    provenance, parent, outcome, weights, pictures, start, part, digest, records) and their items (provenance.host,
    configuration.plan), and words for several: inputs, outputs, truth, diagnostics, drawings, head.
    """
    from flowrec.terminal import progress

    opened = flowrec.open(first), flowrec.open(second)
    try:
        length_s = max(session.duration_s for session in opened)
        with progress(f"comparing {first.name}", max(length_s, 1e-3), "s") as done:
            found = flowrec.compare(*opened, only=only or (), ignore=ignore or (), progress=done)
    except Ended as ended:
        if ended.result is None:
            raise
        found = ended.result
    if as_json:
        typer.echo(json.dumps({"first_session": str(first), "second_session": str(second)} | found.as_json()))
    else:
        for line in found.lines():
            typer.echo(line)
    raise typer.Exit(found.exit_status)


def _write_layouts(session: Path, folder: Path, overwrite: bool, as_json: bool) -> None:
    from flowrec.commands.layout import write_layouts
    from flowrec.terminal import say

    made = write_layouts(session, folder, overwrite)
    if as_json:
        found = {"session": session, "foxglove": made.foxglove, "rerun": made.rerun}
        typer.echo(json.dumps({key: str(path) for key, path in found.items()}))
    for line in made.advice:
        say(line)


def _export_json(session: Path, made: Path, file_format: str = "rrd", **more: Any) -> str:
    files = [made] if made.is_file() else [file for file in made.rglob("*") if file.is_file()]
    nbytes = sum(file.stat().st_size for file in files)
    return json.dumps({"session": str(session), file_format: str(made), "bytes": nbytes} | more)
