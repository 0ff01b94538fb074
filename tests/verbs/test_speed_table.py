"""`robot.speed_at_hz` by the motion of a robot: a made-up track, and a simulated mission."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import flowrec
from flowrec.measure import MotionFit
from flowrec.measure.calibrate_motion import calibrate_motion
from flowrec.measure.speed_table import SpeedTable, fit_speed_table, propose_table
from flowrec.physics import Robot
from flowrec.stages import FieldLog, load_config
from tests.short_missions import SMALL

RATE_HZ, LATE_S = 30.0, 0.04
HEADING_OFF = 0.1


def fit_of(**values: float | bool) -> MotionFit:
    """What the fit of the motion tells of offset and heading; the rest is not read."""
    given = dict.fromkeys(MotionFit._fields, 0.0) | {"rate": 1.0, "mirrored": False, "refusal": ""}
    return MotionFit(**(given | {"offset_s": -LATE_S, "heading_offset_rad": HEADING_OFF} | values))  # type: ignore[arg-type]


def track_in(
    frequencies_hz: np.ndarray, speed: np.ndarray, rng: np.random.Generator, mirrored: bool = False
) -> tuple[np.ndarray, ...]:
    """Times, positions and log of a robot that has these speeds, in fields of a second each and any heading."""
    headings = rng.uniform(0.0, 2.0 * np.pi, len(frequencies_hz))
    log = FieldLog(np.arange(len(headings)) * 10**9, frequencies_hz, headings, np.full(len(headings), 4.0))
    time_s = np.arange(0.0, len(headings) - 1.0, 1.0 / RATE_HZ)
    now = np.maximum(np.floor(time_s - LATE_S), 0.0).astype(int)
    course = HEADING_OFF + (-headings[now] if mirrored else headings[now])
    steps = speed[now, None] * np.column_stack([np.cos(course), np.sin(course)]) / RATE_HZ
    positions = np.cumsum(steps, axis=0) + rng.normal(0.0, 0.5, (len(now), 2))
    return time_s, positions, log


@pytest.mark.parametrize("mirrored", [False, True])
def test_the_speeds_of_a_robot_that_is_slower_per_revolution_at_high_frequencies_are_found(mirrored: bool) -> None:
    rng = np.random.default_rng(1)
    frequencies_hz = rng.choice([4.0, 8.0, 12.0, 16.0], 240)
    speed = np.interp(frequencies_hz, [0.0, 4.0, 8.0, 12.0, 16.0], [0.0, 100.0, 180.0, 230.0, 250.0])
    time_s, positions, log = track_in(frequencies_hz, speed, rng, mirrored)
    found = fit_speed_table(time_s, positions, lambda at_s: log.turns_until(at_s * 1e9), fit_of(mirrored=mirrored))
    assert not found.why_not
    hz, um_s = np.array(found.pairs).T
    assert np.all(np.diff(hz) > 0.0) and np.all(np.diff(um_s) > 0.0) and hz[-1] > 15.0
    expected = np.interp(hz, [0.0, 4.0, 8.0, 12.0, 16.0], [0.0, 100.0, 180.0, 230.0, 250.0])
    assert um_s == pytest.approx(expected, rel=0.03)
    assert (np.abs(um_s - expected) < 3.0 * np.array(found.std_um_s)).all()


def test_of_a_field_with_one_frequency_one_line_says_why_there_is_no_table() -> None:
    rng = np.random.default_rng(1)
    frequencies_hz = np.full(100, 8.0)
    time_s, positions, log = track_in(frequencies_hz, 20.0 * frequencies_hz, rng)
    found = fit_speed_table(time_s, positions, lambda at_s: log.turns_until(at_s * 1e9), fit_of())
    assert not found.pairs and "8 Hz" in found.why_not


def test_a_robot_that_does_not_get_faster_has_no_table() -> None:
    rng = np.random.default_rng(1)
    frequencies_hz = rng.choice([5.0, 10.0], 120)
    time_s, positions, log = track_in(frequencies_hz, np.where(frequencies_hz > 6.0, 50.0, 100.0), rng)
    found = fit_speed_table(time_s, positions, lambda at_s: log.turns_until(at_s * 1e9), fit_of())
    assert not found.pairs and "does not rise" in found.why_not


@pytest.mark.slow("records a mission, and fits its motion")
def test_calibrate_motion_finds_that_a_simulated_robot_is_a_fifth_faster_than_its_table_says(tmp_path: Path) -> None:
    table = ((5.0, 150.0), (20.0, 420.0), (30.0, 520.0))
    sets = [each for each in SMALL if each.startswith(("camera.", "simulated.world", "recording."))]
    sets += ["camera.um_per_px=20", "robot.radius_um=80", "mission.phases=survey,plan,navigate"]
    sets += [f"robot.speed_at_hz={[list(pair) for pair in table]}", "simulated.um_per_rev_share=1.2"]
    session, out = tmp_path / "s.mcap", tmp_path / "motion.toml"
    flowrec.record(out=session, sets=sets)
    found = calibrate_motion(session, out=out)
    assert "robot.um_per_rev" not in found.sets
    hz, um_s = np.array(found.sets["robot.speed_at_hz"]).T
    expected = 1.2 * np.interp(hz, *np.array([(0.0, 0.0), *table]).T)
    assert um_s == pytest.approx(expected, rel=0.1)
    assert load_config(out).robot.speed_at_hz == found.sets["robot.speed_at_hz"], "the file is a configuration"


def test_a_stated_table_is_replaced_by_the_one_found_and_said_to_be_off_by_the_most_on_the_side_it_is() -> None:
    table = (5.0, 100.0), (10.0, 150.0)
    robot = Robot(radius_um=50.0, um_per_rev=20.0, max_speed_um_s=150.0, step_out_hz=10.0, speed_at_hz=table)
    found = SpeedTable(((5.0, 80.0), (10.0, 165.0)), (1.0, 2.0))
    sets: dict[str, Any] = {"robot.um_per_rev": 16.0, "robot.delay_s": 0.04}
    (said,) = propose_table(found, robot, sets)
    assert sets == {"robot.delay_s": 0.04, "robot.speed_at_hz": found.pairs}
    assert said == "speeds: 80 ± 1 um/s at 5 Hz, 165 ± 2 um/s at 10 Hz; the stated table is up to -20 % off"
    assert propose_table(found._replace(std_um_s=(30.0, 30.0)), robot, dict(sets, **{"robot.um_per_rev": 16.0})) == [
        "speeds: 80 ± 30 um/s at 5 Hz, 165 ± 30 um/s at 10 Hz; the stated table agrees"
    ]
