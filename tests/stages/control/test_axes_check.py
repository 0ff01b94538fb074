"""The check of the axes at the beginning of a run."""

import math
from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest

from flowrec.core import Outcome, Phase, parse_toml
from flowrec.physics import AS_STATED, ORIENTATIONS, load_chip
from flowrec.rigs import SimulatedRig, checked_images
from flowrec.stages import (
    Coils,
    MotionOfRun,
    assemble,
    config_from_toml,
    load_config,
    orientation_by_motion,
    own_gain,
    step,
    to_toml,
)
from flowrec.stages.control.motion_axes import coil_settings
from flowrec.stages.pipeline import Tick
from flowrec.stages.resolve import resolve

SETS = ["simulated.seed=1", "simulated.world=kind", "mission.phases=survey"]


@lru_cache(maxsize=2)
def pipeline(*sets):
    chip = load_chip(load_config(None, SETS).chip)
    config = resolve(load_config(None, [*SETS, *sets]), chip)
    return config, replace(config.flow.solve(chip), request=1), assemble(config, chip)


def flown(coils=AS_STATED, *sets, most_s=4.0, after_s=0.3):
    """Ticks of a start, up to a little after the verdict; the robot moves in this orientation of what is commanded."""
    config, assumed, stages = pipeline(*sets)
    rig = SimulatedRig.of(stages, config)
    inputs, ticks, end_s = [], [Tick()], most_s
    with rig:
        for arrived in checked_images(rig.inputs(), stages.image_shape):
            told = replace(arrived.applied, turns=coils.matrix.T @ arrived.applied.turns)
            solved = assumed if len(inputs) == 3 else None
            inputs.append(replace(arrived, applied=told, assumed=solved))
            ticks.append(step(stages, ticks[-1], inputs[-1]))
            currents, now_s = ticks[-1].currents, arrived.stamp_ns / 1e9
            way = coils.matrix @ (math.cos(currents.heading_rad), math.sin(currents.heading_rad))
            rig.apply(replace(currents, heading_rad=math.atan2(way[1], way[0])))
            if ticks[-1].axes is not None and ticks[-1].axes.verdict and end_s == most_s:
                end_s = now_s + after_s
            if now_s >= end_s:
                return ticks[1:], inputs
    raise AssertionError("the rig has ended")


@pytest.mark.parametrize("orientation", ORIENTATIONS, ids=lambda each: each.name)
def test_a_robot_that_moves_in_another_orientation_is_refused_within_3_s_without_touching_a_wall(orientation):
    ticks, inputs = flown(orientation)
    last = ticks[-1]
    assert inputs[-1].truth.contacts == 0 and last.axes.driven_s <= 3.1
    assert last.axes.leg < 4, "it is not driven on, and drifts no farther, once that is known"
    if orientation == AS_STATED:
        assert last.axes.verdict == "agrees" and not last.mission.finished
        return
    assert last.axes.verdict == "contradicts" and last.mission.outcome == Outcome.REFUSED
    assert f"the robot moves {orientation.name}" in last.mission.note
    assert coil_settings(orientation, pipeline()[0].coils) in last.mission.note
    assert last.currents.frequency_hz == 0.0


def test_a_robot_that_does_not_follow_the_field_is_refused_as_that():
    ticks, _ = flown(AS_STATED, "simulated.um_per_rev_share=0.01")
    assert ticks[-1].axes.verdict == "no motion" and ticks[-1].mission.outcome == Outcome.REFUSED
    assert "does not follow the field" in ticks[-1].mission.note


def test_nothing_is_controlled_before_the_verdict_and_the_robot_stays_within_a_radius_but_for_the_flow():
    ticks, _ = flown()
    before = [tick for tick in ticks if tick.axes is not None and not tick.axes.verdict]
    for tick in before:
        if tick.assumed is None:
            assert np.count_nonzero(tick.demand.velocity_um_s) <= 1, "along one axis, whatever the position"
    own_um = np.array([tick.axes.own_um - tick.axes.steady_um for tick in before])
    assert np.abs(own_um).max() <= pipeline()[0].robot.radius_um
    assert all(tick.mission.phase == Phase.START and tick.mission.request == 1 for tick in before), "no order yet"
    assert ticks[-1].mission.request == 2


def test_the_check_goes_on_the_same_from_any_of_its_ticks():
    _, _, stages = pipeline()
    ticks, inputs = flown()
    for first in range(1, len(ticks), 5):
        again = step(stages, ticks[first - 1], inputs[first])
        assert again.axes is ticks[first].axes or again.axes.same_as(ticks[first].axes)
        assert again.demand.same_as(ticks[first].demand) and again.currents.same_as(ticks[first].currents)


def test_a_session_that_does_not_state_the_setting_is_replayed_without_the_check():
    config = pipeline()[0]
    assert config.mission.check_axes and load_config().mission.check_axes
    text = "\n".join(line for line in to_toml(config).splitlines() if not line.startswith("check_axes"))
    assert not config_from_toml(text, "a session").mission.check_axes


