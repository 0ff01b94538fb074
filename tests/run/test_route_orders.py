"""What a survey and a plan are given of what is known in the tick of their order."""

from types import SimpleNamespace

import numpy as np
import pytest

from flowrec.core import Phase
from flowrec.run import route_orders
from flowrec.run.route_orders import route, survey_route
from flowrec.stages import SurveyPlanner, no_route
from flowrec.stages.estimation import Sampler
from tests.stages.planning.worlds import robot

NOWHERE = no_route("none", "")


def ordered(survey, planner, limit_hz=None, speed_limit_um_s=None):
    """A survey and a plan are asked for, of a pipeline that hands them on."""
    pipeline = SimpleNamespace(
        survey=survey,
        planner=planner,
        mission=SimpleNamespace(survey_limit_s=10.0, lead_s=2.0),
        refiner=SimpleNamespace(uncertainty=lambda *_: "how wrong the flow may be"),
        **{"robot": robot(600.0), "sampler": Sampler(), "hindsight": None, "solver": None, "chip": None},
    )
    tick = SimpleNamespace(
        estimate=SimpleNamespace(covariance=np.eye(4)),
        extra={},
        health=SimpleNamespace(limit_hz=limit_hz),
        **{
            "field": 1,
            "assumed": 1,
            "route": None,
            "demand": None,
            "observations": None,
            "tracer_flow": None,
            "stamp_ns": 0,
        },
    )
    mission = SimpleNamespace(
        phase=Phase.START, start_um=np.zeros(2), goal_um=np.ones(2), speed_limit_um_s=speed_limit_um_s
    )
    survey_route(pipeline, tick, mission)
    route(pipeline, tick, mission)


@pytest.mark.parametrize("limit_hz", [None, 5.0])
def test_a_survey_and_a_plan_count_on_a_robot_as_slow_as_it_has_stepped_out(limit_hz):
    given = []
    survey = SimpleNamespace(needs_uncertainty=True, plan=lambda order: given.append(order.robot))
    ordered(
        survey, SimpleNamespace(plan=lambda field, start, goal, chip, able: given.append(able) or NOWHERE), limit_hz
    )
    able = robot(600.0).limited_to(limit_hz)
    assert [one.speed_limit_um_s for one in given] == [able.speed_limit_um_s] * 2
    assert (able.speed_limit_um_s < robot(600.0).speed_limit_um_s) is (limit_hz is not None)
    ordered(
        survey,
        SimpleNamespace(plan=lambda field, start, goal, chip, able: given.append(able) or NOWHERE),
        limit_hz,
        50.0,
    )
    assert [one.speed_limit_um_s for one in given[2:]] == [50.0] * 2  # or as a person allows


def test_how_wrong_the_flow_may_be_is_computed_for_a_survey_that_asks_for_it_alone():
    given = []
    for needed in (True, False):
        survey = SimpleNamespace(needs_uncertainty=needed, plan=lambda order: given.append(order.uncertainty))
        ordered(survey, SimpleNamespace(plan=lambda *_: NOWHERE))
    assert given == ["how wrong the flow may be", None]
    assert [SurveyPlanner(method).needs_uncertainty for method in ("information", "downstream")] == [True, False]


def test_a_pause_takes_nothing_from_the_time_of_a_survey():
    given = []
    pipeline = SimpleNamespace(
        survey=SimpleNamespace(needs_uncertainty=False, plan=lambda order: given.append(order.left_s) or NOWHERE),
        mission=SimpleNamespace(survey_limit_s=100.0, lead_s=2.0),
        **{"robot": robot(600.0), "sampler": Sampler(), "hindsight": None, "chip": None},
    )
    order = SimpleNamespace(
        stamp_ns=75_000_000_000,
        estimate=SimpleNamespace(covariance=np.eye(4)),
        extra={},
        health=SimpleNamespace(limit_hz=None),
        route=SimpleNamespace(arrival_s=np.array([0.0, 7.0]), lasts_s=7.0),
        demand=SimpleNamespace(progress_s=4.0),
        **{"field": 1, "observations": None, "tracer_flow": None},
    )
    for held_ns in (0, 60_000_000_000):
        phase = {"phase": Phase.SURVEY, "since_ns": 5_000_000_000, "held_ns": held_ns}
        where = {"start_um": np.zeros(2), "goal_um": np.ones(2), "speed_limit_um_s": None}
        survey_route(pipeline, order, SimpleNamespace(**phase, **where))
    # Of 100 s the survey has used 70, or 10 if it was held for 60; 3 s of the way under way are still to come.
    assert given == [pytest.approx(27.0), pytest.approx(87.0)]


def test_a_better_route_begins_where_the_robot_will_be_when_it_is_adopted(monkeypatch):
    given = []

    def better(planner, field, uncertainty, present, from_s, *others):
        given.append((present, from_s))
        return NOWHERE

    monkeypatch.setattr(route_orders, "better_route", better)
    pipeline = SimpleNamespace(
        planner=None,
        mission=SimpleNamespace(lead_s=2.0),
        refiner=SimpleNamespace(uncertainty=lambda *_: None),
        **{"robot": robot(600.0), "sampler": Sampler(), "hindsight": None, "solver": None, "chip": None},
    )
    order = SimpleNamespace(
        extra={},
        health=SimpleNamespace(limit_hz=None),
        route="the present one",
        demand=SimpleNamespace(progress_s=4.0),
        **{"field": 1, "assumed": 1, "observations": None, "tracer_flow": None, "stamp_ns": 0},
    )
    goal_um = np.array([3.0, 5.0])
    mission = {"phase": Phase.NAVIGATE, "former_goal_um": (), "goal_um": goal_um, "speed_limit_um_s": None}
    np.testing.assert_array_equal(route(pipeline, order, SimpleNamespace(**mission)).goal_um, goal_um)
    assert given == [("the present one", 6.0)]


def test_a_survey_expects_the_noise_of_the_latest_observations():
    pipeline = SimpleNamespace(sampler=Sampler(), robot=robot(600.0))
    made = SimpleNamespace(std_um_s=np.array([50.0] * 30 + [3.0] * 20))
    order = SimpleNamespace(estimate=SimpleNamespace(covariance=np.eye(4)), observations=made)
    assert route_orders._sampling(pipeline, order).noise_um_s == 3.0
