"""Tables that leave flowrec: the value, the unit and the axis of each quantity, read back by other programs."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.csv
import pyarrow.parquet
import pytest

import flowrec
from flowrec.core import UsageError
from flowrec.store import Session
from tests.outlets import primes as p

# By table: the columns, each with its unit and its value in the last row; {} stands for x, y and z, a column each.
TOPICS = {
    "estimate": {
        "stamp_ns": ("ns", p.FIRST_NS + 23 * p.STEP_NS),
        "time_s": ("s", 5.3),
        "position_{}_um": ("um", p.position_um(23)),
        "flow_{}_um_s": ("um/s", p.FLOW_UM_S),
        "covariance": (None, np.diag([1.21, 1.44, 2.25, 2.89])),
        "nis": (None, p.NIS),
    },
    "currents": {
        "frequency_hz": ("Hz", p.FREQUENCY_HZ),
        "heading_rad": ("rad", p.HEADING_RAD),
        "amplitude_mt": ("mT", p.AMPLITUDE_MT),
        "currents_{}_a": ("A", p.CURRENTS_A),
    },
    "applied": {
        "frequency_hz": ("Hz", p.APPLIED_HZ),
        "heading_rad": ("rad", p.APPLIED_RAD),
        "amplitude_mt": ("mT", p.APPLIED_MT),
        "currents_{}_a": ("A", p.APPLIED_A),
        "turns_{}": (None, p.TURNS),
    },
    "demand": {"velocity_{}_um_s": ("um/s", p.DEMAND_UM_S), "error_um": ("um", p.ERROR_UM), "progress_s": ("s", 2.3)},
    "track": {"position_{}_um": ("um", p.position_um(23)), "radius_px": ("px", 2.71), "score": (None, 0.83)},
    "truth": {"flow_{}_um_s": ("um/s", np.array(p.TRUE_UM_S)), "clearance_um": ("um", p.CLEARANCE_UM)},
    "timing": {"total_ms": ("ms", 4.7), "track_ms": ("ms", 1.1), "queue_mb": ("MB", 5.9)},
    "losses": {"ids": (None, 967), "frames": (None, 950), "link": (None, 2), "backlog": (None, 7)},
    "health": {"nis": (None, p.HEALTH_NIS), "mean_{}_um_s": ("um/s", p.FLOW_UM_S)},
    "route": {"waypoints_um": ("um", p.WAY_UM), "arrival_s": ("s", [0.0, 4.3, 8.9])},
    "observations": {"position_um": ("um", p.OBSERVED.position_um), "std_um_s": ("um/s", p.OBSERVED.std_um_s)},
}
FIELDS = {
    "field_assumed": (p.ASSUMED_UM_S, None),
    "field_refined": (p.REFINED_UM_S, p.STD_UM_S),
    "field_true": (p.TRUE_UM_S, None),
}
OBSERVED_UNITS = {"x_um": "um", "y_um": "um", "u_um_s": "um/s", "v_um_s": "um/s", "std_um_s": "um/s", "time_s": "s"}


@pytest.fixture(scope="module")
def exported(session: Session, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("tables")
    return {
        kind: flowrec.export(session, folder / name, file_format=kind)
        for kind, name in {"parquet": "parquet", "csv": "csv", "zarr": "a.zarr"}.items()
    }


def columns_of(name: str) -> dict[str, tuple[str | None, object]]:
    """TOPICS with a column each."""
    found: dict[str, tuple[str | None, object]] = {}
    for column, (unit, value) in TOPICS[name].items():
        parts = zip("xyz", np.atleast_1d(value), strict=False) if "{}" in column else [("", value)]
        found |= {column.format(letter): (unit, part) for letter, part in parts}
    return found


def cells(found: object) -> np.ndarray:
    return np.array(json.loads(found) if isinstance(found, str) else found, np.float64)


@pytest.mark.parametrize("name", TOPICS)
def test_a_table_of_a_topic_has_the_values_and_units_of_its_messages(name: str, exported: dict[str, Path]) -> None:
    table = pyarrow.parquet.read_table(exported["parquet"] / f"{name}.parquet")
    text = pyarrow.csv.read_csv(exported["csv"] / f"{name}.csv")
    for kind in ("parquet", "csv"):
        package = json.loads((exported[kind] / "datapackage.json").read_text())
        stated = next(each for each in package["resources"] if each["path"] == f"{name}.{kind}")
        units = {each["name"]: each.get("unit") for each in stated["schema"]["fields"]}
        for column, (unit, _) in columns_of(name).items():
            assert units[column] == unit, (kind, column)
        types = {each["name"]: each["type"] for each in stated["schema"]["fields"]}
        assert (types["stamp_ns"], types.get("seen", "boolean")) == ("integer", "boolean")
    for column, (unit, value) in columns_of(name).items():
        about = table.schema.field(column).metadata or {}
        assert about.get(b"unit", b"").decode() == (unit or ""), column
        for each in (table, text):
            np.testing.assert_allclose(cells(each.column(column)[-1].as_py()), value, rtol=1e-6, err_msg=column)


def at(row: int, column: int, middle: tuple[float, float]) -> list[float]:
    """The velocity of primes.field at a pixel."""
    return [middle[0] + 0.1 * (column - 30), middle[1] + 0.3 * (row - 14)]


def places(x_um: np.ndarray, y_um: np.ndarray) -> None:
    """A row for each pixel of fluid: those of the whole width, and of the channel's rows."""
    assert len(x_um) == p.COLUMNS * (p.LAST_ROW - p.FIRST_ROW + 1)
    assert (x_um.min(), x_um.max()) == (0.0, 60 * p.UM_PER_PX)
    assert (y_um.min(), y_um.max()) == (p.FIRST_ROW * p.UM_PER_PX, p.LAST_ROW * p.UM_PER_PX)


