"""`flowrec doctor`: each device in a line, what to do about it, and an exit status that a script can use."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from flowrec.core import CameraLosses
from flowrec.physics import AS_STATED, ORIENTATIONS, Calibration, Chip, ChipSettings, Orientation, load_chip
from flowrec.rigs import CameraInfo
from flowrec.rigs.lab.cameras import probe as camera
from flowrec.stages import Config, load_config, registration_of, with_sets
from flowrec.stages.resolve import resolve
from flowrec.verbs import diagnosis
from flowrec.verbs.diagnosis import FAILURE, OK, WARNING, diagnose
from tests.conftest import invoke
from tests.physics.chip.looks import LOOKS, picture
from tests.short_missions import set_words

MEASURED = (
    "rig=lab",
    "camera.um_per_px=20.0",
    "camera.rate_hz=20.0",
    "robot.radius_um=70.0",
    "robot.max_speed_um_s=900.0",
    "robot.step_out_hz=40.0",
    "robot.delay_s=0.05",
    "recording.admission_s=0",
)
SEEN = camera.CameraProbe(
    CameraInfo("Maker Model", "7", 640, 512, 8, 20.0, pixel_format="Mono8"),
    rate_hz=20.0,
    losses=CameraLosses(0, 1000, 1000, 0, 0, 0, 0, 0, 0),
    clock_slope=1.0,
    arrival_ms=51.0,
    brightest=200,
    notes=(),
)


@pytest.fixture(autouse=True)
def short_trial(monkeypatch: pytest.MonkeyPatch) -> None:
    """The disk is tried with 4 MB."""
    monkeypatch.setattr(diagnosis, "_TRIAL_BYTES", 1 << 22)


def sees(monkeypatch: pytest.MonkeyPatch, chip: Chip, camera_at: Calibration) -> None:
    """The camera shows dark walls of the chip, in an image of 320 x 256 pixels."""
    image = picture(chip.mask, chip.um_per_px, camera_at, (320, 256), LOOKS["dark lines"], np.random.default_rng(1))
    info = replace(SEEN.info, width_px=320, height_px=256)
    monkeypatch.setattr("flowrec.rigs.probe_camera", lambda *_: replace(SEEN, info=info, image=image))


def levels(config: Config, folder: Path) -> dict[str, str]:
    order = [OK, WARNING, FAILURE]
    worst: dict[str, str] = {}
    for finding in diagnose(config, folder=folder):
        assert "\n" not in finding.text
        worst[finding.what] = max(worst.get(finding.what, OK), finding.level, key=order.index)
    return worst


@pytest.mark.parametrize(
    ("seen", "what", "level"),
    [
        (SEEN, "camera", OK),
        (replace(SEEN, notes=("the gain is 3 dB",)), "camera", WARNING),
        (replace(SEEN, info=replace(SEEN.info, bits=12)), "camera", FAILURE),
        (SEEN, "rate", OK),
        (replace(SEEN, rate_hz=15.0), "rate", WARNING),
        (SEEN, "losses", OK),
        (replace(SEEN, losses=replace(SEEN.losses, link=20, frames=980)), "losses", WARNING),
        (replace(SEEN, losses=replace(SEEN.losses, backlog=200, frames=800)), "losses", FAILURE),
        (SEEN, "clock", OK),
        (replace(SEEN, clock_slope=0.0), "clock", WARNING),
        (replace(SEEN, clock_slope=10.0), "clock", WARNING),
        (SEEN, "image", OK),
        (replace(SEEN, brightest=255), "image", WARNING),
        (replace(SEEN, brightest=9), "image", WARNING),
    ],
)
def test_what_a_camera_shows_is_judged(
    seen: camera.CameraProbe, what: str, level: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("flowrec.rigs.probe_camera", lambda *_: seen)
    config = load_config(None, [*MEASURED, "mission.phases=observe"])
    assert levels(config, tmp_path)[what] == level


def test_a_camera_that_states_no_name_is_called_camera(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    nameless = replace(SEEN, info=replace(SEEN.info, model="", serial=""))
    monkeypatch.setattr("flowrec.rigs.probe_camera", lambda *_: nameless)
    found = diagnose(load_config(None, [*MEASURED, "mission.phases=observe"]), folder=tmp_path)
    assert next(one for one in found if one.what == "camera").text.startswith("camera: 640 x 512 pixels")


@pytest.mark.parametrize(("turned_deg", "level"), [(0.0, OK), (1.0, WARNING)])
def test_a_chip_that_was_turned_since_its_registration_is_noticed(
    turned_deg: float, level: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    chip = load_chip(ChipSettings())
    centre_um = (np.array(chip.size_um) - chip.um_per_px) / 2
    sees(monkeypatch, chip, Calibration.centre_on(20.0, centre_um, (320, 256), turned_deg))
    sets = ["camera.width_px=320", "camera.height_px=256", "mission.phases=observe"]
    assert levels(load_config(None, [*MEASURED, *sets]), tmp_path)["walls"] == level


TURNED = pytest.mark.slow("compares an image with the chip, in another orientation")


@pytest.mark.parametrize(
    "orientation",
    [each if number % 6 == 0 else pytest.param(each, marks=TURNED) for number, each in enumerate(ORIENTATIONS)],
    ids=lambda each: each.name,
)
def test_a_camera_that_shows_the_chip_in_another_orientation_is_a_failure_with_the_setting_that_mends_it(
    orientation: Orientation, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked = ["chip.path=sessions/chips/y_junction.png", "camera.width_px=320", "camera.height_px=256"]
    config = load_config(None, [*MEASURED, *asked, "mission.phases=observe"])
    chip = load_chip(config.chip)
    sees(monkeypatch, chip, orientation.about(registration_of(resolve(config, chip).camera, chip), (159.5, 127.5)))
    axes = {one.what: one for one in diagnose(config, folder=tmp_path)}["axes"]
    assert (axes.level == OK) == (orientation == AS_STATED)
    sets = [each.replace(" ", "") for each in axes.text.partition(": set ")[2].split(", ") if each]
    assert levels(with_sets(config, sets), tmp_path)["axes"] == OK


# A run of that rate needs 3.64 MB/s.
@pytest.mark.parametrize(
    ("speed", "level"), [(1e9, OK), (7.3e6, OK), (7.2e6, WARNING), (3.7e6, WARNING), (3.6e6, FAILURE)]
)
def test_a_disk_is_judged_by_what_the_camera_delivers(
    speed: float, level: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(diagnosis, "_write_speed", lambda _folder: speed)
    monkeypatch.setattr(shutil, "disk_usage", lambda _folder: SimpleNamespace(free=10**12))
    assert levels(load_config(None, ["camera.rate_hz=20.0", "recording.admission_s=0"]), tmp_path)["disk"] == level


@pytest.mark.parametrize(("free_gb", "level"), [(105.0, OK), (101.0, WARNING), (99.0, WARNING)])
def test_a_disk_has_room_down_to_the_floor_at_which_a_run_is_ended(
    free_gb: float, level: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(diagnosis, "_write_speed", lambda _folder: 1e9)
    monkeypatch.setattr(shutil, "disk_usage", lambda _folder: SimpleNamespace(free=free_gb * 1e9))
    asked = ["camera.rate_hz=20.0", "recording.admission_s=0", "recording.disk_floor_gb=100.0"]  # 2.2 GB in 10 minutes
    assert levels(load_config(None, asked), tmp_path)["disk"] == level


@pytest.mark.slow("flies the rehearsal of a mission")
def test_the_kernels_of_a_live_run_are_compiled_before_it(tmp_path: Path) -> None:
    assert levels(load_config(), tmp_path)["kernels"] == OK


def without_devices(folder: Path, *sets: str) -> tuple[dict[str, str], set[str]]:
    """Failures of a lab whose camera and amplifier are missing, and all that was looked at."""
    asked = (*MEASURED, "lab.camera=opencv", "lab.device=nowhere.avi", "lab.serial.port=/dev/nothing", *sets)
    words = ["doctor", "--json", "--folder", str(folder), *set_words(asked)]
    done = invoke(*words)
    assert done.exit_code == 1, done.output
    found = json.loads(done.stdout)
    assert found["level"] == FAILURE
    failures = {one["what"]: one["text"] for one in found["findings"] if one["level"] == FAILURE}
    assert "nowhere.avi" in failures["camera"] and "/dev/nothing" in failures["coils"], sets
    return failures, {one["what"] for one in found["findings"]}


def test_missing_devices_are_failures_in_one_line_each_and_the_others_are_still_looked_at(tmp_path: Path) -> None:
    failures, looked_at = without_devices(tmp_path)
    assert set(failures) == {"camera", "coils"}
    assert {"settings", "mission", "disk", "viewer"} <= looked_at
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("phases", "width_px", "level"),
    [("survey,refine,plan,navigate", 200, WARNING), ("observe", 200, OK), ("survey,refine,plan,navigate", 640, None)],
)
def test_a_chip_that_the_camera_does_not_see_whole_is_noticed(phases: str, width_px: int, level: str | None) -> None:
    chip = load_chip(ChipSettings())
    sets = (*MEASURED, f"mission.phases={phases}", f"camera.width_px={width_px}", "camera.um_per_px=10.0")
    found = [*diagnosis._view(resolve(with_sets(Config(), sets), chip), chip)]
    assert [each[1] for each in found] == ([level] if level else [])


@pytest.mark.parametrize(
    ("days", "residual_um", "level"), [(None, 1.0, WARNING), (1, 1.0, OK), (1, 90.0, WARNING), (3650, 1.0, WARNING)]
)
def test_a_registration_is_judged_by_its_age_and_its_residual(
    days: int | None, residual_um: float, level: str, tmp_path: Path
) -> None:
    sets = [*MEASURED, "mission.phases=observe", f"camera.residual_um={residual_um}"]
    if days is not None:
        sets.append(f'camera.registered_on="{(datetime.now(UTC) - timedelta(days=days)).isoformat()}"')
    assert levels(load_config(None, sets), tmp_path)["registration"] == level


def test_a_setting_that_is_wrong_is_told_and_the_devices_are_looked_at_all_the_same(tmp_path: Path) -> None:
    for wrong, text in {
        "robot.radius_um=-5.0": "robot.radius_um = -5",
        "camera.bits=9": "camera.bits = 9",
        "chip.path=nowhere.png": "nowhere.png",
        "mission.goal=[1e6, 0.0]": "goal",
        "lab.devise=7": "lab.devise",
    }.items():
        failures, _ = without_devices(tmp_path, wrong)
        assert text in failures["settings"], wrong


def test_settings_that_are_not_measured_are_a_failure_that_names_them() -> None:
    done = invoke("doctor", "--rig", "lab")
    assert done.exit_code == 1
    assert "x settings" in done.stdout and "robot.radius_um" in done.stdout
