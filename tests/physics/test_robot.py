"""The robot's response to the frequency of the field: in proportion, or by a table of speeds."""

import math

import numpy as np
import pytest

from flowrec.core import Applied, FlowField, UsageError
from flowrec.physics import ROLLING_BY_DRAG, Robot, load_chip
from flowrec.stages import load_config
from flowrec.stages.resolve import resolve
from flowrec.store import SessionReader
from flowrec.verbs.record import record
from tests.conftest import invoke
from tests.short_missions import SMALL

# Speed per revolution falls from 30 to 14 um: of a helix near its step-out, or a roller that slips.
TABLE = ((5.0, 150.0), (10.0, 260.0), (20.0, 420.0), (40.0, 560.0))
BENT = Robot(radius_um=50.0, um_per_rev=30.0, max_speed_um_s=900.0, step_out_hz=40.0, speed_at_hz=TABLE)


def refined_with(**parameters):
    """A flow with what a refinement found: values and standard deviations by name."""
    still, (values, stds) = np.zeros((2, 2, 2), np.float32), np.array(list(parameters.values())).T
    return FlowField(
        *(0, 0, "assimilate", 20.0, still, still[..., 0], None, np.zeros(0), 1.0, 1000.0, ""),
        parameter_names="; ".join(parameters),
        parameters=values,
        parameter_std=stds,
    )


def table_of(robot):
    return "robot.speed_at_hz=" + str([list(pair) for pair in robot])


def test_a_robot_by_a_table_is_as_fast_as_the_table_says_and_is_driven_at_the_frequency_for_it():
    for hz, um_s in TABLE:
        assert BENT.rolled_speed_um_s(hz) == pytest.approx(um_s)
        assert BENT.frequency_hz(um_s / BENT.um_per_rev) == pytest.approx(hz)
    assert BENT.rolled_speed_um_s(15.0) == pytest.approx(340.0) and BENT.rolled_speed_um_s(2.0) == pytest.approx(60.0)
    assert BENT.frequency_hz(1e6) == 40.0, "not beyond what was measured"
    assert BENT.speed_limit_um_s == pytest.approx(BENT.rolled_speed_um_s(36.0))
    # Stepped out, it follows 1 - sqrt(1 - (40 / 60)^2) of the turns, each as far as in its last step with the field.
    assert BENT.rolled_speed_um_s(60.0) == pytest.approx(560.0 / 40.0 * (60.0 - math.sqrt(60.0**2 - 40.0**2)))


def test_the_proportional_robot_is_as_fast_and_comes_back_to_the_same_table():
    known = BENT.proportional()
    assert known.speed_at_hz == () and known.speed_limit_um_s == pytest.approx(BENT.speed_limit_um_s)
    again = BENT.responding(known)
    assert again.speed_at_hz == TABLE and again.step_out_hz == pytest.approx(BENT.step_out_hz)
    slower = BENT.responding(known.limited_to(known.step_out_margin * BENT.proportional_hz(10.0)))
    assert slower.step_out_hz * slower.step_out_margin == pytest.approx(
        BENT.frequency_hz(0.9 * BENT.proportional_hz(10.0))
    )
    for frequency_hz in (1.0, 7.0, 25.0):
        turns = 0.05 * frequency_hz * np.array([0.6, -0.8])
        before, now = (Applied(k * 50_000_000, frequency_hz, 0.0, 4.0, np.zeros(3), turns) for k in (0, 1))
        moved_um = known.um_per_rev * BENT.proportional_turns(before, now).turns
        np.testing.assert_allclose(moved_um, 0.05 * BENT.rolled_speed_um_s(frequency_hz) * np.array([0.6, -0.8]))
        assert known.proportional_turns(before, now) is now and known.proportional() is known


@pytest.mark.parametrize(
    ("change", "std", "per_rev", "speed"),
    [
        (-0.2, 0.05, 0.8, 0.8),  # it is slower
        (0.2, 0.05, 1.2, 1.0),  # it steps out no later, so it is not commanded to swim faster
        (0.2, 0.11, 1.0, 1.0),  # less than two standard deviations
        (-0.2, 0.11, 1.0, 1.0),
        (-1.1, 0.1, 1.0, 1.0),  # no robot rolls backwards
    ],
)
def test_what_a_refinement_finds_of_the_um_per_revolution_is_taken_where_it_is_significant(change, std, per_rev, speed):
    robot = Robot(radius_um=50.0, um_per_rev=25.0, max_speed_um_s=600.0, step_out_hz=30.0)
    refined = refined_with(um_per_rev_share=(change, std))
    found = robot.learned_from(refined)
    assert (found.um_per_rev, found.max_speed_um_s) == pytest.approx((25.0 * per_rev, 600.0 * speed))
    assert robot.learned_from(None) is robot


