"""Results of slow stages that are refused: what is in use stays, it is recorded why, and a replay refuses as well."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

from flowrec.core import (
    Demand,
    Estimate,
    FlowField,
    FlowrecError,
    Mission,
    NotFiniteError,
    Observations,
    Route,
    Tick,
    as_read,
)
from flowrec.physics import FlowSolver
from flowrec.run import work
from flowrec.stages import Pipeline, Planner, Refiner, SurveyPlanner, assemble, load_config
from flowrec.stages.refine.obstacles import Likelihood
from flowrec.store import SessionReader
from flowrec.verbs import prepare
from flowrec.verbs import session_replay as verb
from flowrec.verbs.record import record
from tests.short_missions import SMALL

REASON = "NaN or infinity in velocity_um_s"


def broken(field: FlowField) -> FlowField:
    """The field with one number in the fluid that is none."""
    velocity = np.array(field.velocity_um_s)
    velocity[tuple(np.argwhere(velocity)[0])] = np.nan
    return replace(field, velocity_um_s=velocity)


@dataclass(frozen=True, slots=True)
class Diverging(Refiner):
    """Its flow is not finite."""

    def refine(self, assumed, *known) -> FlowField:  # type: ignore[no-untyped-def]
        return broken(assumed)


@dataclass(frozen=True, slots=True)
class Singular(Refiner):
    """Its equations have no solution."""

    def refine(self, *known) -> FlowField:  # type: ignore[no-untyped-def]
        np.linalg.cholesky(-np.eye(2))
        raise AssertionError


@dataclass(frozen=True, slots=True)
class Lost(SurveyPlanner):
    """Its times are not finite."""

    def plan(self, order) -> Route:  # type: ignore[no-untyped-def]
        return Route(0, 0, "survey", True, "", np.zeros((2, 2)), np.array([0.0, np.inf]))


@dataclass(frozen=True, slots=True)
class Endless(Planner):
    """Likewise."""

    def plan(self, *known) -> Route:  # type: ignore[no-untyped-def]
        return Route(0, 0, "time_field", True, "", np.zeros((2, 2)), np.array([0.0, np.inf]))


@dataclass(frozen=True, slots=True)
class Stormy(FlowSolver):
    """Its flow is not finite."""

    def solve(self, chip) -> FlowField:  # type: ignore[no-untyped-def]
        return broken(FlowSolver.solve(self, chip))


@pytest.fixture(scope="module")
def pipeline() -> Pipeline:
    return prepare(load_config(None, SMALL))[2]


@pytest.fixture(scope="module")
def known(pipeline: Pipeline) -> Tick:
    """A robot on its way, with maps and a route in use."""
    assumed = pipeline.solver.solve(pipeline.chip)
    refined = replace(assumed, method="assimilate", velocity_um_s=1.1 * assumed.velocity_um_s, request=2)
    way = Route(0, 3, "time_field", True, "", np.array([[0.0, 0.0], [9.0, 9.0]]), np.array([0.0, 1.0]), more=True)
    here, nowhere = Estimate(5, np.zeros(2), np.zeros(2), np.eye(4), 2.0, np.zeros(2), True), np.zeros(2)
    demand = Demand(5, nowhere, nowhere, 0.0, 0.0, False, np.zeros((0, 2)))
    return Tick(stamp_ns=5, assumed=assumed, refined=refined, route=way, estimate=here, demand=demand)


def ordered(known: Tick, phase: str, wanted: str) -> Tick:
    nowhere = np.zeros(2)
    return replace(known, mission=Mission(0, phase, 0, 7, wanted, 5, nowhere, nowhere, False, "", ""))


@pytest.mark.parametrize("refiner", [Diverging(), Singular()])
def test_of_a_refused_refinement_the_map_in_use_stays_with_the_number_of_the_order_and_the_reason(
    pipeline: Pipeline, known: Tick, refiner: Refiner
) -> None:
    failing = replace(pipeline, refiner=refiner)
    for before in (known, replace(known, refined=None)):
        result = work(failing, ordered(before, "refine", "refine"))
        assert isinstance(result, FlowField) and before.field is not None
        assert (result.request, result.stamp_ns) == (7, 5)
        assert REASON in result.refused or "positive definite" in result.refused
        assert replace(result, refused="", request=0, stamp_ns=0).same_as(replace(before.field, request=0, stamp_ns=0))


def test_of_a_refused_route_the_one_in_use_stays_and_a_robot_that_is_on_none_gets_none(
    pipeline: Pipeline, known: Tick
) -> None:
    failing = replace(pipeline, survey=Lost(), planner=Endless())
    for phase, wanted in (("survey", "survey_route"), ("navigate", "route")):
        kept = work(failing, ordered(known, phase, wanted))
        assert isinstance(kept, Route) and known.route is not None
        assert "NaN or infinity in arrival_s" in kept.refused and kept.refused in kept.reason
        assert (kept.request, kept.more) == (7, False)
        np.testing.assert_array_equal(kept.arrival_s, known.route.arrival_s)
    for phase, wanted in (("start", "survey_route"), ("plan", "route")):
        none = work(failing, ordered(known, phase, wanted))
        assert isinstance(none, Route) and not none.reachable and none.request == 7
        assert "arrival_s" in none.refused and none.reason == none.refused


def test_of_an_order_with_a_number_that_is_none_the_result_is_refused(pipeline: Pipeline, known: Tick) -> None:
    assert known.assumed is not None and known.demand is not None
    with as_read():
        spoilt = replace(known, assumed=broken(known.assumed), demand=replace(known.demand, progress_s=np.nan))
    refined = work(pipeline, ordered(spoilt, "refine", "refine"))
    assert refined.refused.startswith(f"FlowField at 0.000 s refused: {REASON}") and known.refined is not None
    np.testing.assert_array_equal(refined.velocity_um_s, known.refined.velocity_um_s)
    for phase, wanted in (("survey", "survey_route"), ("navigate", "route")):
        route = work(pipeline, ordered(replace(spoilt, assumed=known.assumed), phase, wanted))
        assert isinstance(route, Route) and known.route is not None
        assert route.refused.startswith("Demand at 0.000 s refused: NaN or infinity in progress_s")
        np.testing.assert_array_equal(route.arrival_s, known.route.arrival_s)


def test_of_observations_the_finite_ones_count_and_the_others_refuse_nothing(pipeline: Pipeline, known: Tick) -> None:
    given: list[Observations] = []

    class Taking(Refiner):
        """Notes what it is given."""

        def refine(self, assumed, observations, *known) -> FlowField:  # type: ignore[no-untyped-def]
            given.append(observations)
            return assumed

    with as_read():
        flow_um_s = np.array([[10.0, 0.0], [np.nan, 0.0], [12.0, 0.0]])
        made = Observations(5, np.full((3, 2), 100.0), flow_um_s, np.ones(3))
    done = work(replace(pipeline, refiner=Taking()), ordered(replace(known, observations=made), "refine", "refine"))
    assert len(given) == 1 and "NaN" not in done.refused


def test_what_a_fit_has_lost_is_found_before_scipy_is_given_it() -> None:
    """The search for obstacles comes before there is a message that would be refused."""
    likelihood = Likelihood(np.zeros(4), np.eye(4), np.eye(4), np.zeros(4), 0.0)
    known, still = np.zeros((1, 2, 2)), np.zeros((2, 2))
    lost = np.full((2, 2), np.nan)
    assert np.isfinite(likelihood.of_flow(still, known, still))
    for flow in ((lost, known, still), (still, lost[None], still), (still, known, lost)):
        with pytest.raises(NotFiniteError, match="observations"):
            likelihood.of_flow(*flow)
    with pytest.raises(NotFiniteError):
        likelihood.gains(lost[None], np.ones((1, 1)))


def test_a_refused_first_flow_ends_the_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        "flowrec.verbs.preparation.assemble", lambda config, chip: replace(assemble(config, chip), solver=Stormy())
    )
    path = tmp_path / "a.mcap"
    with pytest.raises(NotFiniteError, match=REASON):
        record(load_config(None, SMALL), path)
    with SessionReader(path) as reader:
        assert reader.outcome["outcome"] == "failed" and REASON in reader.outcome["reason"]
        assert not list(reader.messages("assumed"))


def test_a_replay_refuses_a_refinement_at_the_tick_at_which_the_run_did(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def planted(config, chip):  # type: ignore[no-untyped-def]
        return replace(assemble(config, chip), refiner=Diverging())

    monkeypatch.setattr("flowrec.verbs.preparation.assemble", planted)
    recorded = record(load_config(None, [*SMALL, "mission.phases=refine"]), tmp_path / "a.mcap")
    assert recorded.report.outcome == "refine complete"
    assert recorded.exit_status == 3 and any("the flow was not refined" in doubt for doubt in recorded.doubts)
    with SessionReader(recorded.path) as reader:
        (refused,) = reader.messages("refined")
        (assumed,) = reader.messages("assumed")
        said = [event for event in reader.messages("event") if "refused" in event.text]
    assert REASON in refused.refused and refused.method == "fvm"
    np.testing.assert_array_equal(refused.velocity_um_s, assumed.velocity_um_s)
    assert [event.stamp_ns for event in said] == [refused.stamp_ns]
    assert said[0].level == "warning"
    assert said[0].text.startswith("refined flow refused, the map in use stays: FlowField at")
    monkeypatch.setattr("flowrec.verbs.session_replay.assemble", planted)
    assert verb.replay_session(recorded.path, verb.Change(), verify=True).identical
    monkeypatch.setattr("flowrec.verbs.session_replay.assemble", assemble)
    assert not verb.replay_session(recorded.path, verb.Change(), verify=True).identical


def test_bad_settings_of_a_refinement_still_end_the_run(pipeline: Pipeline, known: Tick) -> None:
    other = replace(known, assumed=None, refined=None)
    assert known.assumed is not None
    smaller = replace(
        known.assumed,
        velocity_um_s=known.assumed.velocity_um_s[1:],
        pressure_pa=known.assumed.pressure_pa[1:],
        wall_px=None,
    )
    with pytest.raises(FlowrecError, match="chip"):
        work(pipeline, ordered(replace(other, assumed=smaller), "refine", "refine"))
