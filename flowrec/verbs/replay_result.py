"""The result of a replay: its messages, its comparison with the recording, what it changed; worker, digests."""

from __future__ import annotations

import html
import math
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from flowrec.core import (
    ANSWERED_BY,
    BY_FIELD,
    WORKER_FIELDS,
    Coverage,
    FlowField,
    Mission,
    Row,
    Tick,
    UsageError,
    WorkOrder,
    comparison_for_people,
    needs,
    printable,
    say,
    table,
    verdict_lines,
    warn,
    with_micro,
)
from flowrec.run import CommandDifference, ReplayPair, RunControl, RunReport, before_after, messages_read, work
from flowrec.stages import Pipeline, ResolvedConfig
from flowrec.store import Session, digest_faults
from flowrec.verbs.comparison import Comparison

if TYPE_CHECKING:
    import pandas
    import pyarrow as pa

_SAME_MAP = 1e-3  # of the largest speed: smaller changes are not visible in any table
CONSISTENT = "head and messages: consistent with their digest, unsigned: whoever can edit the file can edit both"


@dataclass(slots=True)
class WorkerResults:
    """Comparison of the recorded results of the worker with those that were computed again.

    Attributes
    ----------
    comparison : of the messages.
    lines : a line of text for each result.
    adopted, computed : results of this run that the loop adopted, and how many of them were computed again.
    """

    comparison: Comparison
    lines: list[str] = field(default_factory=list)
    adopted: int = 0
    computed: int = 0

    def followed_by(self, later: WorkerResults) -> None:
        """Add what was compared in the ticks that follow."""
        self.comparison.followed_by(later.comparison)
        self.lines += later.lines
        self.adopted += later.adopted
        self.computed += later.computed


class WorkerCheck:
    """Computes every recorded work order again and compares the adopted result within the tolerance of its topic.

    Parameters
    ----------
    pipeline : the stages as recorded.
    start : the tick before the first one of the replay.
    order : the tick of an order whose result is not yet adopted at `start`; None without one.
    results : receives what is found.
    """

    def __init__(self, pipeline: Pipeline, start: Tick, order: Tick | None, results: WorkerResults) -> None:
        self._pipeline = pipeline
        self._orders: dict[int, Tick] = {}  # by number; computed when the result was adopted, if it ever was
        self._ordered = start.mission.request if start.mission is not None else 0
        self._last = start
        self._unknown = {0}  # orders that can not be computed again; 0: fields of an earlier session
        self.results = results
        if order is None or order.mission is None:
            return
        mission = order.mission
        answer = ANSWERED_BY[WorkOrder(mission.wanted)]
        if _knows_more(order, mission, answer):
            self._unknown.add(mission.request)
            path = BY_FIELD[answer].path
            self.results.lines.append(f"{path}: ordered in the part before, taken as recorded")
        else:
            self._orders[mission.request] = order

    def add(self, tick: Tick) -> None:
        """Take the next tick: note a new order, compute and compare newly adopted results."""
        for name in WORKER_FIELDS:
            adopted = getattr(tick, name)
            if adopted is None or adopted is getattr(self._last, name):
                continue
            self.results.adopted += adopted.request != 0
            if adopted.request in self._unknown:
                continue
            order = self._orders.pop(adopted.request, None)
            computed = replace(work(self._pipeline, order), stamp_ns=tick.stamp_ns) if order is not None else None
            self.results.computed += computed is not None
            topic = BY_FIELD[name]
            comparison = self.results.comparison
            # The words about a result may have been mended since: they are told, and only what was computed is judged.
            words = ""
            if isinstance(computed, FlowField) and isinstance(adopted, FlowField) and computed.note != adopted.note:
                words = f"; its note reads otherwise now: {computed.note}"
                computed = replace(computed, note=adopted.note)
            found = comparison.add_pair(topic, adopted, computed, tick.stamp_ns)
            how = "identical"
            if found is not None:
                how = f"{comparison.different_word if found.beyond else 'within tolerance'}: {found}"
            self.results.lines.append(printable(f"{topic.path} {adopted.method}: {how}{words}"))
        mission = tick.mission
        if mission is not None and mission.wanted and mission.request > self._ordered:
            self._ordered = mission.request
            self._orders[mission.request] = tick
        self._last = tick


