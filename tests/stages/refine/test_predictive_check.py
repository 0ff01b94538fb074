"""The predictive check: what no cause explains is said where it is, bars grow there, and chance is not taken for it."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from flowrec.core.messages import FlowField, Observations
from flowrec.stages.refine import Refiner
from flowrec.stages.refine.findings import TAKEN_FOR, map_doubts
from flowrec.stages.refine.predictive_check import UNEXPLAINED, Departure

REFINER = Refiner(adopt="always")
PLACE_UM = np.array([300.0, 120.0])


def refine(case: Any, observations: Observations) -> FlowField:
    return REFINER.refine(case.assumed, observations, case.chip, case.solver)


def slower_at(case: Any, factor: float) -> Observations:
    """The flow that is observed within 45 um of a place, times a factor."""
    near = np.hypot(*(case.observations.position_um - PLACE_UM).T) < 45.0
    assert near.sum() >= 6
    flow = case.observations.flow_um_s * np.where(near, factor, 1.0)[:, None]
    return replace(case.observations, flow_um_s=flow)


def swimming(observations: Observations, seed: int, weaker_to_the_right: float = 1.0) -> Observations:
    """Observations of a robot that swims in all directions, and moves less per revolution where it heads right."""
    count = len(observations.std_um_s)
    angle = 2.0 * np.pi * np.random.default_rng(seed).random(count)
    stated = 150.0 * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    weaker = np.where(np.cos(angle) > 0.8, weaker_to_the_right, 1.0)[:, None]
    flow = observations.flow_um_s + (weaker - 1.0) * stated
    return replace(observations, flow_um_s=flow, rolled_um_s=stated, time_s=0.6 * np.arange(count))


def test_a_flow_that_no_cause_explains_is_said_where_it_is_and_its_bars_reach_what_was_observed(twin):
    case = twin(every=1)
    field = refine(case, slower_at(case, 0.4))
    assert UNEXPLAINED in field.note
    at_um = [field.parameter(name)[0] for name in ("unexplained_x_um", "unexplained_y_um")]
    assert np.hypot(*(at_um - PLACE_UM)) < 45.0
    share = field.parameter("unexplained_share")[0]
    assert 0.3 < share < 0.8
    column, row = np.round(PLACE_UM / case.chip.um_per_px).astype(int)
    usual = refine(case, case.observations)  # without the departure
    speed = float(np.hypot(*field.velocity_um_s[row, column]))
    assert field.std_um_s[row, column].min() > 0.7 * share * speed > 1.5 * usual.std_um_s[row, column].max()
    seen = 0.4 * case.true.velocity_um_s[row, column]
    off = np.abs(np.stack([field.velocity_um_s, usual.velocity_um_s])[:, row, column] - seen).max(axis=1)
    bars = np.stack([field.std_um_s, usual.std_um_s])[:, row, column].max(axis=1)
    assert off[0] < 2.0 * bars[0] and off[1] > 5.0 * bars[1]
    stem = 240 // 10, 60 // 10  # everywhere else by the mean of what was found
    assert (field.std_um_s[stem] > 1.2 * usual.std_um_s[stem]).any()
    (doubt,) = map_doubts(field, case.chip.um_per_px)
    assert UNEXPLAINED in doubt
    assert map_doubts(field, case.chip.um_per_px, scale_known=True) == [doubt]  # of the flow, whatever the scale


@pytest.mark.slow("refines a survey of a flow that wanders")
def test_a_wander_of_the_flow_is_no_explanation_and_is_not_said_beside_what_nothing_explains(twin):
    case = twin(every=1)
    seen = slower_at(case, 0.4)
    field = refine(case, replace(seen, time_s=0.6 * np.arange(len(seen.std_um_s))))
    assert UNEXPLAINED in field.note
    assert not [clause for clause in field.note.split("; ") if clause.startswith(TAKEN_FOR)]


@pytest.mark.slow("refines surveys of many seeds")
def test_chance_and_single_outliers_are_no_departure(twin):
    for seed, every in ((0, 1), (1, 1), (2, 3)):
        case = twin(every=every, seed=seed)
        wrong = case.observations.flow_um_s.copy()
        wrong[np.random.default_rng(seed).choice(len(wrong), 2, replace=False)] *= -3.0
        for observations in (case.observations, replace(case.observations, flow_um_s=wrong)):
            field = refine(case, observations)
            assert UNEXPLAINED not in field.note
            assert field.parameter("unexplained_share") is None
            assert map_doubts(field, case.chip.um_per_px) == []


@pytest.mark.slow("refines surveys of several seeds")
def test_noise_that_is_twice_as_large_as_stated_is_no_departure(twin):
    for seed in range(2):
        case = twin(every=2, seed=seed, noise=0.1)
        stated = replace(case.observations, std_um_s=0.5 * case.observations.std_um_s)
        assert UNEXPLAINED not in refine(case, stated).note


def test_a_robot_that_moves_less_in_one_direction_is_said_with_the_direction_and_no_bar_of_the_flow_grows(twin):
    case = twin(every=1)
    field = refine(case, swimming(case.observations, 1, 0.6))
    assert f"{UNEXPLAINED} how the robot moves when it heads" in field.note and "to the right" in field.note
    assert UNEXPLAINED not in refine(case, swimming(case.observations, 1)).note


@pytest.mark.slow("refines surveys with an unsteady pump")
def test_what_an_unsteady_pump_explains_is_said_of_the_pump(twin):
    case = twin(every=1)
    time_s = 0.6 * np.arange(len(case.observations.std_um_s))
    pulsates = 1.0 + 0.4 * np.sin(2.0 * np.pi * 0.2 * time_s)
    seen = replace(case.observations, flow_um_s=case.observations.flow_um_s * pulsates[:, None], time_s=time_s)
    field = refine(case, seen)
    assert "the pump pulsates" in field.note
    assert UNEXPLAINED not in field.note and "shakes" not in field.note


def test_a_departure_at_a_place_widens_the_bars_there_by_what_it_found_and_one_of_the_heading_none():
    flow = np.array([[0.0, 100.0], [100.0, 0.0], [0.0, 20.0]])
    points = np.array([[10.0, 20.0], [90.0, 20.0], [90.0, 40.0]])
    found = Departure(20.0, -np.inf, 0.3, 0.1, 5.0, points[0], 3.0, None, None)
    np.testing.assert_allclose(found.least_variance(points, flow)[:, 0], [30.0**2, 5.0**2, 2.0**2])
    assert not replace(found, heading_rad=1.0).least_variance(points, flow).any()