@pytest.mark.parametrize("name", FIELDS)
@pytest.mark.parametrize("kind", ["csv", "parquet", "pandas"])
def test_a_table_of_a_flow_has_the_velocity_of_each_place(
    kind: str, name: str, session: Session, exported: dict[str, Path]
) -> None:
    if kind == "csv":
        table = pyarrow.csv.read_csv(exported["csv"] / f"{name}.csv").to_pandas()
    elif kind == "parquet":
        table = pyarrow.parquet.read_table(exported["parquet"] / f"{name}.parquet").to_pandas()
    else:
        table = session.fields[name.removeprefix("field_")].to_pandas()
    velocity, std = FIELDS[name]
    places(table["x_um"], table["y_um"])
    for row, column in ((6, 0), (14, 30), (22, 60), (9, 51)):
        here = table[(table["x_um"] == column * p.UM_PER_PX) & (table["y_um"] == row * p.UM_PER_PX)]
        (found,) = here[["u_um_s", "v_um_s"]].to_numpy()
        np.testing.assert_allclose(found, at(row, column, velocity), rtol=1e-6)
        assert here["pressure_pa"].item() == pytest.approx(7.0 * column + 0.5 * row)
        if std is not None:
            (spread,) = here[["std_u_um_s", "std_v_um_s"]].to_numpy()
            np.testing.assert_allclose(spread, np.array(std) * (1.0 if column < p.KNOWN_COLUMNS else 10.0))


def test_the_observed_flow_has_a_row_for_each_observation_and_is_read_back_as_it_was(exported: dict[str, Path]) -> None:
    for kind, table in (
        ("csv", pyarrow.csv.read_csv(exported["csv"] / "observed_flow.csv")),
        ("parquet", pyarrow.parquet.read_table(exported["parquet"] / "observed_flow.parquet")),
    ):
        found, seen = table.to_pandas(), p.OBSERVED
        np.testing.assert_allclose(found[["x_um", "y_um"]], seen.position_um, err_msg=kind)
        np.testing.assert_allclose(found[["u_um_s", "v_um_s"]], seen.flow_um_s)
        np.testing.assert_allclose(found["std_um_s"], seen.std_um_s)
        np.testing.assert_allclose(found[["own_u_um_s", "own_v_um_s"]], seen.rolled_um_s)
        np.testing.assert_allclose(found["time_s"], seen.time_s)
        if kind == "parquet":
            for name, unit in OBSERVED_UNITS.items():
                assert table.schema.field(name).metadata[b"unit"].decode() == unit


def test_a_persons_table_without_deviations_counts_each_at_a_twentieth_of_the_usual_speed() -> None:
    from flowrec.store import observations_of

    table = {"x_um": [1.0, 2.0], "y_um": [3.0, 4.0], "u_um_s": [30.0, 0.0], "v_um_s": [40.0, 50.0]}  # 50 um/s each
    np.testing.assert_allclose(observations_of(table).std_um_s, 2.5)