@pytest.mark.parametrize("by_drag_std", [0.01, 0.05, 0.1])
def test_where_the_robot_was_observed_it_rolls_as_was_found_there_and_less_nearer_to_a_wall(by_drag_std):
    robot = Robot(radius_um=50.0, um_per_rev=25.0, max_speed_um_s=600.0, step_out_hz=30.0)
    in_open, by_drag, seen_drag = 0.08, -0.4, 0.35
    everywhere = in_open + by_drag * seen_drag
    names = dict(zip(ROLLING_BY_DRAG, ((in_open, 0.02), (by_drag, by_drag_std)), strict=True))
    refined = refined_with(um_per_rev_share=(everywhere, 0.02), **names)
    assert robot.um_per_rev_at(seen_drag, refined) == pytest.approx((1.0 + everywhere) * 25.0)
    slopes = np.diff([robot.um_per_rev_at(drag, refined) for drag in (0.0, 0.5, 1.0)]) / (0.5 * 25.0)
    # Between what was found and what is usual of a roller, -0.3 +- 0.1, by their variances.
    np.testing.assert_allclose(slopes, (-0.4 / by_drag_std**2 - 0.3 / 0.01) / (by_drag_std**-2 + 100.0))


@pytest.mark.parametrize("table", ["[[5, 100], [5, 120]]", "[[5, 100], [10, 90]]", "[[10, 100], [5, 120]]"])
def test_a_table_that_does_not_rise_is_refused_in_one_line(table):
    with pytest.raises(UsageError, match=r"^--set: robot\.speed_at_hz: [^\n]*$"):
        load_config(None, [f"robot.speed_at_hz={table}"])
    with pytest.raises(UsageError, match=r"robot\.speed_at_hz"):
        load_config(None, ["robot.speed_at_hz=[[5, -1]]"])


def test_a_table_sets_the_um_per_revolution_of_slow_turns_and_the_fastest_speed():
    config = load_config(None, [table_of(TABLE)])
    chip = load_chip(config.chip)
    robot = resolve(config, chip).robot
    assert (robot.um_per_rev, robot.max_speed_um_s, robot.step_out_hz) == (30.0, 560.0, 40.0)
    assert resolve(resolve(config, chip), chip).robot == robot


@pytest.mark.parametrize(
    "sets",
    [
        pytest.param(["coils.mode=roller"], marks=pytest.mark.slow("the mode of most missions")),
        pytest.param(["coils.mode=helix"], marks=pytest.mark.slow("flies and replays a mission")),
        [table_of(TABLE)],
    ],
    ids=["roller", "helix", "table"],
)
def test_a_roller_a_helix_and_a_robot_by_a_table_reach_their_goal_and_replay_identically(tmp_path, sets):
    done = record(load_config(None, [*SMALL, *sets, "mission.phases=plan,navigate"]), tmp_path / "a.mcap")
    reader = SessionReader(done.path)
    assert list(reader.messages("mission"))[-1].outcome == "reached"
    assert list(reader.messages("truth"))[-1].contacts == 0
    verdict = invoke("replay", done.path, "--verify")
    assert verdict.exit_code == 0 and "identical" in verdict.stdout + verdict.stderr
    if sets != [table_of(TABLE)]:
        return
    sent = [each for each in reader.messages("currents") if 6.0 < each.frequency_hz < 35.0]
    demanded = {each.stamp_ns: np.hypot(*each.velocity_um_s) for each in reader.messages("demand")}
    assert len(sent) > 20
    own_um_s = [np.hypot(*each.rolled_um_s) for each in reader.messages("estimate")]
    assert 300.0 < max(own_um_s) <= 560.0, "the observer knows how fast it turns, not how often"
    for each in sent[::5]:
        if each.frequency_hz < 0.999 * each.limit_hz:
            assert BENT.rolled_speed_um_s(each.frequency_hz) == pytest.approx(demanded[each.stamp_ns], rel=1e-6)
