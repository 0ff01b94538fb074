"""The survey by information: it goes where the flow is not known, from where the goal can still be reached."""

import re
from dataclasses import replace

import numpy as np
import pytest

from flowrec.core import Observations, nearest_pixels
from flowrec.physics import Doubts, FlowUncertainty, Opening, Registration
from flowrec.stages import Need, Sampling, SurveyOrder, SurveyPlanner, covariance_after
from flowrec.stages.planning.survey_design import Looks
from tests.stages.planning.worlds import PX, channel, chip_of, field_of, length_um, robot

SPEED_UM_S = 60.0
STEM, UPPER, LOWER = (300.0, 445.0), (1250.0, 145.0), (1250.0, 745.0)


def junction(upper=20.0, lower=20.0, stem=40.0, neck=None):
    """A stem from the left, 9 px wide, that parts into an upper and a lower branch; both end at the right.

    At the neck, where it begins, the lower branch flows at its own speed or another.
    """
    mask = np.zeros((90, 140), bool)
    vx, vy = np.zeros(mask.shape), np.zeros(mask.shape)
    mask[40:49, :40] = mask[10:79, 40:49] = mask[10:19, 40:] = mask[70:79, 40:] = True
    vx[40:49, :40] = stem
    vy[10:40, 40:49], vy[49:79, 40:49] = -upper, lower if neck is None else neck
    vx[10:19, 40:], vx[70:79, 40:] = upper, lower
    openings = (
        Opening("left", 40, 48, "inlet", stem),
        Opening("right", 10, 18, "outlet", 0.0),
        Opening("right", 70, 78, "outlet", 0.0),
    )
    return chip_of(mask, openings), field_of(mask, vx, vy)


def unknown(chip, field, seen=(1.0, 1.0), rolled=None):
    """The flow of the upper and of the lower branch are each in doubt by a factor, with these standard deviations."""
    velocity = field.velocity_um_s[chip.mask].astype(float)
    rows = np.nonzero(chip.mask)[0]
    columns = np.stack([velocity * (rows < 40)[:, None], velocity * (rows > 48)[:, None]])
    deviations = [*seen, *([] if rolled is None else [rolled])]
    constants = np.ones((len(deviations) - 2, len(velocity)))
    return FlowUncertainty(velocity, columns, constants, np.diag(np.square(deviations)), np.zeros(len(velocity)))


def ordered(chip, field, uncertainty, start=STEM, goal=UPPER, **more):
    sampling = Sampling(spacing_um=20.0, interval_s=0.0, noise_um_s=2.0)
    return SurveyOrder(field, np.array(start), chip, robot(SPEED_UM_S), np.array(goal), uncertainty, sampling, **more)


def planner(**settings):
    return SurveyPlanner(method="information", worth=0.01, **settings)


def promised(route):
    """The error of the flow in %, now and after the stretch, as the reason states them."""
    return [float(number) for number in re.findall(r"([0-9.]+) %", route.reason)]


def branch_of(route):
    return "upper" if route.waypoints_um[-1, 1] < 400.0 else "lower"


@pytest.mark.parametrize(("seen", "goes"), [((0.02, 0.3), "lower"), ((0.3, 0.02), "upper")])
def test_where_one_branch_is_known_the_next_stretch_goes_into_the_other(seen, goes):
    chip, field = junction()
    # The goal lies in the branch that is known.
    goal = UPPER if goes == "lower" else LOWER
    route = planner().plan(ordered(chip, field, unknown(chip, field, seen), goal=goal))
    assert route.reachable and route.more, route.reason
    assert branch_of(route) == goes


def test_the_gain_that_is_expected_is_the_one_that_observations_bring():
    chip, field = junction()
    uncertainty = unknown(chip, field, (0.3, 0.3))
    sampling = Sampling(spacing_um=20.0, interval_s=0.0, noise_um_s=2.0)
    looks = Looks.none(uncertainty, sampling, chip, 30.0, 0.0)
    way = np.array([[445.0, 300.0], [445.0, 145.0], [1245.0, 145.0]])
    expected = covariance_after(uncertainty.covariance, looks.information(way, np.array([0.0, 5.0, 30.0])))
    # One leg of 155 um and one of 800 um, each seen in its middle, along the flow of 20 um/s.
    precision = 1.0 / 0.3**2 + (955.0 / 20.0) * 20.0**2 / 2.0**2
    assert expected[0, 0] == pytest.approx(1.0 / precision)
    assert expected[1, 1] == pytest.approx(0.3**2)
    need = Need.of(uncertainty, (1.0, np.ones(len(uncertainty.mean_um_s))))
    assert need.error(uncertainty.covariance) == pytest.approx(0.3 * np.sqrt(upper_part(chip, field)))
    assert need.error(expected) < need.error(uncertainty.covariance)


