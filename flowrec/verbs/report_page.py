"""Report of a session and of its replays, as one HTML page and as figures for a paper: flowrec report.

Needs the packages of the extra `report`: see `require_packages`.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from flowrec.core import (
    DOUBTS,
    Figures,
    FlowField,
    Level,
    Outcome,
    Output,
    OutputFolder,
    UsageError,
    completes_mission,
    doubts_of,
    doubts_text,
    goal_text,
    is_of_robot,
    name_of,
    progress,
    say,
    shell_word,
    text_of_figure,
    verdict_lines,
    with_micro,
)
from flowrec.exports import (
    GLOSSARY,
    MEANINGS,
    ChangeFigure,
    Folded,
    MapFigure,
    MotionFigure,
    ObserverFigure,
    Page,
    PathFigure,
    PathFlowFigure,
    RecordingFigure,
    ReplayPart,
    ReportData,
    ReportFigure,
    ReportTable,
    Span,
    TimelineFigure,
    TrackFigure,
    draw_figure,
    numbered_actions,
    render,
    sentence,
    style,
)
from flowrec.run import ReplayFiles, before_after
from flowrec.stages import flow_error
from flowrec.store import Session, files_behind, input_blamed, named_beside, session_sha256, toml_table
from flowrec.verbs.check import check
from flowrec.verbs.info import facts_for_people, info
from flowrec.verbs.options import HTML
from flowrec.verbs.replay_change import OF_EVERY_REPLAY
from flowrec.verbs.replay_result import refinement_remarks
from flowrec.verbs.session_parts import flat
from flowrec.verbs.verdict import Verdict
from flowrec.view import goal_of

_HIDDEN = frozenset(  # of the outcome: shown elsewhere
    {
        "outcome",
        "stated_flow_error",  # of each map is
        "note",
        "reason",
        DOUBTS,
        "wall_s",
        "wall_ns",
        "monotonic_ns",
        "clocks",
        "not_refined",
        "recovered_from",
        "frames_windows",
    }
)
_NEUTRAL = (Outcome.REPLAYED, Outcome.ENDED, Outcome.CONTINUED, Outcome.SNAPSHOT)  # of a file, not of a run
_LINES = 600  # of settings or local changes on the page
_EVENTS = 60  # rows of the table of events
_OF_CODE = ("flowrec", "numerics_version", "git_commit", "git_changed")


def write_report(
    session: Session | Path | str,
    replays: Sequence[Session | Path | str],
    out: Path | str | None,
    figures: Path | str | None,
    overwrite: bool,
) -> Path:
    """Write the report of a session; arguments and errors as of `flowrec.report`."""
    session = Session.of(session)
    parts = [Session.of(each) for each in replays]
    path = session.path
    read = tuple(file for each in (session, *parts) for file in files_behind(each.path))
    target = Path(out) if out is not None else named_beside(path, f"{path.stem}_report.html")
    output = Output(target, HTML, read, overwrite)
    output.check()
    folder = None
    if figures is not None:
        made_from = {"format": "figures", "session": session.key, "replays": " ".join(each.key for each in parts)}
        folder = OutputFolder(Path(figures), made_from, inputs=read, overwrite=overwrite)
        folder.check()
    _check_parents(session, parts)
    config = session.config
    with ExitStack() as stack:
        done = stack.enter_context(progress(f"reading {path.name}", max(session.duration_s, 1e-3), "s"))
        stack.enter_context(input_blamed(session, config, "reported on"))
        verdict = check(session)
        data = ReportData.of(session, done)
        pairs = [ReplayFiles.of(session, each) for each in parts]
        with style.drawing():
            kinds = _figures(data, verdict, pairs)
            page = _page(data, verdict, pairs, kinds)
            # Made before either is written: an error in one leaves neither.
            files = dict(_files(kinds, data)) if folder is not None else {}
        text = render(page)
    with ExitStack() as stack:  # what fails in one leaves neither
        stack.enter_context(output.new_file()).write_text(text, encoding="utf-8")
        if folder is not None:
            place = stack.enter_context(folder.new_folder())
            for name, content in files.items():
                (place / name).write_bytes(content)
    if folder is not None:
        say(f"{folder.path}: {len(files)} files, figures of 88 and 180 mm")
    say(f"{output.path} written; open it in a browser, print it, or send it as it is")
    return output.path


def _check_parents(session: Session, replays: Sequence[Session]) -> None:
    """Refuse a file that is no replay of this session."""
    sha256 = session_sha256([file.path for file in session.run.files]) if replays else ""
    for replay in replays:
        parent = replay.header.parent
        if parent.get("sha256") != sha256:
            what = f"is a replay of {parent.get('file', '?')}, another recording" if parent else "is no replay"
            raise UsageError(
                f"{replay.path}: {what}; name replays of {session.path}, which "
                f"`flowrec replay {shell_word(session.path)} --refine` makes, or compare any two with flowrec compare"
            )


def _figures(data: ReportData, verdict: Verdict, pairs: Sequence[ReplayFiles]) -> list[ReportFigure]:
    first_s = data.history.first_s
    gaps = [Span("no image", first_s + gap.at_s, first_s + gap.at_s + gap.length_s) for gap in verdict.gaps]
    changes = [ChangeFigure(pair.recorded.field, pair.replayed.field, n) for n, pair in enumerate(pairs, 1)]
    if not data.tells_flow:
        return [PathFigure("Path of the robot"), TrackFigure(), TimelineFigure(gaps), RecordingFigure(), *changes]
    return [
        PathFigure(),
        MapFigure(),
        PathFlowFigure(),
        ObserverFigure(),
        MotionFigure(),
        TimelineFigure(gaps),
        RecordingFigure(),
        *changes,
    ]


def _files(kinds: Sequence[ReportFigure], data: ReportData) -> Iterator[tuple[str, bytes]]:
    """Name and content of each figure's files."""
    for kind in kinds:
        if kind.why_not(data):
            continue
        for width_mm in style.WIDTHS_MM:
            figure = kind.draw(data, width_mm)
            name = f"{kind.name}_{width_mm:.0f}mm"
            yield f"{name}.svg", style.as_svg(figure, kind.title, style.PAPER_DPI, text="none")
            yield f"{name}.pdf", style.as_pdf(figure, kind.title)


