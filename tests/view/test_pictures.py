"""Maps, scales and arrows: what a person reads off them is what the field says."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
import rerun as rr

from flowrec.console.page_state import SHOWN, PageState
from flowrec.core import Applied, CameraLosses, Drops, FlowField, Measured, Outcome, Shift, Tick
from flowrec.physics import Calibration, sample
from flowrec.stages import figures_of
from flowrec.store.viewer_scene import ChipCamera, ViewerScene
from flowrec.view import (
    Batch,
    ColourScale,
    Scene,
    WindowCompleter,
    arrow_grid,
    colours,
    flow_arrows,
    flow_values,
    maps,
    registration_remark,
    scale_of,
)
from flowrec.view.drawing import encode_jpeg
from flowrec.view.entities import LOSSES, TIME_TO_GO
from flowrec.view.logger import TickLogger
from flowrec.view.state_lanes import StateLogger
from flowrec.view.summary_text import LiveSummary


class Record:
    """Stands in for a recording stream and keeps what is logged last of each entity."""

    def __init__(self) -> None:
        self.logged: dict[str, Any] = {}

    def set_time(self, *_: object, **__: object) -> None: ...
    def disable_timeline(self, *_: object) -> None: ...

    def log(self, path: str, what: Any, *_: Any, static: bool = False) -> None:
        if not static:
            self.logged[path] = what

    def map(self, path: str) -> np.ndarray:
        """(h, w, 3) RGB."""
        png = np.asarray(self.logged[path].blob.as_arrow_array().to_pylist()[0], np.uint8)
        return np.asarray(cv2.imdecode(png, cv2.IMREAD_COLOR)[..., ::-1])


def times(field: FlowField, factor: float) -> FlowField:
    return replace(field, velocity_um_s=field.velocity_um_s * np.float32(factor))


def test_maps_beside_each_other_have_one_scale_also_when_a_faster_flow_comes(scene: Scene, ticks: list[Tick]) -> None:
    assumed = ticks[0].assumed
    assert assumed is not None
    record, speeds = Record(), maps.SpeedScale()
    logger = TickLogger(record, scene, speeds=speeds)  # type: ignore[arg-type]
    logger.log(Tick(0, assumed=assumed))
    before = record.map("/flow/assumed/speed")
    logger.log(Tick(1, assumed=assumed, refined=times(assumed, 3.0)))
    after, refined = record.map("/flow/assumed/speed"), record.map("/flow/refined/speed")
    assert speeds.scale is not None
    assert speeds.scale.high >= 3.0 * flow_values.peak(assumed)
    assert not np.array_equal(before, after)  # painted again, or its colours would mean something else
    fluid = scene.chip.mask
    assert np.array_equal(after, speeds.scale.paint(flow_values.speed(assumed, fluid)))
    assert np.array_equal(refined, speeds.scale.paint(flow_values.speed(times(assumed, 3.0), fluid)))
    assert (after[~fluid] == colours.SOLID).all()


def test_a_recorded_and_a_replayed_session_share_one_scale(scene: Scene, ticks: list[Tick]) -> None:
    assumed = ticks[0].assumed
    assert assumed is not None
    record, speeds = Record(), maps.SpeedScale()
    recorded, replayed = (
        TickLogger(record, scene, prefix, speeds=speeds)  # type: ignore[arg-type]
        for prefix in ("recorded", "replayed")
    )
    recorded.log(Tick(0, assumed=assumed))
    replayed.log(Tick(0, assumed=times(assumed, 5.0)))
    recorded.log(Tick(1, assumed=assumed))
    assert speeds.scale is not None
    assert np.array_equal(
        record.map("/recorded/flow/assumed/speed"), speeds.scale.paint(flow_values.speed(assumed, scene.chip.mask))
    )


def test_a_map_of_the_time_to_go_tells_far_from_unreachable(scene: Scene, ticks: list[Tick]) -> None:
    route = ticks[-1].route
    assert route is not None
    fluid = scene.chip.mask
    time_s = np.where(fluid, np.arange(fluid.shape[1]) * 0.05, np.inf)
    time_s[:, -20:] = np.inf
    record = Record()
    logger = TickLogger(record, scene)  # type: ignore[arg-type]
    logger.log(Tick(0, route=replace(route, time_to_go_s=time_s)))
    seen = record.map("/plan/time\\ to\\ go/map")
    assert (seen[~fluid] == colours.SOLID).all()
    assert (seen[:, -20:][fluid[:, -20:]] == colours.UNREACHABLE).all()
    assert TIME_TO_GO in logger.present
    row = int(np.argmax(fluid[:, :-20].sum(1)))
    assert seen[row, -30].astype(int).sum() > seen[row, 10].astype(int).sum()  # lighter is farther
    logger.log(Tick(1, route=route))
    assert isinstance(record.logged["/plan/time\\ to\\ go/map"], rr.Clear)


@pytest.mark.parametrize("largest", [3e-7, 0.9, 1.0, 7.3, 42.0, 100.0, 456.0, 1e6])
def test_a_scale_holds_its_largest_value_on_few_round_ticks(largest: float) -> None:
    for shown in ("speed", "change"):
        scale = ColourScale.up_to(largest, shown)  # type: ignore[arg-type]
        assert largest <= scale.high * (1 + 1e-9) < 2.6 * largest
        assert 3 <= len(scale.ticks) <= 8
        assert scale.high - 0.51 * scale.step < scale.ticks[-1] <= scale.high * (1 + 1e-9)
        assert scale.high < 1.5 * largest


def test_the_ticks_of_the_colour_bar_stand_where_their_colour_is(scene: Scene) -> None:
    scale, bar = ColourScale.up_to(500.0, "speed"), maps.ColourBar(scene)
    image, _ = bar.strip(scale)
    marks, numbers = bar.ticks(scale)
    words = numbers.labels.as_arrow_array().to_pylist()  # type: ignore[union-attr]
    assert words == ["0", "100", "200", "300", "400", "500", "µm/s"]
    rows = image.buffer.as_arrow_array().to_pylist()[0]  # type: ignore[union-attr]
    colours = np.array(rows, np.uint8).reshape(256, 3)
    for strip, word in zip(marks.strips.as_arrow_array().to_pylist(), words[:-1], strict=True):  # type: ignore[union-attr]
        row = int(np.clip((strip[0][1] - bar.top) / bar.height * 256, 0, 255))
        assert np.abs(colours[row].astype(int) - scale.paint(float(word))).max() <= 4


def test_arrows_stand_in_fluid_apart_and_point_where_the_flow_goes(scene: Scene, ticks: list[Tick]) -> None:
    field = ticks[-1].refined
    assert field is not None
    grid = arrow_grid(scene)
    origins, vectors, speed = flow_arrows(scene, field, grid)
    middle_um = scene.calibration.to_um(origins + 0.5 * vectors - 0.5)
    assert np.allclose(middle_um, grid[0])
    velocity = sample(field, grid[0])
    assert len(speed) > 60
    assert (speed > 0).all()  # none in solid
    cosine = (vectors * velocity).sum(1) / np.hypot(*vectors.T) / speed
    assert cosine.min() > 0.999999
    assert np.hypot(*vectors.T).max() <= scene.length_px(grid[1])  # no longer than their spacing
    gaps = np.linalg.norm(grid[0][:, None] - grid[0], axis=-1)[~np.eye(len(speed), dtype=bool)]
    assert gaps.min() > 0.75 * grid[1]
    order = np.argsort(speed)
    assert (np.diff(np.hypot(*vectors.T)[order]) >= -1e-9).all()  # faster is never shorter


def test_the_branches_of_a_narrow_network_all_have_arrows(scene: Scene) -> None:
    mask = np.zeros((400, 400), bool)
    for at in (37, 151, 263, 388):
        mask[at : at + 5] = True
    narrow = replace(scene, chip=replace(scene.chip, mask=mask))
    rows = arrow_grid(narrow)[0][:, 1] / narrow.chip.um_per_px
    assert all(np.sum(np.abs(rows - at - 2) <= 2) > 15 for at in (37, 151, 263, 388))


@pytest.mark.parametrize(("angle_deg", "mirror"), [(0.0, False), (30.0, False), (-80.0, True)])
def test_pictures_of_any_resolution_lie_on_each_other(scene: Scene, angle_deg: float, mirror: bool) -> None:
    turned = replace(scene, calibration=Calibration(0.7, (30.0, -12.0), angle_deg, mirror))
    place = turned.mask_to_plane()
    column_row = np.array([10.0, 20.0])  # a pixel of the mask, whose centre Rerun counts half a pixel further
    in_plane = place[:, :2] @ (column_row + 0.5) + place[:, 2]
    assert np.allclose(turned.to_plane(4.0 * column_row), in_plane)
    left, top, right, bottom = turned.chip_bounds()
    assert left < in_plane[0] < right and top < in_plane[1] < bottom
    preview = turned.preview_to_plane(3)
    assert np.allclose(preview[:, :2] @ (column_row + 0.5) + preview[:, 2], 3 * column_row + 0.5)


def test_arrows_turn_with_the_camera(scene: Scene, ticks: list[Tick]) -> None:
    field = ticks[0].assumed
    assert field is not None
    turned = replace(scene, calibration=Calibration(2.0, (5.0, 9.0), 25.0, True))
    (start, vector, _), (start_turned, vector_turned, _) = (
        flow_arrows(each, field, arrow_grid(scene)) for each in (scene, turned)
    )
    for points, points_turned in ((start, start_turned), (start + vector, start_turned + vector_turned)):
        on_chip = [each.calibration.to_um(at - 0.5) for each, at in ((scene, points), (turned, points_turned))]
        assert np.allclose(*on_chip)


def test_a_robot_that_is_not_seen_is_grey_and_says_so(scene: Scene, ticks: list[Tick]) -> None:
    record = Record()
    logger = TickLogger(record, scene)  # type: ignore[arg-type]
    words = []
    for tick in ticks[70:78]:
        logger.log(tick)
        label = record.logged.get("/camera/robot\\ label")
        word = label.labels.as_arrow_array().to_pylist() if label is not None else []
        (colour,) = record.logged["/camera/robot"].colors.as_arrow_array().to_pylist()
        words.append(word)
        expected = colours.PALE if word else colours.ORANGE
        assert colour >> 8 == (expected[0] << 16) + (expected[1] << 8) + expected[2]
    assert words == [[]] * 2 + [["robot not seen"]] * 4 + [[]] * 2
    assert logger.present >= {"Robot"}


def test_the_stand_in_has_the_methods_of_a_real_stream() -> None:
    assert all(hasattr(rr.RecordingStream, name) for name in ("set_time", "disable_timeline", "log"))


def test_a_window_is_shown_in_the_last_whole_image_dimmed() -> None:
    windows = WindowCompleter()
    whole = np.full((40, 60), 200, np.uint8)
    window = np.zeros_like(whole)
    window[10:20, 30:45] = 90
    assert np.array_equal(windows.complete(window), window)  # nothing is known of the rest
    assert np.array_equal(windows.complete(whole), whole)
    shown = windows.complete(window)
    assert np.all(shown[10:20, 30:45] == 90)
    shown[10:20, 30:45] = 120
    assert np.all(shown == 120)


def test_what_an_amplifier_puts_out_wrongly_is_seen_as_the_difference_of_each_coil(scene: Scene) -> None:
    record = Record()
    logger = TickLogger(record, scene)  # type: ignore[arg-type]
    logger.log(Tick(0, measured=Measured(0, np.array([0.5, -1.0, 0.0, 0.25]), np.array([0.5, -0.5, 0.0, 0.5]))))
    drawn = record.logged["/coils/read-back"].scalars.as_arrow_array().to_pylist()
    assert np.allclose(np.ravel(drawn), [0.0, -0.5, 0.0, -0.25])
    assert "coils/read-back" in logger.present  # the layout has a plot for it


def test_image_and_robot_lie_on_the_chip_once_the_refinement_found_the_registration(
    scene: Scene, ticks: list[Tick]
) -> None:
    tick = ticks[-1]
    assert tick.refined is not None
    assert tick.estimate is not None
    turn, at = np.deg2rad(2.0), np.array([30.0, -20.0])
    registration = np.array([[np.cos(turn), -np.sin(turn), at[0]], [np.sin(turn), np.cos(turn), at[1]]])
    turned = replace(scene, calibration=Calibration(2.0, (5.0, 9.0), 25.0, True))
    record = Record()
    logger = TickLogger(record, turned)  # type: ignore[arg-type]
    logger.log(replace(tick, refined=replace(tick.refined, registration=registration)))
    on_chip = registration[:, :2] @ tick.estimate.position_um + at
    ring = np.array(record.logged["/camera/robot"].strips.as_arrow_array().to_pylist()[0])
    assert np.allclose(ring[:-1].mean(axis=0), turned.to_plane(on_chip), atol=1e-3)
    moved = record.logged["/camera/measured"]
    matrix = np.array(moved.mat3x3.as_arrow_array().to_pylist()[0]).reshape(3, 3).T[:2, :2]
    shift = np.array(moved.translation.as_arrow_array().to_pylist()[0])[:2]
    seen = turned.to_plane(tick.estimate.position_um)  # where the robot is in the image
    assert np.allclose(matrix @ seen + shift, turned.to_plane(on_chip), atol=1e-3)


def test_a_shaken_image_is_moved_back_to_where_route_and_robot_lie_in_every_view(
    scene: Scene, ticks: list[Tick]
) -> None:
    turned, off_px = replace(scene, calibration=Calibration(2.0, (5.0, 9.0), 25.0, True)), np.array([3.0, -1.5])
    tick = replace(ticks[-1], shift=Shift(ticks[-1].stamp_ns, off_px, found=True, alike=1.0))
    assert tick.estimate is not None
    record = Record()
    logger = TickLogger(record, turned)  # type: ignore[arg-type]
    logger.log(tick)
    at = turned.to_plane(tick.estimate.position_um)
    ring = np.array(record.logged["/camera/robot"].strips.as_arrow_array().to_pylist()[0])
    assert np.allclose(ring[:-1].mean(axis=0), at, atol=1e-3)  # on the chip, which rests
    moved = np.array(record.logged["/camera/measured"].translation.as_arrow_array().to_pylist()[0])[:2]
    assert np.allclose(at + off_px + moved, at, atol=1e-3)  # where the image shows it
    page = PageState(turned)
    page.take(Batch(1, [tick.news(Tick(), SHOWN)], {}))  # what the feed hands on
    assert np.allclose(page.state()["robot"], at + off_px, atol=0.06)
    assert np.allclose(page.chip_um(*(at + off_px)), tick.estimate.position_um, atol=0.01)
    viewer = ViewerScene(ChipCamera(turned.calibration, (640, 512), 50.0))
    viewer.update({"shift": tick.shift})
    assert viewer.picture is not None
    assert np.allclose(viewer.picture.to_px(tick.estimate.position_um[None])[0], at + off_px)


class States(Record):
    """Keeps the colours of the lanes."""

    def log(self, path: str, what: Any, *_: Any, static: bool = False) -> None:
        if isinstance(what, rr.StateConfiguration):
            self.logged[path] = what


def test_the_outcome_of_a_run_is_amber_if_its_track_is_doubtful_and_else_green(scene: Scene, ticks: list[Tick]) -> None:
    mission, track = ticks[-1].mission, ticks[-1].track
    assert mission is not None
    assert track is not None
    middle_px, border_px = (100.0, 100.0), (0.5, 100.0)
    found = []
    for place_px in (middle_px, border_px):
        at = replace(track, seen=True, position_um=scene.calibration.to_um(place_px))
        record, summary = States(), LiveSummary(replace(scene, camera_shape=(512, 640)))
        logger = TickLogger(record, scene)  # type: ignore[arg-type]
        done = replace(mission, finished=True, outcome=Outcome.REACHED)
        for tick in (Tick(0, track=at, mission=replace(mission, finished=False)), Tick(1, track=at, mission=done)):
            summary.add(tick)
            logger.states.doubtful = summary.doubtful
            logger.log(tick)
        shades = np.asarray(record.logged["/Mission"].colors.as_arrow_array().to_pylist()[-1]).ravel()
        found.append(int(shades[-1]) >> 8)
    green, amber = ((r << 16) + (g << 8) + b for r, g, b in (colours.GREEN, colours.YELLOW))
    assert found == [green, amber]


def test_the_summary_says_by_how_much_the_picture_is_moved_in_the_middle_of_the_chip(ticks: list[Tick]) -> None:
    refined = ticks[-1].refined
    assert refined is not None
    assert registration_remark(replace(refined, registration=None)) == ""
    height, width = refined.pressure_pa.shape
    middle = 0.5 * refined.um_per_px * np.array([width - 1.0, height - 1.0])
    # 3 % smaller about the middle, and 12.5 um to the right, 4 um up: at the origin it would be another shift.
    grown = 0.97 * np.eye(2)
    registration = np.column_stack((grown, middle + np.array([12.5, -4.0]) - grown @ middle))
    assert "(12.5, -4.0) um" in registration_remark(replace(refined, registration=registration))


def test_where_nothing_is_commanded_the_field_is_that_of_the_log_of_the_coils(scene: Scene, ticks: list[Tick]) -> None:
    mission, currents = ticks[-1].mission, ticks[-1].currents
    assert mission is not None and currents is not None
    applied = Applied(ticks[-1].stamp_ns, 12.5, 0.0, 3.0, np.zeros(3), np.zeros(2))
    shown = []
    for phase in ("navigate", "observe"):
        record = Record()
        logger = TickLogger(record, scene)  # type: ignore[arg-type]
        logger.log(replace(ticks[-1], mission=replace(mission, phase=phase), applied=applied))
        shown += record.logged["/coils/frequency"].scalars.as_arrow_array().to_pylist()
    assert shown == [currents.frequency_hz, 12.5]


def test_a_run_that_ends_in_its_survey_states_no_route_to_the_goal(scene: Scene, ticks: list[Tick]) -> None:
    tick = ticks[-1]
    assert tick.mission is not None and tick.route is not None
    ended = replace(tick, mission=replace(tick.mission, phase="done", outcome="lost"))
    assert "planned_s" in figures_of(scene.chip, ended, None, 0, None)
    surveyed = replace(ended, route=replace(tick.route, method="survey"))
    assert not {"planner", "planned_s", "route_length_um"} & set(figures_of(scene.chip, surveyed, None, 0, None))


def test_a_map_that_comes_later_says_so_until_it_is_there(scene: Scene, ticks: list[Tick]) -> None:
    field = ticks[-1].assumed
    assert field is not None
    record = Record()
    logger = TickLogger(record, scene)  # type: ignore[arg-type]
    logger.log(Tick(0))
    assumed, refined = (f"/flow/{name}/not\\ yet" for name in ("assumed", "refined"))
    assert record.logged[assumed].labels.as_arrow_array().to_pylist() == ["not computed yet"]
    logger.log(Tick(1, assumed=field))
    assert isinstance(record.logged[assumed], rr.Clear)
    assert not isinstance(record.logged[refined], rr.Clear)


@pytest.mark.parametrize("bits", [8, 10, 12, 16])
def test_a_preview_of_a_deep_image_has_its_upper_8_bits(bits: int) -> None:
    levels = np.linspace(0, 2**bits - 1, 256).round().astype(np.uint8 if bits == 8 else np.uint16)
    image = np.repeat(levels[None], 64, axis=0)
    seen = cv2.imdecode(np.frombuffer(encode_jpeg(image, bits, 95), np.uint8), cv2.IMREAD_UNCHANGED)
    np.testing.assert_allclose(seen.astype(float), image >> (bits - 8), atol=2.0)


@pytest.mark.parametrize("table", ["speed", "uncertainty", "change", "time"])
def test_a_scale_reaches_to_all_but_a_hundredth_of_a_map_and_not_far_beyond(table: Any) -> None:
    rng = np.random.default_rng(11)
    for size in 10.0 ** np.arange(-3, 5):
        values = (
            size * np.abs(rng.normal(size=(40, 50))) * (rng.choice((-1.0, 1.0), (40, 50)) if table == "change" else 1)
        )
        values[0, :5], values[1] = 1e3 * size, np.nan  # corners, and solid
        scale = scale_of(values, table)
        known = np.abs(values[np.isfinite(values)])
        assert (known > scale.high).mean() < 0.01 and scale.low == (-scale.high if table == "change" else 0.0)
        assert scale.high < 1.7 * np.quantile(known, 0.995), "the colours are of what is there"


@pytest.mark.parametrize(
    ("message", "said"),
    [
        (Drops(1, "/camera/frame", 2, 0, 1), "2 lost"),
        (Drops(1, "/camera/frame", 0, 3, 1), "3 lost"),
        (Drops(1, "/camera/frame", 2, 3, 4), "5 lost, every 4. kept"),
        (Drops(1, "/camera/frame", 0, 0, 1), None),
        (CameraLosses(1, 967, 950, 2, 3, 5, 7, 0, 0), "17 lost before the loop"),
        (CameraLosses(1, 967, 967, 0, 0, 0, 0, 0, 0), None),
    ],
)
def test_the_lane_of_losses_counts_those_of_camera_and_disk(message: Any, said: str | None) -> None:
    told: list[Any] = []
    logger = StateLogger(SimpleNamespace(log=lambda *of, **_: told.append(of)), doubtful=False)  # type: ignore[arg-type]
    logger.log(message)
    assert logger._now == ({} if said is None else {LOSSES: said}) and bool(told) == (said is not None)


@pytest.mark.parametrize("scale", [ColourScale("speed", 0.0, 8.0, 2.0), ColourScale("change", -8.0, 8.0, 4.0)])
def test_the_colours_of_a_scale_go_from_its_low_end_to_its_high_end(scale: ColourScale) -> None:
    table = scale.paint(np.linspace(scale.low, scale.high, 256))
    assert len(np.unique(table, axis=0)) > 200
    middle = 0.5 * (scale.low + scale.high)
    found = scale.paint([scale.low - 9.0, scale.low, middle, scale.high, scale.high + 9.0, np.nan])
    np.testing.assert_allclose(found[:5].astype(int), table[[0, 0, 128, 255, 255]].astype(int), atol=2)
    assert tuple(found[5]) == colours.SOLID
