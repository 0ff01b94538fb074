"""What Rerun, Foxglove and the movie with drawings show, read off scales, axes and legends as a person does."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from mcap.reader import make_reader
from rerun.chunk import RrdReader

import flowrec
from flowrec.core import FlowField, Tick
from flowrec.physics import Calibration
from flowrec.store import Session
from flowrec.view import Overlay, Scene, colours
from flowrec.view.foxglove_layout import foxglove_layout
from tests.outlets import primes as p
from tests.rewritten import parser_of

ROW, COLUMN = np.mgrid[: p.ROWS, : p.COLUMNS]
FLUID = p.mask()
MM_PER_UM = 1e-3


def speed_of(middle: tuple[float, float]) -> np.ndarray:
    """(ROWS, COLUMNS) speed of primes.field in um/s."""
    return np.hypot(middle[0] + 0.1 * (COLUMN - 30), middle[1] + 0.3 * (ROW - 14))


def speed_at(middle: tuple[float, float], place_um: np.ndarray) -> float:
    column, row = place_um / p.UM_PER_PX
    return math.hypot(middle[0] + 0.1 * (column - 30), middle[1] + 0.3 * (row - 14))


# ---- Rerun, by its own reader


@pytest.fixture(scope="module")
def rerun(session: Session, tmp_path_factory: pytest.TempPathFactory) -> dict[str, dict[str, Any]]:
    """The latest value of each component of each entity."""
    path = flowrec.export(session, tmp_path_factory.mktemp("rrd") / "a.rrd", file_format="rrd")
    reader = RrdReader(path)
    (recording,) = reader.recordings()
    found: dict[str, dict[str, Any]] = {}
    for chunk in reader.stream(store=recording):
        batch = chunk.to_record_batch()
        entity = chunk.entity_path.lstrip("/").replace("\\", "")
        for name in batch.schema.names:
            if ":" in name:
                found.setdefault(entity, {})[name.split(":")[1]] = batch.column(name)[-1].as_py()
    return found


SERIES = {  # names, and the last values
    "coils/amplitude": (["amplitude (mT)"], [p.AMPLITUDE_MT]),
    "coils/frequency": (["frequency (Hz)"], [p.FREQUENCY_HZ]),
    "coils/heading": (["heading (°)"], [math.degrees(p.HEADING_RAD)]),
    "robot/tracking error": (["tracking error (µm)"], [p.ERROR_UM]),
    "robot/estimate error": (["estimate error (µm)"], [5.0]),
    "robot/observer NIS": (["NIS"], [p.NIS]),
    "robot/observer NIS, mean": (["mean (2 is right)"], [p.HEALTH_NIS]),
    "run/timing": (
        ["track (ms)", "observe (ms)", "control (ms)", "sinks (ms)", "total (ms)"],
        [1.1, 0.3, 0.5, 0.2, 4.7],
    ),
    "robot/flow speed": (
        ["observer", "map", "truth"],
        [p.FLOW_SPEED_UM_S, speed_at(p.REFINED_UM_S, p.position_um(23)), p.TRUE_SPEED_UM_S],
    ),
}


@pytest.mark.parametrize("entity", SERIES)
def test_a_series_of_rerun_has_the_value_of_its_name(entity: str, rerun: dict[str, dict[str, Any]]) -> None:
    names, values = SERIES[entity]
    assert rerun[entity]["names"] == names
    np.testing.assert_allclose(rerun[entity]["scalars"], values, rtol=1e-3)


CHANGE = speed_of(p.REFINED_UM_S) - speed_of(p.ASSUMED_UM_S)
MAPS = {  # its scale, the unit on it, and what can be read off
    "flow/assumed/speed": ("flow/speed scale", "µm/s", speed_of(p.ASSUMED_UM_S)),
    "flow/refined/speed": ("flow/speed scale", "µm/s", speed_of(p.REFINED_UM_S)),
    "flow/truth/speed": ("flow/speed scale", "µm/s", speed_of(p.TRUE_UM_S)),
    "flow/change/map": ("flow/change/scale", "µm/s", CHANGE),
    "flow/uncertainty/map": (
        "flow/uncertainty/scale",
        "µm/s",
        np.where(COLUMN < p.KNOWN_COLUMNS, 1.0, 10.0) * p.STD_LENGTH_UM_S,
    ),
    "plan/time to go/map": ("plan/time to go/scale", "s", 0.25 * COLUMN),
}


@pytest.mark.parametrize("entity", MAPS)
def test_what_is_read_off_a_map_by_its_colour_bar_is_the_value(entity: str, rerun: dict[str, dict[str, Any]]) -> None:
    scale, unit, wanted = MAPS[entity]
    bar, ticks = rerun[f"{scale}/bar"], rerun[f"{scale}/ticks"]
    strip = np.array(bar["buffer"], np.float64).reshape(-1, 3)
    *labels, shown_unit = ticks["labels"]
    assert shown_unit == unit
    rows = np.arange(len(strip)) + 0.5
    strip_y = bar["translation"][0][1] + rows * bar["scale"][0][1]
    ticks_y = [line[0][1] for line in ticks["strips"]]
    values = np.polyval(np.polyfit(ticks_y, [float(label) for label in labels], 1), strip_y)
    png = np.array(rerun[entity]["blob"][0], np.uint8)
    shown = cv2.imdecode(png, cv2.IMREAD_COLOR)[..., ::-1].astype(np.float64)
    assert shown.shape == (p.ROWS, p.COLUMNS, 3)
    nearest = np.linalg.norm(shown[:, :, None] - strip, axis=-1)
    read = values[nearest.argmin(axis=-1)]
    clear = FLUID & (nearest.min(axis=-1) < 6.0)  # not the wave fronts, which are darker
    assert clear.sum() > 0.7 * FLUID.sum()
    np.testing.assert_allclose(read[clear], wanted[clear], atol=0.02 * np.ptp(values))
    np.testing.assert_array_equal(shown[~FLUID], np.broadcast_to(colours.SOLID, shown[~FLUID].shape))
    placed = rerun[entity]
    np.testing.assert_allclose(np.diag(np.reshape(placed["mat3x3"], (3, 3)))[:2], p.UM_PER_PX / p.CAMERA_UM_PER_PX)


def test_robot_route_and_goal_lie_where_the_camera_of_rerun_shows_them(
    session: Session, rerun: dict[str, dict[str, Any]]
) -> None:
    pixel = session.calibration.to_px
    np.testing.assert_allclose(rerun["camera/path"]["strips"][0], pixel(p.WAY_UM) + 0.5, rtol=1e-5)
    ring = np.array(rerun["camera/robot"]["strips"][0])
    np.testing.assert_allclose(0.5 * (ring.min(axis=0) + ring.max(axis=0)), pixel(p.position_um(23)) + 0.5, atol=0.05)
    velocity = np.array(rerun["camera/commanded velocity"]["vectors"][0])
    assert math.atan2(*velocity[::-1]) == pytest.approx(math.atan2(*p.DEMAND_UM_S[::-1]))


# ---- Foxglove: the messages of the file, by the schemas in it


@pytest.fixture(scope="module")
def foxglove(session: Session) -> dict[str, Any]:
    """The latest message of each topic."""
    found: dict[str, Any] = {}
    with session.path.open("rb") as file:
        reader = make_reader(file)
        for schema, channel, message in reader.iter_messages():
            assert schema is not None
            if channel.topic.startswith(("/view/", "/camera/frame/")) and schema.encoding == "protobuf":
                found[channel.topic] = parser_of(schema).FromString(message.data)
    return found


def test_the_camera_of_foxglove_sees_the_middle_of_the_image_in_its_middle(
    session: Session, foxglove: dict[str, Any]
) -> None:
    camera = foxglove["/view/camera"]
    assert (camera.width, camera.height) == (p.WIDTH_PX, p.HEIGHT_PX)
    focal, _, cx, _, focal_y, cy, *_ = camera.K
    # Viewers count from the corner of the first pixel: the middle of 96 pixels is at 48.
    assert (cx, cy, focal_y) == (0.5 * p.WIDTH_PX, 0.5 * p.HEIGHT_PX, focal)
    assert [camera.P[i] for i in (0, 2, 5, 6)] == [focal, cx, focal, cy]
    there = next(each for each in foxglove["/view/frames"].transforms if each.child_frame_id == camera.frame_id)
    middle_um = session.calibration.to_um((0.5 * p.WIDTH_PX - 0.5, 0.5 * p.HEIGHT_PX - 0.5))
    np.testing.assert_allclose((there.translation.x, there.translation.y), MM_PER_UM * np.asarray(middle_um))
    # A pixel beside the middle is one pixel's size away on the chip, at the distance of the camera.
    assert abs(there.translation.z) / focal == pytest.approx(MM_PER_UM * p.CAMERA_UM_PER_PX)


def test_places_of_foxglove_are_in_millimetres_and_numbers_in_the_units_of_their_names(
    foxglove: dict[str, Any],
) -> None:
    here = p.position_um(23)
    pose = foxglove["/view/robot_pose"].pose.position
    np.testing.assert_allclose((pose.x, pose.y, pose.z), (*(MM_PER_UM * here), 0.0))
    way = [(each.position.x, each.position.y) for each in foxglove["/view/path"].poses]
    np.testing.assert_allclose(way, MM_PER_UM * p.WAY_UM)
    robot = foxglove["/view/robot_flow"]
    np.testing.assert_allclose((robot.x_um, robot.y_um, robot.flow_um_s), (*here, p.FLOW_SPEED_UM_S))
    assert robot.map_um_s == pytest.approx(speed_at(p.REFINED_UM_S, here), rel=1e-3)
    seen = foxglove["/view/observation"]
    np.testing.assert_allclose((seen.x_um, seen.y_um), p.OBSERVED.position_um[-1])
    np.testing.assert_allclose((seen.flow_x_um_s, seen.flow_y_um_s), p.OBSERVED.flow_um_s[-1])
    assert (seen.std_um_s, seen.count) == (pytest.approx(2.2), 2)


def test_the_flow_of_foxglove_is_a_grid_of_cells_in_millimetres(foxglove: dict[str, Any]) -> None:
    grid = foxglove["/view/flow_refined_grid"]
    assert (grid.cell_size.x, grid.cell_size.y) == pytest.approx((MM_PER_UM * p.UM_PER_PX,) * 2)
    assert grid.column_count == p.COLUMNS
    assert grid.pose.position.x == pytest.approx(-0.5 * MM_PER_UM * p.UM_PER_PX)
    values = np.frombuffer(grid.data, "<f4").reshape(-1, p.COLUMNS, grid.cell_stride // 4)
    assert len(values) == p.ROWS
    names = [field.name for field in grid.fields]
    velocity = np.stack([p.REFINED_UM_S[0] + 0.1 * (COLUMN - 30), p.REFINED_UM_S[1] + 0.3 * (ROW - 14)], -1)
    for name, wanted in zip(names, (*np.moveaxis(velocity, -1, 0), speed_of(p.REFINED_UM_S)), strict=True):
        np.testing.assert_allclose(values[..., names.index(name)][FLUID], wanted[FLUID], rtol=1e-3, err_msg=name)
    assert names == ["vx_um_s", "vy_um_s", "speed_um_s"]


def test_rerun_makes_views_of_the_bare_file_by_itself_for_verdict_numbers_and_a_chip_some_units_wide(
    session: Session,
) -> None:
    from rerun.chunk import McapReader

    found: dict[str, dict[str, Any]] = {}
    for chunk in McapReader(session.path).stream().to_chunks():
        columns = chunk.to_record_batch()
        found.setdefault(str(chunk.entity_path), {}).update(zip(columns.schema.names, columns.columns, strict=True))
    (text,) = found["/verdict"]["TextDocument:text"].to_pylist()[0]
    assert text.startswith(f"{session.outcome['outcome'].capitalize()}\n\n") and "69 µm/s (yellow)" in text
    errors = [number for (number,) in found["/view/tracking_error_um"]["Scalars:scalars"].to_pylist()]
    assert errors[-1] == p.ERROR_UM
    (speed,) = found["/view/flow_at_robot_um_s"]["Scalars:scalars"].to_pylist()[-1]
    assert speed == pytest.approx(p.FLOW_SPEED_UM_S)
    way = np.array(found["/camera/frame/path"]["Points3D:positions"].to_pylist()[-1])
    assert 0.1 < np.ptp(way, axis=0).max() < 100.0  # its 3-D view looks past what is some thousandths wide


def test_foxglove_looks_at_the_chip_from_where_the_camera_is(foxglove: dict[str, Any]) -> None:
    layout = foxglove_layout((0.1, 0.2), 0.3)
    view = layout["configById"]["3D!chip"]["cameraState"]
    # phi counts from +z: at 0 the view is from +z, with x to the right and y up; at 180 from -z, and y is down.
    at_z = math.cos(math.radians(view["phi"]))
    name = foxglove["/view/camera"].frame_id
    camera = next(each for each in foxglove["/view/frames"].transforms if each.child_frame_id == name)
    assert at_z * camera.translation.z > 0.0, "seen from the other side, the chip is a mirror image"
    assert view["targetOffset"] == [0.1, 0.2, 0]


# ---- the movie with drawings


IMAGE_PX = (480, 280)  # of a camera with smaller pixels, so that nothing is enlarged


@pytest.fixture
def scene(session: Session) -> Scene:
    made = Calibration(1.4, (103.0, 71.0))
    return Scene(session.chip, made, session.config.robot, "primes", image_px=IMAGE_PX)


def drawn(overlay: Overlay, tick: Tick) -> np.ndarray:
    """(h, w, 3) BGR over a grey image."""
    grey = np.full((IMAGE_PX[1] // overlay.zoom, IMAGE_PX[0] // overlay.zoom), 90, np.uint8)
    return overlay.draw(grey, tick).astype(np.float64)


def centre_of(picture: np.ndarray, without: np.ndarray) -> np.ndarray:
    """The middle (x, y) of what differs between two pictures, in pixels counted at their centres."""
    weight = np.abs(picture - without).sum(axis=-1)[: IMAGE_PX[1]]
    rows, columns = np.mgrid[: weight.shape[0], : weight.shape[1]]
    return np.array([(columns * weight).sum(), (rows * weight).sum()]) / weight.sum()


@pytest.mark.parametrize("zoom", [1, 5])
def test_robot_and_goal_are_drawn_where_the_image_shows_their_places(scene: Scene, session: Session, zoom: int) -> None:
    if zoom == 5:  # an image of 96 x 56 pixels
        made = replace(scene.calibration, um_per_px=p.CAMERA_UM_PER_PX)
        scene = replace(scene, calibration=made, image_px=(96, 56))
    assert scene.image_px is not None
    overlay = Overlay(scene, scene.image_px)
    assert overlay.zoom == zoom
    tick, at_um = next(p.ticks()), scene.calibration.to_um(np.array([240.25, 141.75]) / zoom)
    assert tick.estimate is not None
    assert tick.mission is not None
    bare = drawn(overlay, Tick(p.FIRST_NS))
    wanted = zoom * (scene.calibration.to_px(at_um) + 0.5) - 0.5  # an enlarged image keeps its corner
    robot = drawn(Overlay(scene, scene.image_px), Tick(p.FIRST_NS, estimate=replace(tick.estimate, position_um=at_um)))
    np.testing.assert_allclose(centre_of(robot, bare), wanted, atol=0.25)
    goal = drawn(Overlay(scene, scene.image_px), Tick(p.FIRST_NS, mission=replace(tick.mission, goal_um=at_um)))
    np.testing.assert_allclose(centre_of(goal, bare), wanted, atol=0.25)


def test_an_image_of_an_odd_width_is_made_even_by_its_last_column(scene: Scene) -> None:
    width, height = 481, 283
    overlay = Overlay(replace(scene, image_px=(width, height)), (width, height))
    grey = np.tile(np.linspace(20, 220, width).astype(np.uint8), (height, 1))
    picture = overlay.draw(grey, Tick(p.FIRST_NS))
    assert picture.shape[1] == width + 1
    np.testing.assert_array_equal(picture[:height, width], picture[:height, width - 1])
    assert (picture[:height, width] == 220).all()


def test_the_arrow_of_the_legend_is_as_long_as_an_arrow_of_the_speed_that_it_names(scene: Scene) -> None:
    velocity = np.zeros((p.ROWS, p.COLUMNS, 2))
    velocity[FLUID, 0] = 50.0  # a speed that a legend names
    flow = FlowField(
        p.FIRST_NS, 1, "fvm", p.UM_PER_PX, velocity, velocity[..., 0], None, np.zeros(2), 1.0, 998.0, "even"
    )
    picture = drawn(Overlay(scene, IMAGE_PX), Tick(p.FIRST_NS, assumed=flow))
    in_image = max(runs_of(picture[: IMAGE_PX[1]]))
    scale_bar, in_legend = runs_of(picture[IMAGE_PX[1] :])[:2]  # letters are shorter
    assert scale_bar > 60
    assert in_image == pytest.approx(30, abs=5)
    assert in_legend == pytest.approx(in_image, abs=3)


def runs_of(picture: np.ndarray) -> list[int]:
    """Lengths of the bright lines along the middle rows of what is drawn, the longest first; one for each place."""
    bright = picture.min(axis=-1) > 130.0
    found: dict[int, int] = {}  # by the column where a line begins
    for row in bright:
        column = 0
        for on, run in itertools.groupby(row):
            length = len(list(run))
            if on:
                found[column // 4] = max(found.get(column // 4, 0), length)
            column += length
    return sorted(found.values(), reverse=True)


def test_a_scale_bar_of_the_movie_is_as_long_as_it_says(scene: Scene, tmp_path: Path) -> None:
    from flowrec.view import length_text

    picture = drawn(Overlay(scene, IMAGE_PX), Tick(p.FIRST_NS))[IMAGE_PX[1] :]
    assert length_text(100.0) == "100 µm"
    assert runs_of(picture)[0] * 1.4 == pytest.approx(100.0, abs=4.0)  # at most 0.16 of 480 pixels of 1.4 um: 100 um
