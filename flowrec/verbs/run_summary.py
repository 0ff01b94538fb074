"""The result of `flowrec record`: files, figures, exit status, and what is said at the end of a run."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from flowrec.core import (
    Coverage,
    Figures,
    FlowField,
    Outcome,
    body_lines,
    doubts_of,
    end_text,
    flow_text,
    name_of,
    say,
    shell_word,
    text_of_figure,
    warn,
    way_text,
)
from flowrec.physics import Chip
from flowrec.run import RunReport
from flowrec.stages import MotionOfRun, Pipeline, ResolvedConfig, TrackQuality, map_doubts
from flowrec.stages import figures_of as figures_of_ticks
from flowrec.store import is_snapshot

# What is said at the end of a run where there is any.
_ALSO = (
    *("contacts", "frames_dropped", "speed_limit_um_s", "latest_goal"),
    *("covered", "note_movie", "note_not_finished", "rrd"),
)
# The mission was completed, or was ended on purpose.
GOOD_ENDS = frozenset(
    outcome for outcome in Outcome if outcome.completes_mission or outcome in (Outcome.STOPPED, Outcome.TIME_OVER)
)


@dataclass(frozen=True, slots=True)
class Recorded:
    """The result of a recording.

    Attributes
    ----------
    path : of the run, also where it is in several files.
    report : how the loop went.
    facts : figures, with the unit in the key.
    files : in order; none if only the time around events was to be recorded, and there was no event.
    derived : settings that were derived because they were not given, by key.
    lost : why the run was ended early by the disk monitor; '' if it was not.
    stopped : a person or a signal ended it.
    source : of a movie: facts about it, and the alignment of its log as JSON; as in the head of the session.
    covered : of a movie: how many of its images were taken; None of a run, which ends when somebody ends it.
    """

    path: Path
    report: RunReport
    facts: Figures
    files: tuple[Path, ...] = ()
    derived: Mapping[str, float] = field(default_factory=dict)
    lost: str = ""
    stopped: bool = False
    source: Mapping[str, str] = field(default_factory=dict)
    covered: Coverage | None = None

    @property
    def sessions(self) -> tuple[Path, ...]:
        """Paths that other verbs can open: the run, or each of its snapshots."""
        return self.files if any(map(is_snapshot, self.files)) else (self.path,) if self.files else ()

    @property
    def exit_status(self) -> int:
        """0 reached its end, 1 did not, 3 was ended early by the disk monitor or is doubtful; 130, 143 was stopped."""
        if self.lost:
            return 3
        if self.covered is not None and self.covered.stopped:
            return self.covered.status
        if self.report.outcome not in GOOD_ENDS:
            return 1
        return 3 if self.doubts else 0

    @property
    def doubts(self) -> list[str]:
        """Reasons to doubt the result; none if there is no reason."""
        return doubts_of(self.facts)

    def as_json(self) -> dict[str, Any]:
        derived = {"derived": dict(self.derived), "files": [*map(str, self.files)]}
        return {"path": str(self.path), **self.facts, **derived}

    def lines(self) -> list[str]:
        """The end of the run and what was won, as text: outcome, way, flow, files; what is not known is left out."""
        facts = self.facts
        ended = f"{end_text(facts)}, computed in {text_of_figure('wall_s', facts['wall_s'])}"
        also = [f"{name_of(key)}: {text_of_figure(key, facts[key])}" for key in _ALSO if facts.get(key)]
        also += body_lines(facts)
        won = ["; ".join(filter(None, (ended, way_text(facts)))), flow_text(facts)]
        return [*filter(None, won), *also, f"file: {files_text(self.path, self.files)}"]

    def show(self) -> None:
        """Print how the run ended, and what to do next."""
        for line in self.lines():
            say(line)
        sessions, report, covered = self.sessions, self.report, self.covered
        if self.lost:
            say(
                f"flowrec: the run was ended early, its file is whole: {self.lost}; free some space before the next one"
            )
        elif covered is not None and covered.stopped:
            say(f"flowrec: {covered.text}; the session holds those, and no more is known of the movie")
        for doubt in self.doubts:
            warn(f"doubtful: {doubt}")
        if sessions:
            refined = self.facts.get("refined_method") not in (None, "fvm") and "not_refined" not in self.facts
            session = shell_word(sessions[0])
            first = f"replay {session} --refine" if refined else f"export {session} tables --format csv"
            verbs = [first, f"view {session}"] if report.outcome in GOOD_ENDS else [f"view {session}"]
            say(f"next: {'    '.join(f'flowrec {each}' for each in verbs)}")


def judges_of(pipeline: Pipeline) -> tuple[TrackQuality, MotionOfRun]:
    """Sinks of the ticks of a run, whose `doubts` are then the reasons to doubt its track and its axes."""
    return TrackQuality(pipeline.calibration, pipeline.image_shape, pipeline.robot), MotionOfRun(pipeline.robot)


def figures_of(chip: Chip, report: RunReport, true_field: FlowField | None) -> Figures:
    """The figures of a run in the order of the table; flow errors are relative to the true flow."""
    ran: Figures = {
        "outcome": report.outcome,
        "note": report.note,
        "duration_s": report.duration_s,
        "wall_s": report.wall_s,
        "ticks": report.ticks,
    }
    return ran | figures_of_ticks(chip, report.last, true_field, report.contacts, report.navigating_ns)


def judge_refinement(
    refined: FlowField | None, config: ResolvedConfig, *, known_doubts: bool, still: bool
) -> tuple[dict[str, str], list[str]]:
    """Facts and doubts about the refined flow of a run; its scale is not doubted again if the walls' is.

    In an open field that nothing drives, `still`, nobody asked for a flow.
    """
    facts: dict[str, str] = {}
    doubts: list[str] = []
    if refined is None:
        return facts, doubts
    doubts += map_doubts(refined, config.camera.um_per_px, scale_known=known_doubts)
    if refined.refused and refined.log_score is None and not still:
        if config.refine.observes_flow:
            doubts.append(f"the flow was not refined: {refined.refused}")
        else:  # a movie without a log: nothing was asked that was not done
            facts["not_refined"] = f"because {refined.refused}"
    return facts, doubts


def files_text(path: Path, files: tuple[Path, ...]) -> str:
    """Names and sizes of the files of a run, as text."""
    if not files:
        return "none: no mark, note, warning or loss of images, and a good end"
    size = f"{sum(file.stat().st_size for file in files) / 1e6:.1f} MB"
    if len(files) == 1:
        return f"{files[0]} ({size})"
    kind = "snapshots" if is_snapshot(files[0]) else "parts"
    return f"{len(files)} {kind}, {files[0]} to {files[-1].name} ({size} in all)"
