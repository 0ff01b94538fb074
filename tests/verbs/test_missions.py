"""Whole missions: the way the paper's robot goes, and honest ends."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import flowrec
from flowrec.core import MCAP, Output, Phase
from flowrec.run import before_after
from flowrec.stages import load_config
from flowrec.store import SessionReader
from flowrec.verbs import refly
from flowrec.verbs import session_replay as verb
from flowrec.verbs.record import record
from flowrec.verbs.run_summary import GOOD_ENDS, Recorded
from tests.conftest import made_once
from tests.short_missions import SMALL

SESSIONS = Path(__file__).parents[2] / "sessions"
# The island between the branches of the bifurcation: above it runs the long slow branch, below it the short fast one.
ISLAND_ROW_UM = 2550.0
CASES = ["case_02.npz", "case_05.npz", "case_08.npz"]


def rows_where_it_swam(recorded: Recorded) -> np.ndarray:
    """Rows of the true positions half way between the forks, while navigating."""
    navigating, rows = False, []
    for tick in SessionReader(recorded.path).ticks(with_frames=False):
        navigating |= tick.mission is not None and tick.mission.phase == "navigate"
        if navigating and tick.truth is not None and 2900.0 < tick.truth.position_um[0] < 3500.0:
            rows.append(tick.truth.position_um[1])
    return np.array(rows)


def test_downstream_the_robot_takes_the_short_fast_branch(mission: Recorded) -> None:
    rows = rows_where_it_swam(mission)
    assert len(rows) > 5
    assert np.all(rows > ISLAND_ROW_UM)


def test_the_end_of_a_mission_tells_its_outcome_its_way_what_was_won_and_where_the_file_is(mission: Recorded) -> None:
    facts = mission.facts
    assert facts["shortest_way_um"] <= 1.01 * facts["route_length_um"]
    assert facts["shortest_way_s"] >= 0.99 * facts["planned_s"], "no way is faster than the one in least time"
    last = mission.report.last
    assert last.refined is not None and last.assumed is not None and last.route is not None
    assert facts["stated_flow_error"] == last.refined.error_share != last.assumed.error_share
    session = flowrec.open(mission.path)
    assert last.mission is not None
    phases = [(each.stamp_ns, each.phase) for each in session.messages("mission")]
    began_ns = next(stamp_ns for stamp_ns, phase in phases if phase == Phase.NAVIGATE)
    assert facts["navigation_s"] == pytest.approx(1e-9 * (last.mission.since_ns - began_ns))
    begin_um, config = last.route.waypoints_um[0], session.config
    by_length = replace(config.plan, method="astar_length")
    on_the_refined, on_the_assumed = (
        by_length.plan(field, begin_um, config.mission.goal, session.chip, config.robot).arrival_s[-1]
        for field in (last.refined, last.assumed)
    )
    assert facts["shortest_way_s"] == pytest.approx(on_the_refined) != pytest.approx(on_the_assumed)
    ended, flow, file = mission.lines()
    assert ended.startswith("reached after ") and f"planned {facts['planned_s']:.1f} s" in ended
    assert ended.endswith(f"would take {facts['shortest_way_s']:.1f} s")
    assumed, refined, stated = (
        f"{100 * facts[f'{name}_flow_error']:.1f} %" for name in ("assumed", "refined", "stated")
    )
    assert flow.startswith(f"flow error: assumed {assumed} (fvm), refined {refined} (assimilate)")
    assert flow.endswith(f"the map states an error of {stated}")
    assert file.startswith(f"file: {mission.path} (")
    slow = {key: value for key, value in facts.items() if key != "shortest_way_um"} | {"shortest_way_s": None}
    odd = replace(mission, facts={**slow, "contacts": 2, "frames_dropped": 3, "planned_s": 99.0}).lines()
    assert "planned 99.0 s" in odd[0]
    assert odd[0].endswith("on the shortest way the flow is too fast for the robot")
    assert odd[2:4] == ["wall contacts: 2", "frames dropped: 3"]


@pytest.fixture(scope="module")
def upstream(tmp_path_factory: pytest.TempPathFactory) -> Recorded:
    asked = load_config(SESSIONS / "upstream.toml", [*SMALL, "mission.goal=inlet"])
    return made_once(tmp_path_factory, "upstream", lambda folder: record(asked, folder / "upstream.mcap"))


@pytest.mark.slow("a whole mission of its own")
def test_upstream_it_takes_the_long_slow_branch_and_arrives(upstream: Recorded) -> None:
    assert upstream.report.outcome == "reached"
    assert upstream.report.contacts == 0
    rows = rows_where_it_swam(upstream)
    assert len(rows) > 5
    assert np.all(rows < ISLAND_ROW_UM)
    facts = upstream.facts
    assert facts["shortest_way_um"] < facts["route_length_um"]
    assert facts["shortest_way_s"] > 1.2 * facts["planned_s"], "the direct way is the wrong one"


@pytest.mark.slow("replays a mission with another planner and flies both routes")
def test_the_paper_planner_goes_upstream_the_same_way_but_slower_and_loses_in_flight_what_was_predicted(
    upstream: Recorded, tmp_path: Path
) -> None:
    done = verb.replay_session(upstream.path, verb.Change(plan="astar_paper"))
    assert done.replayed.route is not None
    assert done.recorded.route is not None
    assert done.replayed.route.method == "astar_paper"
    assert done.replayed.route.waypoints_um[:, 1].min() < ISLAND_ROW_UM - 500.0
    assert done.replayed.route.arrival_s[-1] > done.recorded.route.arrival_s[-1]
    predicted = {row[0]: row[1:] for row in before_after(done)}
    ours_s, paper_s = predicted["travel_time_on_replayed_map_s"]
    assert ours_s < 0.995 * paper_s
    flown = {row[0]: row[1:] for row in refly(done, Output(tmp_path / "flown.mcap", MCAP))}
    assert flown["reflown_outcome"] == ("reached", "reached")
    flown_ours_s, flown_paper_s = flown["reflown_navigation_s"]
    assert flown_paper_s > flown_ours_s
    assert flown_paper_s / flown_ours_s == pytest.approx(paper_s / ours_s, rel=0.03)
    flight = SessionReader(tmp_path / "flown.mcap")
    assert flight.outcome["outcome"] == "reached"
    (flown_in,) = flight.messages("true_field")  # not in the map of the replay, which would favour its own plan
    assert done.recorded.true_field is not None and done.replayed.refined is not None
    np.testing.assert_array_equal(flown_in.velocity_um_s, done.recorded.true_field.velocity_um_s)
    assert not np.array_equal(flown_in.velocity_um_s, done.replayed.refined.velocity_um_s)


@pytest.mark.slow("a whole mission of its own, replayed")
def test_a_map_that_is_refined_again_on_the_way_is_surer_and_replays(tmp_path: Path) -> None:
    sets = ["simulated.world=kind", "mission.phases=refine,plan,navigate", "mission.reassimilate_observations=5"]
    recorded = record(load_config(None, [*SMALL, *sets]), tmp_path / "again.mcap")
    assert recorded.report.outcome == "reached"
    session = SessionReader(recorded.path)
    maps = list(session.messages("refined"))
    assert len(maps) >= 3
    assert len(list(session.messages("route"))) >= len(maps)  # each asks whether another way is better now
    stated = [field.error_share for field in maps]
    assert stated == sorted(stated, reverse=True)
    assert stated[-1] < 0.8 * stated[0]
    # A route that is kept does not begin anew.
    missions = list(session.messages("mission"))
    began_ns = next(mission.stamp_ns for mission in missions if mission.phase == "navigate")
    assert recorded.facts["navigation_s"] == pytest.approx(1e-9 * (missions[-1].since_ns - began_ns))
    assert verb.replay_session(recorded.path, verb.Change()).comparison.identical


@pytest.mark.slow("flies a mission downstream")
def test_a_robot_slower_than_the_flow_says_that_it_can_not_go_back(tmp_path: Path) -> None:
    sets = [*SMALL, "robot.max_speed_um_s=150", "mission.goal=[500.0, 2700.0]"]
    recorded = record(load_config(SESSIONS / "upstream.toml", sets), tmp_path / "slow.mcap")
    assert recorded.report.outcome == "unreachable"
    assert "too fast" in recorded.report.note
    assert recorded.exit_status == 1


@pytest.mark.slow("flies a mission")
def test_a_robot_that_is_not_in_view_is_not_found_and_nothing_is_driven(tmp_path: Path) -> None:
    recorded = record(load_config(None, [*SMALL, "camera.um_per_px=2"]), tmp_path / "blind.mcap")
    assert recorded.report.outcome == "not found"
    assert recorded.exit_status == 1
    for tick in SessionReader(recorded.path).ticks(with_frames=False):
        assert tick.currents is not None
        assert tick.currents.frequency_hz == 0.0


@pytest.mark.skipif("FLOWREC_REFERENCE_DATA" not in os.environ, reason="FLOWREC_REFERENCE_DATA is not set")
@pytest.mark.parametrize("case", CASES)
def test_real_vessels_are_navigated_or_honestly_refused(case: str, tmp_path: Path) -> None:
    path = Path(os.environ["FLOWREC_REFERENCE_DATA"]) / "vessels" / case
    half = [f"chip.path={path}", "survey.method=downstream", "survey.share=0.5"]
    recorded = record(load_config(None, half), tmp_path / "vessel.mcap")
    assert recorded.report.outcome in (*GOOD_ENDS, "unreachable")
    assert recorded.report.contacts <= 1
