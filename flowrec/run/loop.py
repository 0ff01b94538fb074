"""The one loop. Record and replay differ only in the rig and in where the worker's results come from."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, Protocol

from flowrec.clocks import ClockWatch
from flowrec.enums import WorkOrder
from flowrec.errors import RigError
from flowrec.messages import Currents, FlowField, Mission, OperatorEvent, Route, Tick, Timing
from flowrec.pipeline import Inputs, Pipeline, step, with_inputs
from flowrec.rigs.frame_checks import Arrivals
from flowrec.run.control import Desk
from flowrec.run.jobs import work
from flowrec.run.watchdog import Guard
from flowrec.run.worker_process import WorkProcess
from flowrec.topics import ANSWERED_BY, WORKER_FIELDS
from flowrec.units import nanoseconds, seconds

SWITCH_S = 1e-4
_PASSED_OVER = 50  # frames in a row, then the robot is out of control


class Rig(Protocol):
    """Camera and coils. Leaving the context zeroes the coils.

    `zero` is for emergencies: it is called by another thread than the other methods (guard.py), at any time from before
    the context is entered until the process ends, also while `inputs` or `apply` is at work or stuck in a driver.
    """

    def __enter__(self) -> Rig: ...

    def __exit__(self, *error: object) -> None: ...

    def inputs(self) -> Iterator[Inputs]:
        """What arrives, frame by frame."""

    def apply(self, currents: Currents) -> None:
        """Send a command to the coils."""

    def zero(self) -> None:
        """Take the field away now; until the rig is entered again `apply` lets none back. A second call is harmless.

        Raises
        ------
        RigError : the hardware has refused; it is called again.
        """


class Sink(Protocol):
    """Takes every tick and must not keep the loop waiting."""

    def write(self, tick: Tick) -> None:
        """Take one tick."""


class Worker(Protocol):
    """Does the slow stages beside the loop."""

    def submit(self, order: Tick) -> None:
        """Start on `order.mission`."""

    def due(self, stamp_ns: int) -> Mapping[str, FlowField | Route]:
        """Results to be adopted on the tick of this stamp, by field of Tick."""

    def close(self) -> None:
        """Let go of processes."""


def _answered_by(mission: Mission) -> str:
    """The field of Tick that the result of the pending work order goes to."""
    return ANSWERED_BY[WorkOrder(mission.wanted)]


class LockstepWorker:
    """Adopts each result a fixed time after its order: same seed, same session, however fast the machine is.

    `schedule` (request number to stamp) overrides the time: a replay adopts where the recording did. Orders for
    fields outside `fills` are somebody else's (in a replay: recorded).
    """

    def __init__(
        self,
        pipeline: Pipeline,
        adopt_after_s: float,
        schedule: Mapping[int, int] | None = None,
        fills: Iterable[str] = WORKER_FIELDS,
    ) -> None:
        self._pipeline = pipeline
        self._after_ns = nanoseconds(adopt_after_s)
        self._schedule = dict(schedule or {})
        self._fills = frozenset(fills)
        self._order: Tick | None = None

    def submit(self, order: Tick) -> None:
        assert order.mission is not None
        if _answered_by(order.mission) in self._fills:
            self._order = order

    def due(self, stamp_ns: int) -> Mapping[str, FlowField | Route]:
        if self._order is None:
            return {}
        mission = self._order.mission
        assert mission is not None
        if stamp_ns < self._schedule.get(mission.request, mission.requested_ns + self._after_ns):
            return {}
        return {_answered_by(mission): replace(self.drain(), stamp_ns=stamp_ns)}

    def drain(self) -> FlowField | Route:
        """Do the pending order now."""
        assert self._order is not None
        order, self._order = self._order, None
        return work(self._pipeline, order)

    @property
    def pending(self) -> bool:
        """Whether an order waits."""
        return self._order is not None

    def close(self) -> None:
        """Nothing is held."""


class ProcessWorker:
    """Works in a process of its own, so that the control loop of a live run never waits for it."""

    def __init__(self, pipeline: Pipeline) -> None:
        self._process = WorkProcess(pipeline)
        self._fills = ""  # of the order that is being worked on

    def submit(self, order: Tick) -> None:
        assert order.mission is not None
        self._fills = _answered_by(order.mission)
        needed = {name: getattr(order, name) for name in WORKER_FIELDS[self._fills].reads}
        self._process.submit(Tick(order.stamp_ns, mission=order.mission, **needed))

    def due(self, stamp_ns: int) -> Mapping[str, FlowField | Route]:
        result = self._process.result() if self._fills else None
        if result is None:
            return {}
        fills, self._fills = self._fills, ""
        return {fills: replace(result, stamp_ns=stamp_ns)}

    def close(self) -> None:
        self._process.close()


class Preloaded:
    """A worker whose first results are fields of an earlier session, adopted on the first tick."""

    def __init__(self, worker: Worker, fields: Mapping[str, FlowField]) -> None:
        self._worker = worker
        self._fields = dict(fields)

    def submit(self, order: Tick) -> None:
        self._worker.submit(order)

    def due(self, stamp_ns: int) -> Mapping[str, FlowField | Route]:
        fields, self._fields = self._fields, {}
        return {name: replace(field, stamp_ns=stamp_ns, request=0) for name, field in fields.items()} | dict(
            self._worker.due(stamp_ns)
        )

    def close(self) -> None:
        self._worker.close()


@dataclass(slots=True)
class RunReport:
    """How a run went, for the outcome record and the summary."""

    outcome: str = "time over"
    note: str = ""
    ticks: int = 0
    duration_s: float = 0.0
    wall_s: float = 0.0
    contacts: int = 0
    passed_over: int = 0  # frames whose stamp did not grow
    last: Tick = field(default_factory=Tick)


def run(
    pipeline: Pipeline,
    rig: Rig,
    worker: Worker,
    sinks: Sequence[Sink],
    start: Tick | None = None,
    desk: Desk | None = None,
    on_tick: Callable[[Tick], None] | None = None,
    queue_state: Callable[[], tuple[float, int]] = lambda: (0.0, 0),
    end_when_finished: bool = True,
    clocks: ClockWatch | None = None,
    guard: Guard | None = None,
) -> RunReport:
    """Run until the rig ends, the mission is finished and the coils are at zero, or somebody stops it at the `desk`.

    However it ends, the guard takes the field away before anything else is done. `guard` is that of this rig; None: one
    without a timer. `start` is the tick to resume from; `queue_state` tells MB waiting for the disk and frames dropped.
    A stage that fails leaves its inputs, and only those, as the last tick in the sinks. A frame whose stamp does not
    grow enters no stage and is counted; `clocks` has it told, with what else clocks do, in the record. Frames are
    checked on arrival where `end_when_finished`, so not in a replay: its inputs hold what was found.

    Raises
    ------
    RigError : the rig can not go on, or its zero() has failed. Besides, what stages, rig, worker and sinks raise.
    """
    report = RunReport()
    desk = desk if desk is not None else Desk()
    guard = guard if guard is not None else Guard(rig, tripped=partial(desk.stop, zero=True))
    tick = ended = start if start is not None else Tick()
    first_ns: int | None = None
    clock = time.perf_counter
    began = clock()
    laps: dict[str, float] = {}
    mark = clock()
    sinks_ms = 0.0

    def lap(stage: str) -> None:
        nonlocal mark
        now = clock()
        laps[stage] = (now - mark) * 1e3
        mark = now

    with ExitStack() as stack:
        # Reader and writer threads need the interpreter for moments only; at the default of 5 ms each of their turns
        # may cost a tick as much.
        stack.callback(sys.setswitchinterval, sys.getswitchinterval())
        sys.setswitchinterval(SWITCH_S)
        stack.callback(worker.close)
        stack.enter_context(guard.running())
        stack.enter_context(rig)
        stack.callback(guard.field_off)
        stack.enter_context(desk.left_when_late())
        growing = _growing(rig.inputs(), tick.stamp_ns, report, clocks)
        arrivals = map(Arrivals(pipeline.image_shape).check, growing) if end_when_finished else growing
        while True:
            with desk.interruptible:
                arrived = next(arrivals, None)
            if arrived is None or desk.overdue or (desk.reason and not end_when_finished):
                break
            desk.ticking = True
            begin = mark = clock()
            stamp_ns = arrived.stamp_ns
            none: Mapping[str, FlowField | Route] = {}
            due: dict[str, Any] = dict(desk.unless_stopped(partial(worker.due, stamp_ns), none))
            held = tick.mission is not None and tick.mission.held_since_ns is not None
            asked = desk.next(stamp_ns, held) if end_when_finished else None
            inputs = replace(arrived, **due) if asked is None else replace(arrived, **due, operator=asked)
            last = tick
            mark = clock()
            try:
                with desk.interruptible:
                    tick = step(pipeline, last, inputs, lap)
            except Exception:
                guard.take_away()
                _write(sinks, with_inputs(last, inputs))
                raise
            assert tick.currents is not None
            assert tick.mission is not None
            with desk.interruptible:
                guard.apply(tick.currents)
            if tick.mission.wanted and (last.mission is None or tick.mission.request != last.mission.request):
                worker.submit(tick)
            lap("apply")
            queue_mb, dropped = queue_state()
            timing = Timing(
                stamp_ns=tick.stamp_ns,
                track_ms=laps["track"],
                observe_ms=laps["observe"],
                control_ms=laps["control"] + laps["apply"],
                sinks_ms=sinks_ms,  # of the tick before: this one's are still to come
                total_ms=(clock() - begin) * 1e3 + sinks_ms,
                queue_mb=queue_mb,
                dropped_frames=dropped,
            )
            recorded = replace(tick, timing=timing, truth=inputs.truth, true_field=inputs.true_field)
            if clocks is not None:
                recorded = replace(recorded, clocks=clocks.see(tick.stamp_ns, inputs.clock))
            _write(sinks, recorded)
            lap("sinks")
            sinks_ms = laps["sinks"]
            first_ns = tick.stamp_ns if first_ns is None else first_ns
            report.ticks += 1
            report.duration_s = seconds(tick.stamp_ns - first_ns)
            report.contacts = inputs.truth.contacts if inputs.truth is not None else report.contacts
            if on_tick is not None:
                on_tick(recorded)
            ended = tick
            guard.tick_ended()
            at_rest = tick.mission.finished and tick.currents.amplitude_mt == 0.0
            if end_when_finished and at_rest and not desk.pending:
                break
    report.wall_s = clock() - began
    report.last = tick = ended
    still_on = desk.reason and tick.currents is not None and tick.currents.amplitude_mt > 0.0
    cut_by = ("" if desk.overdue else desk.zero_waiting) or (desk.reason if still_on else "")
    if cut_by and end_when_finished and report.ticks:
        # No tick has come to say so: the file tells without one.
        since_ns = max(nanoseconds(guard.clock() - guard.ticked_s), 1)
        told = OperatorEvent(tick.stamp_ns + since_ns, "zero", cut_by)
        _write(sinks, replace(tick, stamp_ns=told.stamp_ns, operator=told))
    if tick.mission is not None and tick.mission.finished:
        report.outcome, report.note = tick.mission.outcome, tick.mission.note
    elif desk.reason:  # no tick came to say so
        report.outcome, report.note = "stopped", desk.reason
    if still_on:
        report.note += "; the coils were switched off before they were down their ramp"
    if guard.hung:
        report.outcome, report.note = "failed", guard.reason
    if guard.failures:
        report.note += f"; the coils' zero() worked after {guard.failures} failures"
    return report


def _write(sinks: Sequence[Sink], tick: Tick) -> None:
    for sink in sinks:
        sink.write(tick)


def _growing(inputs: Iterator[Inputs], after_ns: int, report: RunReport, clocks: ClockWatch | None) -> Iterator[Inputs]:
    """Inputs whose stamps grow. How far the field has turned since the frame before is not lost with one passed over.

    Raises
    ------
    RigError : nothing else comes, so nobody steers any more.
    """
    lost: list[Inputs] = []
    for arrived in inputs:
        if arrived.stamp_ns > after_ns:
            turns = sum((one.applied.turns for one in lost), arrived.applied.turns)
            yield replace(arrived, applied=replace(arrived.applied, turns=turns)) if lost else arrived
            after_ns = arrived.stamp_ns
            lost.clear()
            continue
        lost.append(arrived)
        report.passed_over += 1
        if clocks is not None:
            clocks.pass_over()
        if len(lost) == _PASSED_OVER:
            raise RigError(
                f"the rig's frames have gone back in time by {seconds(after_ns - arrived.stamp_ns):.3f} s, {len(lost)}"
                " in a row; see to the camera's clock, then record again"
            )
