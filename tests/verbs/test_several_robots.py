"""A mission with several robots: recorded, replayed, edited, compared and exported, each robot by itself."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet
import pytest

import flowrec
from flowrec.stages import robot_topic
from flowrec.verbs.compare import compare
from tests.conftest import answered
from tests.rewritten import leaves_of, rewrite
from tests.short_missions import SMALL

SEVERAL = [*SMALL, "simulated.robots=3", "tracker.robots=3", "simulated.seed=4"]
COMPUTED = [robot_topic(path, number) for path in ("/robot/track", "/robot/estimate") for number in (1, 2)]


def recorded(path: Path, *sets: str) -> Path:
    chosen = [word for each in (*SEVERAL, *sets) for word in ("--set", each)]
    status, said = answered("record", *chosen, "--duration", 2, "--out", path)
    assert status == 0, said
    return path


@pytest.fixture(scope="module")
def mission(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return recorded(tmp_path_factory.mktemp("several") / "several.mcap")


def verified(path: Path, *more: object) -> tuple[int, dict[str, Any]]:
    status, said = answered("replay", path, "--verify", "--json", *more)
    return status, json.loads(said)


@pytest.mark.parametrize("more", [(), ("--from", 0.7)])
def test_a_replay_computes_all_robots_again_also_from_the_middle(mission: Path, more: tuple[object, ...]) -> None:
    status, found = verified(mission, *more)
    assert status == 0 and found["same"] is not False
    for path in (*COMPUTED, "/robots/walls"):
        assert found["topics"][path]["identical"] > 30 and not found["topics"][path]["different"], path
    assert answered("check", mission)[0] == 0


@pytest.mark.parametrize("path", [*COMPUTED[1:3], "/robots/walls"])
def test_an_edit_of_another_robot_is_found_by_the_replay_itself(path: str, mission: Path, tmp_path: Path) -> None:
    todo = [20]

    def edit(channel: Any, message: Any, wire: Any) -> bool:
        if channel.topic != path or message.sequence != 20 or not todo:
            return False
        todo.pop()
        list(leaves_of(wire))[-1][1]()
        return True

    assert rewrite(mission, tmp_path / "edited.mcap", edit, keep_digest=False) == 1
    status, found = verified(tmp_path / "edited.mcap")
    assert status == 3
    assert {topic for topic, told in found["topics"].items() if told["different"]} == {path}


def test_without_its_images_a_session_is_replayed_from_the_tracks_of_all_robots(mission: Path, tmp_path: Path) -> None:
    rewrite(mission, tmp_path / "blind.mcap", drop="/camera/frame", keep_digest=False)
    _, found = verified(tmp_path / "blind.mcap")
    for path in (*COMPUTED, "/robots/walls", "/robot/estimate"):
        assert found["topics"][path]["different"] == 0, path


def test_a_comparison_tells_which_robot_differs(mission: Path, tmp_path: Path) -> None:
    path = robot_topic("/robot/estimate", 2)

    def edit(channel: Any, message: Any, wire: Any) -> bool:
        if channel.topic != path or message.sequence < 20:
            return False
        list(leaves_of(wire))[-1][1]()
        return True

    rewrite(mission, tmp_path / "other.mcap", edit)
    found = compare(mission, tmp_path / "other.mcap")
    assert found.exit_status == 3
    assert found.as_json()["different"] == [path]


def test_the_first_robot_may_be_replayed_alone(mission: Path) -> None:
    status, said = answered(
        "replay", mission, "--set", "tracker.robots=1", "--json", "--out", mission.with_name("one.mcap")
    )
    assert status == 0, said
    session = flowrec.open(mission.with_name("one.mcap"))
    assert session.topics["/robot/track"] > 30 and "/robot/1/track" not in session.topics


def test_tables_have_one_for_each_robot_and_its_truth(mission: Path, tmp_path: Path) -> None:
    status, said = answered("export", mission, tmp_path / "tables", "--format", "parquet")
    assert status == 0, said
    for number in (1, 2):
        track, truth = (
            pyarrow.parquet.read_table(tmp_path / "tables" / f"extra.{name}.{number}{end}.parquet")
            for name, end in (("robot", ".track"), ("truth.robot", ""))
        )
        assert track.num_rows == truth.num_rows > 30
        assert {"position_x_um", "seen"} <= set(track.column_names), track.column_names
    assert np.isfinite(track["score"].to_numpy()).all()
