"""The bench of whole missions: its intervals are the published ones, and its figures those of the ticks themselves."""

import json
import math
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from flowrec.bench import missions
from flowrec.bench.figures import draw_missions
from flowrec.bench.harness import paired_ratio, wilson
from flowrec.bench.mission_tables import compare_times, summary
from flowrec.bench.missions import MissionLog, TrueWorld, chip_of, fly, optimum_s, results_of
from flowrec.core.errors import UsageError
from flowrec.physics.chip.chip import ChipSettings
from flowrec.physics.chip.io import load_chip
from flowrec.rigs.lab.amplifiers.limits import CommandLimits
from flowrec.stages.control.amplifier import AmplifierSettings
from flowrec.stages.control.coils import Coils
from flowrec.stages.rig_settings import OutputLimits
from tests.stages.estimation.lap import ROBOT
from tests.stages.planning.worlds import channel, field_of, open_water, robot
from tests.stages.planning.worlds import chip_of as made_up

TINY = ("chip.name=straight", "camera.width_px=320", "camera.height_px=80", "mission.goal=[2400.0, 620.0]")


@pytest.mark.parametrize(
    ("successes", "count", "interval"),
    # Newcombe, Statistics in Medicine 17 (1998), table I, method 3.
    [(81, 263, (0.2553, 0.3662)), (15, 148, (0.0624, 0.1605)), (0, 20, (0.0, 0.1611)), (1, 29, (0.0061, 0.1718))],
)
def test_the_interval_of_a_share_is_wilsons(successes, count, interval):
    assert wilson(successes, count) == pytest.approx(interval, abs=6e-5)
    low, high = wilson(count - successes, count)
    assert (1.0 - high, 1.0 - low) == pytest.approx(interval, abs=6e-5)


def test_no_rounding_takes_wilsons_interval_out_of_0_to_1():
    for count in range(1, 200):
        assert (wilson(0, count)[0], wilson(count, count)[1]) == (0.0, 1.0), count


def test_pairs_are_compared_by_their_ratios():
    same = paired_ratio(np.full(10, 0.8))
    assert (same["mean"], *same["interval_95"]) == pytest.approx((0.8, 0.8, 0.8))
    assert same["less"] == 10 and same["sign_p"] == pytest.approx(2 / 2**10)
    even = paired_ratio(np.array([0.5, 2.0, 0.8, 1.25]))
    assert even["mean"] == pytest.approx(1.0) and even["sign_p"] == 1.0
    assert even["interval_95"][0] < 1.0 < even["interval_95"][1]
    assert paired_ratio(np.zeros(0)) == {"count": 0}


@pytest.mark.parametrize("flow", [0.0, 60.0, -60.0])
def test_the_optimum_in_a_uniform_flow_is_the_way_less_the_tolerance_at_full_speed(flow):
    mask = open_water()
    time_s = optimum_s(field_of(mask, flow), (100.0, 400.0), (900.0, 400.0), 30.0, made_up(mask), robot())
    assert time_s == pytest.approx((800.0 - 30.0) / (100.0 + flow), rel=2e-3)


def test_there_is_no_optimum_against_a_flow_that_is_too_fast():
    mask = channel()
    assert optimum_s(field_of(mask, -120.0), (100.0, 200.0), (900.0, 200.0), 10.0, made_up(mask), robot()) is None


MISSION = pytest.mark.slow("needs a mission of the bench")


@pytest.fixture(scope="module")
def flown():
    ticks = []
    sets = "plan.method=astar_time", "observer.method=kalman_map"
    row = fly(3, TINY, "down", "assumed", "vector", TrueWorld("inlet", "real", sets), ticks.append)
    return row, ticks


@MISSION
def test_a_row_says_what_the_ticks_say(flown):
    row, ticks = flown
    going = [tick for tick in ticks if tick.mission.phase == "navigate"]
    done = next(tick for tick in ticks if tick.mission.finished)
    assert (row.outcome, row.contacts, row.survey_contacts, row.replans) == ("reached", 0, 0, 0)
    assert row.beyond == 0 and max(tick.currents.amplitude_mt for tick in ticks) > 3.0
    assert ticks[-1].truth.contacts == 0
    assert row.seconds == pytest.approx((done.stamp_ns - going[0].stamp_ns) * 1e-9)
    assert row.ratio == row.seconds / row.optimum_s and 0.97 < row.ratio < 1.6
    errors = [tick.demand.error_um for tick in going]
    assert row.rms_um == pytest.approx(math.sqrt(np.mean(np.square(errors))))
    assert math.dist(done.truth.position_um, done.mission.goal_um) < 1.2 * row.radius_um
    # In the middle of a straight channel nothing is faster than to swim with 1.5 times the mean flow.
    way_um = math.dist(going[0].truth.position_um, done.mission.goal_um) - row.radius_um
    true_um_s = row.speed_limit_um_s + ticks[0].true_field.velocity_um_s[..., 0].max()
    assert row.optimum_s == pytest.approx(way_um / true_um_s, rel=0.02)