@pytest.mark.parametrize(("fastest_um_s", "counts"), [(990.0, True), (1010.0, False)])
def test_a_row_a_hundred_times_as_fast_as_most_says_nothing_of_the_deviation_of_the_others(
    fastest_um_s: float, counts: bool
) -> None:
    from flowrec.store import observations_of

    speeds = np.array([*[10.0] * 18, 0.0, fastest_um_s])  # most of the moving ones: 10 um/s
    places = np.arange(20.0)
    usual = np.sqrt((speeds[: 20 if counts else 19] ** 2).mean())
    made = observations_of({"x_um": places, "y_um": places, "u_um_s": -0.6 * speeds, "v_um_s": 0.8 * speeds})
    np.testing.assert_allclose(made.std_um_s, 0.05 * usual)


def test_zarr_has_images_and_fields_with_axes_in_um(session: Session, exported: dict[str, Path]) -> None:
    import xarray

    with xarray.open_zarr(exported["zarr"]) as images:
        frames = images["frames"]
        assert frames.dims == ("time", "y_px", "x_px")
        assert frames.shape == (p.COUNT, p.HEIGHT_PX, p.WIDTH_PX)
        np.testing.assert_array_equal(frames[3], p.image(3))
        np.testing.assert_allclose(images["time_s"], 3.0 + 0.1 * np.arange(p.COUNT))
        assert images["time_s"].attrs["units"] == "s"
        row, column = 9, 51
        here = images.sel(y_px=row, x_px=column)
        chip_um = session.calibration.to_um((column, row))
        np.testing.assert_allclose((here["x_um"], here["y_um"]), chip_um, rtol=1e-6)
        assert images["x_um"].attrs["units"] == images["y_um"].attrs["units"] == "um"
        assert frames.attrs["bits"] == p.BITS
    with xarray.open_zarr(exported["zarr"], group="refined") as flow:
        check_dataset(flow)


def test_an_xarray_dataset_has_named_axes_and_units(session: Session) -> None:
    check_dataset(session.fields["refined"].to_xarray())


def test_all_fields_are_one_dataset_that_is_selected_by_name_and_place_and_can_be_subtracted(session: Session) -> None:
    fields = session.fields
    data = fields.to_xarray()
    assert data["field"].values.tolist() == list(fields)
    assert data["method"].values.tolist() == [field.method for field in fields.values()]
    assert data["time_s"].values.tolist() == [field.stamp_ns / 1e9 for field in fields.values()]
    row, column = 9, 51
    near_um = {"x_um": (column + 0.4) * p.UM_PER_PX, "y_um": (row - 0.4) * p.UM_PER_PX}
    here = data.sel(field="refined").sel(near_um, method="nearest")
    np.testing.assert_allclose(here["velocity_um_s"], at(row, column, p.REFINED_UM_S), rtol=1e-6)
    change = data.sel(field="refined") - data.sel(field="assumed")
    wanted = fields["refined"].velocity_um_s - fields["assumed"].velocity_um_s
    np.testing.assert_array_equal(change["velocity_um_s"], wanted)
    assert bool(np.isnan(data["std_um_s"].sel(field="assumed")).all()) == (fields["assumed"].std_um_s is None)
    with pytest.raises(UsageError, match="flow field"):
        type(fields)().to_xarray()


def check_dataset(flow: Any) -> None:
    row, column = 9, 51
    here = flow.sel(x_um=column * p.UM_PER_PX, y_um=row * p.UM_PER_PX)
    np.testing.assert_allclose(here["velocity_um_s"], at(row, column, p.REFINED_UM_S), rtol=1e-6)
    np.testing.assert_allclose(here["std_um_s"], 10.0 * np.array(p.STD_UM_S))
    assert float(here["pressure_pa"]) == pytest.approx(7.0 * column + 0.5 * row)
    assert flow["velocity_um_s"].attrs["units"] == "um/s"
    assert flow["pressure_pa"].attrs["units"] == "Pa"
    assert flow["x_um"].attrs["units"] == flow["y_um"].attrs["units"] == "um"
    assert flow["velocity_um_s"].dims[:2] == ("y_um", "x_um")
    assert list(flow["component"].values) == ["x", "y"]
    assert (flow["velocity_um_s"].attrs["long_name"], flow["x_um"].attrs["long_name"]) == ("flow velocity", "x")
    assert bool(here["fluid"]) and not bool(flow["fluid"].values[0, 0])
