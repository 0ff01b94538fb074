"""A whole mission of `record --rig lab`: an emulated camera and the serial firmware, a simulated world between them.

The recorder is a process of its own, as in a lab. The world is moved by the currents of the firmware's outputs alone.
"""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from flowrec.chip import load_chip
from flowrec.commands.check import check
from flowrec.commands.replay import replay
from flowrec.config import load_config
from flowrec.pipeline import assemble
from flowrec.resolve import resolve
from flowrec.session import Session
from tests.conftest import needs_quiet
from tests.twins.firmware import compiled, firmware_twin
from tests.twins.world import live_images

pytest.importorskip("pypylon")
pytestmark = needs_quiet

COMMON = (
    "camera.width_px=320",
    "camera.height_px=256",
    "camera.um_per_px=20.0",
    "robot.radius_um=80.0",
    "robot.max_speed_um_s=300.0",
    "robot.step_out_hz=15.0",
    "robot.delay_s=0.06",
    "chip.inlet_speed_um_s=40.0",  # slow: a computer that tests beside it delays frames by 0.1 s and more
    "mission.phases=plan,navigate",
    "mission.goal=[1100.0, 2700.0]",
)
# A computer that compiles, tests and renders beside the recorder stops it for longer than a lab's may.
PATIENT = ("lab.guardian_s=1.0", "safety.guard_timeout_s=3.0", "lab.camera_timeout_s=1.0")


@pytest.fixture(scope="module")
def firmware(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return compiled(tmp_path_factory.mktemp("firmware"), timer_ms=1000)


def words(sets: tuple[str, ...]) -> list[str]:
    return [word for text in sets for word in ("--set", text)]


def test_a_mission_with_emulated_devices_arrives_and_replays_exactly(firmware: Path, tmp_path: Path) -> None:
    config = load_config(None, [*COMMON, "camera.rate_hz=40.0", "simulated.seed=5"])
    chip = load_chip(config.chip)
    resolved = resolve(config, chip)
    session = tmp_path / "s.mcap"
    with (
        firmware_twin(firmware, tmp_path / "outputs") as twin,
        live_images(assemble(resolved, chip), resolved, twin.samples, tmp_path) as (features, positions),
    ):
        sets = (*COMMON, *PATIENT, "camera.rate_hz=20.0", "recording.anonymous=true", "lab.camera=pylon")
        devices = (f'lab.device_config="{features}"', f'lab.port="{twin.port}"')
        command = [sys.executable, "-m", "flowrec", "record", "--rig", "lab", "--out", str(session)]
        done = subprocess.run(
            [*command, *words((*sets, *devices))],
            env=os.environ | {"PYLON_CAMEMU": "1"},
            capture_output=True,
            text=True,
            timeout=240,
            check=False,
        )
        times_ns, currents = twin.samples()
    assert done.returncode == 0, done.stderr[-2000:]
    away_um = np.hypot(*(np.array(positions) - (1100.0, 2700.0)).T)
    assert away_um.min() < 120.0, "the robot of the world was at the goal"
    assert np.abs(currents).max() > 1.0 and not currents[-1].any()
    with Session(session) as recorded:
        assert recorded.outcome["outcome"] == "reached"
        ticks = list(recorded.ticks())
    turns = np.sum([tick.applied.turns for tick in ticks], axis=0)
    rolled_um = 25.0 * float(np.hypot(*turns))
    assert rolled_um > 100.0, "the coils did the work"
    assert any(tick.losses is not None for tick in ticks)
    assert len(times_ns) > 1000
    assert replay(session, verify=True).same
    assert check(session).exit_status in (0, 3)


@pytest.mark.parametrize(
    ("cameras", "sets", "told"),
    [
        ("0", (), "pylon: no camera found"),
        ("2", (), "pylon: 2 cameras found; set lab.device"),
        ("1", ("coils.max_current_a=50.0",), "coils.max_current_a = 50 A: .* makes at most 5 A"),
    ],
)
def test_devices_that_are_not_there_or_can_not_do_it_are_one_line_and_leave_no_file_and_no_field(
    cameras: str, sets: tuple[str, ...], told: str, firmware: Path, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    out.mkdir()
    with firmware_twin(firmware, tmp_path / "outputs") as twin:
        given = (*COMMON, "camera.rate_hz=20.0", "lab.camera=pylon", f'lab.port="{twin.port}"', *sets)
        command = [sys.executable, "-m", "flowrec", "record", "--rig", "lab", "--out", str(out / "s.mcap")]
        done = subprocess.run(
            [*command, *words(given)],
            env=os.environ | {"PYLON_CAMEMU": cameras},
            capture_output=True,
            text=True,
            timeout=120,
            check=False,
        )
        _, currents = twin.samples()
    assert done.returncode in (1, 2)
    lines = [line for line in done.stderr.splitlines() if line.startswith("flowrec: ")]
    assert len(lines) == 1 and "Traceback" not in done.stderr
    assert re.search(told, lines[0]), lines[0]
    assert not list(out.iterdir())
    assert not currents.any()
