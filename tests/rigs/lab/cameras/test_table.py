from __future__ import annotations

import sys
import tomllib
from pathlib import Path

import pytest

from flowrec.core import RigError, UsageError
from flowrec.rigs import Wanted
from flowrec.rigs.lab.cameras.camera import difference, find_device, wanted_of
from flowrec.stages import CAMERAS, Lab, ResolvedCamera, load_config

PACKAGES = {"genicam": "viva_genicam", "pylon": "pypylon", "mmcore": "pymmcore_plus"}
PROJECT = Path(__file__).parents[4] / "pyproject.toml"


@pytest.mark.parametrize("name", [row.name for row in CAMERAS.values() if row.extra])
def test_a_missing_package_is_one_line_with_the_command_that_installs_it(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, PACKAGES[name], None)
    monkeypatch.delitem(sys.modules, f"flowrec.rigs.lab.cameras.{name}", raising=False)
    with pytest.raises(UsageError) as raised:
        CAMERAS[name].load()
    command = f"pip install 'flowrec[{CAMERAS[name].extra}]'"
    assert command in str(raised.value) and PACKAGES[name] in str(raised.value) and "\n" not in str(raised.value)
    assert CAMERAS[name].extra in tomllib.loads(PROJECT.read_text())["project"]["optional-dependencies"]


def test_what_a_configuration_asks_of_a_camera() -> None:
    sets = ("camera.bits=12", "camera.rate_hz=90", "lab.offset_x_px=4", "lab.offset_y_px=8", "lab.trigger=Line1")
    config = load_config(None, sets)
    assert wanted_of(config.camera, config.lab) == Wanted(
        offset_px=(4, 8), rate_hz=90.0, exposure_s=0.004, pixel_format="Mono12", trigger="Line1"
    )
    with pytest.raises(RigError, match="set both"):
        wanted_of(ResolvedCamera(rate_hz=60.0, um_per_px=1.0), Lab(offset_x_px=4))


def test_one_camera_needs_no_name_and_two_do() -> None:
    two = {"Basler a 1": 1, "Basler b 2": 2}
    assert find_device({"Basler a 1": 1}, "", "here") == 1 and find_device(two, "basler B", "here") == 2
    for devices, wanted, complaint in (
        ({}, "", "here: no camera found"),
        (two, "", "2 cameras found; set lab.device to part of one of: Basler a 1; Basler b 2"),
        (two, "Basler", "2 cameras found"),
        (two, "c", "no camera matches lab.device = 'c'; found: Basler a 1; Basler b 2"),
    ):
        with pytest.raises(RigError, match=complaint):
            find_device(devices, wanted, "here")


def test_a_difference_from_what_was_asked_is_one_line() -> None:
    assert difference("camera.rate_hz", 60.0, 36.7, "Hz") == ("camera.rate_hz = 60 Hz asked, 36.7 Hz reached",)
    assert difference("camera.rate_hz", 60.0, 59.9988, "Hz") == () == difference("lab.gain", None, 3.0, "")
    assert "no such setting" in difference("lab.gain", 3.0, None, "")[0]
