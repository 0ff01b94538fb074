"""The second generator of worlds: its surveys can be refined, and each fault is there in the size that was drawn."""

from __future__ import annotations

import ast
from pathlib import Path

import numpy as np
import pytest

import flowrec.bench.second_worlds as second
from flowrec.bench.second_chips import FINE, coarse, draw_chip, to_fine
from flowrec.bench.second_worlds import SECOND_WORLDS, faults_of, make_survey
from flowrec.bench.world_flights import FlightCase, fly, refine
from flowrec.physics import FlowSolver


def test_a_survey_measures_the_true_flow_with_its_noise_where_nothing_is_wrong() -> None:
    made = make_survey("as_stated", 3)
    column, row = np.round(made.observations.position_um / made.chip.um_per_px).astype(int).T
    off = made.observations.flow_um_s - made.truth_um_s[row, column]
    typical = np.sqrt((made.truth_um_s[made.fluid] ** 2).sum(axis=1).mean())
    assert made.fluid[row, column].mean() > 0.95
    assert np.median(np.abs(off)) < 0.12 * typical
    assert made.planted


def test_the_mask_holds_the_pixels_of_which_half_is_fluid_and_their_centres_are_those_of_the_truth() -> None:
    fine = draw_chip(np.random.default_rng(5)).fine_mask()
    mask = coarse(fine)
    assert abs(mask.mean() - fine.mean()) < 0.01
    assert np.array_equal(to_fine(np.array([[0.0, 0.0], [2.0, 1.0]])), [[1.0, 1.0], [2 * FINE + 1, FINE + 1]])


@pytest.mark.parametrize("world", ["adaptive", "dilated", "eroded", "growing_bubble"])
def test_a_wrong_mask_is_the_laboratorys_and_another_channel_is_the_truths(world: str) -> None:
    right, wrong = make_survey("as_stated", 4), make_survey(world, 4)
    if world == "growing_bubble":
        assert np.array_equal(right.chip.mask, wrong.chip.mask)
        closed = right.fluid & ~wrong.fluid
        assert closed.sum() >= 4
        still, before = (np.abs(made.truth_um_s[closed]).mean() for made in (wrong, right))
        assert still < 0.1 * before  # the truth is the state at the end
    else:
        assert np.array_equal(right.fluid, wrong.fluid)
        change = int(wrong.chip.mask.sum()) - int(right.chip.mask.sum())
        assert change < 0 if world == "eroded" else change > 0 if world == "dilated" else change


@pytest.mark.parametrize("world", ["roller", "drag", "late_clock", "drifting_stage"])
def test_a_fault_of_robot_or_pump_changes_what_is_measured_and_not_the_mask(world: str) -> None:
    right, wrong = make_survey("as_stated", 4), make_survey(world, 4)
    assert np.array_equal(right.chip.mask, wrong.chip.mask)
    count = min(len(right.observations.std_um_s), len(wrong.observations.std_um_s))
    same = right.observations.flow_um_s[:count] - wrong.observations.flow_um_s[:count]
    place = right.observations.position_um[:count] - wrong.observations.position_um[:count]
    assert max(np.abs(same).max(), np.abs(place).max()) > 2.0


@pytest.mark.slow("surveys three worlds")
def test_the_same_seed_gives_the_same_survey_and_two_faults_are_two() -> None:
    one, two = make_survey("two_faults", 2), make_survey("two_faults", 2)
    assert np.array_equal(one.observations.flow_um_s, two.observations.flow_um_s)
    assert len(set(faults_of("two_faults", 2))) == 2


def test_the_generator_takes_nothing_from_the_refinement_the_rig_or_their_chips() -> None:
    for module in ("second_worlds.py", "second_chips.py"):
        tree = ast.parse((Path(second.__file__).parent / module).read_text(encoding="utf-8"))
        taken = [node.module or "" for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)]
        names = [name.name for node in ast.walk(tree) if isinstance(node, ast.ImportFrom) for name in node.names]
        assert not [name for name in taken if "stages" in name or "rigs" in name]
        assert not {"draw_channel", "bifurcation", "vessels", "Robot"} & set(names)


def test_a_survey_is_refined_and_scored_like_a_flight() -> None:
    flight = fly(FlightCase("weak_robot", "second", 4))
    refine(flight, ["gain", "assimilate"])
    found = flight.refined["assimilate"]
    assert flight.outcome == "surveyed"
    assert found["error"] < 0.6 * flight.refined["assumed"]["error"]
    assert found["error"] < flight.refined["gain"]["error"]
    assert 0.1 < found["beyond"] < 2.0
    assert found["warned"]


@pytest.mark.parametrize(
    ("world", "seed", "doubted"),
    [
        pytest.param("growing_bubble", 3, 1, marks=pytest.mark.slow("refines a survey of a network")),
        pytest.param("late_clock", 2, 1, marks=pytest.mark.slow("refines a survey of a network")),
        ("roller", 2, 0),
    ],
)
def test_what_no_cause_explains_is_said_alone_and_a_pump_that_pulsates_explains_it(world, seed, doubted) -> None:
    flight = fly(FlightCase(world, "second", seed))
    refine(flight, ["assimilate"])
    found = flight.refined["assimilate"]
    assert found["doubted"] == bool(doubted)
    assert found["beyond"] < 2.0
    taken_for = ("the pump pulsates", "the flow wanders", "the walls seem off")
    assert any(words in found["note"] for words in taken_for) != bool(doubted)


@pytest.mark.slow("solves a flow on a finer grid")
def test_the_truth_does_not_depend_on_the_subcells_of_its_solver(monkeypatch: pytest.MonkeyPatch) -> None:
    coarse_truth = make_survey("as_stated", 4).truth_um_s
    monkeypatch.setattr(second, "FlowSolver", lambda _: FlowSolver(2))
    finer = make_survey("as_stated", 4).truth_um_s
    assert np.linalg.norm(finer - coarse_truth) < 0.01 * np.linalg.norm(finer)


def test_every_world_has_a_name_of_its_own() -> None:
    assert len(set(SECOND_WORLDS)) == len(SECOND_WORLDS) >= 20
