"""The one loop where something in it fails: what is in the file afterwards."""

from __future__ import annotations

import re
import threading
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

from flowrec.core import NS_PER_S, Action, Applied, Estimate, NotFiniteError, OperatorEvent, Tick
from flowrec.rigs import SimulatedRig
from flowrec.run import LockstepWorker, RunControl, run
from flowrec.run.loop import _with_events
from flowrec.stages import Inputs, Observer, assemble, load_config
from flowrec.store import SessionReader
from flowrec.verbs import prepare
from flowrec.verbs.record import record
from tests.short_missions import SMALL

BREAKS_NS = NS_PER_S // 2
_LONG_S = 5.0  # for the watchdog's thread to act, on a busy machine


@dataclass(frozen=True, slots=True)
class Breaking(Observer):
    """Fails at a certain frame."""

    def estimate(self, previous, track, *known) -> Estimate:  # type: ignore[no-untyped-def]
        found = Observer.estimate(self, previous, track, *known)
        if track.stamp_ns >= BREAKS_NS:
            self.fail(found)
        return found

    def fail(self, _found: Estimate) -> None:
        """Raise what a defect does."""
        raise ValueError("the observer is broken")


@dataclass(frozen=True, slots=True)
class Diverging(Breaking):
    """Its flow is not finite from a certain frame on."""

    def fail(self, found: Estimate) -> None:
        """Make a message that is refused."""
        replace(found, flow_um_s=np.array([np.inf, 0.0]))


@pytest.mark.parametrize(
    ("observer", "error", "said"),
    [
        (Breaking, ValueError, "the observer is broken"),
        (Diverging, NotFiniteError, r"Estimate at 0.5\d* s refused: NaN or infinity in flow_um_s \(1 of 2 numbers\)"),
    ],
)
def test_a_stage_that_fails_leaves_the_inputs_that_broke_it_as_the_last_tick_and_nothing_made_of_them(
    session: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    observer: type[Breaking],
    error: type[Exception],
    said: str,
) -> None:
    def planted(config, chip):  # type: ignore[no-untyped-def]
        pipeline = assemble(config, chip)
        return replace(pipeline, observer=observer(config.observer.method))

    monkeypatch.setattr("flowrec.verbs.preparation.assemble", planted)
    path = tmp_path / "broken.mcap"
    with pytest.raises(error, match=said):
        record(load_config(None, SMALL), path)
    reader = SessionReader(path)
    assert reader.outcome["outcome"] == "failed"
    assert re.search(said, reader.outcome["reason"])
    *_, before, last = reader.ticks()
    # The same run, whole: what arrived on that tick.
    whole = next(tick for tick in SessionReader(session).ticks() if tick.stamp_ns >= BREAKS_NS)
    assert last.stamp_ns == whole.stamp_ns > before.stamp_ns
    assert last.frame is not None and whole.frame is not None
    np.testing.assert_array_equal(last.frame.image, whole.frame.image)
    assert last.applied is not None and last.applied.same_as(whole.applied)
    assert before.applied is not None and not last.applied.same_as(before.applied)
    for name in ("track", "estimate", "demand", "currents", "mission", "timing"):
        made, known = getattr(last, name), getattr(before, name)
        assert made is known is None or made.same_as(known), name


def test_a_stage_that_fails_loses_the_field_before_anything_is_written_however_long_the_disk_takes() -> None:
    prepared = prepare(load_config(None, SMALL), aloud=False)
    gone, seen = threading.Event(), []

    class Rig(SimulatedRig):
        def zero(self) -> None:
            super().zero()
            gone.set()

    class Hanging:
        """A sink that, for the tick of the failure, hangs until the field is gone, or for seconds."""

        def write(self, tick: Tick) -> None:
            if tick.stamp_ns >= BREAKS_NS:
                seen.append(gone.wait(_LONG_S))

    pipeline = replace(prepared.pipeline, observer=Breaking(prepared.config.observer.method))
    with pytest.raises(ValueError, match="the observer is broken"):
        run(pipeline, Rig.of(pipeline, prepared.config, 1.0), LockstepWorker(pipeline, 0.1), [Hanging()])
    assert seen == [True]


def test_what_an_operator_asks_waits_for_a_tick_that_has_no_event_of_its_own() -> None:
    control, worker = RunControl(), LockstepWorker(prepare(load_config(None, SMALL), aloud=False).pipeline, 0.1)
    assert control.mark()
    own = OperatorEvent(1, Action.END, "the frames have ended")
    nothing = Applied(1, 0.0, 0.0, 0.0, np.zeros(3), np.zeros(2))
    given = [
        _with_events(Inputs(stamp_ns, None, nothing, operator=event), worker, control, Tick(), live=True).operator
        for stamp_ns, event in ((1, own), (2, None), (3, None))
    ]
    assert given[0] is own and given[1] is not None and given[1].action == Action.MARK and given[2] is None


def test_a_run_whose_field_went_only_after_failures_says_so() -> None:
    prepared = prepare(load_config(None, SMALL), aloud=False)
    failures = iter([OSError("the driver is busy")] * 3)

    class Rig(SimulatedRig):
        def zero(self) -> None:
            if (error := next(failures, None)) is not None:
                raise error
            super().zero()

    pipeline = prepared.pipeline
    report = run(pipeline, Rig.of(pipeline, prepared.config, 0.2), LockstepWorker(pipeline, 0.1), [])
    assert report.note.endswith("the coils' zero() worked after 3 failures")