def _knows_more(order: Tick, mission: Mission, answer: str) -> bool:
    """True if a part of a run begins after an order, and its keyframe holds later messages that the work reads."""
    read: list[Any] = [*messages_read(order, answer).values()]
    return any(message is not None and message.stamp_ns > mission.requested_ns for message in read)


def digest_lines(path: Path) -> tuple[bool, list[str]]:
    """True if the files of a session match their digests, and lines of text about it."""
    lines = []
    intact = True
    for file, faults in digest_faults(path).items():
        if faults is None:
            lines.append(printable(f"{file.name}: no digest, recorded by an older flowrec"))
        elif faults:
            intact = False
            lines += [printable(f"{file.name}: damaged or edited at {fault}") for fault in faults]
    return intact, lines or [CONSISTENT]


class BeforeAfter(tuple[Row, ...]):
    """Rows of key, recorded and replayed value; the keys carry the unit. As text and in a notebook it is a table."""

    __slots__ = ()

    def to_pandas(self) -> pandas.DataFrame:
        """The columns recorded and replayed, a row a key; UsageError if pandas is not installed."""
        with needs("to_pandas", "export"):
            import pandas
        columns = {"recorded": [row[1] for row in self], "replayed": [row[2] for row in self]}
        return pandas.DataFrame(columns, index=pandas.Index([row[0] for row in self], name="quantity"), dtype=object)

    def __str__(self) -> str:
        shown = [("", "recorded", "replayed"), *comparison_for_people(self)]
        widths = [max(len(row[column]) for row in shown) for column in range(3)]
        return "\n".join(f"{a:<{widths[0]}}  {b:>{widths[1]}}  {c:>{widths[2]}}" for a, b, c in shown)

    def _repr_html_(self) -> str:
        rows = "".join(
            "<tr>" + "".join(f"<td>{html.escape(with_micro(cell))}</td>" for cell in row) + "</tr>"
            for row in comparison_for_people(self)
        )
        return f"<table><tr><th></th><th>recorded</th><th>replayed</th></tr>{rows}</table>"