@MISSION
def test_the_true_flow_is_wrong_by_what_was_asked(flown):
    _, ticks = flown
    inlet_um_s = [opening.value for opening in load_chip(ChipSettings("straight")).openings if opening.kind == "inlet"]
    assert len(inlet_um_s) == 1
    share = ticks[0].true_field.boundary_values.max() / inlet_um_s[0]
    assert abs(share - 1.0) == pytest.approx(0.1)


@MISSION
def test_observations_of_a_mission_that_corrects_a_map_are_taken_from_the_filter_without_it(flown):
    _, ticks = flown
    taken = [now for last, now in pairwise(ticks) if now.observations is not last.observations and now.mapless]
    assert len(taken) > 3 and all(tick.mapless.stamp_ns == tick.stamp_ns for tick in taken)
    assert all(tick.observations.flow_um_s[-1].tolist() == tick.mapless.flow_um_s.tolist() for tick in taken)
    assert all(tick.mapless.flow_um_s.tolist() != tick.estimate.flow_um_s.tolist() for tick in taken)


@MISSION
def test_the_world_flies_as_it_is_with_its_walls_its_robot_and_its_coils(flown):
    ticks = []
    row = fly(
        3, (*TINY, "mission.navigate_limit_s=0.1"), "down", "assumed", "vector", TrueWorld("hard", "real"), ticks.append
    )
    note = ticks[0].true_field.note
    for drawn in ("world hard", "depth", "um per revolution", "step-out", "walls", "coils up to 3 % off"):
        assert drawn in note, drawn
    assert row.world == "hard" and "world" not in flown[1][0].true_field.note


@MISSION
def test_a_command_that_an_amplifier_would_change_or_an_output_beyond_its_limit_is_counted(flown):
    _, ticks = flown
    coils = Coils(amplifier=AmplifierSettings(kind="voltage"))
    tick = next(tick for tick in ticks if tick.currents.amplitude_mt == 4.0 and tick.currents.frequency_hz > 5.0)
    fine, weak = (
        MissionLog(CommandLimits(c, ROBOT, OutputLimits())) for c in (coils, replace(coils, max_current_a=1.0))
    )
    for log in (fine, weak):
        log.write(tick)
    assert (fine.beyond, weak.beyond) == (0, 1)
    fine.write(replace(tick, currents=replace(tick.currents, frequency_hz=1e3)))
    assert fine.beyond == 1


@MISSION
def test_a_flow_too_swift_is_refused_before_the_robot_is_let_in():
    swift = (*TINY, "chip.inlet_speed_um_s=60000")
    ticks = []
    row = fly(3, swift, "down", "assumed", "vector", TrueWorld(sets=("plan.method=astar_time",)), ticks.append)
    assert row.world == "kind"
    assert row.outcome == "refused" and "too swift to be steered" in row.note
    assert not ticks


@pytest.mark.slow("flies two missions of the bench")
def test_a_summary_counts_and_pairs_what_arrived(flown, tmp_path, capsys):
    row, _ = flown
    rows = [
        row,
        replace(row, policy="paper", seconds=2.0 * row.seconds, ratio=2.0 * row.ratio, contacts=2),
        replace(row, seed=4, outcome="unreachable", seconds=None, ratio=None),
        replace(row, seed=4, policy="paper", outcome="timeout", seconds=None, ratio=None),
    ]
    ours = summary([made for made in rows if made.policy == "vector"])
    theirs = summary([made for made in rows if made.policy == "paper"])
    assert (ours["reached"]["count"], ours["honest"]["count"], ours["without_contact"]["count"]) == (1, 2, 2)
    assert (theirs["reached"]["count"], theirs["honest"]["count"], theirs["without_contact"]["count"]) == (1, 1, 1)
    assert ours["ratio"]["median"] == row.ratio and theirs["failed"] == ["straight 4 down assumed: timeout"]
    pair = compare_times(rows, "vector", "paper")
    assert pair["count"] == 1 and pair["mean"] == pytest.approx(0.5)
    hard = replace(row, world="hard", outcome="left the chip", seconds=None, ratio=None, beyond=2)
    figures = results_of([*rows, hard], ["inlet", "hard"], ["vector", "paper"]) | {"seeds": 2, "coils": "real"}
    assert figures["summary"]["inlet"] == {"vector": ours, "paper": theirs}
    assert figures["pairs"]["inlet"] == {"vector / paper": pair} and figures["fault_count"] == 2
    assert list(figures["summary"]["hard"]) == ["vector"]
    json.dumps(figures)
    missions.show(figures)
    said = capsys.readouterr().err
    assert "straight 3 down assumed" in said and "2 commands" in said
    draw_missions(tmp_path / "a.png", figures)
    assert (tmp_path / "a.png").read_bytes().startswith(b"\x89PNG")


def test_seeds_take_chips_in_turn_and_wrong_requests_are_said_at_once(tmp_path):
    assert [chip_of(seed, [])[0] for seed in (1, 2)] == ["chip.name=bifurcation", "chip.name=vessels"]
    for words, named in (
        ((None, "luck"), "luck"),
        ((None, "vector", "mild"), "mild"),
        ((None, "vector", "hard", "none"), "none.*ample, real"),
        ((tmp_path, "vector"), str(tmp_path)),
    ):
        with pytest.raises(UsageError, match=named):
            missions.measure(1, *words)
