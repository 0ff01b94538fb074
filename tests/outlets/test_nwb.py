"""NWB, read by pynwb: each series with its unit, its value and its place."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

import flowrec
from flowrec.session import Session
from tests.outlets import primes as p

LAST_UM = p.position_um(p.COUNT - 1)
SERIES = {  # unit and last value
    "field_frequency": ("hertz", p.FREQUENCY_HZ),
    "field_heading": ("radians", p.HEADING_RAD),
    "field_amplitude": ("tesla", 1e-3 * p.AMPLITUDE_MT),
    "coil_currents": ("amperes", p.CURRENTS_A),
    "centre": ("meters", 1e-6 * LAST_UM),
    "flow_at_robot": ("m/s", 1e-6 * p.FLOW_UM_S),
}


@pytest.fixture(scope="module")
def nwb(session: Session, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    import pynwb  # most of a second: not in each worker

    path = flowrec.export(session, tmp_path_factory.mktemp("nwb") / "a.nwb", file_format="nwb")
    with pynwb.NWBHDF5IO(str(path), "r") as io:
        yield io.read()


@pytest.mark.parametrize("name", SERIES)
def test_a_series_has_the_unit_and_the_values_of_its_messages(name: str, nwb: Any) -> None:
    behavior = nwb.processing["behavior"]
    series = (
        nwb.stimulus[name]
        if name in nwb.stimulus
        else behavior["PoseEstimation"][name]
        if name == "centre"
        else behavior[name]
    )
    unit, value = SERIES[name]
    assert series.unit == unit
    np.testing.assert_allclose(series.data[-1], value)
    np.testing.assert_allclose(series.timestamps[:], 3.0 + 0.1 * np.arange(p.COUNT))
    assert series.conversion == 1.0


def test_images_state_their_pixels_per_centimetre(nwb: Any) -> None:
    shown = nwb.acquisition["camera_images"].images["image_00005"]
    assert 1e4 / shown.resolution == pytest.approx(p.CAMERA_UM_PER_PX)
    np.testing.assert_array_equal(shown.data[:], p.image(5))


def test_a_flow_has_x_to_the_right_and_y_downwards(nwb: Any) -> None:
    table = nwb.analysis["refined_flow"].to_dataframe()
    assert (table["x_um"].max(), table["y_um"].max()) == (60 * p.UM_PER_PX, p.LAST_ROW * p.UM_PER_PX)
    here = table[(table["x_um"] == 51 * p.UM_PER_PX) & (table["y_um"] == 9 * p.UM_PER_PX)]
    wanted = {
        "velocity_x_um_s": p.REFINED_UM_S[0] + 2.1,
        "velocity_y_um_s": p.REFINED_UM_S[1] - 1.5,
        "std_x_um_s": 10.0 * p.STD_UM_S[0],
        "std_y_um_s": 10.0 * p.STD_UM_S[1],
    }
    for column, value in wanted.items():
        assert here[column].item() == pytest.approx(value), column
        assert nwb.analysis["refined_flow"][column].description.endswith("um/s")
