"""`flowrec record --rig lab` in a process of its own, with settings that suit the twins."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import islice
from pathlib import Path

from flowrec.physics import load_chip
from flowrec.rigs import SimulatedRig
from flowrec.stages import assemble, load_config
from flowrec.stages.resolve import resolve
from tests.short_missions import set_words
from tests.twins.coils import environment
from tests.twins.emulator import showing

ROOT = Path(__file__).parents[2]
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
    "recording.admission_s=0",
)
RATE = "camera.rate_hz=20.0"
# A computer that compiles, tests and renders beside the recorder stops it for longer than a lab's may.
PATIENT = ("lab.guardian_s=1.0", "safety.guard_timeout_s=3.0", "lab.camera_timeout_s=1.0")
_STILLS = 20


def still_scene(folder: Path) -> tuple[str, ...]:
    """Settings of an emulated camera that shows a robot at rest, with other noise in every image."""
    config = load_config(None, [*COMMON, "camera.rate_hz=40.0", "simulated.seed=5", "simulated.world=kind"])
    chip = load_chip(config.chip)
    resolved = resolve(config, chip)
    rig = SimulatedRig.of(assemble(resolved, chip), resolved)
    images = [inputs.frame.image for inputs in islice(rig.inputs(), _STILLS) if inputs.frame is not None]
    return ("lab.camera=pylon", f'lab.device_config="{showing(folder, images)}"')


@contextmanager
def recorder(
    out: Path, *sets: str, module: str = "flowrec", cameras: int = 1, errors: Path | None = None
) -> Iterator[subprocess.Popen[str]]:
    """The recorder while it runs; it is killed at the end. `errors` takes its stderr, which is lost else."""
    command = [sys.executable, "-m", module, "record", "--rig", "lab", "--out", str(out), *set_words(sets)]
    with (errors or Path("/dev/null")).open("w") as stderr:
        process = subprocess.Popen(
            command,
            cwd=ROOT,
            env=environment(PYLON_CAMEMU=str(cameras)),
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=stderr,
            text=True,
        )
        try:
            yield process
        finally:
            process.kill()
            process.communicate()
