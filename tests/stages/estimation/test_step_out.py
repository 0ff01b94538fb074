"""Step-out: found where the robot rolls less than its field turns, and not where the flow is another than the map's."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from flowrec.core import Applied, Estimate, FlowField, Health, Tick
from flowrec.physics import Robot
from flowrec.rigs import SimulatedRig
from flowrec.stages import Config, HealthMonitor, Pipeline, load_config
from flowrec.stages.control.events import event_of
from flowrec.store import SessionReader
from flowrec.verbs import session_replay as replay
from flowrec.verbs.record import record
from tests.short_missions import SMALL

ROBOT = Robot(radius_um=50.0, um_per_rev=25.0, max_speed_um_s=600.0, step_out_hz=28.8)
DT_S = 1 / 30


def uniform(speed_um_s: float) -> FlowField:
    velocity = np.zeros((8, 400, 2))
    velocity[..., 0] = speed_um_s
    return FlowField(0, 0, "fvm", 20.0, velocity, np.zeros((8, 400)), None, [1.0], 1.0, 1000.0, "")


def swum(
    seconds: float,
    true_um_s: float,
    mapped_um_s: float,
    step_out_hz: float,
    wanted_hz: float = 24.0,
    wall_um: float = math.inf,
    later_hz: float | None = None,
    share: float = 1.0,
) -> list[Health]:
    """Health on a straight way against a flow: the field turns as fast as wanted and allowed, the robot as it can.

    `later_hz` is its step-out from 3 s on, `share` what it rolls of what it should.
    """
    rng = np.random.default_rng(3)
    at, found, before = np.array([4000.0, 80.0]), list[Health](), None
    for index in range(round(seconds / DT_S)):
        stamp = round(index * DT_S * 1e9)
        limit_hz = found[-1].limit_hz if found and found[-1].limit_hz is not None else math.inf
        frequency = min(wanted_hz, limit_hz)
        turns = np.array([-frequency * DT_S, 0.0])
        true_robot = replace(ROBOT, step_out_hz=later_hz if later_hz and index * DT_S >= 3.0 else step_out_hz)
        at = at + DT_S * np.array([true_um_s - share * true_robot.rolled_speed_um_s(frequency), 0.0])
        seen = at + rng.normal(0.0, 1.0, 2)
        estimate = Estimate(stamp, seen, np.zeros(2), np.eye(4), 2.0, seen, True)
        applied = Applied(stamp, frequency, math.pi, 4.0, np.zeros(3), turns, stamp)
        last = found[-1] if found else None
        found.append(HealthMonitor().watch(last, before, estimate, uniform(mapped_um_s), ROBOT, applied, wall_um))
        before = estimate
    return found


def limits(found: list[Health]) -> list[float | None]:
    """The limits one after the other."""
    return [each.limit_hz for k, each in enumerate(found) if k == 0 or each.limit_hz != found[k - 1].limit_hz]


@pytest.mark.parametrize("map_error", [-0.3, 0.0, 0.3])
def test_a_robot_that_steps_out_is_slowed_down_until_it_rolls_as_it_should(map_error: float) -> None:
    found = swum(6.0, 300.0, 300.0 / (1.0 + map_error), step_out_hz=0.7 * 24.0)
    assert len(limits(found)) >= 2
    settled = found[-1].limit_hz
    assert settled is not None and 0.45 * 24.0 < settled < 0.87 * 24.0  # up to where it rolls faster than at 24 Hz
    assert ROBOT.limited_to(settled).speed_limit_um_s == pytest.approx(25.0 * settled)
    rolled, asked = found[-1].rolled_sums[:2]
    assert rolled > 0.6 * asked
    assert next(each.stamp_ns for each in found if each.limit_hz is not None) < 1e9
    if map_error == 0.0:
        assert settled == pytest.approx(ROBOT.step_out_margin * 0.7 * 24.0, rel=0.03), (
            "the true step-out, and the margin"
        )


@pytest.mark.parametrize("share", [0.7, 1.0, 1.4])
@pytest.mark.parametrize("flow_um_s", [0.0, 200.0, 500.0])
def test_a_map_that_is_wrong_by_up_to_40_percent_and_a_robot_that_rolls_as_it_should_are_no_step_out(
    flow_um_s: float, share: float
) -> None:
    assert limits(swum(5.0, flow_um_s * share, flow_um_s, step_out_hz=28.8)) == [None]


def test_a_limit_that_does_not_help_is_lifted_and_not_tried_again_at_once() -> None:
    found = swum(9.0, 400.0, 0.0, step_out_hz=28.8)  # a flow that the map knows nothing of
    seen = limits(found)
    assert len(seen) == 3 and seen[0] is None and seen[1] is not None and seen[1] < 0.8 * 24.0 and seen[2] is None
    lowered, lifted = [k for k in range(1, len(found)) if found[k].limit_hz != found[k - 1].limit_hz]
    told = [event_of(Tick(k - 1, health=found[k - 1]), Tick(k, health=found[k])) for k in (lowered, lifted)]
    assert told[0] is not None and told[0].level == "warning" and f"limited to {seen[1]:.1f} Hz" in told[0].text
    assert told[1] is not None and "no step-out" in told[1].text


def test_the_limit_of_a_robot_that_a_wall_off_the_map_holds_back_is_lifted() -> None:
    none, lowered, lifted = limits(swum(5.0, 200.0, 200.0, step_out_hz=28.8, share=0.4))
    assert none is None and lowered is not None and lifted is None


def test_a_robot_that_steps_out_at_ever_lower_frequencies_is_slowed_down_each_time_at_once() -> None:
    found = swum(6.0, 0.0, 0.0, step_out_hz=0.7 * 24.0, later_hz=0.55 * 24.0)
    none, first, last = limits(found)
    assert none is None and first is not None and last is not None and last < 0.9 * first
    assert next(each.stamp_ns for each in found if each.limit_hz == last) < 4e9  # 10 s after one that did not help


def test_a_slow_field_says_nothing_of_step_out() -> None:
    assert limits(swum(5.0, 400.0, 0.0, step_out_hz=28.8, wanted_hz=10.0)) == [None]


def test_a_robot_that_a_wall_may_stop_says_nothing_of_step_out() -> None:
    assert limits(swum(5.0, 400.0, 0.0, step_out_hz=28.8, wall_um=1.2 * ROBOT.radius_um)) == [None]


@pytest.mark.slow("flies a mission upstream")
def test_upstream_a_robot_that_steps_out_below_what_was_stated_is_slowed_down_and_arrives(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Made:
        @staticmethod
        def of(pipeline: Pipeline, config: Config, *more: object) -> SimulatedRig:
            weak = replace(config.robot, step_out_hz=0.7 * config.robot.max_speed_um_s / config.robot.um_per_rev)  # type: ignore[operator]
            return SimulatedRig.of(pipeline, replace(config, robot=weak), *more)  # type: ignore[arg-type]

    monkeypatch.setattr("flowrec.rigs.simulated.rig.SimulatedRig", Made)
    sets = ["mission.phases=navigate", "mission.start=[6000, 2620]", "mission.goal=inlet"]
    done = record(load_config(None, [*SMALL, *sets]), tmp_path / "s.mcap")
    assert (done.report.outcome, done.report.contacts) == ("reached", 0), done.report.note
    told = [event for event in SessionReader(tmp_path / "s.mcap").messages("event") if "step-out" in event.text]  # type: ignore[attr-defined]
    assert told and all(event.level == "warning" for event in told)  # type: ignore[attr-defined]
    middle_s = told[-1].stamp_ns / 1e9 + 0.2  # type: ignore[attr-defined]
    replayed = replay.replay_session(tmp_path / "s.mcap", replay.Change(), from_s=round(middle_s, 3), verify=True)
    assert replayed.comparison.identical, str(replayed.comparison.first)
