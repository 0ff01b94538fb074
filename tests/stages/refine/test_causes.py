"""What robot, pump, depth and registration add to observations is found, or said to be unknown, with its sign."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from flowrec.core import cells_at
from flowrec.core.messages import Observations
from flowrec.physics import ROLLING_BY_DRAG, ChannelWidths, SphereBetweenWalls, with_levels
from flowrec.physics.chip.clearance import clearance_um
from flowrec.physics.flow.sampling import sample
from flowrec.stages.refine import Assimilate, Refiner
from flowrec.stages.refine.causes import Observed
from flowrec.stages.refine.disturbances import frequencies_hz, held_back, likeliest_hz, shaking
from flowrec.stages.refine.evidence import Effect, EffectModel
from flowrec.stages.refine.flow_model import flow_model
from flowrec.stages.refine.observation_operator import observation_operator

SETTINGS = Refiner(assimilate=Assimilate(doubt_walls=False, doubt_depth=False))


def flown(
    case, headings="varied", seed=0, gain=0.0, pump=0.0, hz=0.5, noise=3.0, offset=(0.0, 0.0), count=80, scale=0.0
):
    """A survey in a true flow, by a robot that rolls along headings that vary, or always in proportion to the flow."""
    rng = np.random.default_rng(seed)
    corners = np.array([[20, 240], [240, 240], [240, 120], [555, 120], [555, 240], [760, 240]], float)
    pieces = [np.linspace(a, b, int(np.abs(b - a).max() / 5), endpoint=False) for a, b in pairwise(corners)]
    way = np.concatenate(pieces)
    points = way[np.linspace(0, len(way) - 1, count).astype(int)]
    if headings == "varied":
        angle = rng.uniform(0.0, 2.0 * np.pi, count)
        rolled = 150.0 * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    else:
        rolled = 0.8 * sample(case.assumed, points)
    time_s = 0.25 * np.arange(count)
    truth = (1.0 + scale) * sample(case.true, points + np.array(offset) - scale * (points - points.mean(axis=0)))
    flow = truth * (1.0 + pump * np.sin(2.0 * np.pi * hz * time_s + 1.0))[:, None]
    flow = flow + (gain + scale) * rolled + noise * rng.standard_normal(flow.shape)
    return Observations(0, points, flow, np.full(count, noise), rolled, time_s)


def found(refined, name):
    """Value and standard deviation."""
    index = refined.parameter_names.split("; ").index(name)
    return float(refined.parameters[index]), float(refined.parameter_std[index])


def test_where_the_headings_never_vary_the_note_says_that_it_is_unknown_and_the_error_bars_contain_it(twin):
    case = twin(truth=(120.0, 0.0, 0.0))
    scores = []
    for gain in (-0.12, 0.0, 0.12):
        observed = flown(case, headings="along", gain=gain)
        refined = SETTINGS.refine(case.assumed, observed, case.chip, case.solver)
        value, std = found(refined, "um_per_rev_share")
        assert abs(value - gain) < 3.0 * std and std > 0.04
        assert "um per revolution they tell to" in refined.note
        fast = np.linalg.norm(case.true.velocity_um_s, axis=-1) > 20.0
        scores.append((refined.velocity_um_s - case.true.velocity_um_s)[fast] / refined.std_um_s[fast])
    # Two of the three gains lie 1.5 standard deviations of the prior from what is stated.
    assert np.mean(np.abs(np.concatenate(scores)) < 2.0) > 0.85


@pytest.mark.parametrize("hz", [0.1, 0.7])
def test_a_planted_line_of_the_pump_is_found_at_its_frequency_and_the_flow_is_that_without_it(twin, hz):
    case = twin()
    refined = SETTINGS.refine(case.assumed, flown(case, pump=0.25, hz=hz), case.chip, case.solver)
    line = next(name for name in refined.parameter_names.split("; ") if name.startswith("pump_"))
    assert float(line.split("_")[1]) == pytest.approx(hz, abs=0.02)
    assert found(refined, line)[0] == pytest.approx(0.25, abs=0.05)
    assert case.error(refined) < 0.06
    assert "the pump pulsates by" in refined.note


def test_an_offset_of_the_registration_is_found_in_its_direction(twin):
    case = twin()
    observed = flown(case, offset=(4.0, -8.0), noise=1.0)
    refined = SETTINGS.refine(case.assumed, observed, case.chip, case.solver)
    for name, true in (("offset_x_um", 4.0), ("offset_y_um", -8.0)):
        value, std = found(refined, name)
        assert abs(value - true) < 3.0 * std and std < 4.0
    assert "from where the registration puts it" in refined.note
    # Mission and controller place the robot by it, unless that is switched off, as in sessions from before.
    places = np.column_stack((observed.position_um, np.ones(len(observed.position_um))))
    placed = places @ refined.registration.T - observed.position_um
    assert np.hypot(*(placed.mean(axis=0) - [4.0, -8.0])) < 4.0
    stated = replace(SETTINGS, place_robot=False).refine(case.assumed, observed, case.chip, case.solver)
    assert stated.registration is None and stated.parameters.tolist() == refined.parameters.tolist()


def test_an_image_scale_that_moves_observations_across_a_channel_is_found(twin):
    # At the ends of the chip they are 1.4 px off in channels of 8, where the flow is no longer linear.
    case, scale = twin(), -0.04
    observed = flown(case, noise=1.0, scale=scale)
    refined = SETTINGS.refine(case.assumed, observed, case.chip, case.solver)
    value, std = found(refined, "um_per_px_share")
    assert abs(value - scale) < 3.0 * std and std < 0.01
    assert case.error(refined) < 0.04


def test_the_next_stretch_of_a_survey_is_told_where_the_chip_lies_under_the_image(twin):
    case, scale = twin(), -0.04
    observed = flown(case, noise=1.0, scale=scale, offset=(4.0, -8.0))
    uncertainty = SETTINGS.uncertainty(case.assumed, observed, case.chip, case.solver)
    places = observed.position_um
    true = places + np.array([4.0, -8.0]) - scale * (places - places.mean(axis=0))
    off = np.hypot(*(uncertainty.registration.on_chip(places) - true).T)
    before = np.hypot(*(places - true).T)
    assert off.max() < 0.5 * before.max() and np.median(off) < 0.5 * np.median(before)


def test_the_distance_to_a_wall_is_that_of_the_chip(twin):
    # The solver's own distance ends at one pixel: with it every observation was as near to a wall as every other.
    case = twin()
    observations = Observations(0, np.array([[400.0, 100.0], [400.0, 120.0]]), np.ones((2, 2)), np.ones(2))
    operator = observation_operator(observations, case.chip.mask, 10.0, case.assumed.wall_px)
    settings = Assimilate()
    model = flow_model(settings, settings.model, case.chip, case.solver)
    observed = Observed.of(model, operator)
    assert observed.least_px == pytest.approx(2.5, abs=0.1)
    assert observed.near == pytest.approx([1.0, np.exp(-1.0 / 1.25)], abs=0.05)


def test_observations_with_another_model_have_the_error_of_that_model_and_not_of_the_one_before(twin):
    case = twin()
    settings = SETTINGS.assimilate
    model = flow_model(settings, settings.model, case.chip, case.solver)
    operator = observation_operator(flown(case), case.chip.mask, 10.0, case.assumed.wall_px)
    observed = Observed.of(model, operator)
    before = observed.there.local_error
    less_known = replace(observed, model=replace(model, error_std=3.0 * model.error_std))
    assert np.allclose(less_known.there.local_error, 9.0 * before, rtol=1e-12)


def test_a_stage_that_shakes_is_found_and_the_flow_is_that_without_it(twin):
    case = twin()
    observed = flown(case)
    assert "shake" not in SETTINGS.refine(case.assumed, observed, case.chip, case.solver).parameter_names
    sway = np.outer(np.cos(2.0 * np.pi * 1.3 * observed.time_s + 0.4), [60.0, -100.0])
    shaken = replace(observed, flow_um_s=observed.flow_um_s + sway)
    refined = SETTINGS.refine(case.assumed, shaken, case.chip, case.solver)
    assert "the image shakes at 1.3" in refined.note
    name = next(name for name in refined.parameter_names.split("; ") if name.startswith("shake"))
    assert found(refined, name)[0] == pytest.approx(np.hypot(60.0, 100.0), rel=0.1)
    assert case.error(refined) < 0.04


def test_of_frequencies_that_a_camera_can_not_tell_apart_the_slowest_is_taken():
    # Four observations a second see 4 - f, 4 + f and 8 - f Hz as f. Here one of these is a frequency that is tried, and
    # f lies between two of them, so that the alias explains a little more.
    time_s, noise_um_s = 0.25 * np.arange(32), 3.0
    tried = frequencies_hz(time_s)
    for about_hz in (2.7, 6.2):
        alias_hz = tried[np.abs(tried - about_hz).argmin()]
        hz = min(abs(4.0 - alias_hz), abs(8.0 - alias_hz))
        sway = 0.3 * noise_um_s * np.array([3.0, -1.0, 2.0, 1.0]) @ shaking(alias_hz, time_s)[1].reshape(4, -1)
        noise = Effect("noise", 1.0, 0.1, np.zeros((0, len(sway))), noise_um_s**2 * np.eye(len(sway)))
        evidence = EffectModel(sway, 1e-9 * np.eye(len(sway)), [noise])
        found = likeliest_hz(evidence, evidence.sizes(), np.eye(len(sway)), time_s, noise_um_s)
        assert found == pytest.approx(hz, abs=tried[1] - tried[0])


def test_a_robot_that_was_held_is_another_unknown_in_each_stretch_of_time():
    time_s, near = 0.15 * np.arange(40), np.isin(np.arange(40), (5, 6, 7, 30))
    _, columns = held_back(near, time_s)
    assert columns.shape == (12, 40, 2)  # the same, coming and going, changing sign: along two axes, in two stretches
    first, other = (columns[start, :, 0] for start in (0, 3))
    assert first[5:8] == pytest.approx(1.0) and other[30] == pytest.approx(1.0)
    assert first[[3, 9]] == pytest.approx(np.exp(-0.5 * 2.0**2))
    assert np.abs(first[20:]).max() < 1e-9 and np.abs(other[:20]).max() < 1e-9
    assert held_back(np.zeros(40, bool), time_s) is None


def test_a_sphere_between_walls_follows_published_limits():
    # Goldman, Cox and Brenner (1967): a free sphere in a shear flow, its speed over that at its centre at gaps of
    # 0.5431 and 2.7622 radii, and the drag along the wall over Stokes' there (part I).
    mask = np.zeros((404, 8), bool)
    mask[2:402] = True
    clearance = clearance_um(mask, 1.0)
    for gap, carried, drag in ((0.5431, 0.92185, 1.5675), (2.7622, 0.99436, 1.1738)):
        near = 4.0 * (1.0 + gap)
        widths = ChannelWidths.of(mask, clearance).at(np.array([[4.0, 1.5 + near]]))
        sphere = SphereBetweenWalls.of(4.0, np.array([near]), widths)
        assert sphere.near_px + sphere.far_px == pytest.approx(400.0, abs=1.5)
        assert 1.0 - sphere.lag == pytest.approx(carried, abs=0.015)
        assert 1.0 + sphere.drag == pytest.approx(drag, abs=0.08)
    # In the middle of a narrow channel there is no shear; Poiseuille flow carries a sphere by Faxen's law.
    middle = SphereBetweenWalls(4.0, np.array([8.0]), np.array([8.0]))
    v, laplacian = np.array([[90.0, 0.0]]), np.array([[-2.0 * 90.0 / 8.0**2, 0.0]])
    assert middle.transport_slip(v, laplacian)[0] == pytest.approx([-90.0 * 0.25 / 3.0, 0.0])


def test_a_sphere_that_is_seen_nearer_to_a_wall_than_its_radius_touches_it_and_never_the_one_behind_it():
    width = np.full(5, 12.0)
    seen = SphereBetweenWalls.of(4.0, np.array([-1.0, 0.5, 3.0, 3.9, 4.0]), width)
    touching = SphereBetweenWalls.of(4.0, np.full(5, 4.0), width)
    np.testing.assert_array_equal([seen.drag, seen.lag], [touching.drag, touching.lag])
    narrow = SphereBetweenWalls.of(4.0, np.array([2.0]), np.array([5.0]))
    assert narrow.far_px == narrow.near_px == 4.0 and narrow.lag == 0.0


def test_the_width_of_a_channel_is_that_at_the_place_up_to_its_corners():
    mask = np.zeros((60, 80), bool)
    mask[5:11] = mask[20:50] = True  # channels of 6 and 30 pixels
    places = np.array([[0.0, 5.2], [40.0, 7.5], [79.0, 10.4], [0.0, 20.4], [40.0, 34.5], [79.0, 49.3]])
    for turned, points in ((mask, places), (mask.T, places[:, ::-1])):
        widths = ChannelWidths.of(turned, clearance_um(turned, 1.0))
        assert widths.at(points) == pytest.approx([6, 6, 6, 30, 30, 30], abs=1.1)
        assert widths.at(np.array([[15.0, 15.0]])) == pytest.approx(0.5)  # in a wall


def test_hindrance_and_lag_are_those_of_a_sphere_where_its_radius_is_stated(twin):
    case = twin()
    observed = flown(case)
    names = SETTINGS.refine(case.assumed, observed, case.chip, case.solver).parameter_names
    assert "carry_share" in names and "sphere_share" not in names
    refined = SETTINGS.refine(case.assumed, replace(observed, radius_um=25.0), case.chip, case.solver)
    assert "sphere_share" in refined.parameter_names and "carry_share" not in refined.parameter_names
    assert case.error(refined) < 0.04


@pytest.mark.parametrize("radius_um", [None, 20.0])
def test_tracers_beside_a_wall_do_not_change_what_the_walls_do_to_the_robot(twin, radius_um):
    case, settings = twin(), SETTINGS.assimilate
    model = flow_model(settings, settings.model, case.chip, case.solver)
    robot = replace(flown(case), radius_um=radius_um)
    beside_um = np.column_stack([np.linspace(30.0, 180.0, 9), np.full(9, 208.0)])
    beads = Observations(0, beside_um, np.ones((9, 2)), np.ones(9), None, np.arange(9.0), tracer=np.arange(9.0))

    def seen(made):
        return Observed.of(model, observation_operator(made, case.chip.mask, 10.0, case.assumed.wall_px))

    alone, both = seen(robot), seen(robot.with_tracers(beads))
    count = alone.operator.count
    assert both.operator.count == count + 9
    np.testing.assert_allclose(both.near[:count], alone.near)
    assert both.least_px == alone.least_px


def test_what_a_robot_rolls_is_found_as_a_line_over_the_drag_of_the_side_walls(twin):
    case, radius_px = twin(), 3.0
    observed = replace(flown(case, count=120), radius_um=radius_px * case.chip.um_per_px)
    points = observed.position_um / case.chip.um_per_px
    near = cells_at(points, case.chip.mask.shape).interpolate(clearance_um(case.chip.mask, 1.0))
    widths = ChannelWidths.of(case.chip.mask, clearance_um(case.chip.mask, 1.0)).at(points)
    drag = SphereBetweenWalls.of(radius_px, near, widths).drag
    rolled = observed.rolled_um_s
    slower = replace(observed, flow_um_s=observed.flow_um_s + (0.05 - 0.3 * drag)[:, None] * rolled)
    refined = SETTINGS.refine(case.assumed, slower, case.chip, case.solver)
    for name, true in zip(ROLLING_BY_DRAG, (0.05, -0.3), strict=True):
        value, std = found(refined, name)
        assert abs(value - true) < 3.0 * std and std < 0.1, name
    (in_open, _), (by_drag, _), (mean, _) = (found(refined, name) for name in (*ROLLING_BY_DRAG, "um_per_rev_share"))
    assert in_open + by_drag * drag.mean() == pytest.approx(mean, abs=0.03)


def test_observations_without_motion_and_time_are_assimilated_as_those_of_older_sessions(twin):
    case = twin()
    observed = replace(flown(case), rolled_um_s=None, time_s=None)
    refined = SETTINGS.refine(case.assumed, observed, case.chip, case.solver)
    assert "um_per_rev_share" not in refined.parameter_names and "wander" not in refined.parameter_names
    assert case.error(refined) < 0.04


def test_of_a_body_that_only_drifts_no_response_to_a_field_is_found_nor_missed(twin):
    case = twin()
    driven = replace(flown(case), radius_um=25.0)
    drifts = replace(driven, rolled_um_s=np.zeros_like(driven.rolled_um_s))
    refined, other = (SETTINGS.refine(case.assumed, each, case.chip, case.solver) for each in (drifts, driven))
    for word in ("rev", "heading", "hindrance"):
        assert word in other.parameter_names and word not in refined.parameter_names
    assert "revolution" not in refined.note and "wander_share" in refined.parameter_names


@pytest.mark.slow("refines several surveys")
def test_the_expected_error_is_as_large_as_the_error_over_several_surveys(twin):
    case = twin()
    errors, expected = [], []
    for seed in range(4):
        refined = SETTINGS.refine(case.assumed, flown(case, seed=seed, noise=8.0), case.chip, case.solver)
        errors.append(case.error(refined))
        expected.append(refined.error_share)
    # The walls of the twin are right; the expected error is that of walls as they usually are.
    assert 0.2 < np.sqrt(np.mean(np.square(errors))) / np.mean(expected) < 1.5


def test_another_robot_has_a_response_of_its_own_which_is_not_taken_for_flow(twin):
    """The first robot saw the stem only; the second one all channels, and it rolls 25 % farther than is stated."""
    case = twin(truth=(120.0, 0.0, 0.0))
    first, second = flown(case, seed=1, count=80).only(slice(0, 12)), flown(case, seed=2, gain=0.25)
    alone, both, taken_for_the_first = (
        SETTINGS.refine(case.assumed, each, case.chip, case.solver)
        for each in (first, first.with_robots({2: second}), first.followed_by(second))
    )
    assert case.error(both) < 0.5 * min(case.error(alone), case.error(taken_for_the_first))
    value, std = found(both, "um_per_rev_share")
    assert abs(value) < max(3.0 * std, 0.02)
    fast = np.linalg.norm(case.true.velocity_um_s, axis=-1) > 20.0
    off = (both.velocity_um_s - case.true.velocity_um_s)[fast] / both.std_um_s[fast]
    assert np.mean(np.abs(off) < 2.0) > 0.9


def test_robots_leave_their_courses_and_step_out_each_for_itself(twin):
    case = twin()
    one, two = (
        replace(each, rolled_um_s=np.linspace(0.5, 1.0, 20)[:, None] * each.rolled_um_s)
        for each in (flown(case, seed=seed, count=20) for seed in (1, 2))
    )
    joined = one.with_robots({1: two})
    settings = Assimilate()
    model = flow_model(settings, settings.model, case.chip, case.solver)
    operator = observation_operator(joined, case.chip.mask, case.chip.um_per_px, case.assumed.wall_px)
    effects = {effect.name: effect for effect in Observed.of(model, operator).effects(model.base, None)}
    wander = effects["wander 2 s"].kernel
    for own in (effects["rolling"].kernel, effects["stepping"].kernel):
        assert np.abs(own[:40, :40]).max() > 0.0 and not own[:40, 40:].any()
    assert np.abs(wander[:40, 40:]).max() > 0.0, "the pump is one"
    (others,) = effects["gain of others"].columns
    assert not others[:40].any() and others[40:].any()
    assert "height" not in effects


def test_walls_and_registration_of_an_image_leave_less_doubt_about_both_and_as_much_about_the_robot(twin):
    case = twin()
    level_px = np.clip(clearance_um(case.chip.mask, 1.0), -2.5, 2.5)
    settings, sizes = Assimilate(), []
    for chip in (case.chip, with_levels(case.chip, level_px)):
        model = flow_model(settings, settings.model, chip, case.solver)
        operator = observation_operator(flown(case), chip.mask, chip.um_per_px, case.assumed.wall_px)
        sizes.append({each.name: each.median for each in Observed.of(model, operator).effects(model.base, None)})
    drawn, pictured = sizes
    doubted_less = {name for name in drawn if pictured[name] < 0.5 * drawn[name]}
    assert doubted_less == {"walls", "resistance", "offset", "scale", "angle"}
    assert all(pictured[name] == pytest.approx(drawn[name]) for name in ("boundary", "gain", "heading", "fluid"))


@pytest.mark.parametrize("step_out_um_s", [145.0, 1e3])
def test_a_robot_that_steps_out_at_its_highest_speed_is_not_taken_for_flow(twin, step_out_um_s):
    """It goes to and fro, upstream at 150 um/s and downstream at 100; what it misses is Adler's equation's."""
    case = twin(truth=(120.0, 0.0, 0.0))
    observed = flown(case, headings="along")
    v = sample(case.true, observed.position_um)
    upstream = np.arange(len(v)) % 2 == 0
    speed = np.where(upstream, 150.0, 100.0)
    rolled = (np.where(upstream, -1.0, 1.0) * speed / np.hypot(*v.T))[:, None] * v
    missed = np.sqrt(np.maximum(1.0 - (step_out_um_s / speed) ** 2, 0.0))
    observed = replace(observed, flow_um_s=observed.flow_um_s - missed[:, None] * rolled, rolled_um_s=rolled)
    refined = SETTINGS.refine(case.assumed, observed, case.chip, case.solver)
    assert case.error(refined) < 0.08  # 0.18 where this is not among the causes
    fast = np.linalg.norm(case.true.velocity_um_s, axis=-1) > 20.0
    off = (refined.velocity_um_s - case.true.velocity_um_s)[fast]
    assert np.mean(np.abs(off / refined.std_um_s[fast]) < 2.0) > 0.85
