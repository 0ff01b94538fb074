"""The result of a replay: its comparison with the recording and, for `--verify`, worker results and file digests."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from flowrec.core import ANSWERED_BY, BY_FIELD, WORKER_FIELDS, Coverage, FlowField, Mission, Tick, WorkOrder, printable
from flowrec.run import CommandDifference, RunControl, RunReport, work
from flowrec.stages import Pipeline, ResolvedConfig
from flowrec.store import Session, digest_faults
from flowrec.verbs.comparison import Comparison

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
        if _knows_more(order, mission, WORKER_FIELDS[answer].reads):
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


def _knows_more(order: Tick, mission: Mission, reads: Iterable[str]) -> bool:
    """True if a part of a run begins after an order, and its keyframe holds later messages that the work reads."""
    read = [getattr(order, name) for name in reads]
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


@dataclass(slots=True)
class Replayed:
    """The result of a replay.

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
