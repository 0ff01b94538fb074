"""Each sentence of a refinement comes with its cause, with its sign and a number within its error, and only then."""

import re
from dataclasses import replace

import numpy as np
import pytest

from flowrec.core.system.blas_threads import one_blas_thread
from flowrec.physics.chip.fluid import PowerLaw
from flowrec.stages.refine import Assimilate, Refiner
from flowrec.stages.refine.findings import scale_doubt
from flowrec.stages.refine.observation_operator import observation_operator
from flowrec.stages.refine.predictive_check import UNEXPLAINED
from flowrec.stages.refine.report import report
from tests.stages.refine.planted import (
    RADIUS_UM,
    SOLVER,
    Laboratory,
    chip,
    held_share,
    wider_everywhere,
    wider_in_places,
)

DRAWN = Assimilate(doubt_walls=False, doubt_depth=False)
TRUE = (130.0, 0.0, 0.004)  # inlet speed and outlet pressures, where (100, 0, 0) is assumed
NO_CAUSE = re.compile(r"assimilated \d+|\d+ more distrusted|ignored \d+|they do not ask|they say nothing")
NUMBER = r"(\d+\.?\d*) \+- (\d+\.?\d*)"
ASKS_FOR_NOTHING = "they do not ask for another flow than the assumed one"


def refined(lab=None, true=None, stated=None, settings=DRAWN, seed=1, count=56):
    """A refinement of what a laboratory observes in a true flow, of a chip as it is stated; and its sentences."""
    stated = stated or chip()
    assumed = SOLVER.solve(stated)
    observed = (lab or Laboratory()).survey(SOLVER.solve(true or chip(TRUE)), seed, count)
    found = Refiner(assimilate=settings).refine(assumed, observed, stated, SOLVER)
    # Whatever is planted: where nothing is asked for, the map has moved by less than its error.
    change = np.linalg.norm((found.velocity_um_s - assumed.velocity_um_s)[stated.mask])
    assert ASKS_FOR_NOTHING not in found.note or change < np.linalg.norm(found.std_um_s[stated.mask])
    return found, [clause for clause in found.note.split("; ") if not NO_CAUSE.match(clause)]


def number(sentence, words):
    """Value and error of a sentence, which is in these words."""
    match = re.fullmatch(words.replace("{}", NUMBER), sentence)
    assert match, f"said: {sentence}; expected: {words}"
    return float(match[1]), float(match[2])


def within(sentence, words, true, least_error=0.0):
    """The sentence is in these words, its number within three of its errors of the true one, and says something."""
    value, error = number(sentence, words)
    assert abs(value - true) < 3.0 * max(error, least_error), f"{sentence}, true: {true:.3g}"
    assert error < 0.35 * true


def test_where_all_is_as_stated_no_cause_is_named():
    for seed in range(2):
        assert refined(seed=seed)[1] == []


CAUSES = (
    # The camera's true um per px beside 10 that are stated.
    (Laboratory(um_per_px=9.5), "the image scale is {} % smaller than stated", 5.0),
    (Laboratory(um_per_px=10.5), "the image scale is {} % larger than stated", 5.0),
    (Laboratory(um_per_rev=0.85), "the robot moves {} % less per revolution than stated", 15.0),
    (Laboratory(um_per_rev=1.12), "the robot moves {} % more per revolution than stated", 12.0),
    (Laboratory(off_heading_deg=-4.0), "the robot's own course lies {} degrees counterclockwise of its heading", 4.0),
    (Laboratory(off_heading_deg=5.0), "the robot's own course lies {} degrees clockwise of its heading", 5.0),
    (
        Laboratory(chip_turned_deg=-2.0),
        "the chip is turned by {} degrees counterclockwise from how the registration puts it",
        2.0,
    ),
    (
        Laboratory(chip_turned_deg=1.5),
        "the chip is turned by {} degrees clockwise from how the registration puts it",
        1.5,
    ),
    (
        Laboratory(chip_moved_um=(-9.0, 12.0)),
        r"the chip lies {} um from where the registration puts it \(9 um to the left, 12 um down\)",
        15.0,
    ),
    (
        Laboratory(chip_moved_um=(12.0, -9.0)),
        r"the chip lies {} um from where the registration puts it \(12 um to the right, 9 um up\)",
        15.0,
    ),
    (Laboratory(pump=0.25, pump_hz=0.5), "the pump pulsates by {} % at 0.50 Hz", 25.0),
)