@pytest.mark.parametrize(
    ("count", "turned", "doubt"),
    [(600, AS_STATED, None), (600, ORIENTATIONS[6], "mirrored left to right"), (20, AS_STATED, "not confirmed")],
)
def test_a_check_that_did_not_decide_is_a_doubt_unless_the_motion_of_the_run_does(count, turned, doubt):
    ticks, inputs = flown()
    undecided = replace(ticks[-1].axes, verdict="undecided", text="the axes are not confirmed")
    run, way_um = MotionOfRun(pipeline()[0].robot), np.zeros(2)
    for n in range(count):
        turns = np.array((math.cos(n // 20), math.sin(2.0 * (n // 20))))
        way_um = way_um + pipeline()[0].robot.um_per_rev * turned.matrix @ turns + (1.0, 0.0)
        track = replace(ticks[-1].track, stamp_ns=n * 33_000_000, position_um=way_um)
        applied = replace(inputs[-1].applied, stamp_ns=track.stamp_ns, turns=turns)
        run.write(Tick(stamp_ns=track.stamp_ns, track=track, applied=applied, axes=undecided))
    assert (doubt or "") in " ".join(run.doubts()) and bool(run.doubts()) == bool(doubt)
    run.write(replace(ticks[-1]))  # a check that agreed
    assert not run.doubts()


@pytest.mark.parametrize("turned_deg", [-20.0, 20.0])
def test_a_heading_offset_and_a_slower_robot_are_no_contradiction(turned_deg):
    angle = math.radians(turned_deg)
    gain = 0.7 * np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])
    assert orientation_by_motion(gain, 0.03).verdict == "agrees"
    assert orientation_by_motion(gain, 0.3).verdict == "undecided"


@pytest.mark.parametrize("mode", ["roller", "helix"])
@pytest.mark.parametrize("orientation", ORIENTATIONS, ids=lambda each: each.name)
def test_the_pasted_matrix_of_the_coils_makes_the_robot_move_as_commanded(orientation, mode):
    """The true coils make the field that the pasted matrix says; the heading that follows from it is the true one."""
    coils = Coils(mode=mode)
    rows = parse_toml(coil_settings(orientation, coils).removeprefix("coils."))["mt_per_a"]
    pasted = np.array(rows)
    heading_rad, quarter = 0.4, math.pi / 2
    stated_field = coils.field_mt(quarter, heading_rad, coils.amplitude_mt)
    true_field = pasted @ coils.currents_a(stated_field, coils.amplitude_mt)
    way = orientation.matrix @ (math.cos(heading_rad), math.sin(heading_rad))
    expected = coils.field_mt(quarter, math.atan2(way[1], way[0]), coils.amplitude_mt)
    np.testing.assert_allclose(true_field, expected, atol=1e-9)


def test_a_robot_that_goes_mostly_along_one_axis_still_refutes_that_this_axis_is_as_stated():
    std = np.array([[0.05, 0.4], [0.05, 0.4]])  # of the columns: hardly any command along y
    assert orientation_by_motion(np.diag((1.0, 1.1)), std).verdict == "undecided"
    found = orientation_by_motion(np.diag((-1.0, 1.1)), std)
    assert found.verdict == "contradicts" and found.orientation.name == "mirrored left to right"


def test_the_gain_of_a_recording_is_found_although_the_commands_compensate_a_flow():
    rng, time_s = np.random.default_rng(3), np.arange(0.0, 20.0, 1 / 30)
    flow_um_s = np.stack((120.0 + 40.0 * np.sin(0.3 * time_s), -60.0 * np.cos(0.2 * time_s)), -1)
    ways = rng.normal(0.0, 150.0, (25, 2))[np.minimum((time_s / 0.8).astype(int), 24)]
    own_um = np.cumsum((ways - flow_um_s) / 30, axis=0)
    turned = ORIENTATIONS[6].matrix
    seen_um = own_um @ turned.T + np.cumsum(flow_um_s / 30, axis=0) + rng.normal(0.0, 0.5, own_um.shape)
    gain, std = own_gain(time_s, seen_um, own_um)
    np.testing.assert_allclose(gain, turned, atol=max(4.0 * float(std.max()), 0.1))
    assert orientation_by_motion(gain, std).orientation == ORIENTATIONS[6]
    assert orientation_by_motion(*own_gain(time_s[:20], seen_um[:20], own_um[:20])).verdict == "undecided"


@pytest.mark.parametrize("jumps", [0, 4])
def test_the_stated_errors_of_a_gain_are_those_of_many_recordings_also_where_the_track_jumps(jumps):
    rng, time_s = np.random.default_rng(5), np.arange(0.0, 16.0, 1 / 30)
    errors, stds = [], []
    for _ in range(40):
        ways = rng.normal(0.0, 150.0, (40, 2))[np.minimum((time_s / 0.4).astype(int), 39)]
        own_um = np.cumsum(ways / 30, axis=0)
        seen_um = own_um + np.cumsum(rng.normal(0.0, 3.0, own_um.shape), axis=0)
        seen_um[rng.choice(len(time_s), jumps, replace=False)] += 3000.0
        gain, std = own_gain(time_s, seen_um, own_um)
        errors.append(gain - np.eye(2))
        stds.append(std)
    scatter, stated = np.sqrt(np.mean(np.square(errors), axis=0)), np.sqrt(np.mean(np.square(stds), axis=0))
    np.testing.assert_allclose(np.log(stated / scatter), 0.0, atol=0.5)
    assert scatter.max() < 0.2