@dataclass(repr=False)
class Replay:
    """A replay: its comparison with the recording, and all of its messages.

    Attributes
    ----------
    session : what was replayed, with the recorded configuration.
    config : the configuration of the replay.
    report : how the loop went.
    recorded, replayed : the last tick, as recorded and as replayed.
    comparison : of the outputs of both, tick by tick.
    commands : of the demands of both.
    frames_missing : images that are not in the file.
    covered : the ticks that were replayed and compared, of those that were asked for.
    worker : of --verify: the results of the worker.
    digest : of --verify: whether the files match their digests, and lines of text about it; None: they were not read.
    doubts : why what was written is doubtful; none if it is not, or nothing was written.
    packages : where a stage is by another version of a package of others, or by other code of it, than recorded.
    file : the session of the replay; None if none was written.
    reflown : rows about the flights of both plans.
    result : `file`, open, without images unless they were asked for. Without `out` it is a temporary file, which goes
        when this object goes.
    before_after : what the replay changed: errors, routes, times, commands; and how both plans were flown.
    """

    session: Session
    config: ResolvedConfig
    report: RunReport
    recorded: Tick
    replayed: Tick
    comparison: Comparison
    commands: CommandDifference
    frames_missing: int
    covered: Coverage
    worker: WorkerResults | None = None
    digest: tuple[bool, list[str]] | None = None
    doubts: list[str] = field(default_factory=list)
    packages: list[str] = field(default_factory=list)
    file: Path | None = None
    reflown: list[Row] = field(default_factory=list)

    @cached_property
    def result(self) -> Session:
        if self.file is None:
            raise UsageError("this verification wrote no session: it only compares")
        return Session(self.file)

    def __repr__(self) -> str:
        return f"Replay({str(self.session.path)!r}: {self.covered.text})"

    def _repr_html_(self) -> str:
        """Sentences as in all pictures and the table of changes; of a verification its conclusion and its lines."""
        changed = self.worker is None
        title = f"Replay of {self.session.path.name}: {self.covered.text}" if changed else self.lines()[-1]
        doubts = [f"Doubtful: {doubt}" for doubt in self.doubts]
        told = [*doubts, *verdict_lines({}, self.replayed.refined)] if changed else self.lines()[:-1]
        sentences = "".join(f"<div>{html.escape(with_micro(printable(text)))}</div>" for text in told)
        shown = self.before_after._repr_html_() if changed else ""
        return f"<div><b>{html.escape(printable(title))}</b>{sentences}{shown}</div>"

    def table(self, topic: str) -> pa.Table:
        """All messages of one topic of the replay, as `Session.table`."""
        return self.result.table(topic)

    @cached_property
    def before_after(self) -> BeforeAfter:
        return BeforeAfter([*before_after(self), *self.reflown])

    @property
    def _remarks(self) -> list[str]:
        return [*self.packages, *refinement_remarks(self)]

    def changes_as_json(self) -> dict[str, Any]:
        """Changes of the replay, for JSON."""
        report = self.report
        figures = {"wall_s": report.wall_s, "duration_s": report.duration_s, "ticks": report.ticks}
        rows = [dict(zip(("quantity", "recorded", "replayed"), row, strict=True)) for row in self.before_after]
        doubts = {"doubts": "; ".join(self.doubts)} if self.doubts else {}
        return {"refinement": self._remarks, "rows": rows} | figures | {"covered": self.covered.as_json()} | doubts

    def show_changes(self, name: str) -> None:
        """Print what the replay changed, and what is doubtful of it."""
        report = self.report
        table(f"Replay of {name}", ("", "recorded", "replayed"), comparison_for_people(self.before_after))
        length = f"({report.duration_s:.1f} s) replayed in {report.wall_s:.1f} s"
        of_these = "; the figures are of those" if self.covered.stopped else ""
        say(f"{self.covered.text} {length}{of_these} -> {self.file}")
        for line in self._remarks:
            say(line)
        for doubt in self.doubts:
            warn(f"doubtful: {doubt}")

    @property
    def same(self) -> bool | None:
        """True if all that was asked for is the same within its tolerance, and the files match their digests.

        None if it was stopped before a difference was found.
        """
        return self._judge(self._same_so_far)

    @property
    def identical(self) -> bool | None:
        """True if `same` holds bit for bit; None as of `same`."""
        return self._judge(self._identical_so_far)

    @property
    def exit_status(self) -> int:
        """0 the same, 3 something differs, 130 or 143 stopped."""
        return self.covered.status if self.covered.stopped else 0 if self.same else 3

    def _judge(self, compared: bool) -> bool | None:
        if not compared or not self._intact:
            return False
        return None if self.covered.stopped else True

    @property
    def _intact(self) -> bool:
        """No difference from a digest is known."""
        return self.digest is None or self.digest[0]

    @property
    def _comparisons(self) -> list[Comparison]:
        return [self.comparison, *([self.worker.comparison] if self.worker is not None else [])]

    def lines(self) -> list[str]:
        """Comparison of the replay with the recording, in lines, the conclusion last."""
        lines = self.comparison.lines()
        if self.worker is not None:
            lines += self.worker.lines
            lines.append(f"slow results: {self.worker.computed} of {self.worker.adopted} computed again")
        if self.digest is not None:
            lines += self.digest[1]
        elif self.worker is not None:
            lines.append("not looked at: its digest")
        if self.frames_missing:
            lines.append(f"{self.frames_missing} frames are not in the file; the recorded tracks were used instead")
        lines += [printable(f"not looked at: {what}, {why}") for what, why in self.covered.left_out.items()]
        first = next((each.first for each in self._comparisons if each.first is not None), None)
        if first is not None:
            lines.append(f"first difference: {first}")
        return [*lines, *self.packages, self.covered.sentence(self._conclusion)]

    @property
    def _conclusion(self) -> str:
        """Conclusion about the ticks that were looked at."""
        if self.covered.stopped and self._same_so_far and self._intact:
            return "identical" if self._identical_so_far else "the same within tolerance"
        if self.identical:
            return "every tick identical"
        if self.same:
            return "the same within tolerance"
        differs = self.comparison.other_numerics if self._intact else ""
        if differs and self.comparison.same:
            return f"the same within tolerance; results of the worker {differs}"
        return differs or "NOT the same"

    @property
    def _same_so_far(self) -> bool:
        return all(comparison.same for comparison in self._comparisons)

    @property
    def _identical_so_far(self) -> bool:
        return all(comparison.identical for comparison in self._comparisons)

    def as_json(self) -> dict[str, Any]:
        """Comparison in numbers, with the lines; `same` and `identical` are null where a part was not looked at."""
        found = [comparison.as_json() for comparison in self._comparisons]
        topics = {name: count for each in found for name, count in each["topics"].items()}
        same, identical = self.same, self.identical
        whole = self.covered.whole
        covered = replace(self.covered, topics=tuple(topics), head=("digest",) if self.digest is not None else ())
        of_covered = {"same": self._same_so_far, "identical": self._identical_so_far}
        return found[0] | {
            "same": same if whole or same is False else None,
            "identical": identical if whole or identical is False else None,
            "covered": covered.as_json() | of_covered,
            "slow_results": None if self.worker is None else [self.worker.computed, self.worker.adopted],
            "topics": topics,
            "first": next((each["first"] for each in found if each["first"] is not None), None),
            "digest_faults": None if self.digest is None else [] if self.digest[0] else self.digest[1],
            "lines": self.lines(),
        }