@pytest.mark.parametrize(("lab", "words", "true"), CAUSES, ids=[words[:48] for _, words, _ in CAUSES])
def test_a_cause_is_said_alone_with_its_sign_and_its_size(lab, words, true):
    (sentence,) = refined(lab)[1]
    within(sentence, words, true, least_error=0.1)


@pytest.mark.parametrize(("true_um", "said"), [(9.5, "too large"), (10.0, ""), (10.5, "too small")])
def test_a_scale_that_the_motion_contradicts_is_a_doubt_with_the_scale_to_try(true_um, said):
    doubt = scale_doubt(refined(Laboratory(um_per_px=true_um))[0], 10.0)
    assert said in doubt and bool(said) == bool(doubt)
    assert not said or float(doubt.rpartition("try ")[2]) == pytest.approx(true_um, rel=0.02)


@pytest.mark.parametrize(("held", "how"), [(1.0, "slower"), (-1.0, "faster")])
def test_walls_that_hold_the_robot_or_help_it_are_said_beside_what_it_loses_on_the_mean(held, how):
    lab, true = Laboratory(held_by_walls=held), SOLVER.solve(chip(TRUE))
    share = held_share(true, lab.survey(true, 1).position_um)
    (mean, near), others = refined(lab)[1][:2], refined(lab)[1][2:]
    more = "more" if held < 0.0 else "less"
    within(mean, f"the robot moves {{}} % {more} per revolution than stated", 100.0 * float(share.mean()))
    within(near, f"near walls the robot rolls by {{}} % {how} than elsewhere", 100.0 * float(share.max()))
    # The motion that is lost is not proportional to the drag of the walls, as the model has it.
    assert all(one.startswith("they scatter 1.") for one in others)


def test_a_flow_that_wanders_is_said_with_what_it_wandered_by():
    for seed in (1, 2):
        lab = Laboratory(wander=0.15)
        factor = lab.pump_factor(lab.step_s * np.arange(56), seed)
        # So large a wander is none that a map can be sure of: the largest part of it is said, too.
        (sentence,) = [one for one in refined(lab, seed=seed)[1] if not one.startswith(UNEXPLAINED)]
        words = "the flow wanders in time, or by place along the way, by {} %"
        within(sentence, words, 100.0 * float(np.std(factor) / factor.mean()))


def test_a_slow_line_of_hardly_a_period_is_not_blamed_on_the_pump_alone():
    (slow,) = [one for one in refined(Laboratory(pump=0.3, pump_hz=0.06))[1] if " Hz" in one]
    assert slow.startswith("the flow changes by ") and slow.endswith("with the pump or by place")
    (sentence,) = refined(Laboratory(pump=0.3, pump_hz=0.15))[1]
    assert sentence.startswith("the pump pulsates by ")


@pytest.mark.parametrize(("hz", "sway_um_s"), [(1.3, (60.0, -100.0)), (0.7, (-40.0, 30.0))])
def test_a_stage_that_shakes_is_said_with_its_frequency(hz, sway_um_s):
    (sentence,) = refined(Laboratory(shake_um_s=sway_um_s, shake_hz=hz))[1]
    assert float(re.fullmatch(r"the image shakes at (\S+) Hz", sentence)[1]) == pytest.approx(hz, abs=0.02)


def test_noise_beyond_what_is_stated_is_said_with_its_factor_and_a_pump_is_no_noise():
    (sentence,) = refined(Laboratory(noisier=4.0))[1]
    factor = re.fullmatch(r"they scatter (\S+) times more than their std says, error bars widened", sentence)[1]
    assert float(factor) == pytest.approx(4.0, rel=0.2)