@pytest.mark.parametrize("noisier", [0.5, 3.0])
def test_observations_that_scatter_more_than_they_state_tell_less_by_the_square_of_that(noisier):
    chip, field = junction()
    way, arrival_s = np.array([[445.0, 300.0], [445.0, 145.0], [1245.0, 145.0]]), np.array([0.0, 5.0, 30.0])

    def told(uncertainty):
        sampling = Sampling(spacing_um=20.0, interval_s=0.0, noise_um_s=2.0, rolling_share=0.02)
        return Looks.none(uncertainty, sampling, chip, 30.0, 0.0).information(way, arrival_s)

    stated = unknown(chip, field, (0.3, 0.3))
    np.testing.assert_allclose(told(replace(stated, noise_factor=noisier)), told(stated) / noisier**2)


@pytest.mark.parametrize("flow_um_s", [0.0, 40.0])
def test_the_own_motion_of_a_robot_is_as_much_noise_as_it_rolls_uneven(flow_um_s):
    mask = channel()
    chip, field = chip_of(mask), field_of(mask, flow_um_s)
    way, arrival_s = np.array([[100.0, 200.0], [400.0, 200.0], [400.0, 250.0]]), np.array([0.0, 3.0, 3.5])
    own_um_s = np.hypot(100.0 - flow_um_s, 0.0), np.hypot(flow_um_s, 100.0)  # of 100 um/s over ground

    def told(sampling, leg):
        looks = Looks.none(unknown_flow(chip, field), sampling, chip, 30.0, 0.05)
        return looks.information(way[leg : leg + 2], arrival_s[leg : leg + 2])

    for leg, own in enumerate(own_um_s):
        uneven, noisy = Sampling(20.0, 0.0, 3.0, 0.05), Sampling(20.0, 0.0, float(np.hypot(3.0, 0.05 * own)))
        np.testing.assert_allclose(told(uneven, leg), told(noisy, leg))


def unknown_flow(chip, field):
    """A uniform flow of unknown size."""
    mean = field.velocity_um_s[chip.mask].astype(float)
    nothing = np.zeros((0, len(mean)))
    return FlowUncertainty(mean, np.ones((1, *mean.shape)), nothing, 100.0 * np.eye(1), np.full(len(mean), 2.0))


def upper_part(chip, field):
    """The part of the squared speed that is in doubt."""
    square = (field.velocity_um_s[chip.mask].astype(float) ** 2).sum(axis=1)
    rows = np.nonzero(chip.mask)[0]
    return square[(rows < 40) | (rows > 48)].sum() / square.sum()


def test_a_place_that_has_been_looked_at_tells_little_more_of_the_flow_but_of_the_robot_that_moves_otherwise():
    chip, field = junction()
    uncertainty = unknown(chip, field, (0.3, 0.3), rolled=0.2)
    sampling = Sampling(spacing_um=1.0, interval_s=0.0, noise_um_s=1.0)
    new = Looks.none(uncertainty, sampling, chip, 12.0, 0.05)
    place = np.array([[1000.0, 145.0]])
    same_way = np.array([[990.0, 145.0], [1010.0, 145.0]])
    with_flow, against = np.array([0.0, 20.0 / 50.0]), np.array([0.0, 20.0 / 10.0])
    old = new.after_places(np.repeat(place, 50, axis=0), np.tile([30.0, 0.0], (50, 1)))
    fresh, again = new.information(same_way, with_flow), old.information(same_way, with_flow)
    assert again[0, 0] < 0.01 * fresh[0, 0]
    turned = old.information(same_way[::-1], against)
    # Its own velocity is -30 um/s now, 60 um/s from the one before: 20 looks with a variance of 1, nearly all of it.
    assert turned[2, 2] > 100.0 * again[2, 2]


