"""The result of a replay: its comparison with the recording and, for `--verify`, worker results and file digests."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from flowrec.commands.compare import Comparison
from flowrec.config import ResolvedConfig
from flowrec.enums import WorkOrder
from flowrec.errors import printable
from flowrec.messages import Mission
from flowrec.pipeline import Pipeline
from flowrec.replay_figures import CommandDifference
from flowrec.run.loop import RunReport
from flowrec.run.workers import work
from flowrec.session import Session
from flowrec.store.audit import digest_faults
from flowrec.topics import ANSWERED_BY, BY_FIELD, WORKER_FIELDS, Tick


@dataclass(slots=True)
class WorkerResults:
    """How the recorded results of the worker compare with those that were computed again.

    Attributes
    ----------
    comparison : of the messages.
    lines : a line of text for each result.
    """

    comparison: Comparison
    lines: list[str] = field(default_factory=list)

    def followed_by(self, later: WorkerResults) -> None:
        """Add what was compared in the ticks that follow."""
        self.comparison.followed_by(later.comparison)
        self.lines += later.lines


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
            if adopted is None or adopted is getattr(self._last, name) or adopted.request in self._unknown:
                continue
            order = self._orders.pop(adopted.request, None)
            computed = replace(work(self._pipeline, order), stamp_ns=tick.stamp_ns) if order is not None else None
            topic = BY_FIELD[name]
            comparison = self.results.comparison
            found = comparison.add_pair(topic, adopted, computed, tick.stamp_ns)
            how = "identical"
            if found is not None:
                how = f"{comparison.different_word if found.beyond else 'within tolerance'}: {found}"
            self.results.lines.append(printable(f"{topic.path} {adopted.method}: {how}"))
        mission = tick.mission
        if mission is not None and mission.wanted and mission.request > self._ordered:
            self._ordered = mission.request
            self._orders[mission.request] = tick
        self._last = tick


def _knows_more(order: Tick, mission: Mission, reads: Iterable[str]) -> bool:
    """Whether a part of a run begins after an order, and its keyframe holds later messages that the work reads."""
    read = [getattr(order, name) for name in reads]
    return any(message is not None and message.stamp_ns > mission.requested_ns for message in read)


def digest_lines(path: Path) -> tuple[bool, list[str]]:
    """Whether the files of a session match their digests, and lines of text about it."""
    lines = []
    intact = True
    for file, faults in digest_faults(path).items():
        if faults is None:
            lines.append(printable(f"{file.name}: no digest, recorded by an older flowrec"))
        elif faults:
            intact = False
            lines += [printable(f"{file.name}: DIFFERENT from its digest: {fault}") for fault in faults]
    return intact, lines or ["all messages and the header match the digest"]


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
    worker : of --verify: the results of the worker.
    digest : of --verify: whether the files match their digests, and lines of text about it.
    """

    session: Session
    config: ResolvedConfig
    report: RunReport
    recorded: Tick
    replayed: Tick
    comparison: Comparison
    commands: CommandDifference
    frames_missing: int
    worker: WorkerResults | None = None
    digest: tuple[bool, list[str]] = (True, [])

    @property
    def same(self) -> bool:
        """Whether everything that was compared is the same within its tolerance, and the files are unchanged."""
        return self.digest[0] and all(comparison.same for comparison in self._comparisons)

    @property
    def identical(self) -> bool:
        """The same bit for bit."""
        return self.digest[0] and all(comparison.identical for comparison in self._comparisons)

    @property
    def _comparisons(self) -> list[Comparison]:
        return [self.comparison, *([self.worker.comparison] if self.worker is not None else [])]

    def lines(self) -> list[str]:
        """How the replay compares with the recording, the conclusion last."""
        lines = self.comparison.lines()
        if self.worker is not None:
            lines += self.worker.lines
        lines += self.digest[1]
        if self.frames_missing:
            lines.append(f"{self.frames_missing} frames are not in the file; the recorded tracks were used instead")
        first = next((each.first for each in self._comparisons if each.first is not None), None)
        if first is not None:
            lines.append(f"first difference: {first}")
        differs = self.comparison.other_numerics if self.digest[0] else ""
        conclusion = "every tick identical" if self.identical else "the same within tolerance"
        if not self.same:
            conclusion = differs or "NOT the same"
            if differs and self.comparison.same:
                conclusion = f"the same within tolerance; results of the worker {differs}"
        lines.append(f"{self.comparison.ticks} ticks: {conclusion}")
        return lines

    def as_json(self) -> dict[str, Any]:
        """The same in numbers, with the lines."""
        found = [comparison.as_json() for comparison in self._comparisons]
        return found[0] | {
            "same": self.same,
            "identical": self.identical,
            "topics": {name: count for each in found for name, count in each["topics"].items()},
            "first": next((each["first"] for each in found if each["first"] is not None), None),
            "digest_faults": [] if self.digest[0] else self.digest[1],
            "lines": self.lines(),
        }
