"""Results are numbers with their unit in the key; words are made of them when they are shown."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from flowrec.core import Value, of_text, verdict_lines, way_text, with_micro
from flowrec.store import Session, SessionReader
from flowrec.store.session_metadata import outcome_of_today
from tests.conftest import run
from tests.short_missions import SMALL

GOLDEN = Path(__file__).parents[2] / "sessions" / "golden.mcap"


@pytest.fixture
def told(capsys: pytest.CaptureFixture[str]):  # type: ignore[no-untyped-def]
    def printed(*words: object) -> str:
        """What a verb prints on stdout."""
        capsys.readouterr()
        assert run(words) == 0
        return capsys.readouterr().out

    return printed


def are_results_of_a_mission(facts: dict[str, Any]) -> None:
    assert facts.get("outcome") == "reached"
    for key in ("duration_s", "wall_s", "navigation_s", "planned_s", "route_length_um", "tracking_error_um"):
        assert isinstance(facts.get(key), float), key
        assert facts[key] > 0.0, key
    for key in ("ticks", "contacts", "observations", "frames_dropped"):
        assert isinstance(facts.get(key), int), key
    assert 0.0 < facts["refined_flow_error"] < facts["assumed_flow_error"] < 1.0
    assert facts["assumed_method"] == "fvm"
    assert 1000.0 < facts["route_length_um"] < 20_000.0


def test_info_gives_the_results_of_a_mission_as_numbers(session: Path, told) -> None:  # type: ignore[no-untyped-def]
    facts = json.loads(told("info", session, "--json"))["facts"]
    are_results_of_a_mission(facts)
    assert facts["size_bytes"] == session.stat().st_size
    assert facts["seed"] == 1
    assert facts["derived"]["robot.max_speed_um_s"] == 600.0
    shown = told("info", session)
    assert f"{100 * facts['refined_flow_error']:.1f} %" in shown
    assert f"{facts['route_length_um'] / 1000:.2f} mm" in shown
    assert f"{session.stat().st_size / 1e6:.1f} MB" in shown


def test_the_file_holds_numbers_that_read_back_exactly(session: Path, mission) -> None:  # type: ignore[no-untyped-def]
    kept = SessionReader(session).outcome
    for key in ("duration_s", "wall_s", "refined_flow_error", "tracking_error_um"):
        assert kept.get(key) == repr(mission.facts.get(key)), key


def test_record_gives_its_results_as_numbers_and_info_who_made_it(tmp_path: Path, told) -> None:  # type: ignore[no-untyped-def]
    said = {"operator": "Ada", "sample": "chip 7", "notes": "first light"}
    sets = [*SMALL, "duration_s=0.5", "simulated.seed=42", *(f"recording.{key}={value}" for key, value in said.items())]
    out = tmp_path / "run.mcap"
    found = json.loads(told("record", "--json", "--out", out, *(word for text in sets for word in ("--set", text))))
    assert isinstance(found.get("duration_s"), float)
    assert isinstance(found.get("ticks"), int)
    assert found["files"] == [str(out)]
    assert isinstance(found["derived"]["robot.delay_s"], float)
    facts = json.loads(told("info", out, "--json"))["facts"]
    assert {key: facts[key] for key in said} == said
    assert facts["seed"] == 42
    assert facts["flowrec"]
    assert isinstance(facts["local_changes"], bool) == bool(facts["commit"])
    shown = told("info", out)
    assert all(text in shown for text in ("Ada", "chip 7", "first light", "42", facts["flowrec"]))


@pytest.mark.slow("refines a mission again")
def test_a_replay_gives_numbers_before_and_after(told, tmp_path: Path) -> None:  # type: ignore[no-untyped-def]
    out = tmp_path / "again.mcap"
    found = json.loads(told("replay", GOLDEN, "--plan", "astar_time", "--out", out, "--json"))
    assert isinstance(found["duration_s"], float)
    rows = {row["quantity"]: (row["recorded"], row["replayed"]) for row in found["rows"]}
    for key in ("refined_flow_error", "residual_um_s", "route_length_um", "travel_time_on_replayed_map_s"):
        assert all(isinstance(value, float) for value in rows.get(key, ("missing",))), key
    assert rows["planner"] == ("time_field", "astar_time")
    assert isinstance(rows["commands_changed"][1], int)
    assert math.isfinite(float(SessionReader(out).outcome["wall_s"]))


def test_an_older_file_that_holds_sentences_is_still_read(told) -> None:  # type: ignore[no-untyped-def]
    facts = json.loads(told("info", GOLDEN, "--json"))["facts"]
    assert facts.get("assumed_flow_error") == 0.127
    assert facts["refined_method"] == "assimilate"
    assert "duration" not in facts
    assert facts["tracking_error"] == "22.6 um rms"
    assert facts["seed"] == 5
    assert facts["commit"].startswith("7bf8e22119")
    shown = told("info", GOLDEN)
    assert "12.7 %" in shown
    assert "golden session" in shown


def test_check_gives_what_it_counted_as_numbers(session: Path, told) -> None:  # type: ignore[no-untyped-def]
    figures = json.loads(told("check", session, "--json")).get("figures")
    assert figures is not None
    assert figures["frames"] == figures["ticks"] > 100
    assert figures["frames_dropped"] == 0
    assert figures["rate_hz"] == pytest.approx(30.0, rel=0.01)
    assert figures["duration_s"] == pytest.approx((figures["ticks"] - 1) / 30.0, rel=0.01)


def test_a_new_file_holds_the_count_of_dropped_frames_once_and_readers_take_the_names_of_older_files(
    session: Path,
) -> None:
    outcome = Session(session).run.outcome
    assert outcome["dropped_frames"] == "0"
    assert "frames_dropped" not in outcome
    assert Session(session).outcome["frames_dropped"] == 0
    for older in ({"frames_dropped": "3"}, {"dropped_frames": "3"}, {"frames_dropped": "3", "dropped_frames": "1"}):
        assert of_text(outcome_of_today(older)) == {"frames_dropped": 3}
    for odd in ({"dropped_frames": "many"}, {"frames_dropped": "many", "dropped_frames": "1"}, {}):
        assert outcome_of_today(odd) == {key: text for key, text in odd.items() if key == "dropped_frames"}


def test_what_a_file_states_of_the_way_in_part_only_is_no_sentence() -> None:
    whole: dict[str, Value] = {"route_length_um": 7190.0, "navigation_s": 23.0, "planned_s": 23.1}
    assert way_text(whole) == "7.19 mm to the goal in 23.0 s, planned 23.1 s"
    replayed = verdict_lines(whole | {"outcome": "replayed", "note": "replay of a.mcap", "duration_s": 35.1})
    way = "Route of 7.19 mm to the goal, planned 23.1 s; it was not flown"
    assert replayed == ["Replayed", "Replay of a.mcap", way]
    for key in whole:
        assert way_text({name: value for name, value in whole.items() if name != key}) == ""


def test_pictures_tell_the_end_first_then_the_reason_the_doubts_what_was_won_and_what_was_learned() -> None:
    figures: dict[str, Value] = {"outcome": "lost", "note": "at 5 um", "duration_s": 16.2, "doubts": "axes; scale"}
    flow: dict[str, Value] = {"assumed_method": "fvm", "assumed_flow_error": 0.089}
    refined = Session(GOLDEN).last.refined
    assert refined is not None
    found = replace(refined, note="assimilated 53 observations; it moves 10 +- 2 % less")
    assert verdict_lines(figures | flow, found) == [
        "Lost after 16.2 s, doubtful",
        "At 5 µm",
        "Doubtful: axes",
        "Doubtful: scale",
        "Flow error: assumed 8.9 % (fvm)",
        "Learned from 53 observations: it moves 10 ± 2 % less",
    ]
    (refused,) = verdict_lines({}, replace(found, refused="no light"))
    assert refused.endswith(": no light")
    assert verdict_lines({}, replace(found, note="assimilated 53 observations")) == verdict_lines({}) == []


def test_pictures_and_pages_spell_micrometres_as_axes_do_and_leave_names_alone() -> None:
    assert with_micro("(240, 2700) um, 15.5 um/s, um per revolution") == "(240, 2700) µm, 15.5 µm/s, µm per revolution"
    assert with_micro("10 +- 2 %") == "10 ± 2 %"
    assert with_micro("robot.radius_um = 3, sum, um_per_px, a.um") == "robot.radius_um = 3, sum, um_per_px, a.um"
