"""BLAS computes with one thread in what must be the same on a machine with other cores."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import pytest
from threadpoolctl import threadpool_info, threadpool_limits

from flowrec.core.system.blas_threads import one_blas_thread
from flowrec.run import workers
from flowrec.stages.refine.refiner import AssumedFlow, Refiner
from tests.store.made_up import ticks_of


def most_threads() -> int:
    """The most threads of any BLAS library of this process."""
    return max(int(library["num_threads"]) for library in threadpool_info() if library["user_api"] == "blas")


def test_blas_has_one_thread_inside_and_as_many_as_before_afterwards() -> None:
    with threadpool_limits(limits=2, user_api="blas"):
        with one_blas_thread():
            assert most_threads() == 1
        assert most_threads() == 2


def test_a_refinement_has_one_blas_thread(twin: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    case, seen = twin(), []

    def fit(_: AssumedFlow, problem: Any) -> Any:
        seen.append(most_threads())
        return problem.assumed

    monkeypatch.setattr(AssumedFlow, "fit", fit)
    with threadpool_limits(limits=2, user_api="blas"):
        Refiner("fvm").refine(case.assumed, case.observations, case.chip, case.solver)
    assert seen == [1]


def test_a_route_of_a_mission_is_planned_with_one_blas_thread(monkeypatch: pytest.MonkeyPatch) -> None:
    tick, seen = next(tick for tick in ticks_of(21) if tick.mission and tick.route), []
    assert tick.mission is not None

    def route(*_: Any) -> Any:
        seen.append(most_threads())
        return tick.route

    monkeypatch.setattr(workers, "route", route)
    order = replace(tick, mission=replace(tick.mission, wanted="route"))
    with threadpool_limits(limits=2, user_api="blas"):
        workers.work(SimpleNamespace(inlets=None), order)  # type: ignore[arg-type]
    assert seen == [1]
