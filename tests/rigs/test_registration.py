"""Whole missions seen by a camera that is turned, mirrored and shifted."""

import numpy as np
import pytest

import flowrec
from flowrec.core import ChipError, Tick, bilinear
from flowrec.physics import ChipSettings, clearance_um, load_chip
from flowrec.stages import calibration_of, load_config
from flowrec.stages.control import axes_check
from flowrec.stages.resolve import resolve
from flowrec.stages.vision.walls import walls_in_view
from flowrec.verbs.check import check
from flowrec.verbs.record import record
from flowrec.view import rows_of_run
from tests.short_missions import SMALL

SURVEY = [*SMALL, "mission.phases=survey,refine"]
TURNED = {
    "2 degrees": ["camera.angle_deg=2"],
    "90 degrees": ["camera.angle_deg=90", "camera.width_px=256", "camera.height_px=320"],
    "mirrored": ["camera.mirror=true", "camera.angle_deg=180"],
    "shifted": ["camera.centre_um=[3490,2550]"],
}
FLIGHT = pytest.mark.slow("flies a survey with another pose of the camera")


def flown(tmp_path, *sets):
    recorded = record(load_config(None, [*SURVEY, *sets]), tmp_path / "turned.mcap")
    ticks = flowrec.open(recorded.path).ticks()
    off = [tick.track.position_um - tick.truth.position_um for tick in ticks if tick.track.seen]
    return recorded.facts["refined_flow_error"], np.sqrt(np.mean(np.square(off)))


@FLIGHT
@pytest.mark.parametrize("name", TURNED)
def test_a_turned_camera_costs_nothing_where_the_settings_say_so(name, tmp_path):
    error, track_um = flown(tmp_path, *TURNED[name])
    assert error < 0.02  # 0.13 before the refinement
    assert track_um < 4.0  # a fifth of a pixel


@pytest.mark.slow("flies a mission with a turned camera")
def test_a_turned_camera_of_which_the_settings_know_nothing_spoils_track_and_flow_unless_its_image_is_asked(tmp_path):
    for name, asked in (("asked", "true"), ("not_asked", "false")):
        (tmp_path / name).mkdir()
        error, track_um = flown(tmp_path / name, "simulated.angle_deg=2", f"camera.trace_walls={asked}")
        assert (error < 0.02) == (track_um < 5.0) == (asked == "true")


@pytest.mark.parametrize("name", TURNED)
def test_the_tracker_expects_the_walls_where_they_are(name):
    chip = load_chip(ChipSettings())
    config = resolve(load_config(None, [*SURVEY, *TURNED[name]]), chip)
    calibration = calibration_of(config, chip)
    walls = walls_in_view(chip, calibration, (config.camera.height_px, config.camera.width_px))
    clearance = clearance_um(chip.mask, chip.um_per_px).astype(np.float64)
    compared = 0
    for x, y in np.random.default_rng(1).integers(0, (config.camera.width_px, config.camera.height_px), (400, 2)):
        column, row = calibration.to_um((x, y)) / chip.um_per_px
        if 0 <= column < chip.mask.shape[1] - 1 and 0 <= row < chip.mask.shape[0] - 1:
            expected = bilinear(clearance, column, row)
            assert abs(float(walls.distance_px[y, x]) * calibration.um_per_px - expected) < 2.0
            compared += 1
            x0, y0, x1, y1 = walls.box
            assert expected < 1.0 or (x0 <= x < x1 and y0 <= y < y1)
    assert compared > 300


def test_a_run_whose_camera_shows_the_chip_turned_leaves_no_file_and_names_the_setting(tmp_path):
    config = load_config(None, [*SURVEY, "mission.check_axes=true", "simulated.angle_deg=180"])
    with pytest.raises(ChipError, match=r"camera\.angle_deg = 180"):
        record(config, tmp_path / "turned.mcap")
    assert not list(tmp_path.iterdir())


def test_a_run_whose_axes_are_not_confirmed_is_doubtful(tmp_path, monkeypatch):
    monkeypatch.setattr(axes_check, "LIMIT_S", 0.2)  # too short to tell anything
    config = load_config(None, [*SMALL, "mission.phases=survey", "mission.check_axes=true", "duration_s=0.7"])
    recorded = record(config, tmp_path / "short.mcap")
    assert recorded.facts["axes_check"] == "undecided" and recorded.exit_status == 3
    assert any("are not confirmed" in doubt for doubt in recorded.doubts)
    assert any("are not confirmed" in finding.text for finding in check(recorded.path).findings)
    assert ("axes_check", "undecided", None) in rows_of_run(Tick(), recorded.facts), "as Rerun's panel shows it"
