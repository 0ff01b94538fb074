"""`mission.phases = observe`: a robot that drifts is tracked, and the flow is refined when the frames end."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from flowrec.core import UsageError
from flowrec.physics import load_chip
from flowrec.stages import Sight, load_config, pipeline
from flowrec.stages.resolve import resolve
from flowrec.store import Session, SessionReader
from flowrec.verbs import replay_session
from flowrec.verbs.check import check
from flowrec.verbs.record import record

GOLDEN = Path(__file__).parents[2] / "sessions" / "golden.toml"
DEPTH_AS_STATED = "refine.assimilate.doubt_depth=false"  # a third of the time
OBSERVE = ("mission.phases=observe", "duration_s=3.0", "recording.own_process=false", DEPTH_AS_STATED)


@pytest.fixture(scope="module")
def observed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("observe") / "s.mcap"
    done = record(load_config(GOLDEN, [*OBSERVE, "camera.bits=12"]), path)
    assert (done.report.outcome, done.exit_status) == ("observe complete", 0)
    error = {name: done.facts[f"{name}_flow_error"] for name in ("assumed", "refined")}
    assert error["refined"] < 0.03 < error["assumed"]
    return path


def test_no_coil_is_ever_commanded_and_the_file_ends_with_the_refined_flow(observed: Path) -> None:
    with SessionReader(observed) as reader:
        ticks = list(reader.ticks())
        length_s = 1e-9 * (reader.frame_stamps[-1] - reader.frame_stamps[0])
        assert float(reader.outcome["duration_s"]) == pytest.approx(length_s, abs=0.01), "to the last image"
    assert sum(tick.is_afterwards for tick in ticks) > 0
    assert all(tick.currents.amplitude_mt == 0.0 and not tick.currents.currents_a.any() for tick in ticks)
    assert not any(tick.demand.velocity_um_s.any() for tick in ticks)
    assert {tick.mission.phase for tick in ticks} == {"observe", "done"}
    assert ticks[-1].refined is not None and ticks[-2].refined is None
    assert np.isfinite(ticks[-1].refined.velocity_um_s).all()


@pytest.mark.parametrize("from_s", [None, 2.0])
def test_a_replay_of_an_observation_is_exact_and_its_file_is_whole(observed: Path, from_s: float | None) -> None:
    with Session(observed) as session:
        assert session.outcome["outcome"] == "observe complete"
        assert {tick.frame.bits for tick in session.ticks()} == {12}
    assert replay_session(observed, from_s=from_s, verify=True).same
    assert not check(observed).findings


@pytest.mark.slow("flies an observation")
def test_a_robot_out_of_sight_ends_no_observation(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    found = pipeline.find_robots

    def blind(*known: Any) -> Sight:
        sight = found(*known)
        return sight._replace(track=replace(sight.track, seen=False, seen_ns=None))

    monkeypatch.setattr(pipeline, "find_robots", blind)
    limits = ("mission.find_limit_s=0.5", "mission.lost_limit_frames=3")
    done = record(load_config(GOLDEN, [*OBSERVE, *limits]), tmp_path / "s.mcap")
    assert done.report.outcome == "not found"
    assert done.report.duration_s >= 3.0


def test_observe_needs_neither_start_nor_goal_nor_what_only_matters_for_driving() -> None:
    measured = ["camera.um_per_px=33.0", "camera.rate_hz=15.0", "robot.radius_um=70.0"]
    config = load_config(None, ["rig=movie", "mission.phases=observe", *measured])
    chip = load_chip(config.chip)
    assert resolve(config, chip).robot.max_speed_um_s >= 600.0
    with pytest.raises(UsageError, match=r"rig = 'movie': robot\.radius_um, camera\.rate_hz, camera\.um_per_px "):
        resolve(load_config(None, ["rig=movie", "mission.phases=observe"]), chip)
    other = load_config(
        None, ["rig=lab", "mission.phases=observe", "simulated.seed=3", "simulated.image.debris=0", *measured]
    )
    with pytest.raises(UsageError, match=r"simulated\.seed, simulated\.image\.debris is of the simulated rig only"):
        resolve(other, chip)
    with pytest.raises(UsageError, match=r"mission\.phases = observe, plan: observe drives no robot"):
        load_config(None, ["mission.phases=observe,plan"])
