"""The process of the slow stages: the same results as at home, never in the way, never left behind."""

from __future__ import annotations

import os
import signal
import textwrap
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from flowrec.core import PUMP, Extra, FlowField, FlowrecError, Mission, PumpShare, Tick
from flowrec.run import ProcessWorker, work
from flowrec.stages import Pipeline, load_config
from flowrec.verbs import prepare
from tests.conftest import HANG_S, until
from tests.short_missions import SMALL

# Found by this process and by its child: stages that fail in every way in which an answer can fail.
HURDLES = """
    import sys, threading, time
    from dataclasses import dataclass
    from flowrec.core.errors import FlowError
    from flowrec.physics.flow.solver import FlowSolver

    def explode():
        raise RuntimeError("this can not be read back")

    class TakesTwo(Exception):
        def __init__(self, what, where):
            super().__init__(f"{what} in {where}")

    class Locked(Exception):
        def __init__(self, text):
            super().__init__(text)
            self.lock = threading.Lock()

    @dataclass
    class Unreadable:
        stamp_ns: int = 0
        request: int = 0
        error_share: float | None = None
        def __reduce__(self):
            return explode, ()

    @dataclass(frozen=True)
    class Watched(FlowSolver):
        def sensitivities(self, chip, *given):
            print("walls moved by", chip.wall_offset_px, file=sys.stderr, flush=True)
            return super().sensitivities(chip, *given)

    class Stage:
        def __init__(self, *ways):
            self.ways = list(ways)
        def solve(self, chip):
            how = self.ways.pop(0)
            print("solving", how, file=sys.stderr, flush=True)
            if how == "sleeps":
                time.sleep(600)
            if how == "raises":
                raise ValueError("a plain reason")
            if how == "takes two":
                raise TakesTwo("leak", "valve")
            if how == "holds a lock":
                raise Locked("stuck valve")
            if how == "exits":
                sys.exit(7)
            return Unreadable()
        def sensitivities(self, *_):
            raise FlowError("of a field without a flow")
"""


@pytest.fixture(scope="module")
def pipeline() -> Pipeline:
    return prepare(load_config(None, SMALL))[2]


@pytest.fixture
def order() -> Tick:
    nowhere = np.zeros(2)
    return Tick(0, mission=Mission(0, "start", 0, 1, "solve", 0, nowhere, nowhere, False, "", ""))


@pytest.fixture
def working(
    pipeline: Pipeline, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Iterator[Callable[..., ProcessWorker]]:
    """A process whose solver fails in the ways named, one for each order; none: the real one."""
    (tmp_path / "hurdles.py").write_text(textwrap.dedent(HURDLES))
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    with ExitStack() as stack:

        def start(*ways: str) -> ProcessWorker:
            if ways:
                import hurdles  # type: ignore[import-not-found]
            process = ProcessWorker(replace(pipeline, solver=hurdles.Stage(*ways)) if ways else pipeline)
            stack.callback(process.close)
            return process

        yield start


def answer(process: ProcessWorker) -> Any:
    """The next result, or what was raised instead of one; None where it hangs."""
    end = time.monotonic() + HANG_S
    try:
        while not (results := process.due(0)) and time.monotonic() < end:
            time.sleep(0.02)
    except Exception as error:  # noqa: BLE001
        return error
    return next(iter(results.values()), None)


@pytest.mark.slow("starts a worker")
def test_what_later_orders_need_of_the_chip_is_computed_while_no_order_waits(pipeline, order, working) -> None:
    import hurdles  # found by `working`

    with closing(ProcessWorker(replace(pipeline, solver=hurdles.Watched()))) as process:
        process.submit(order)
        assert isinstance(answer(process), FlowField)
        until(lambda: b"walls moved by 0.5" in process._child.printed)  # are compared with those that are drawn
        process.submit(order)
        assert isinstance(answer(process), FlowField)


@pytest.mark.slow("starts three workers")
def test_orders_are_answered_as_at_home_and_a_process_that_is_killed_is_told_of(pipeline, order, working) -> None:
    process = working()
    process.submit(order)
    process.submit(order)
    assert answer(process).same_as(work(pipeline, order))
    assert answer(process).request == 1
    os.kill(process._child.process.pid, signal.SIGKILL)
    process.submit(order)
    error = answer(process)
    assert isinstance(error, FlowrecError)
    assert "SIGKILL" in str(error)


@pytest.mark.slow("starts a worker, and solves a flow")
def test_a_route_is_planned_with_the_mean_flow_of_the_pump_in_the_process_as_at_home(pipeline, order, working) -> None:
    places = np.array([300.0, 2700.0]), np.array([6000.0, 2700.0])
    mission = replace(order.mission, wanted="route", phase="plan", start_um=places[0], goal_um=places[1])
    still = replace(order, assumed=work(pipeline, order), mission=mission)
    pumped = replace(still, extra=Extra({PUMP: PumpShare(0, 1.0, 0.4, 1.0, 0)}))
    process = working()
    process.submit(pumped)
    assert (planned := answer(process)).same_as(work(pipeline, pumped))
    assert planned.reachable and not planned.same_as(work(pipeline, still))


def test_a_process_that_is_stopped_while_the_mission_waits_for_it_is_told_of(order, working) -> None:
    process = working("sleeps")
    process.submit(order)
    assert process.due(0) == {}
    os.kill(process._child.process.pid, signal.SIGSTOP)
    assert "was stopped by a signal" in str(answer(process))


@pytest.mark.slow("starts processes of the worker")
def test_whatever_an_order_raises_or_answers_comes_back(order, working) -> None:
    process = working("raises", "takes two", "holds a lock", "exits", "gives what can not be read")
    errors = []
    for _ in range(5):
        process.submit(order)
        errors.append(answer(process))
    assert [type(error) for error in errors] == [ValueError, *4 * [FlowrecError]]
    for error, told in zip(
        errors, ("a plain reason", "leak in valve", "stuck valve", "SystemExit: 7", "can not be read back"), strict=True
    ):
        assert told in str(error)


@pytest.mark.slow("starts four processes of the worker")
def test_what_the_process_printed_is_in_the_log_that_the_error_names_and_a_clean_end_leaves_none(
    order, working, tmp_path: Path
) -> None:
    process = working("sleeps")
    process.submit(order)
    until(lambda: b"solving sleeps" in process._child.printed)
    os.kill(process._child.process.pid, signal.SIGKILL)
    log = Path(str(answer(process)).split("see ")[1].split(" for")[0])
    assert "solving sleeps" in log.read_text()
    log.unlink()
    clean = working()
    clean.submit(order)
    answer(clean)
    clean.close()
    assert not list(tmp_path.glob("*.log"))


@pytest.mark.slow("starts a process of the worker, for where it is started")
def test_a_file_in_the_working_directory_does_not_shadow_a_library(
    order, working, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    desk = tmp_path / "desk"
    desk.mkdir()
    for name in ("filterpy", "scipy"):
        (desk / f"{name}.py").write_text("raise SystemExit('the file of the user was run')")
    monkeypatch.chdir(desk)
    monkeypatch.syspath_prepend(str(desk))  # as python -m does
    process = working()
    process.submit(order)
    result = answer(process)
    assert not isinstance(result, BaseException), str(result)


def test_a_process_that_is_closed_leaves_no_thread_and_no_open_pipe(order, working) -> None:
    before = set(threading.enumerate())
    process = working()
    process.submit(order)
    process.close()
    until(lambda: set(threading.enumerate()) <= before)
    child = process._child.process
    assert all(pipe.closed for pipe in (child.stdin, child.stdout, child.stderr))