def test_where_um_per_rev_is_in_doubt_the_stretches_vary_the_own_motion():
    chip, field = junction(upper=25.0, lower=25.0, stem=45.0)
    uncertainty = unknown(chip, field, (0.02, 0.3), rolled=0.3)
    sampling = Sampling(spacing_um=20.0, interval_s=0.0, noise_um_s=2.0)
    own, route, start, progress = [], None, STEM, 0.0
    for _ in range(6):
        order = replace(
            ordered(chip, field, uncertainty, start=start, present=route, progress_s=progress), sampling=sampling
        )
        new = planner().plan(order)
        if not new.more:
            break
        since = 0 if route is None else len(route.waypoints_um)
        points, times = new.waypoints_um[max(since - 1, 0) :], new.arrival_s[max(since - 1, 0) :]
        rows, columns = nearest_pixels(0.5 * (points[1:] + points[:-1]) / PX, chip.mask.shape)
        through = np.diff(points, axis=0) / np.diff(times)[:, None] - field.velocity_um_s[rows, columns]
        own += through.tolist()
        covariance = covariance_after(
            uncertainty.covariance, Looks.none(uncertainty, sampling, chip, 4.0, 0.05).information(points, times)
        )
        uncertainty = replace(uncertainty, covariance=covariance)
        route, start, progress = new, new.waypoints_um[-1], float(new.arrival_s[-1])
    known = uncertainty.covariance[2, 2] ** 0.5
    assert known < 0.05, "the stretches tell the robot's motion from the flow"
    along = np.array(own)[:, 0]
    assert along.max() - along.min() > 0.5 * SPEED_UM_S


@pytest.mark.parametrize(("rolled", "drifts"), [(None, False), (1.0, True)])
def test_a_stretch_drifts_where_um_per_rev_is_in_doubt_and_no_change_of_heading_tells_it_from_the_flow(rolled, drifts):
    # In a straight channel the robot's own motion, all along the flow, looks like a part of it; a drift has little.
    mask = np.zeros((20, 120), bool)
    mask[6:15] = True
    chip, field = chip_of(mask), field_of(mask, np.where(mask, 20.0, 0.0))
    velocity = field.velocity_um_s[mask].astype(float)
    deviations = [0.1, *([] if rolled is None else [rolled])]
    constants = np.ones((len(deviations) - 1, len(velocity)))
    doubt = FlowUncertainty(
        velocity, velocity[None], constants, np.diag(np.square(deviations)), np.zeros(len(velocity))
    )
    route = planner().plan(ordered(chip, field, doubt, start=(300.0, 100.0), goal=(1100.0, 100.0)))
    ground = np.diff(route.waypoints_um, axis=0) / np.diff(route.arrival_s)[:, None]
    own = np.hypot(*(ground - [20.0, 0.0]).T)
    assert np.median(own) == pytest.approx((0.15 if drifts else 0.85) * SPEED_UM_S, rel=0.02)


def test_a_stretch_from_which_the_goal_can_not_be_reached_is_never_chosen():
    # The lower branch flows faster than the robot: whoever enters it is carried out.
    chip, field = junction(lower=75.0)
    doubt = unknown(chip, field, (0.02, 0.5))
    for start in (STEM, (900.0, 145.0)):
        route = planner(robust_deviations=0.0).plan(ordered(chip, field, doubt, start=start))
        assert not len(route.waypoints_um) or route.waypoints_um[:, 1].max() < 600.0, route.reason
    # Nor one with a calm end, behind a neck that is too fast to return through.
    chip, field = junction(lower=20.0, neck=75.0)
    route = planner(robust_deviations=0.0).plan(ordered(chip, field, unknown(chip, field, (0.02, 0.5))))
    assert not len(route.waypoints_um) or route.waypoints_um[:, 1].max() < 600.0, route.reason
    # A flow that may be as fast is as forbidden: 45 um/s believed, 67 um/s with one deviation.
    chip, field = junction(lower=45.0)
    route = planner(robust_deviations=1.0).plan(ordered(chip, field, unknown(chip, field, (0.02, 0.5))))
    assert not len(route.waypoints_um) or route.waypoints_um[:, 1].max() < 600.0, route.reason
    assert (
        branch_of(planner(robust_deviations=0.0).plan(ordered(chip, field, unknown(chip, field, (0.02, 0.5)))))
        == "lower"
    )
    # From where the goal is out of reach, nothing is surveyed.
    chip, field = junction(lower=75.0)
    lost = planner().plan(ordered(chip, field, doubt, start=LOWER))
    assert not lost.reachable and "can not be reached" in lost.reason


def test_the_survey_ends_when_nothing_is_worth_its_time_or_none_is_left():
    chip, field = junction()
    known = planner().plan(ordered(chip, field, unknown(chip, field, (0.01, 0.01))))
    assert not known.reachable and known.reason.startswith("enough"), known.reason
    doubt = unknown(chip, field, (0.3, 0.3))
    first = planner().plan(ordered(chip, field, doubt))
    assert first.more
    end = {"start": first.waypoints_um[-1], "present": first, "progress_s": 0.0}
    late = planner().plan(ordered(chip, field, doubt, left_s=0.1, **end))
    assert not late.more and late.reachable
    np.testing.assert_array_equal(late.waypoints_um, first.waypoints_um)


