"""`flowrec import` of what `flowrec export` made: images, stamps, scale, chip and turns are those of the session."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import tifffile

import flowrec
from flowrec.commands.align import aligned
from flowrec.commands.import_movie import asked_import
from flowrec.errors import MovieError
from flowrec.movies import open_movie
from flowrec.rigs.movie.rig import fitted_to_movie

GOLDEN = Path(__file__).parents[2] / "sessions" / "golden.mcap"


@pytest.fixture(scope="module")
def exported(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("exported")
    names = {"mp4": "a.mp4", "mp4_plain": "b.mp4", "tiff": "c.ome.tif", "csv": "tables"}
    return {kind: flowrec.export(GOLDEN, folder / name, file_format=kind) for kind, name in names.items()}


def test_a_tiff_has_the_same_images_and_stamps_and_states_its_scale_as_ome(exported):
    frames = list(flowrec.open(GOLDEN).frames)
    with open_movie(exported["tiff"]) as movie:
        for frame, read in zip(frames, movie.frames(), strict=True):
            assert (read.image == frame.image).all() and read.time_ns == frame.stamp_ns
    with tifffile.TiffFile(exported["tiff"]) as file:
        pixels = tifffile.xml2dict(file.ome_metadata)["OME"]["Image"]["Pixels"]
    um_per_px = flowrec.open(GOLDEN).config.camera.um_per_px
    assert pixels["PhysicalSizeX"] == pytest.approx(um_per_px) and pixels["PhysicalSizeXUnit"] == "µm"
    assert [plane["DeltaT"] for plane in pixels["Plane"]] == pytest.approx([1e-9 * f.stamp_ns for f in frames])


def test_a_plain_movie_has_nearly_the_same_images_and_stamps_to_half_a_microsecond(exported):
    frames = list(flowrec.open(GOLDEN).frames)
    with open_movie(exported["mp4_plain"]) as movie:
        for frame, read in zip(frames, movie.frames(), strict=True):
            assert np.abs(read.image.astype(int) - frame.image).mean() < 1.0
            assert abs(read.time_ns - frame.stamp_ns) <= 500


@pytest.mark.parametrize("kind", ["mp4_plain", "tiff"])
def test_an_import_need_not_be_told_scale_robot_chip_and_clock(kind, exported):
    session = flowrec.open(GOLDEN)
    asked = asked_import(exported[kind], coils=exported["csv"] / "applied.csv")
    config, facts, _ = fitted_to_movie(aligned(asked)[0])
    assert config.camera.um_per_px == session.config.camera.um_per_px
    assert config.robot.radius_um == session.config.robot.radius_um
    assert (flowrec.chip.load_chip(config.chip).mask == session.chip.mask).all()
    assert facts["source_started"] == session.provenance["wall_time"]
    assert facts["source_session_key"] == session.key


def test_a_movie_with_drawings_is_refused_and_the_error_names_the_format_to_import(exported):
    with pytest.raises(MovieError, match=r"drawn over its images; import what flowrec export .*mp4_plain"):
        open_movie(exported["mp4"])
