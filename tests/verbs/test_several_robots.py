"""A mission with several robots: recorded, replayed, edited, compared and exported, each robot by itself."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet
import pytest
import tifffile

import flowrec
from flowrec.core import UsageError
from flowrec.stages import load_config, robot_topic
from flowrec.stages.robot_topics import track_of
from flowrec.verbs.align import asked_import, fit_import
from flowrec.verbs.compare import compare
from flowrec.verbs.preparation import prepare
from tests.conftest import answered
from tests.rewritten import leaves_of, rewrite
from tests.short_missions import SMALL, set_words

SEVERAL = [*SMALL, "simulated.robots=3", "tracker.robots=3", "simulated.seed=4"]
IMPORTED = ["mission.check_axes=false", "refine.assimilate.doubt_depth=false", "recording.own_process=false"]
COMPUTED = [robot_topic(path, number) for path in ("/robot/track", "/robot/estimate") for number in (1, 2)]
OBSERVED = [robot_topic("/robot/observations", number) for number in (1, 2)]


def recorded(path: Path, *sets: str) -> Path:
    chosen = set_words((*SEVERAL, *sets))
    status, said = answered("record", *chosen, "--duration", 1.5, "--out", path)
    assert status == 0, said
    return path


@pytest.fixture(scope="module")
def mission(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return recorded(tmp_path_factory.mktemp("several") / "several.mcap")


def verified(path: Path, *more: object) -> tuple[int, dict[str, Any]]:
    status, said = answered("replay", path, "--verify", "--json", *more)
    return status, json.loads(said)


@pytest.mark.parametrize("more", [(), ("--from", 0.4)])
def test_a_replay_computes_all_robots_again_also_from_the_middle(mission: Path, more: tuple[object, ...]) -> None:
    status, found = verified(mission, *more)
    assert status == 0 and found["same"] is not False
    for path in (*COMPUTED, "/robots/walls"):
        assert found["topics"][path]["identical"] > 30 and not found["topics"][path]["different"], path
    for path in OBSERVED:
        assert found["topics"][path]["identical"] and not found["topics"][path]["different"], path
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
    assert not any(key.startswith("robot_") for key in session.outcome)


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
        observed = pyarrow.parquet.read_table(tmp_path / "tables" / f"observed_flow.robot.{number}.parquet")
        last = flowrec.open(mission).last.extra[robot_topic("/robot/observations", number)]
        assert observed["x_um"].to_pylist() == last.position_um[:, 0].tolist()
    assert np.isfinite(track["score"].to_numpy()).all()


@pytest.fixture(scope="module")
def movie(mission: Path) -> tuple[Path, Path, list[list[float]]]:
    """The images of the mission, the log of its coils, and where its robots are in the first image, in px."""
    file, tables = mission.with_name("movie.ome.tif"), mission.with_name("tables")
    for target, kind in ((file, "tiff"), (tables, "csv")):
        status, said = answered("export", mission, target, "--format", kind)
        assert status == 0, said
    session = flowrec.open(mission)
    first = next(iter(session.ticks()))
    places = [track_of(first, number).position_um for number in range(3)]
    return file, tables / "applied.csv", [session.calibration.to_px(place).tolist() for place in places]


def test_robots_of_a_movie_are_named_by_their_places(
    movie: tuple[Path, Path, list[list[float]]], mission: Path
) -> None:
    file, log, (first, second, third) = movie
    out = mission.with_name("imported.mcap")
    places = [f"{x:.0f},{y:.0f}px" for x, y in (first, third)]
    flowrec.import_movie(file, out, sets=IMPORTED, coils=log, robot=places, align=False)
    ticks = [tick for tick in flowrec.open(out).ticks() if tick.frame is not None]
    was = {tick.stamp_ns: track_of(tick, 2).position_um for tick in flowrec.open(mission).ticks()}
    off_um = [np.hypot(*(track_of(tick, 1).position_um - was[tick.stamp_ns])) for tick in ticks[:20]]
    assert max(off_um) < 10.0, "the second one that was named is robot 2 of the mission"
    assert track_of(ticks[0], 2) is None
    x, y = second[0] + 60.0, second[1]
    with pytest.raises(UsageError, match="no disc of the robot's size"):
        flowrec.import_movie(
            file, out, sets=IMPORTED, coils=log, robot=[places[0], f"{x},{y}px"], align=False, overwrite=True
        )


def test_a_point_on_a_single_robot_is_refused_where_it_would_not_be_read() -> None:
    with pytest.raises(UsageError, match=r"names one; .* tracker.click_px = \[39.5, 75\]"):
        prepare(load_config(None, ["tracker.robots_px=[[39.5,75]]"]))


@pytest.mark.parametrize(
    ("to_second_px", "told"), [((0, 0), "name each once"), ((60, 0), "no disc of the robot's size")]
)
def test_points_of_the_settings_are_looked_at_as_those_of_the_command_line(
    to_second_px: tuple[int, int], told: str, movie: tuple[Path, Path, list[list[float]]]
) -> None:
    file, log, (first, _, third) = movie
    second = (first if to_second_px == (0, 0) else third) + np.array(to_second_px)
    asked = asked_import(
        file, load_config(None, [*IMPORTED, f"tracker.robots_px={[first, second.tolist()]}"]), coils=log
    )
    with pytest.raises(UsageError, match=rf"tracker.robots_px\[1\]: .*{told}"):
        fit_import(asked, file.parent, [], align=False)
    asked = asked_import(file, load_config(None, IMPORTED), coils=log)
    with pytest.raises(UsageError, match=rf"--robot .*px: .*{told}"):
        fit_import(asked, file.parent, [f"{x},{y}px" for x, y in (first, second)], align=False)


def test_robots_of_a_movie_are_named_by_numbers_of_its_picture(movie: tuple[Path, Path, list[list[float]]]) -> None:
    file, log, places = movie
    from_the_top = sorted(places, key=lambda place: place[1])
    asked = asked_import(file, load_config(None, IMPORTED), coils=log)
    for named in ((3, 1), (1, 2)):  # the two that stand out most, and others
        found = fit_import(asked, file.parent, [*map(str, named)], align=False).asked.tracker
        np.testing.assert_allclose(found.robots_px, [from_the_top[each - 1] for each in named], atol=1.0)
    with pytest.raises(UsageError, match=r"--robot 7: .* 3 "):
        fit_import(asked, file.parent, ["1", "7"], align=False)


def test_numbers_of_a_picture_that_is_not_the_first_image_name_no_robots(
    movie: tuple[Path, Path, list[list[float]]], tmp_path: Path
) -> None:
    file, log, _ = movie
    later = tmp_path / "later.ome.tif"
    with tifffile.TiffFile(file) as read:
        images, about = read.asarray(), read.ome_metadata
    images[:4] = np.median(images)  # the robots are in no image before number 4
    tifffile.imwrite(later, images, description=about.encode(), metadata=None)
    asked = asked_import(later, load_config(None, IMPORTED), coils=log)
    with pytest.raises(UsageError, match=r"the numbers is image 4, .* named in image 0: give each as X,Ypx there"):
        fit_import(asked, tmp_path, ["1", "2"], align=False)


def test_a_line_for_each_other_robot_ends_a_run_and_stands_in_its_session(mission: Path) -> None:
    outcome = flowrec.open(mission).outcome
    ticks = list(flowrec.open(mission).ticks())
    for number in (1, 2):
        text = outcome[f"robot_{number}"]
        assert f"tracked in 100% of {len(ticks)} images" in text
        at_um = track_of(ticks[0], number).position_um
        contacts = [
            (math.dist(each.position_um, at_um), path)
            for path, each in ticks[0].extra.items()
            if path.startswith("/truth/robot/")
        ]
        truth = ticks[-1].extra[min(contacts)[1]]
        assert f", {truth.contacts} wall contact" in text
    status, said = answered("info", mission)
    assert status == 0 and "robot 1" in said and "tracked in" in said