def test_the_next_stretch_continues_the_present_way_with_its_times():
    chip, field = junction()
    doubt = unknown(chip, field, (0.3, 0.3))
    first = planner().plan(ordered(chip, field, doubt))
    second = planner().plan(ordered(chip, field, doubt, start=first.waypoints_um[-1], present=first, progress_s=0.0))
    assert branch_of(first) != branch_of(second)
    # What the first will have seen counts already: one ends with the error that the other begins with.
    assert promised(second)[0] == pytest.approx(promised(first)[1], rel=0.1)
    count = len(first.waypoints_um)
    np.testing.assert_array_equal(second.waypoints_um[:count], first.waypoints_um)
    np.testing.assert_array_equal(second.arrival_s[:count], first.arrival_s)
    assert (np.diff(second.arrival_s) > 0.0).all() and length_um(second) > length_um(first)


def test_where_the_image_is_off_the_stretch_runs_where_the_camera_shows_the_channels():
    chip, field = junction()
    doubt = unknown(chip, field, (0.3, 0.3))
    off = Registration(np.array([6.0, -25.0]), 0.02, 0.01, np.array([700.0, 400.0]))
    places = np.array([STEM, UPPER, LOWER])
    np.testing.assert_allclose(off.on_chip(off.to_measured(places)), places, atol=1e-9)
    # x - scale (x - c) - angle J (x - c), where J turns (10, 0) to (0, 10)
    right = off.on_chip(np.array([[710.0, 400.0]]))[0] - off.on_chip(np.array([[700.0, 400.0]]))[0]
    np.testing.assert_allclose(right, [10.0 * (1.0 - 0.02), -10.0 * 0.01])
    seen = np.column_stack([np.full(24, 445.0), np.arange(130.0, 370.0, 10.0)])

    def two_stretches(registration, measured):
        looks = Observations(0, measured(seen), np.ones((24, 2)), np.full(24, 2.0))
        known = {"uncertainty": replace(doubt, registration=registration), "observations": looks}
        first = planner().plan(ordered(chip, field, start=measured(np.array([STEM]))[0], **known))
        present = {"present": first, "progress_s": 0.0}
        return first, planner().plan(ordered(chip, field, start=first.waypoints_um[-1], **present, **known))

    straight = two_stretches(Registration.identity(), np.copy)
    first, second = two_stretches(off, off.to_measured)
    for moved, still in zip((first, second), straight, strict=True):
        np.testing.assert_allclose(off.on_chip(moved.waypoints_um)[[0, -1]], still.waypoints_um[[0, -1]], atol=1e-6)
    np.testing.assert_allclose(second.stretches, straight[1].stretches, rtol=1e-3)
    np.testing.assert_array_equal(second.waypoints_um[: len(first.waypoints_um)], first.waypoints_um)


def doubted(chip, field, *columns, probability=0.15):
    """At these columns of the lower branch the flow may be three times as fast in one half and at rest in the other."""
    velocity = field.velocity_um_s[chip.mask].astype(float)
    y, x = np.nonzero(chip.mask)
    changes = [
        velocity * ((np.abs(x - at) < 6) & (y > 48))[:, None] * np.where(y < 74, 2.0, -1.0)[:, None] for at in columns
    ]
    known = unknown(chip, field, (0.01, 0.01))
    return replace(known, doubts=Doubts(np.stack(changes), np.full(len(changes), probability)))


def test_where_a_channel_may_be_blocked_the_survey_passes_all_the_places_and_then_has_enough():
    chip, field = junction()
    assert not planner().plan(ordered(chip, field, unknown(chip, field, (0.01, 0.01)))).reachable
    uncertainty = doubted(chip, field, 70, 90, 110)
    route = planner().plan(ordered(chip, field, uncertainty))
    while route.more:
        new = planner().plan(
            ordered(chip, field, uncertainty, start=route.waypoints_um[-1], present=route, progress_s=0.0)
        )
        if not new.more:
            break
        route = new
    assert route.reachable and branch_of(route) == "lower"
    assert route.waypoints_um[:, 0].max() >= 10.0 * 105, "it has seen the last one"
    before, after = promised(route)[0], promised(new)[0]
    assert after < 3.0 < before, (route.reason, new.reason)


