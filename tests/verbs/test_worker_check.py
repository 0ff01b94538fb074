"""What `replay --verify` says of a result of the worker whose words or numbers are not those of today."""

from dataclasses import replace
from pathlib import Path

import flowrec
from flowrec.run import work
from flowrec.stages import assemble
from flowrec.verbs.comparison import Comparison, Side
from flowrec.verbs.replay_result import WorkerCheck, WorkerResults


def test_a_note_that_reads_otherwise_today_is_told_and_only_its_numbers_are_judged(session: Path) -> None:
    opened = flowrec.open(session)
    order, after = {}, None
    for tick in opened.reader.ticks():
        if tick.mission is not None and tick.mission.wanted:
            order.setdefault(tick.mission.request, tick)
        if after is None and tick.refined is not None:
            after = tick
    asked = order[after.refined.request]
    pipeline = assemble(opened.config, opened.chip)
    result = replace(work(pipeline, asked), stamp_ns=after.stamp_ns)

    def said(adopted, computed=1):
        sides = Side.of("recorded", opened), Side.of("replayed", opened)
        results = WorkerResults(Comparison(sides=sides))
        check = WorkerCheck(pipeline, replace(asked, mission=None), None, results)
        check.add(asked)
        check.add(replace(after, refined=adopted))
        assert (results.adopted, results.computed) == (1, computed)
        return results.comparison, results.lines[-1]

    same, line = said(replace(result, note="assimilated 8 observations; the image scale is larger than stated"))
    assert same.identical and line.endswith(f": identical; its note reads otherwise now: {result.note}")
    assert said(result)[1].endswith(": identical")
    other, line = said(replace(result, note="assimilated 8 observations", velocity_um_s=1.01 * result.velocity_um_s))
    assert not other.same and "DIFFERENT" in line and "its note reads otherwise now" in line
    other, line = said(replace(result, request=asked.mission.request + 1), computed=0)  # of an order that is not there
    assert not other.same and "DIFFERENT" in line
