"""`flowrec import` of what `flowrec export` made: images, stamps, scale, chip and turns are those of the session."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import tifffile

import flowrec
from flowrec.core import MovieError
from flowrec.movies import open_movie
from flowrec.rigs import MovieRig, fitted_to_movie
from flowrec.stages import Config, to_toml
from flowrec.verbs import prepare
from flowrec.verbs.align import asked_import, fit_import

GOLDEN = Path(__file__).parents[2] / "sessions" / "golden.mcap"


@pytest.fixture(scope="module")
def exported(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("exported")
    names = {"mp4": "a.mp4", "mp4_plain": "b.mp4", "tiff": "c.ome.tif", "csv": "tables"}

    class Exported(dict[str, Path]):
        """Each is made when a test first asks for it."""

        def __missing__(self, kind: str) -> Path:
            self[kind] = made = flowrec.export(GOLDEN, folder / names[kind], file_format=kind)
            return made

    return Exported()


@pytest.mark.slow("exports and reads a whole session")
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


@pytest.mark.slow("exports and reads a whole session")
def test_a_plain_movie_has_nearly_the_same_images_and_stamps_to_half_a_microsecond(exported):
    frames = list(flowrec.open(GOLDEN).frames)
    with open_movie(exported["mp4_plain"]) as movie:
        for frame, read in zip(frames, movie.frames(), strict=True):
            assert np.abs(read.image.astype(int) - frame.image).mean() < 1.0
            assert abs(read.time_ns - frame.stamp_ns) <= 500


@pytest.mark.slow("exports a whole session")
@pytest.mark.parametrize("kind", ["mp4_plain", "tiff"])
def test_an_import_need_not_be_told_scale_robot_chip_and_clock(kind, exported, tmp_path):
    session = flowrec.open(GOLDEN)
    asked = asked_import(exported[kind], coils=exported["csv"] / "applied.csv")
    config, facts, _ = fitted_to_movie(fit_import(asked, tmp_path).asked)
    assert config.camera.um_per_px == session.config.camera.um_per_px
    assert config.robot.radius_um == session.config.robot.radius_um
    assert (flowrec.physics.chip.io.load_chip(config.chip).mask == session.chip.mask).all()
    assert facts["source_started"] == session.provenance["wall_time"]
    assert facts["source_session_key"] == session.key


def test_a_movie_with_drawings_is_refused_and_the_error_names_the_format_to_import(exported):
    with pytest.raises(MovieError, match=r"flowrec export .*mp4_plain"):
        open_movie(exported["mp4"])


@pytest.fixture(scope="module")
def slow_robot(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Exports of the golden session as if robot, camera and latency were not the usual ones."""
    session, folder = flowrec.open(GOLDEN), tmp_path_factory.mktemp("slow_robot")
    config = session.config
    config = replace(
        config,
        robot=replace(config.robot, um_per_rev=30.0, delay_s=0.08),
        camera=replace(config.camera, angle_deg=12.0),
    )
    vars(session).update(config=config, header=replace(session.header, config_toml=to_toml(config)))
    plain = folder / "plain.tif"
    tifffile.imwrite(plain, np.array([frame.image for frame in session.frames]), metadata={"axes": "TYX"})
    names = {"tiff": "a.ome.tif", "csv": "tables"}
    made = {kind: flowrec.export(session, folder / name, file_format=kind) for kind, name in names.items()}
    return made | {"plain": plain, "log": made["csv"] / "applied.csv"}


@pytest.mark.parametrize("movie", ["tiff", "plain"])
def test_robot_and_pose_of_the_camera_come_from_the_movie_or_from_the_tables_and_what_is_given_stays(
    movie, slow_robot, tmp_path
):
    rate = {} if movie == "tiff" else {"fps": 15.0}
    asked = asked_import(slow_robot[movie], coils=slow_robot["log"], **rate)
    assert (asked.robot.um_per_rev, asked.robot.delay_s, asked.camera.angle_deg) == (30.0, 0.08, 12.0)
    assert (flowrec.physics.chip.io.load_chip(asked.chip).mask == flowrec.open(GOLDEN).chip.mask).all()
    usual = Config()
    given = replace(usual, robot=replace(usual.robot, um_per_rev=28.0), camera=replace(usual.camera, angle_deg=10.0))
    asked = asked_import(slow_robot[movie], given, coils=slow_robot["log"], **rate)
    assert (asked.robot.um_per_rev, asked.robot.delay_s, asked.camera.angle_deg) == (28.0, 0.08, 10.0)
    if movie == "plain":  # one that was cut is not the picture of which the tables speak
        cut = tmp_path / "cut.tif"
        tifffile.imwrite(cut, tifffile.imread(slow_robot["plain"])[:, :, 8:], metadata={"axes": "TYX"})
        asked = asked_import(cut, coils=slow_robot["log"], **rate)
        assert (asked.robot.um_per_rev, asked.camera) == (30.0, usual.camera)
    measured = replace(usual, camera=replace(usual.camera, registration="measured.toml"))
    assert asked_import(slow_robot[movie], measured, coils=slow_robot["log"], **rate).camera.angle_deg == 0.0


@pytest.mark.slow("exports and reads a whole session")
def test_what_the_robot_rolled_between_two_images_is_what_the_session_holds_whatever_the_latency(slow_robot, tmp_path):
    asked = fit_import(asked_import(slow_robot["tiff"], coils=slow_robot["log"]), tmp_path, "1").asked
    config, _, pipeline, *_ = prepare(asked, aloud=False)
    assert config.robot.delay_s == 0.08
    with MovieRig.of(pipeline, config) as rig:
        inputs = list(rig.inputs())
    session = flowrec.open(GOLDEN)
    assert [each.stamp_ns for each in inputs] == session.reader.frame_stamps
    turns = [each.turns for each in session.messages("applied")]
    np.testing.assert_allclose([each.applied.turns for each in inputs], turns, atol=1e-9)


@pytest.mark.slow("aligns a whole movie by its motion")
def test_the_log_of_another_session_is_not_taken_to_have_the_clock_of_the_movie(exported, tmp_path):
    other = Path(shutil.copytree(exported["csv"], tmp_path / "tables"))
    marker = other / "flowrec_export.json"
    marker.write_text(json.dumps(json.loads(marker.read_text()) | {"session_key": "another"}))
    own = asked_import(exported["tiff"], coils=exported["csv"] / "applied.csv")
    assert "alignment" not in fit_import(own, tmp_path).facts
    facts = fit_import(asked_import(exported["tiff"], coils=other / "applied.csv"), tmp_path).facts
    assert abs(json.loads(facts["alignment"])["offset_s"]) < 0.01
