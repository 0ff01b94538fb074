"""The one loop. Record and replay differ only in the rig and in where the results of the slow stages come from."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, Protocol

import numpy as np

from flowrec.core import (
    NS_PER_S,
    Action,
    Applied,
    ClockMonitor,
    OperatorEvent,
    Outcome,
    Phase,
    Tick,
    Timing,
    nanoseconds,
    seconds,
)
from flowrec.rigs import Rig, checked_images, increasing_stamps
from flowrec.run.control import RunControl
from flowrec.run.watchdog import Watchdog
from flowrec.run.workers import Results, Worker
from flowrec.stages import Inputs, Pipeline, recorded_extra, step, with_inputs

SWITCH_S = 1e-4
_END_NS, _AFTER_NS = NS_PER_S // 1000, NS_PER_S // 2  # from the last frame to the tick of its end; between later ticks


class Joining(Protocol):
    """Adds to the inputs what others than the rig send, while it is entered as a context."""

    def __enter__(self) -> object: ...

    def __exit__(self, *error: object) -> None: ...

    def join(self, arriving: Iterator[Inputs]) -> Iterator[Inputs]:
        """The inputs with what has come."""


class Sink(Protocol):
    """Takes every tick and must not keep the loop waiting."""

    def write(self, tick: Tick) -> None:
        """Take one tick."""


@dataclass(slots=True)
class RunReport:
    """Figures of a run, for the outcome record and the summary."""

    outcome: str = Outcome.TIME_OVER
    note: str = ""
    ticks: int = 0
    duration_s: float = 0.0  # to the last image: without the ticks in which an observation waits for its refinement
    wall_s: float = 0.0
    contacts: int = 0
    passed_over: int = 0  # frames whose stamp did not increase
    navigating_ns: int | None = None  # stamp of the first tick on the way to the goal
    last: Tick = field(default_factory=Tick)


class _Stopwatch:
    """Wall time of the stages of one tick, in ms by stage."""

    def __init__(self) -> None:
        self.ms: dict[str, float] = {}
        self.start()

    def start(self) -> None:
        """Begin to time the next stage."""
        self._since_s = time.perf_counter()

    def lap(self, stage: str) -> None:
        """End a stage, and begin to time the next one."""
        now_s = time.perf_counter()
        self.ms[stage] = (now_s - self._since_s) * 1e3
        self._since_s = now_s


def run(
    pipeline: Pipeline,
    rig: Rig,
    worker: Worker,
    sinks: Sequence[Sink],
    start: Tick | None = None,
    control: RunControl | None = None,
    on_tick: Callable[[Tick], None] | None = None,
    queue_state: Callable[[], tuple[float, int]] = lambda: (0.0, 0),
    live: bool = True,
    clocks: ClockMonitor | None = None,
    watchdog: Watchdog | None = None,
    paced: bool = False,
    joining: Sequence[Joining] = (),
) -> RunReport:
    """Run until the rig ends, the mission is finished and the coils are at zero, or `control` stops the run.

    A mission that observes goes on when the rig has ended, without images, until its refinement is adopted.

    However it ends, the watchdog takes the field away before anything else is done. A stage that fails leaves its
    inputs, and only those, as the last tick in the sinks. A frame whose stamp does not increase enters no stage and is
    counted.

    Long because one tick's calls stand in the order in which they may fail: the commands after all stages, the sinks
    after the commands. They share the ticks, the times and the report. Raises RigError: the rig can not go on, or its
    zero() has failed. Besides, what stages, rig, worker and sinks raise.

    Parameters
    ----------
    start : the tick to resume from.
    queue_state : MB that wait for the disk, and the number of frames dropped.
    live : False for a replay. It continues after the end of the mission, takes no operator's events from `control`, and
        does not check frames, because the recorded inputs hold the results of those checks.
    clocks : records the clocks, and the frames whose stamp did not increase.
    watchdog : that of this rig; None: one without a timer.
    paced : the worker takes real time, and the ticks after the end of the rig wait for it.
    joining : messages and streams of other programs and devices, which join the inputs.
    """
    report = RunReport()
    control = control if control is not None else RunControl()
    watchdog = watchdog if watchdog is not None else Watchdog(rig, tripped=partial(control.stop, zero=True))
    tick = ended = start if start is not None else Tick()
    first_ns: int | None = None
    began_s = time.perf_counter()
    watch = _Stopwatch()
    sinks_ms = 0.0

    def reject() -> None:
        report.passed_over += 1
        if clocks is not None:
            clocks.count_skipped()

    with ExitStack() as stack:
        # Reader and writer threads need the interpreter for moments only; at the default of 5 ms each of their turns
        # may cost a tick as much.
        stack.callback(sys.setswitchinterval, sys.getswitchinterval())
        sys.setswitchinterval(SWITCH_S)
        stack.callback(worker.close)
        stack.enter_context(watchdog.running())
        stack.enter_context(rig)
        stack.callback(watchdog.field_off)
        stack.enter_context(control.interrupted_when_overdue())
        arriving = increasing_stamps(rig.inputs(), tick.stamp_ns, reject)
        for each in joining:
            stack.enter_context(each)
            arriving = each.join(arriving)
        if live:
            stack.enter_context(control.hand.connection(watchdog.rest, watchdog.go_on))
            arriving = checked_images(arriving, pipeline.image_shape, pipeline.image_bits)
            arriving = _and_afterwards(arriving, lambda: tick, paced=paced)
        while True:
            with control.interruptible:
                arrived = next(arriving, None)
            if arrived is None or control.overdue or (control.reason and not live):
                break
            control.ticking = True
            begin_s = time.perf_counter()
            inputs = _with_events(arrived, worker, control, tick, live=live)
            last = tick
            watch.start()
            delays = _delays_of(inputs)
            try:
                with control.interruptible:
                    tick = step(pipeline, last, inputs, watch.lap)
            except Exception:
                watchdog.take_away()
                _write(sinks, with_inputs(last, inputs, pipeline.topics))
                raise
            mission, currents = tick.mission, tick.currents
            assert mission is not None and currents is not None
            with control.interruptible:
                watchdog.apply(currents)
            if mission.wanted and (last.mission is None or mission.request != last.mission.request):
                worker.submit(tick)
            watch.lap("apply")
            queue_mb, dropped = queue_state()
            timing = Timing(
                stamp_ns=tick.stamp_ns,
                track_ms=watch.ms["track"],
                observe_ms=watch.ms["observe"],
                control_ms=watch.ms["control"] + watch.ms["apply"],
                sinks_ms=sinks_ms,  # of the previous tick: this one's are still to come
                total_ms=(time.perf_counter() - begin_s) * 1e3 + sinks_ms,
                queue_mb=queue_mb,
                dropped_frames=dropped,
                apply_ms=watch.ms["apply"],
                **delays,
            )
            recorded = replace(
                tick,
                timing=timing,
                truth=inputs.truth,
                true_field=inputs.true_field,
                true_tracers=inputs.true_tracers,
                losses=inputs.losses,
                extra=recorded_extra(tick, inputs, pipeline.topics),
            )
            if clocks is not None:
                recorded = replace(recorded, clocks=clocks.update(tick.stamp_ns, inputs.clock))
            _write(sinks, recorded)
            watch.lap("sinks")
            sinks_ms = watch.ms["sinks"]
            first_ns = tick.stamp_ns if first_ns is None else first_ns
            report.ticks += 1
            if not tick.is_afterwards:
                report.duration_s = seconds(tick.stamp_ns - first_ns)
            report.contacts = inputs.truth.contacts if inputs.truth is not None else report.contacts
            if report.navigating_ns is None and mission.phase == Phase.NAVIGATE:
                report.navigating_ns = tick.stamp_ns
            if on_tick is not None:
                on_tick(recorded)
            ended = tick
            watchdog.tick_ended()
            if live and mission.finished and currents.amplitude_mt == 0.0 and not control.pending:
                break
    report.wall_s = time.perf_counter() - began_s
    report.last = ended
    _end(report, sinks, control, watchdog, live=live)
    return report


def _delays_of(inputs: Inputs) -> dict[str, float | None]:
    """Those of a tick that begins now, for its `Timing`; none of a rig that does not tell."""
    told = inputs.delays
    if told is None:
        return {}
    waited_ms = None if told.arrived_ns is None else 1e-6 * (time.monotonic_ns() - told.arrived_ns)
    return {"arrival_ms": told.arrival_ms, "wait_ms": waited_ms, "field_ms": told.field_ms}


def _and_afterwards(arriving: Iterator[Inputs], state: Callable[[], Tick], *, paced: bool) -> Iterator[Inputs]:
    """The rig's inputs, and for a mission that observes then others without images until it is finished.

    The first of these tells the mission, as an event, that the frames have ended. They say that the last image is
    repeated, so that no stage takes anything for seen, and a replay needs no image.
    """
    yield from arriving
    ended = False
    while True:
        last = state()
        mission, applied = last.mission, last.applied
        if mission is None or mission.phase != Phase.OBSERVE or applied is None:
            return
        if paced and ended:
            time.sleep(seconds(_AFTER_NS))
        stamp_ns, zeros = last.stamp_ns + (_AFTER_NS if ended else _END_NS), np.zeros_like(applied.currents_a)
        nothing = Applied(stamp_ns, 0.0, 0.0, 0.0, zeros, np.zeros(2), applied.image_since_ns, stamp_ns)
        event = None if ended else OperatorEvent(stamp_ns, Action.END, "the frames have ended")
        yield Inputs(stamp_ns, None, nothing, operator=event)
        ended = True


def _with_events(arrived: Inputs, worker: Worker, control: RunControl, last: Tick, *, live: bool) -> Inputs:
    """The inputs with the results of the worker that are due and, in a live run, the next event of the operator."""
    none: Results = {}
    new: dict[str, Any] = dict(control.unless_stopped(partial(worker.due, arrived.stamp_ns), none))
    held = last.mission is not None and last.mission.held_since_ns is not None
    event = control.next_event(arrived.stamp_ns, held) if live and arrived.operator is None else None
    if event is not None:
        new["operator"] = event
    if live and (hand := control.hand.message(arrived.stamp_ns)) is not None:
        new["hand"] = hand
    return replace(arrived, **new) if new else arrived


def _end(report: RunReport, sinks: Sequence[Sink], control: RunControl, watchdog: Watchdog, *, live: bool) -> None:
    """State how the run ended. An end that no tick has recorded is written as a tick of its own."""
    tick = report.last
    field_was_on = control.reason and tick.currents is not None and tick.currents.amplitude_mt > 0.0
    why_zero = ("" if control.overdue else control.pending_zero) or (control.reason if field_was_on else "")
    if why_zero and live and report.ticks:
        since_ns = max(nanoseconds(watchdog.clock() - watchdog.ticked_s), 1)
        event = OperatorEvent(tick.stamp_ns + since_ns, Action.ZERO, why_zero)
        _write(sinks, replace(tick, stamp_ns=event.stamp_ns, operator=event))
    if tick.mission is not None and tick.mission.finished:
        report.outcome, report.note = tick.mission.outcome, tick.mission.note
    elif control.reason:  # no tick has recorded it
        report.outcome, report.note = Outcome.STOPPED, control.reason
    if field_was_on:
        report.note += "; the coils were switched off before they had ramped down"
    if watchdog.hung:
        report.outcome, report.note = Outcome.FAILED, watchdog.reason
    if watchdog.failures:
        report.note += f"; the coils' zero() worked after {watchdog.failures} failures"


def _write(sinks: Sequence[Sink], tick: Tick) -> None:
    for sink in sinks:
        sink.write(tick)
