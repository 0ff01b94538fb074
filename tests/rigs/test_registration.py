"""Whole missions seen by a camera that is turned, mirrored and shifted."""

import numpy as np
import pytest

import flowrec
from flowrec.chip import ChipSettings, clearance_um, load_chip
from flowrec.commands.record import record
from flowrec.config import calibration_of, load_config
from flowrec.errors import ChipError
from flowrec.interpolation import bilinear
from flowrec.resolve import resolve
from flowrec.vision.walls import walls_in_view
from tests.short_missions import SMALL

SURVEY = [*SMALL, "mission.phases=survey,refine"]
TURNED = {
    "2 degrees": ["camera.angle_deg=2"],
    "90 degrees": ["camera.angle_deg=90", "camera.width_px=256", "camera.height_px=320"],
    "mirrored": ["camera.mirror=true", "camera.angle_deg=180"],
    "shifted": ["camera.centre_um=[3490,2550]"],
}


def flown(tmp_path, *sets):
    recorded = record(load_config(None, [*SURVEY, *sets]), tmp_path / "turned.mcap")
    ticks = flowrec.open(recorded.path).ticks()
    off = [tick.track.position_um - tick.truth.position_um for tick in ticks if tick.track.seen]
    return recorded.facts["refined_flow_error"], np.sqrt(np.mean(np.square(off)))


@pytest.mark.parametrize("name", TURNED)
def test_a_turned_camera_costs_nothing_where_the_settings_say_so(name, tmp_path):
    error, track_um = flown(tmp_path, *TURNED[name])
    assert error < 0.02  # 0.13 before the refinement
    assert track_um < 4.0  # a fifth of a pixel


def test_a_turned_camera_of_which_the_settings_know_nothing_spoils_track_and_flow(tmp_path):
    error, track_um = flown(tmp_path, "simulated.angle_deg=2")
    assert error > 0.04
    assert track_um > 20.0


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
    with pytest.raises(ChipError, match=r"camera: the image shows the chip turned by 180 .*camera\.angle_deg = 180"):
        record(config, tmp_path / "turned.mcap")
    assert not list(tmp_path.iterdir())