def _page(data: ReportData, verdict: Verdict, pairs: Sequence[ReplayFiles], kinds: Sequence[ReportFigure]) -> Page:
    session = data.session
    facts = info(session)
    outcome = str(facts["outcome"])
    done = {kind.name: draw_figure(kind, data) for kind in kinds}
    judgement, *_ = verdict.lines()
    provenance = session.provenance
    packages = [(key.removeprefix("package."), text) for key, text in provenance.items() if key.startswith("package.")]
    doubts = _doubts(data, verdict)
    known: Figures = {"outcome": outcome, "duration_s": session.duration_s, DOUBTS: doubts_text(doubts)}
    ended, *_ = verdict_lines(known)
    _, *won = verdict_lines({**session.outcome, **known, "note": "", DOUBTS: ""}, data.refined)
    return Page(
        name=session.path.name,
        outcome=outcome,
        ended=ended,
        good=completes_mission(outcome) or outcome in _NEUTRAL,
        sentence=sentence(outcome),
        note=_sentence(with_micro(str(facts["note"] or ""))),
        won=won,
        doubts=doubts,
        about=_about(facts, data),
        notes=[note for note in (str(facts.get("notes") or ""), *facts["notes_added"]) if note],
        key_figures=_key_figures(data),
        figures=done,
        refined=data.refined is not None,
        refinement=_refinement(data.refined),
        boundary=_boundary(data),
        events=_events(data),
        recording=ReportTable("", [fact for fact in verdict.facts.items() if fact[0] not in ("written", "outcome")]),
        findings=[judgement, *(finding.text for finding in verdict.findings if finding.about != "doubts")],
        replays=[_replay_part(pair, done[f"replay_{number}"]) for number, pair in enumerate(pairs, 1)],
        provenance=[ReportTable("", _provenance(facts, session))],
        folded=[
            Folded("Packages", [f"{name} {text}" for name, text in packages]),
            Folded("Local changes to the code", _cut(provenance.get("git_diff", "").splitlines())),
            Folded("All settings", _cut(session.header.config_toml.splitlines())),
        ],
        glossary=GLOSSARY,
    )


