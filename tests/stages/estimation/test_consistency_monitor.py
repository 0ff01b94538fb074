"""Alarms: when something is wrong, and not when all is well."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from flowrec.core import Estimate, Health, Tick
from flowrec.stages import HealthMonitor, Kalman, Observer
from flowrec.stages.control.events import event_of
from tests.stages.estimation.lap import ROBOT, driven, vortex
from tests.store.made_up import encode

KALMAN = Observer(kalman=Kalman(position_noise_um=3.0))


def watched(estimates: list[Estimate], field=None) -> list[Health]:  # type: ignore[no-untyped-def]
    monitor = HealthMonitor()
    found: list[Health] = []
    for index, estimate in enumerate(estimates):
        before = estimates[index - 1] if index else None
        found.append(monitor.watch(found[-1] if found else None, before, estimate, field, ROBOT))
    return found


def first(health: list[Health], name: str) -> float:
    return next((each.stamp_ns / 1e9 for each in health if name in each.alarm), math.inf)


@pytest.mark.parametrize("mapped", [False, True])
def test_a_steady_flow_raises_no_alarm(mapped: bool) -> None:
    health = watched(driven(3.0).observed(KALMAN), vortex(1.1) if mapped else None)
    assert {each.alarm for each in health} == {""}
    assert abs(health[-1].nis - 2.0) < 0.5
    assert len(encode(health[-1])) < 1300


def test_a_map_is_compared_where_its_registration_puts_the_robot() -> None:
    estimates, field = driven(3.0).observed(KALMAN), vortex(1.1)
    moved = replace(field, velocity_um_s=np.roll(field.velocity_um_s, 3, axis=1))
    registration = np.array([[1.0, 0.0, 3.0 * field.um_per_px], [0.0, 1.0, 0.0]])
    right, placed, beside = (
        np.array([each.offset_share for each in watched(estimates, each_map)])
        for each_map in (field, replace(moved, registration=registration), moved)
    )
    assert placed == pytest.approx(right, abs=1e-6)
    assert np.abs(beside - right).max() > 0.01


@pytest.mark.parametrize("hertz", [0.1, 0.5, 1.0, 2.0])
def test_a_pulsating_flow_is_told_within_seconds_with_its_frequency_and_strength(hertz: float) -> None:
    lap = driven(3.0, pulsation=0.5, pulsation_hz=hertz)
    health = watched(lap.observed(KALMAN), vortex(1.1))
    assert first(health, "pulsation") < 3.0 + 2.0 / hertz
    assert health[-1].pulsation_hz == pytest.approx(hertz, rel=0.08)
    assert 0.25 < health[-1].pulsation_share < 0.75


def test_noise_beyond_what_was_stated_is_told_by_the_nis() -> None:
    health = watched(driven(6.0).observed(KALMAN))
    assert first(health, "nis") < 10.0


def test_a_robot_out_of_sight_is_an_alarm_that_ends_when_it_is_back() -> None:
    estimates = driven(3.0).observed(KALMAN)[:600]
    gone = [
        replace(each, seen=False, nis=math.nan) if 200 <= index < 290 else each for index, each in enumerate(estimates)
    ]
    health = watched(gone)
    assert 200 / 30 < first(health, "tracking") < 290 / 30
    assert health[-1].alarm == ""


def test_the_beginning_and_the_end_of_an_alarm_are_told() -> None:
    nothing = np.zeros(0)
    well = Health(1, "", 2.0, 0.0, 9.0, 1.0, 0.02, 0.1, nothing, nothing, nothing, np.zeros(2), 0.0)
    ill = replace(well, stamp_ns=2, alarm="nis; pulsation", pulsation_share=0.5, nis=4.0)
    began = event_of(Tick(1, health=well), Tick(2, health=ill))
    assert began is not None and began.level == "warning" and "pulsates at 1 Hz by 50%" in began.text
    assert event_of(Tick(2, health=ill), Tick(3, health=replace(ill, stamp_ns=3))) is None
    over = event_of(Tick(2, health=ill), Tick(3, health=replace(well, stamp_ns=3)))
    assert over is not None and over.level == "info" and "alarm over: pulsation" in over.text


def test_a_session_from_before_slow_lines_were_looked_for_has_the_resonators_that_it_recorded() -> None:
    lap = driven(3.0, pulsation=0.5, pulsation_hz=0.1)
    estimates = lap.observed(KALMAN)
    first_health = HealthMonitor(slowest_hz=0.3).watch(None, None, estimates[0], None, ROBOT)
    assert len(first_health.bank_re) == 24
    assert len(HealthMonitor().watch(None, None, estimates[0], None, ROBOT).bank_re) == 39
