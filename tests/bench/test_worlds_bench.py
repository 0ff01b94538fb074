"""The bench of worlds: a flight is flown once, its observations are kept, its scores are published ones."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest

from flowrec.bench import worlds
from flowrec.bench.harness import mean_with_interval
from flowrec.bench.planted_causes import count_causes, planted_causes
from flowrec.bench.world_flights import (
    WORLDS,
    FlightCase,
    Given,
    Judged,
    chip_sets,
    fly,
    in_world,
    prepare_case,
    refine,
    score_field,
)
from flowrec.core.errors import UsageError
from flowrec.rigs.simulated.rig import SimulatedRig
from flowrec.stages.config import load_config
from flowrec.stages.pipeline import assemble
from flowrec.stages.simulated_settings import WORLDS as PRESETS
from flowrec.stages.simulated_settings import Simulated

TINY = ("camera.width_px=320", "camera.height_px=80", "mission.goal=[2400.0, 620.0]")
CASE = FlightCase("slip", "straight", 3, TINY)
SEVERAL = replace(CASE, sets=(*TINY, "tracker.robots=2", "simulated.robots=2"))


@pytest.fixture(scope="module")
def flown():
    flight = fly(CASE)
    refine(flight, ["fvm", "assimilate"])
    return flight


@pytest.mark.slow("a flight and its refinements, again from what was kept")
def test_a_kept_flight_is_refined_as_the_mission_did_and_needs_no_other_flight(flown, tmp_path, monkeypatch, capsys):
    assert (flown.outcome, flown.contacts) == ("reached", 0)
    assert flown.refined["assimilate"]["warned"] == ("% less per revolution" in flown.refined["assimilate"]["note"])
    assert not flown.refined["fvm"]["warned"]
    assert len(flown.order["observations"]["position_um"][1]) > 10
    file = tmp_path / "rows.jsonl"
    line = json.dumps(worlds.as_line(flown))
    file.write_text(line + "\n" + line[:1000])  # killed while it wrote
    (kept,) = worlds.read_flights(file)
    assert worlds.as_line(kept) == json.loads(line) | {"sets": TINY}
    again = replace(kept, refined={})
    refine(again, ["assimilate"])
    assert again.refined["assimilate"] == flown.refined["assimilate"]
    assert again.refined["assumed"]["error"] == flown.refined["fvm"]["error"]
    monkeypatch.setattr(worlds, "fly", None)
    options = {"worlds": "slip", "chips": "straight", "seeds": 1, "first_seed": 3, "sets": list(TINY), "rows": file}
    found = worlds.measure(methods="fvm,assimilate", **options)
    assert file.read_text() == line + "\n"  # nothing was left to do
    assert found["flights"][0]["refined"] == flown.refined
    worlds.measure(methods="assimilate", again=True, **options)
    assert len(list(worlds.read_flights(file))) == 2
    assert {"slip"} == {one.world for one in worlds.read_flights(file)} and list(worlds.read_flights(file))[-1].code
    assert "flown by" in capsys.readouterr().err  # the fixture's flight states no code
    json.dumps(found)
    worlds.show(found)
    assert "slip" in capsys.readouterr().out


@pytest.mark.slow("a flight of two robots and its refinements, again from what was kept")
def test_what_another_robot_observed_is_kept_and_left_out_where_one_robot_alone_is_asked_for():
    flight = fly(SEVERAL)
    assert list(flight.order["others"]) == ["/robot/1/observations"]
    kept = worlds.Flight.of(json.loads(json.dumps(worlds.as_line(flight))))
    refine(kept, ["assimilate", "robot_alone"])
    del flight.order["others"]
    refine(flight, ["assimilate"])
    assert kept.refined["robot_alone"] == flight.refined["assimilate"] != kept.refined["assimilate"]


def test_every_world_can_be_made_and_a_fault_is_as_large_as_its_name_says():
    config, chip = prepare_case(replace(CASE, world="offset"))
    place_um, camera = config.simulated.centre_um, config.camera
    assert math.dist(place_um, (2550.0, 630.0)) == pytest.approx(2.0 * camera.um_per_px, abs=0.01)
    kind, _ = prepare_case(replace(CASE, world="kind"))
    sizes = set()
    for seed in range(6):
        given = Given(np.random.default_rng(seed), kind, chip)
        for world, faults in WORLDS.items():
            made = load_config(None, [f"simulated.{fault}" for fault in ("world=kind", *faults(given))]).simulated
            assert made.world == (world if world in PRESETS else "kind")
            assert (made == Simulated(world="kind")) == (world == "kind"), world
            sizes |= {made.um_per_rev_share} if world == "um_per_rev" else set()
    assert sizes == {0.85, 1.15}
    assert chip_sets("vessels-12") == ("chip.name=vessels", "chip.seed=12")
    assert chip_sets("a/b.npz") == ("chip.path=a/b.npz",)


def test_scores_are_the_published_ones():
    config, chip = prepare_case(CASE)
    truth = SimulatedRig.of(assemble(config, chip), config).true_world().field
    rng = np.random.default_rng(0)
    std = np.full((*chip.mask.shape, 2), 8.0, np.float32)
    noisy = truth.velocity_um_s + rng.normal(0.0, 8.0, truth.velocity_um_s.shape).astype(np.float32)
    rows, columns = np.nonzero(chip.mask)
    seen_um = chip.um_per_px * np.stack([columns, rows], axis=1)[::10]
    judged = Judged(truth, lambda _: truth, truth.velocity_um_s, chip.mask, (), seen_um)
    score = score_field(replace(truth, velocity_um_s=noisy, std_um_s=std), judged)
    rms = math.sqrt((truth.velocity_um_s[chip.mask].astype(float) ** 2).sum(axis=1).mean())
    assert score["error"] == pytest.approx(8.0 * math.sqrt(2.0) / rms, rel=0.02)
    assert score["within_2_sigma"] == pytest.approx(0.9545, abs=0.006)
    # The mean CRPS of a right Gaussian is sigma / sqrt(pi); wider and narrower ones score worse.
    assert score["crps"] == pytest.approx(8.0 / math.sqrt(math.pi) / rms, rel=0.03)
    for factor in (0.5, 2.0):
        other = score_field(replace(truth, velocity_um_s=noisy, std_um_s=factor * std), judged)
        assert other["crps"] > 1.02 * score["crps"]
        assert other["beyond"] == pytest.approx(1.0 / factor, rel=0.1)  # at the places that were observed
    bare = score_field(replace(truth, velocity_um_s=noisy, std_um_s=None), judged)
    assert bare["crps"] == pytest.approx(8.0 * math.sqrt(2.0 / math.pi) / rms, rel=0.03)
    assert bare["within_2_sigma"] is None


def causes(*faults):
    config, chip = in_world(lambda _: faults, 99, 3, [*chip_sets("straight"), *TINY])
    return planted_causes(config, chip)


@pytest.mark.parametrize(
    ("fault", "sentence", "other_side"),
    [
        ("um_per_rev_share=0.85", "the robot moves 15 +- 1 % less per revolution than stated", ("less", "more")),
        ("um_per_rev_share=1.15", "the robot moves 15 +- 1 % more per revolution than stated", ("more", "less")),
        ("slip=0.15", "the robot moves 15 +- 1 % less per revolution than stated", ("less", "more")),
        ("hindrance=1.0", "near walls the robot rolls by 28 +- 2 % slower than elsewhere", ("slower", "faster")),
        ("um_per_px=15.5", "the image scale is 3.0 +- 0.2 % smaller than stated", ("smaller", "larger")),
        ("um_per_px=16.5", "the image scale is 3.0 +- 0.2 % larger than stated", ("larger", "smaller")),
        ("angle_deg=2.0", "the chip is turned by 2.0 +- 0.1 degrees clockwise from", (" clock", " counterclock")),
        ("angle_deg=-2.0", "the chip is turned by 2.0 +- 0.1 degrees counterclockwise from", ("counterclock", "clock")),
        # The middle of the image truly shows what lies 20 um to the right on the chip: the chip lies to the left.
        (
            "centre_um=[2570.0, 630.0]",
            "the chip lies 20 +- 1 um from where the registration puts it (20 um to the left, 0 um up)",
            ("left", "right"),
        ),
        (
            "centre_um=[2550.0, 610.0]",
            "the chip lies 20 +- 1 um from where the registration puts it (0 um to the left, 20 um down)",
            ("down", "up"),
        ),
        ("unstated_depth_widths=0.5", "chip depth 110 +- 9 um", None),
        ("wall_error_px=1.0", "the walls seem off by 5 um or more in places", None),
        ("blocked_share=0.5", "a channel is partly blocked at (100, 200) um", None),
        ("pulsation_share=0.3", "the pump pulsates by 30 +- 1 % at 1.00 Hz", None),
        ("drift_share=0.05", "the flow wanders in time, or by place along the way, by 7 +- 2 %", None),
        ("shake_um=10.0", "the image shakes at 3.00 Hz", None),
    ],
    ids=lambda value: value.partition(",")[0] if isinstance(value, str) and "=" in value else "",
)
def test_a_warning_counts_where_it_names_the_planted_cause_on_its_side(fault, sentence, other_side):
    def note(clause):
        return f"assimilated 8 observations; 1 more distrusted as outliers; {clause}; they scatter 2.0 times more"

    assert count_causes(note(sentence), causes(fault)) == (1, 0)
    assert count_causes(note(sentence), causes()) == (0, 1)  # nothing is planted
    if other_side:
        assert count_causes(note(sentence.replace(*other_side)), causes(fault)) == (0, 1)
    # A wrong scale also moves the chip, to a side that depends on where the survey was.
    moved = "the chip lies 27 +- 10 um from where the registration puts it (25 um to the right, 11 um up)"
    assert count_causes(moved, causes(fault))[0] == int("um_per_px" in fault or "angle" in fault)
    assert count_causes("assimilated 8 observations; they say nothing about outlet 1 (right)", causes(fault)) == (0, 0)


@pytest.mark.slow("needs a flight and its refinements")
def test_a_summary_counts_worse_maps_and_those_of_which_nothing_was_said(flown):
    def made(assumed, refined, note):
        found = {"assumed": {"error": assumed}, "gain": {**SCORE, "error": 0.1}}
        return replace(flown, refined={**found, "assimilate": {**SCORE, "error": refined, "warned": note}})

    flights = [made(0.2, 0.05, False), made(0.2, 0.3, False), made(0.2, 0.4, True)]
    found = worlds.scores(flights, "assimilate")
    assert (found["count"], found["worse"], found["unsaid"]) == (3, 2, 1)
    assert found["error"]["mean"] == pytest.approx(0.25) and found["within_2_sigma"] == 0.9
    assert found["over_null"]["mean"] == pytest.approx((0.5 * 3 * 4) ** (1 / 3))
    low, high = mean_with_interval([0.05, 0.3, 0.4])["interval_95"]
    assert 0.05 <= low < 0.25 < high < 0.401
    assert math.isnan(worlds.scores([], "assimilate")["error"]["mean"])


SCORE = {"within_2_sigma": 0.9, "crps": 0.01, "warned": False, "expected": None, "note": ""}


def test_wrong_requests_are_said_at_once(tmp_path):
    for wrong in ({"worlds": "mars"}, {"methods": "luck"}):
        with pytest.raises(UsageError, match=r"mars|luck"):
            worlds.measure(**wrong)
    (tmp_path / "rows.jsonl").write_text("{}\n{}\n")
    with pytest.raises(UsageError, match=r"line 1: is no flight"):
        worlds.measure(rows=tmp_path / "rows.jsonl")


def test_a_flight_that_can_not_be_flown_is_a_row_and_no_error():
    flight = fly(replace(CASE, sets=(*TINY, "chip.inlet_speed_um_s=60000")))
    assert flight.outcome == "refused" and "too swift" in flight.note
    refine(flight, ["fvm"])
    assert flight.refined == {}