def _doubts(data: ReportData, verdict: Verdict) -> list[str]:
    """Those that the session states, and those that its track shows."""
    found = (finding.text.removeprefix("doubtful: ") for finding in verdict.findings if finding.about == "doubts")
    return [with_micro(doubt) for doubt in dict.fromkeys([*doubts_of(data.session.outcome), *found])]


def _sentence(text: str) -> str:
    end = "" if not text or text.endswith((".", "!", "?")) else "."
    return text[:1].upper() + text[1:] + end


def _about(facts: dict[str, Any], data: ReportData) -> str:
    """Time, place, equipment and goal of the run, in one line."""
    goal = with_micro(f"goal {goal_text(goal_of(data.history.last.mission))}")
    rig = {"simulated": "in simulation", "movie": "from a movie", "lab": "in the laboratory"}
    when = f"{str(facts['recorded'])[:16].replace('T', ' ')} UTC"
    made = f"replay of {facts['replay_of']}, made {when}" if facts["replay_of"] else f"recorded {when}"
    where = rig.get(str(facts["rig"]), f"rig {facts['rig']}")
    chip = "open field" if facts["chip_openings"] is None else f"chip {facts['chip']}"
    named = (f"{key}: {facts[key]}" for key in ("operator", "sample") if facts.get(key))
    return ", ".join([made, where, chip, goal, *named])


def _maps(data: ReportData) -> dict[str, FlowField]:
    """The flow maps that the session holds."""
    named = {"assumed": data.assumed, "refined": data.refined}
    return {name: field for name, field in named.items() if field is not None}


def _key_figures(data: ReportData) -> ReportTable:
    session = data.session
    figures = {"duration_s": session.duration_s} | {
        key: value for key, value in session.outcome.items() if key not in _HIDDEN and value not in (None, "")
    }
    for name, field in _maps(data).items():
        error = flow_error(data.scene.chip, field, data.truth)
        if error is not None:  # of a run that was cut off, its last tick instead of its figures
            figures.setdefault(f"{name}_flow_error", error)
    rows = [
        (name_of(key), with_micro(text_of_figure(key, value)), MEANINGS.get("robot" if is_of_robot(key) else key, ""))
        for key, value in figures.items()
    ]
    for name, field in _maps(data).items():
        if field.error_share is not None:
            text = text_of_figure("_error", field.error_share)
            rows.append((f"{name} flow, stated error", text, f"what the {name} map expects its error to be"))
    if data.truth is None and data.tells_flow:
        rows.append(("error of the flow", "-", "not known: only a simulation knows the true flow"))
    return ReportTable("In numbers", rows, ("", "", ""))


def _boundary(data: ReportData) -> ReportTable | None:
    """Inflow and pressure at the openings of the chip, before and after."""
    fields = _maps(data) | ({"true": data.truth} if data.truth is not None else {})
    openings = data.scene.chip.openings
    if any(len(field.boundary_values) != len(openings) for field in fields.values()) or not fields:
        return None
    rows = []
    for number, opening in enumerate(openings):
        inlet = opening.kind == "inlet"
        values = [float(field.boundary_values[number]) for field in fields.values()]
        texts = [f"{value:.0f} µm/s" if inlet else f"{value:.3g} Pa" for value in values]
        what = "mean inward speed" if inlet else "pressure"
        rows.append((f"{opening.kind} on the {opening.side}, {what}", *texts))
    return ReportTable("At the openings of the chip", rows, ("", *fields))


