"""Figures of a report and of a field, read from Matplotlib's artists: values, units, labels, axes, scale bars."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from dataclasses import fields
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest
from matplotlib.colors import to_hex
from matplotlib.figure import Figure

from flowrec.core import NS_PER_S, Clocks, Tick
from flowrec.exports import MapFigure, MotionFigure, PathFigure, PathFlowFigure, ReportData, style
from flowrec.exports.report.history import History
from flowrec.exports.report.map_figure import _panels
from flowrec.exports.report.path_figure import scale_bar
from flowrec.exports.report.report_data import picture_of
from flowrec.store import Session
from tests.outlets import primes as p

WIDE_MM = 180.0
FLUID = p.mask()
PANELS = {"assumed": p.ASSUMED_UM_S, "refined": p.REFINED_UM_S, "true": p.TRUE_UM_S}  # in the middle


@pytest.fixture(scope="module")
def data(session: Session) -> ReportData:
    return ReportData.of(session)


@pytest.fixture(autouse=True)
def closed() -> Iterator[None]:
    yield
    from matplotlib import pyplot

    pyplot.close("all")


def lines_of(figure: Figure) -> dict[str, tuple[np.ndarray, np.ndarray, str]]:
    """The curves of a figure by their labels: x, y, and the label of the y axis."""
    return {
        str(line.get_label()): (np.asarray(line.get_xdata()), np.asarray(line.get_ydata()), ax.get_ylabel())
        for ax in figure.axes
        for line in ax.lines
    }


CURVES = {
    "robot over ground": (p.SPEED_UM_S, "speed (µm/s)"),
    "demanded through fluid": (p.DEMAND_SPEED_UM_S, "speed (µm/s)"),
    "flow at the robot": (p.FLOW_SPEED_UM_S, "speed (µm/s)"),
    "distance to the route": (p.ERROR_UM, "distance (µm)"),
    "error of the estimate": (5.0, "distance (µm)"),
}


@pytest.mark.parametrize(("width", "step"), [(899, 1), (900, 1), (901, 2), (1800, 2), (1801, 3)])
def test_the_picture_is_thinned_by_the_least_step_that_makes_it_900_pixels_wide(width: int, step: int) -> None:
    image = np.full((4, width), 7, np.uint8)
    image[:, ::2] = 200
    frame = SimpleNamespace(image=image, index=0)
    reader = SimpleNamespace(counts={"frame": 1}, tick_before=lambda _stamp_ns: SimpleNamespace(frame=frame))
    picture = picture_of(cast(Session, SimpleNamespace(reader=reader, run=SimpleNamespace(first_ns=0, last_ns=1))))
    assert picture is not None and picture.step == step
    assert picture.image.shape[1] == -(-width // step) <= 900


@pytest.mark.slow("records a mission with a known motion")
def test_the_curves_of_motion_are_what_their_labels_say(data: ReportData) -> None:
    figure = MotionFigure().draw(data, WIDE_MM)
    found = lines_of(figure)
    assert found.keys() >= CURVES.keys()
    for label, (value, axis) in CURVES.items():
        time_s, values, shown_axis = found[label]
        np.testing.assert_allclose(values, value, rtol=1e-6, err_msg=label)
        assert shown_axis == axis
        assert 3.0 <= time_s.min() < time_s.max() <= 5.3
    assert figure.axes[-1].get_xlabel() == "session time (s)"


HISTORY = {
    "speed_um_s": p.SPEED_UM_S,
    "demand_um_s": p.DEMAND_SPEED_UM_S,
    "error_um": p.ERROR_UM,
    "estimate_error_um": 5.0,
    "flow_x_um_s": p.FLOW_UM_S[0],
    "flow_y_um_s": p.FLOW_UM_S[1],
    "flow_std_um_s": math.sqrt((2.25 + 2.89) / 2.0),
    "true_x_um_s": p.TRUE_UM_S[0],
    "true_y_um_s": p.TRUE_UM_S[1],
    "nis": p.HEALTH_NIS,
    "tick_ms": 4.7,
    "queue_mb": 5.9,
    "dropped": 0.0,
    "lost": 2.0 + 3.0 + 5.0 + 7.0,  # by link, as incomplete, by the driver, by the queue
}


def test_a_curve_of_the_history_has_the_values_of_the_messages_by_which_it_is_called(data: ReportData) -> None:
    for name, value in HISTORY.items():
        np.testing.assert_allclose(data.history.curve(name).known, value, rtol=1e-6, err_msg=name)
    for name, axis in (("x_um", 0), ("y_um", 1)):
        curve = data.history.curve(name)
        way = p.START_UM[axis] + p.VELOCITY_UM_S[axis] * (curve.time_s - 3.0)
        np.testing.assert_allclose(curve.mean, way, rtol=1e-6, err_msg=name)


def test_the_curves_of_the_delay_of_images_are_its_mean_and_its_largest_in_ms() -> None:
    history = History(0, NS_PER_S)
    for number in range(1, 5):
        stamp_ns = number * NS_PER_S // 5
        told = dict.fromkeys((each.name for each in fields(Clocks)), 0)
        told |= {"stamp_ns": stamp_ns, "rate": 1.0, "late_s": 0.003, "latest_s": 0.011}
        history.add(Tick(stamp_ns, clocks=Clocks(**told)))
    for name, value_ms in (("late_ms", 3.0), ("latest_ms", 11.0)):
        np.testing.assert_allclose(history.curve(name).known, value_ms, err_msg=name)


def test_the_flow_at_the_places_of_the_robot_is_that_of_each_map(data: ReportData) -> None:
    found = lines_of(PathFlowFigure().draw(data, WIDE_MM))
    place_px = p.position_um(10) / p.UM_PER_PX
    for label, middle in (("assumed", p.ASSUMED_UM_S), ("refined", p.REFINED_UM_S)):
        _, values, axis = found[label]
        wanted = np.hypot(middle[0] + 0.1 * (place_px[0] - 30), middle[1] + 0.3 * (place_px[1] - 14))
        assert values[10] == pytest.approx(wanted, rel=0.02)
        assert "µm/s" in axis
    np.testing.assert_allclose(found["true (simulated)"][1], p.TRUE_SPEED_UM_S)


def test_the_maps_have_the_speed_of_each_pixel_in_um_per_second(data: ReportData) -> None:
    figure = MapFigure().draw(data, WIDE_MM)
    maps = {ax.get_title().partition(" (")[0]: ax for ax in figure.axes if ax.get_title()}
    assert {ax.get_title() for ax in maps.values()} == {f"{name} (µm/s)" for name in maps}
    flows = {f"{name.capitalize()} flow": middle for name, middle in PANELS.items()}
    change, wrong, uncertain = "Refined - assumed", "Refined - true", "Uncertainty, 1 σ"
    assert set(maps) == {*flows, change, wrong, uncertain}
    crop = (slice(p.FIRST_ROW - 3, p.LAST_ROW + 4), slice(None))
    row, column = np.mgrid[: p.ROWS, : p.COLUMNS][:, *crop]
    fluid = FLUID[crop]

    def speed(middle: tuple[float, float]) -> np.ndarray:
        return np.hypot(middle[0] + 0.1 * (column - 30), middle[1] + 0.3 * (row - 14))

    wanted = {name: speed(middle) for name, middle in flows.items()}
    wanted[change] = speed(p.REFINED_UM_S) - speed(p.ASSUMED_UM_S)  # refined is faster: positive
    wanted[wrong] = wanted["Refined flow"] - wanted["True flow"]
    wanted[uncertain] = np.where(column < p.KNOWN_COLUMNS, 1.0, 10.0) * p.STD_LENGTH_UM_S
    for name, values in wanted.items():
        (shown,) = maps[name].images
        np.testing.assert_allclose(shown.get_array().filled(np.nan)[fluid], values[fluid], rtol=1e-5, err_msg=name)
        assert np.isnan(shown.get_array().filled(np.nan)[~fluid]).all()
    (low, high) = maps[change].images[0].get_clim()
    assert low == -high < 0.0


def test_the_one_scale_of_all_maps_of_speed_reaches_to_the_fastest_of_them(data: ReportData) -> None:
    fastest = max(
        float(np.hypot(*field.velocity_um_s.T).max()) for field in (data.assumed, data.refined, data.truth) if field
    )
    assert fastest > p.TRUE_SPEED_UM_S and fastest <= data.speed_scale().high < 1.7 * fastest


def test_the_part_of_the_map_that_is_not_known_is_hatched_and_no_other(data: ReportData) -> None:
    (deviation,) = (panel for panel in _panels(data) if panel.title.startswith("uncertainty"))
    column = np.mgrid[: p.ROWS, : p.COLUMNS][1]
    np.testing.assert_array_equal(deviation.hatched, FLUID & (column >= p.KNOWN_COLUMNS))
    share = (p.COLUMNS - p.KNOWN_COLUMNS) / p.COLUMNS
    assert f"({share:.0%} of the fluid)" in MapFigure().caption(data)


UNITS_UM = {"µm": 1.0, "mm": 1e3}


@pytest.mark.parametrize("um_per_unit", [0.7, 2.5, 7.0, 13.0, 90.0])
def test_a_scale_bar_is_as_long_as_it_says(um_per_unit: float) -> None:
    from matplotlib import pyplot

    figure, ax = pyplot.subplots()
    ax.set_xlim(11.0, 611.0)
    scale_bar(ax, 1e3 / um_per_unit)
    check_bar(ax, um_per_unit)


def check_bar(ax: object, um_per_unit: float) -> None:
    (bar,) = (line for line in ax.lines if np.asarray(line.get_ydata()).tolist() == [0.0, 0.0])  # type: ignore[attr-defined]
    (text,) = (each.get_text() for each in ax.texts if re.fullmatch(r"[\d.]+ (µm|mm)", each.get_text()))  # type: ignore[attr-defined]
    number, unit = text.split()
    left, right = ax.get_xlim()  # type: ignore[attr-defined]
    shown_um = float(np.ptp(bar.get_xdata())) * abs(right - left) * um_per_unit  # its x are shares of the axis
    assert float(number) * UNITS_UM[unit] == pytest.approx(shown_um)


def test_path_route_and_goal_lie_where_the_camera_sees_them(data: ReportData) -> None:
    figure = PathFigure().draw(data, WIDE_MM)
    ax = figure.axes[0]
    check_bar(ax, p.CAMERA_UM_PER_PX)
    bottom, top = ax.get_ylim()
    assert bottom > top  # y down, as in the image
    drawn = [line for line in ax.lines if line.get_transform() == ax.transData]  # not the scale bar
    paths = {to_hex(line.get_color()): np.column_stack(line.get_data()) for line in drawn}
    plane = data.scene.to_plane
    np.testing.assert_allclose(paths[to_hex(style.VERMILLION)][[0, -1]], plane([p.START_UM, p.position_um(23)]))
    np.testing.assert_allclose(paths[to_hex(style.INK)].max(axis=0), plane(p.WAY_UM).max(axis=0))
    names = {text.get_text(): text.xy for text in ax.texts if hasattr(text, "xy") and text.get_text()}
    assert names["goal"][0] == pytest.approx(plane(p.GOAL_UM)[0])
    assert figure.axes[1].get_ylabel() == "speed of the flow (µm/s)"


def test_a_field_is_plotted_in_um_with_y_down(session: Session) -> None:
    refined = session.fields["refined"]
    ax = refined.plot(path_um=p.WAY_UM)
    left, right, bottom, top = ax.images[0].get_extent()
    assert (left, right) == (-0.5 * p.UM_PER_PX, 60.5 * p.UM_PER_PX)
    assert (bottom, top) == (28.5 * p.UM_PER_PX, -0.5 * p.UM_PER_PX)
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("x (um)", "y (um)")
    assert ax.images[0].get_array()[14, 30] == pytest.approx(p.REFINED_SPEED_UM_S)
    np.testing.assert_array_equal(np.column_stack(ax.lines[-1].get_data()), p.WAY_UM)
    assert ax.images[0].colorbar.ax.get_ylabel() == "speed (um/s)"
    arrows = next(each for each in ax.collections if hasattr(each, "U"))
    middle = np.argmin(np.hypot(arrows.X - 30 * p.UM_PER_PX, arrows.Y - 14 * p.UM_PER_PX))
    at = arrows.X[middle] / p.UM_PER_PX, arrows.Y[middle] / p.UM_PER_PX
    assert arrows.U[middle] == pytest.approx(p.REFINED_UM_S[0] + 0.1 * (at[0] - 30), rel=1e-5)
    assert arrows.V[middle] == pytest.approx(p.REFINED_UM_S[1] + 0.3 * (at[1] - 14), rel=1e-5)
    error = refined.plot(show="error")
    assert error.images[0].get_array()[14, 30] == pytest.approx(p.STD_LENGTH_UM_S)
    assert error.images[0].colorbar.ax.get_ylabel() == "one standard deviation (um/s)"