@pytest.mark.parametrize("depth_um", [50.0, pytest.param(100.0, marks=pytest.mark.slow("refines for another depth"))])
def test_the_depth_of_a_chip_that_states_none_is_said_where_it_matters(depth_um):
    settings = Assimilate(doubt_walls=False)
    (sentence,) = refined(true=chip(TRUE, depth_um=depth_um), settings=settings, count=80)[1]
    within(sentence, "chip depth {} um", depth_um)
    assert refined(settings=settings)[1] == []


@pytest.mark.parametrize("depth_um", [60.0, 100.0])
def test_a_depth_that_is_stated_wrong_is_said_on_the_right_side(depth_um):
    settings = replace(DRAWN, depth_std_share=0.2)
    (sentence,) = refined(true=chip(TRUE, depth_um=depth_um), stated=chip(depth_um=80.0), settings=settings)[1]
    within(sentence, "chip depth {} um", depth_um)
    assert (number(sentence, "chip depth {} um")[0] < 80.0) == (depth_um < 80.0)


@pytest.mark.parametrize("exponent", [0.45, 0.75])
def test_the_exponent_of_a_law_of_viscosity_is_said_on_the_right_side(exponent):
    (sentence,) = refined(true=chip(TRUE, law=PowerLaw(exponent)), stated=chip(law=PowerLaw(0.6)))[1]
    within(sentence, "viscosity exponent {}", exponent)


@pytest.mark.parametrize(
    ("pixels", "drawn"), [(-1, "wide"), pytest.param(1, "narrow", marks=pytest.mark.slow("refines in the other walls"))]
)
def test_a_mask_that_is_a_pixel_off_everywhere_is_said_on_the_right_side(pixels, drawn):
    true, settings = wider_everywhere(chip(TRUE), pixels), Assimilate(doubt_depth=False)
    for radius_um in (None, RADIUS_UM):  # of a robot, None: it is not stated
        lab = Laboratory(radius_um=radius_um, across_um=25.0 + 10.0 * (pixels > 0))
        (sentence, *others) = refined(lab, true, settings=settings, seed=0)[1]
        expected = rf"the mask seems wrong: its channels are drawn (\S+) \+- \S+ um too {drawn} on each side"
        assert float(re.fullmatch(expected, sentence)[1]) == pytest.approx(10.0, abs=2.0)  # a pixel
        assert not others


@pytest.mark.parametrize("places", [(-1, 1, -1), (1, -1, 1)])
def test_walls_that_are_a_pixel_off_in_places_are_said_with_a_lower_limit(places):
    _, said = refined(true=wider_in_places(chip(TRUE), *places))
    (walls,) = (one for one in said if one.startswith("the walls"))
    limit_um = float(re.fullmatch(r"the walls seem off by (\d+) um or more in places", walls)[1])
    assert 2.5 <= limit_um <= 10.0
    # A place that the robot passes once looks like a time: nothing else may be sure of its cause.
    assert all("or by place" in one for one in said if one != walls)


@pytest.mark.parametrize(("inlet_um_s", "side"), [(220.0, "higher"), (10.0, "lower")])
def test_a_boundary_value_far_from_the_assumed_one_is_said_on_the_right_side(inlet_um_s, side):
    (sentence,) = refined(true=chip((inlet_um_s, 0.0, 0.0)))[1]
    off = re.fullmatch(rf"far from what was assumed: inlet 0 \(left\) \((\d) prior std {side}\)", sentence)[1]
    assert float(off) == pytest.approx(abs(inlet_um_s - 100.0) / 25.0, abs=0.6)


def test_no_other_flow_is_asked_for_only_where_the_map_moved_by_less_than_its_error():
    assert ASKS_FOR_NOTHING in refined(true=chip())[0].note
    assert ASKS_FOR_NOTHING not in refined()[0].note
    # Observations that do not ask, of a map that has moved all the same: by what other hypotheses make of them.
    stated = chip()
    observed = Laboratory().survey(SOLVER.solve(stated))
    operator = observation_operator(observed, stated.mask, stated.um_per_px, SOLVER.solve(stated).wall_px)
    with one_blas_thread():
        best = DRAWN.hypotheses(operator, stated, SOLVER).best
        assert ASKS_FOR_NOTHING in report(stated, operator, best, [], moved=0.9)
        assert ASKS_FOR_NOTHING not in report(stated, operator, best, [], moved=1.1)