def test_what_the_present_way_will_show_of_a_doubt_counts_for_the_next_stretch():
    chip, field = junction()
    near, far = (doubted(chip, field, at).doubts.changes_um_s for at in (60, 115))
    uncertainty = replace(doubted(chip, field, 60), doubts=Doubts(np.concatenate([near, far]), np.array([0.4, 0.1])))
    # The present way passes the first place and ends behind it.
    x = np.linspace(300.0, 850.0, 56)
    points = np.concatenate([np.full((31, 2), (445.0, 0.0)), np.column_stack([x[15:], np.full(41, 745.0)])])
    points[:31, 1] = np.linspace(445.0, 745.0, 31)
    present = replace(planner().plan(ordered(chip, field, uncertainty)), waypoints_um=points)
    present = replace(present, arrival_s=np.arange(len(points)) * 0.25)
    new = planner().plan(ordered(chip, field, uncertainty, start=points[-1], present=present, progress_s=0.0))
    assert new.more and new.waypoints_um[-1, 0] > 1050.0, new.reason


def test_observations_that_tell_a_doubt_apart_remove_its_error_and_others_do_not():
    chip, field = junction()
    uncertainty = doubted(chip, field, 70, 110)
    looks = Looks.none(uncertainty, Sampling(20.0, 0.0, 2.0), chip, 30.0, 0.05)
    need = Need.of(uncertainty, (1.0, np.ones(len(uncertainty.mean_um_s))))
    covariance = uncertainty.covariance

    def left(*columns):
        """The squared error of the doubts after looks around columns of the lower branch."""
        total = 0.0
        for at in columns:
            way = np.column_stack([np.arange(at - 5.0, at + 6.0), np.full(11, 74.0)]) * PX
            total = total + looks.information(way, np.linspace(0.0, 5.0, 11))
        fixed = need.error(covariance * 0.0, np.zeros((4, 4))) ** 2 if not columns else None
        return fixed if fixed is not None else need.error(covariance * 0.0, total) ** 2

    # Two changes that exclude each other: w (1 - w) each, and the flow is 9 times 12 of its pixels otherwise.
    square = (uncertainty.doubts.changes_um_s**2).sum(axis=(1, 2)) / (uncertainty.mean_um_s**2).sum()
    pairs = 0.15 * 0.7 * square.sum() + 0.15 * 0.15 * square.sum()
    assert left() == pytest.approx(pairs)
    assert left(70, 110) < 0.01 * pairs
    # To see that the first is not there leaves the second, and which of the two it is where there is one.
    assert 0.15 * 0.7 * square[1] * 0.99 < left(70) < 0.6 * pairs
    assert left(90) == pytest.approx(pairs, rel=0.05)


def test_a_doubt_that_looks_like_an_unknown_of_the_flow_can_not_be_told_apart():
    chip, field = junction()
    way, times = np.array([[600.0, 745.0], [1200.0, 745.0]]), np.array([0.0, 30.0])
    for unknown_std, told in ((0.01, True), (3.0, False)):
        uncertainty = unknown(chip, field, (0.01, unknown_std))
        lower = 0.5 * uncertainty.columns_um_s[1:]
        uncertainty = replace(uncertainty, doubts=Doubts(lower, np.array([0.3])))
        looks = Looks.none(uncertainty, Sampling(20.0, 0.0, 2.0), chip, 30.0, 0.0)
        need = Need.of(uncertainty, (1.0, np.ones(len(uncertainty.mean_um_s))))
        after = covariance_after(uncertainty.covariance, looks.information(way, times))
        doubt = need.error(after, looks.information(way, times)) ** 2 - need.error(after, np.zeros((3, 3))) ** 2
        whole = float((need.pairs * need.apart).sum())
        assert (-doubt > 0.9 * whole) == told


def test_no_stretch_makes_the_survey_longer_than_its_limit():
    chip, field = junction()
    doubt = unknown(chip, field, (0.3, 0.3))
    free = planner().plan(ordered(chip, field, doubt))
    limited = planner(distance_um=200.0).plan(ordered(chip, field, doubt))
    assert length_um(limited) <= 205.0 < length_um(free)
    end = {"start": limited.waypoints_um[-1], "present": limited, "progress_s": 0.0}
    assert not planner(distance_um=205.0).plan(ordered(chip, field, doubt, **end)).more


def test_without_a_prior_the_survey_goes_downstream_and_says_so():
    chip, field = junction()
    route = planner().plan(replace(ordered(chip, field, None), uncertainty=None))
    assert route.reachable and not route.more
    assert route.reason.startswith("survey downstream")
