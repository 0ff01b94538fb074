"""Images that leave flowrec and movies that come in: sizes, times and grey levels in the unit that the file states."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import tifffile
import zarr

import flowrec
from flowrec.core import Frame, SessionError
from flowrec.exports.camera_images import GreyScale, image_stamps
from flowrec.movies import open_movie
from flowrec.store import Session
from tests.movies import makers
from tests.outlets import primes as p


def test_a_tiff_states_its_pixel_size_in_its_own_tags_and_in_ome(session: Session, tmp_path: Path) -> None:
    path = flowrec.export(session, tmp_path / "a.ome.tif", file_format="tiff")
    with tifffile.TiffFile(path) as file:
        page = file.pages[0]
        pixels, centimetres = page.tags["XResolution"].value
        assert page.tags["ResolutionUnit"].value == 3  # centimetre
        assert page.tags["YResolution"].value == (pixels, centimetres)
        assert 1e4 * centimetres / pixels == pytest.approx(p.CAMERA_UM_PER_PX)
        stated = tifffile.xml2dict(file.ome_metadata)["OME"]["Image"]["Pixels"]
        assert (stated["PhysicalSizeX"], stated["PhysicalSizeXUnit"]) == (p.CAMERA_UM_PER_PX, "µm")
        assert (stated["PhysicalSizeY"], stated["PhysicalSizeYUnit"]) == (p.CAMERA_UM_PER_PX, "µm")
        assert (stated["SizeX"], stated["SizeY"], stated["SignificantBits"]) == (p.WIDTH_PX, p.HEIGHT_PX, p.BITS)
        assert [plane["DeltaT"] for plane in stated["Plane"][:2]] == pytest.approx([3.0, 3.1])
        assert stated["Plane"][0]["DeltaTUnit"] == "s"
        np.testing.assert_array_equal(file.asarray()[5], p.image(5))


def test_a_tiff_of_fewer_images_than_the_index_names_is_not_left(
    session: Session, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("flowrec.exports.tiff.image_stamps", lambda opened: [*image_stamps(opened), 10**12])
    with pytest.raises(SessionError, match=rf"{p.COUNT + 1} images, {p.COUNT} "):
        flowrec.export(session, tmp_path / "a.ome.tif", file_format="tiff")
    assert not list(tmp_path.glob("a*"))


def test_grey_levels_of_a_deep_movie_span_those_of_all_its_images(session: Session, tmp_path: Path) -> None:
    path = flowrec.export(session, tmp_path / "a.mp4", file_format="mp4_plain")
    with open_movie(path) as movie:
        notes = movie.facts.notes
        assert notes is not None
        first, last = movie.image(0), movie.image(p.COUNT - 1)
        assert movie.facts.um_per_px == p.CAMERA_UM_PER_PX
    assert p.DARK[0] <= notes.grey_low <= p.DARK[0] + 5  # of the dark image, which is the first
    assert p.BRIGHT[1] - 30 <= notes.grey_high <= p.BRIGHT[1] + p.COUNT  # of the bright ones
    per_level = 255.0 / (notes.grey_high - notes.grey_low)
    for made, number in ((first, 0), (last, p.COUNT - 1)):
        wanted = (p.image(number)[28].astype(float) - notes.grey_low) * per_level
        np.testing.assert_allclose(made[28], wanted.clip(0, 255), atol=4)


LENGTHS_UM = {"nm": 1e-3, "µm": 1.0, "mm": 1e3, "cm": 1e4, "m": 1e6}
TIMES_S = {"ns": 1e-9, "µs": 1e-6, "ms": 1e-3, "s": 1.0, "min": 60.0, "h": 3600.0}


@pytest.mark.parametrize("unit", LENGTHS_UM)
def test_a_pixel_size_is_taken_in_the_unit_that_the_file_states(unit: str, tmp_path: Path) -> None:
    metadata = {"axes": "TYX", "PhysicalSizeX": 7.0 / LENGTHS_UM[unit], "PhysicalSizeXUnit": unit}
    tifffile.imwrite(tmp_path / "a.ome.tif", np.ones((3, 8, 16), np.uint8), ome=True, metadata=metadata)
    with open_movie(tmp_path / "a.ome.tif") as movie:
        assert movie.facts.um_per_px == pytest.approx(7.0)


@pytest.mark.parametrize("unit", TIMES_S)
def test_times_are_taken_in_the_unit_that_the_file_states(unit: str, tmp_path: Path) -> None:
    times_s = np.array([0.0, 0.7, 1.3])
    planes = {"DeltaT": (times_s / TIMES_S[unit]).tolist(), "DeltaTUnit": [unit] * 3}
    images = np.ones((3, 8, 16), np.uint8)
    tifffile.imwrite(tmp_path / "a.ome.tif", images, ome=True, metadata={"axes": "TYX", "Plane": planes})
    with open_movie(tmp_path / "a.ome.tif") as movie:
        np.testing.assert_allclose(1e-9 * movie.facts.times_ns, times_s, atol=2e-9)


def test_the_other_letter_for_micro_counts_as_the_same(tmp_path: Path) -> None:
    from flowrec.movies.ome import seconds_per, um_per

    assert {seconds_per(unit) for unit in ("µs", "μs", "us", "microsecond")} == {1e-6}
    assert {um_per(unit) for unit in ("µm", "μm", "um", "micron", "micrometer")} == {1.0}


def test_an_ome_zarr_states_its_scale_in_micrometres_and_seconds(tmp_path: Path) -> None:
    path = makers.ome_zarr(tmp_path / "a.zarr", [np.ones((48, 64), np.uint8)] * 3, 0.07)
    with open_movie(path) as movie:
        assert movie.facts.um_per_px == 2.5
        np.testing.assert_allclose(np.diff(1e-9 * movie.facts.times_ns), 0.07)


def test_the_scale_of_grey_levels_is_that_of_what_was_recorded_where_the_rest_is_black() -> None:
    rng = np.random.default_rng(2)
    window = np.zeros((60, 80), np.uint16)
    window[20:40, 30:60] = rng.integers(900, 1301, (20, 30))
    frame = Frame(0, 0, window, 12)
    session = SimpleNamespace(
        run=SimpleNamespace(first_ns=0, last_ns=10**9), at=lambda _s: SimpleNamespace(frame=frame)
    )
    grey = GreyScale.of(session, frame)  # type: ignore[arg-type]
    assert 900 <= grey.low < 905 and 1295 < grey.high <= 1300
    assert grey(window)[0, 0] == 0 and np.ptp(grey(window)[20:40, 30:60]) == 255


def test_an_ome_zarr_whose_levels_are_scaled_together_has_the_product_of_both_scales_along_x(tmp_path: Path) -> None:
    path = makers.ome_zarr(tmp_path / "a.zarr", [np.ones((48, 64), np.uint8)] * 3, 0.07, axes="tyx")
    group = zarr.open_group(path, mode="r+")
    ome = dict(group.attrs["ome"])
    ome["multiscales"][0]["coordinateTransformations"] = [{"type": "scale", "scale": [10.0, 3.0, 2.0]}]
    group.attrs["ome"] = ome
    with open_movie(path) as movie:
        assert movie.facts.um_per_px == 5.0
        np.testing.assert_allclose(np.diff(1e-9 * movie.facts.times_ns), 0.7)