def refinement_remarks(done: ReplayPair) -> list[str]:
    """Lines about the refinement of a replay; why, if it left the recorded map unchanged."""
    was, now = done.recorded.refined, done.replayed.refined
    if now is None:
        return []
    lines = [f"{now.method}: {now.note}"] if now.note else []
    if was is None or now is was or _largest_change(was, now) > _SAME_MAP:
        return lines
    why = ""
    if now.method == "pi_unet" and done.config.refine.pi_unet.start == "assimilate":
        why = (
            ": pi_unet begins with the assimilated map and keeps it where it explains the observations; with "
            "--set refine.pi_unet.start=fvm it begins with the assumed flow, as in the paper"
        )
    return [*lines, f"the refined map is the recorded one, unchanged{why}"]


def _largest_change(was: FlowField, now: FlowField) -> float:
    """Largest change of a velocity component relative to the largest component."""
    largest = float(np.abs(was.velocity_um_s).max())
    return float(np.abs(now.velocity_um_s - was.velocity_um_s).max()) / largest if largest else math.inf


def coverage_of(
    session: Session, ticks: int, between_ns: tuple[int | None, int], from_s: float | None, control: RunControl
) -> Coverage:
    """Coverage of a replay: the ticks that it has looked at, of those with inputs that it was asked for."""
    reader, (start_ns, end_ns) = session.reader, between_ns
    total = reader.counts.get("applied", 0)
    asked, left_out = total, {}
    if start_ns is not None or end_ns < reader.last_ns:
        asked = sum((start_ns or 0) <= stamp_ns <= end_ns for stamp_ns in reader.stamps("applied"))
    part = ""
    if from_s is not None:
        part, left_out = f"from {from_s:g} s on", {f"{total - asked} ticks before {from_s:g} s": "not asked for"}
    elif ticks < asked and not control.reason:
        left_out = {f"{asked - ticks} ticks": "hold neither image nor track, so there is nothing to replay"}
    return control.with_stop(Coverage(ticks, asked, "ticks", part, left_out=left_out))
