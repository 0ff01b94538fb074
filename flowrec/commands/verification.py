"""What `flowrec replay --verify` checks besides the ticks: results of the worker, and the digests of the files."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from flowrec.commands.compare import Comparison
from flowrec.enums import WorkOrder
from flowrec.errors import printable
from flowrec.messages import FlowField, Route, Tick
from flowrec.pipeline import Pipeline
from flowrec.run.workers import work
from flowrec.store.audit import digest_faults
from flowrec.topics import ANSWERED_BY, BY_FIELD, WORKER_FIELDS


class WorkerCheck:
    """Carries out every recorded work order again and compares the adopted result within the tolerance of its topic.

    Parameters
    ----------
    pipeline : the stages as recorded.
    start : the tick before the first one of the replay.
    order : the tick of an order that is not yet answered there; None without one.
    comparison : takes the results.

    Attributes
    ----------
    results : a line of text for each result.
    """

    def __init__(self, pipeline: Pipeline, start: Tick, order: Tick | None, comparison: Comparison) -> None:
        self._pipeline = pipeline
        self._computed: dict[int, FlowField | Route] = {}  # by number of the order
        self._ordered = start.mission.request if start.mission is not None else 0
        self._last = start
        self._unknown = {0}  # orders that can not be carried out again; 0: fields of an earlier session
        self.comparison = comparison
        self.results: list[str] = []
        if order is None or order.mission is None:
            return
        mission, seen = order.mission, order.observations
        if mission.wanted == WorkOrder.REFINE and seen is not None and seen.stamp_ns > mission.requested_ns:
            # Ordered before this part of a run begins, from fewer observations than its keyframe holds.
            self._unknown.add(mission.request)
            path = BY_FIELD[ANSWERED_BY[WorkOrder.REFINE]].path
            self.results.append(f"{path}: ordered in the part before, taken as recorded")
        else:
            self._computed[mission.request] = work(pipeline, order)

    def add(self, tick: Tick) -> None:
        """Take the next tick: carry out a new order, compare newly adopted results."""
        for name in WORKER_FIELDS:
            adopted = getattr(tick, name)
            if adopted is None or adopted is getattr(self._last, name) or adopted.request in self._unknown:
                continue
            computed = self._computed.pop(adopted.request, None)
            computed = replace(computed, stamp_ns=tick.stamp_ns) if computed is not None else None
            topic = BY_FIELD[name]
            found = self.comparison.add_pair(topic, adopted, computed, tick.stamp_ns)
            how = "identical"
            if found is not None:
                how = f"{self.comparison.different_word if found.beyond else 'within tolerance'}: {found}"
            self.results.append(printable(f"{topic.path} {adopted.method}: {how}"))
        mission = tick.mission
        if mission is not None and mission.wanted and mission.request > self._ordered:
            self._ordered = mission.request
            self._computed[mission.request] = work(self._pipeline, tick)
        self._last = tick


def digest_lines(path: Path) -> tuple[bool, list[str]]:
    """Whether the files of a session hold what was recorded, by their digests, and lines of text about it."""
    lines = []
    intact = True
    for file, faults in digest_faults(path).items():
        if faults is None:
            lines.append(printable(f"{file.name}: no digest, recorded by an older flowrec"))
        elif faults:
            intact = False
            lines += [printable(f"{file.name}: DIFFERENT from its digest: {fault}") for fault in faults]
    return intact, lines or ["all messages and the head are as the digest says"]