def _refinement(refined: FlowField | None) -> str:
    """Prediction of what was held back by the refined map and by the map before it; '' where it is not known."""
    if refined is None or refined.log_score is None or refined.log_score_before is None:
        return ""
    return (
        f"Log score of observations that were held back: {refined.log_score:.2f}, by the map in use before "
        f"{refined.log_score_before:.2f}."
    )


def _events(data: ReportData) -> list[ReportTable]:
    history = data.history
    actions = [
        (number, f"{each.time_s:.2f} s", each.action, with_micro(each.text))
        for number, each in numbered_actions(history.remarks)
    ]
    events = [
        (f"{each.time_s:.2f} s", with_micro(each.text if each.level == Level.INFO else f"{each.level}: {each.text}"))
        for each in history.remarks
        if not each.action
    ]
    spans = history.phases.spans
    phases = [(span.name, f"{span.from_s:.2f} s", f"{span.to_s - span.from_s:.2f} s") for span in spans]
    tables: list[tuple[str, Sequence[tuple[Any, ...]], tuple[str, ...], int]] = [
        ("The operator", actions, ("number", "time", "action", "text"), 0),
        ("Events", events, ("time", "event"), history.remarks_left_out),
        ("Phases of the mission", phases, ("phase", "from", "for"), 0),
    ]
    made = []
    for title, rows, columns, left_out in tables:
        total = len(rows) + left_out
        note = f"The first {_EVENTS} of {total}; the session holds all." if total > min(len(rows), _EVENTS) else ""
        made += [ReportTable(title, rows[:_EVENTS], columns, note)] if rows else []
    return made


def _provenance(facts: dict[str, Any], session: Session) -> list[tuple[str, str]]:
    """The facts of `flowrec info` that are no figures of the run, with what it leaves out of the provenance."""
    figures = session.outcome.keys()
    kept = {key: None if key in figures and key not in ("outcome", "note") else value for key, value in facts.items()}
    rows = [row for row in facts_for_people(facts | kept) if row[0] != "outcome"]
    machine = ("platform", "python", "host", "user")
    return rows + [(name_of(key), session.provenance[key]) for key in machine if key in session.provenance]


def _replay_part(pair: ReplayFiles, figure: Any) -> ReplayPart:
    texts = [
        (
            name_of(key),
            with_micro(text_of_figure(key, was)),
            with_micro(text_of_figure(key, now)),
            MEANINGS.get(key, ""),
        )
        for key, was, now in before_after(pair)
    ]
    changed = _changed_settings(pair)
    of_changed = ("setting", "recorded", "replayed") if changed else ()
    note = "" if changed else "The replay has the settings and the code of the recording."
    tables = [
        ReportTable("Before and after", texts, ("", "recorded", "replayed", ""), narrow_columns=3),
        ReportTable("What was changed", changed, of_changed, note),
    ]
    return ReplayPart(pair.replay.path.name, tables, [*map(with_micro, refinement_remarks(pair))], figure)


def _changed_settings(pair: ReplayFiles) -> list[tuple[str, str, str]]:
    """Settings, weights and versions of the code that differ."""
    sides = []
    for each in (pair.session, pair.replay):
        settings = dict(flat(toml_table(each.header.config_toml, f"{each.path}: config.toml inside")))
        code = {
            key: text
            for key, text in each.provenance.items()
            if key in _OF_CODE or key.startswith(("weights.", "package."))
        }
        sides.append(settings | code)
    was, now = sides
    keys = [key for key in was | now if key not in OF_EVERY_REPLAY and was.get(key) != now.get(key)]
    return [(key, was.get(key, "-")[:80], now.get(key, "-")[:80]) for key in keys[:_LINES]]


def _cut(lines: list[str]) -> list[str]:
    if len(lines) <= _LINES:
        return lines or ["none"]
    return [*lines[:_LINES], f"... {len(lines) - _LINES} lines more in the session"]
