"""From one picture to the settings of a run: the file of a registration, its overlay, its place in a session."""

from __future__ import annotations

import json
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest

import flowrec
from flowrec.core import UsageError
from flowrec.measure import registration_state, write_picture
from flowrec.measure.calibrate_image import fragment, settings_of, walls_state
from flowrec.measure.images import read_picture
from flowrec.physics import Calibration, ChipSettings, load_chip
from flowrec.stages import CameraSettings, load_config, with_sets
from flowrec.stages.config import registration_of
from flowrec.verbs.record import record
from tests.conftest import invoke
from tests.short_missions import SMALL, set_words

POSE = ("angle_deg=182", "mirror=true", "centre_um=[3340,2350]", "um_per_px=20.4")
TRUE = [f"simulated.{each}" for each in POSE]
CHIP = ["chip.name=bifurcation"]


@pytest.fixture(scope="module")
def registration(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Of a picture by a camera that is turned, mirrored, shifted and of another scale than a person would say."""
    folder = tmp_path_factory.mktemp("registration")
    sets = [*CHIP, *TRUE, *SMALL, "camera.um_per_px=20", "duration_s=0.1"]
    picture = next(iter(flowrec.open(record(load_config(None, sets), folder / "short.mcap").path).frames)).image
    cv2.imwrite(str(folder / "picture.png"), picture)
    words = ["calibrate", "image", str(folder / "picture.png"), "-o", str(folder / "registration.toml"), "--mirror"]
    done = invoke(*words, *set_words((*CHIP, "camera.um_per_px=20")))
    assert done.exit_code == 0, done.output
    return folder / "registration.toml"


@pytest.mark.slow("flies two missions")
def test_a_mission_with_the_registration_refines_as_with_the_exact_pose(registration, tmp_path):
    config = load_config(
        None, [*CHIP, *TRUE, *SMALL, f"camera.registration={registration}", "mission.phases=survey,refine"]
    )
    camera = config.camera
    assert camera.mirror and abs(camera.angle_deg % 360.0 - 182.0) < 0.1 and abs(camera.um_per_px / 20.4 - 1.0) < 0.003
    assert np.hypot(camera.centre_um[0] - 3340.0, camera.centre_um[1] - 2350.0) < 5.0
    recorded = record(config, tmp_path / "turned.mcap")
    sets = [*CHIP, *SMALL, *(f"camera.{each}" for each in POSE), "mission.phases=survey,refine"]
    exact = record(load_config(None, sets), tmp_path / "exact.mcap")
    assert abs(recorded.facts["refined_flow_error"] - exact.facts["refined_flow_error"]) < 0.005
    assert recorded.facts["refined_flow_error"] < 0.02
    session = flowrec.open(recorded.path)
    assert session.config.camera.registered_on == camera.registered_on != ""
    assert 0.0 < session.config.camera.residual_um == camera.residual_um < 10.0
    assert session.header.pictures == {"registration.png": registration.with_suffix(".png").read_bytes()}
    off = [tick.track.position_um - tick.truth.position_um for tick in session.ticks() if tick.track.seen]
    assert np.sqrt(np.mean(np.square(off))) < 6.0


@pytest.mark.slow("flies a mission for its image")
def test_a_registration_goes_before_the_section_and_after_what_is_typed(registration, tmp_path):
    path = tmp_path / "own.toml"
    path.write_text(f"[camera]\num_per_px = 33.0\nregistration = {json.dumps(str(registration))}\n")
    assert load_config(path).camera.um_per_px < 21.0
    assert load_config(path, ["camera.um_per_px=30"]).camera.um_per_px == 30.0
    assert with_sets(load_config(), [f"camera.registration={registration}"]).camera.mirror
    with pytest.raises(UsageError, match="320 x 256"):
        load_config(path, ["camera.width_px=640"])
    path.write_text("[camera]\num_per_px = 1\n")
    with pytest.raises(UsageError, match="is no registration"):
        load_config(None, [f"camera.registration={path}"])


def test_the_state_of_a_registration_is_told():
    camera = CameraSettings(
        um_per_px=10.0, registered_on="2026-01-10T08:00:00Z", registered_from="a.png", residual_um=1.5
    )
    now = datetime(2026, 1, 12, 8, tzinfo=UTC)
    assert registration_state(camera, now) == (True, "registered 2 days ago from a.png, residual 1.5 um")
    assert registration_state(replace(camera, registered_on="2025-12-14"), now)[0]  # 29 days
    for worse in (
        {"registered_on": ""},
        {"registered_on": "soon"},
        {"residual_um": 15.0},
        {"registered_on": "2025-12-12"},  # 31 days
    ):
        good, text = registration_state(replace(camera, **worse), now)
        assert not good and "flowrec calibrate image" in text, worse


def test_the_standard_errors_of_a_registration_are_in_the_units_that_stand_beside_them():
    pose = Calibration(10.0, (500.0, 400.0), 0.0, mirror=False)
    fit: Any = SimpleNamespace(
        std=np.array([0.3, 0.7, 0.05, 0.0025]), found=0.9, seen=0.8, calibration=pose, residual_um=2
    )
    picture = SimpleNamespace(image=np.zeros((64, 80), np.uint8), source="a.png", sha256="0" * 64)
    done: Any = SimpleNamespace(picture=picture, chip=SimpleNamespace(name="c"), registered_on="2026-01-10")
    text = fragment(done, fit)
    assert "# Standard errors: 0.7 um, 0.05 degrees, 0.25 %.\n" in text
    assert "90 % of the walls in the picture agree, 80 % of the chip's walls" in text


@pytest.mark.parametrize("mirror", [False, True])
@pytest.mark.parametrize("angle_deg", [0.0, 37.0, 200.0, -90.0])
@pytest.mark.parametrize("size_px", [(80, 64), (81, 65)])
def test_the_settings_of_a_pose_put_each_pixel_where_the_pose_has_it(size_px, angle_deg, mirror):
    pose = Calibration(10.2, (512.3, 431.7), angle_deg, mirror=mirror)
    fit: Any = SimpleNamespace(calibration=pose, residual_um=2.0)
    picture = SimpleNamespace(image=np.zeros(size_px[::-1], np.uint8), source="a.png", sha256="0" * 64)
    sets = settings_of(SimpleNamespace(picture=picture, registered_on="2026-01-10"), fit)  # type: ignore[arg-type]
    camera = SimpleNamespace(size_px=(sets["width_px"], sets["height_px"]), **sets)
    again = registration_of(camera, SimpleNamespace(size_um=(1000.0, 800.0), um_per_px=20.0))  # type: ignore[arg-type]
    places_px = np.array([[0.0, 0.0], [79.0, 0.0], [0.0, 63.0], [31.5, 20.25]])
    np.testing.assert_allclose(again.to_um(places_px), pose.to_um(places_px), atol=0.01)
    assert -180.0 <= sets["angle_deg"] < 180.0


@pytest.mark.slow("searches a picture twice, for every angle and mirrored")
def test_several_poses_are_listed_and_nothing_is_written(tmp_path):
    config = load_config(None, [*SMALL, "duration_s=0.1"])
    picture = next(iter(flowrec.open(record(config, tmp_path / "short.mcap").path).frames)).image
    cv2.imwrite(str(tmp_path / "picture.png"), picture)
    words = ["calibrate", "image", str(tmp_path / "picture.png"), "--set", "camera.um_per_px=20"]
    done = invoke(*words, "-o", tmp_path / "out.toml", "--json")
    found = json.loads(done.stdout)
    assert done.exit_code == 1 and found["chosen"] is None
    assert sorted(pose["mirror"] for pose in found["poses"]) == [False, True]
    assert not list(tmp_path.glob("out*"))
    done = invoke(*words, "-o", tmp_path / "out.toml", "--pick", "1")
    assert done.exit_code == 0 and {file.name for file in tmp_path.glob("out*")} == {"out.toml", "out.png"}


@pytest.mark.parametrize(("stated", "said"), [(10.0, "16.7 % too small"), (15.0, "25.0 % too large")])
def test_a_scale_that_the_walls_contradict_is_said_on_the_right_side_with_the_one_to_set(stated, said, monkeypatch):
    fit = SimpleNamespace(calibration=Calibration(12.0), std=np.array([0.1, 0.1, 0.01, 0.001]))
    monkeypatch.setitem(walls_state.__globals__, "fit_nearby", lambda *_: fit)
    seen = walls_state(np.full((4, 4), int(stated), np.uint8), load_chip(ChipSettings()), Calibration(stated))
    assert seen is not None and seen.other_scale and not seen.good
    assert f"camera.um_per_px = {stated:g} is {said} for the walls in the image" in seen.text
    assert "at 12 ± 0.01: set camera.um_per_px = 12," in seen.text


def test_a_picture_is_written_once_and_another_one_beside_it(tmp_path):
    grey = np.arange(48, dtype=np.uint8).reshape(6, 8)
    first = write_picture(grey, tmp_path / "lab.png")
    assert write_picture(grey, tmp_path / "lab.png") == first == tmp_path / "lab.png"
    other = write_picture(grey + 1, tmp_path / "lab.png")
    assert other.name == "lab_2.png" and write_picture(grey + 1, tmp_path / "lab.png") == other
    assert np.array_equal(cv2.imread(str(first), cv2.IMREAD_GRAYSCALE), grey)


def test_the_picture_of_a_session_is_the_median_of_images_from_its_beginning_to_its_end(tmp_path, monkeypatch):
    def at(time_s):
        image = np.full((8, 100), 120, np.uint8)
        image[:, round(9.9 * time_s)] = 10  # what moves
        return SimpleNamespace(frame=SimpleNamespace(index=round(9.9 * time_s), image=image))

    session = SimpleNamespace(duration_s=10.0, at=at, topics={"/camera/frame": 100})
    monkeypatch.setitem(read_picture.__globals__, "open_session", lambda _: session)
    path = tmp_path / "s.mcap"
    path.write_bytes(b"any")
    seen = read_picture(path, "grey")
    assert (seen.image == 120).all() and (seen.covered.done, seen.covered.total) == (31, 100)
