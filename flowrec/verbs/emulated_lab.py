"""The devices of `flowrec emulate lab`, the world between them, and the configuration that uses them."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from flowrec.core import TOML, Output, say, settings_of
from flowrec.measure import as_toml
from flowrec.physics import load_chip
from flowrec.rigs import EmulatedCamera, EmulatedInstruments, compiled_firmware, emulated_board, emulated_world
from flowrec.stages import assemble, load_config, resolve

# A small, slow lab, which a busy computer with two cores holds. What differs from the truth stays to be found.
_SETTINGS: dict[str, Any] = {
    "camera.width_px": 320,
    "camera.height_px": 256,
    "camera.um_per_px": 20.0,
    "camera.rate_hz": 25.0,
    "robot.radius_um": 80.0,
    "robot.max_speed_um_s": 300.0,
    "robot.step_out_hz": 15.0,
    "robot.delay_s": 0.05,
    "chip.inlet_speed_um_s": 40.0,
    "mission.goal": [1100.0, 2700.0],
    # This computer does the work of all devices, too, and so stops the recorder for longer than one in a lab.
    "lab.guardian_s": 0.3,
    "lab.camera_timeout_s": 0.5,
    "safety.guard_timeout_s": 1.5,
}
_TIMER_MS = 300  # of the firmware, for the same reason
_AGAIN_S = 3.0  # without a field: the mission is over


@dataclass(frozen=True)
class EmulatedLab:
    """Devices that run.

    Attributes
    ----------
    file : the configuration that uses them.
    camera, port : where they are.
    instruments : what a person would hold to them, and do to them.
    """

    file: Path
    camera: str
    port: str
    instruments: EmulatedInstruments


@contextmanager
def emulated_lab(
    file: Path,
    camera_delay_s: float,
    sets: Iterable[str] | Mapping[str, Any],
    overwrite: bool,
    world: Iterable[str] | Mapping[str, Any],
) -> Iterator[EmulatedLab]:
    """Camera, amplifier and world on this computer while the context lasts; `file` is written, and removed at the end.

    Parameters
    ----------
    camera_delay_s : from the end of an exposure until its image is sent.
    sets : settings that differ from those of the emulated lab, of its world and of the recorder; simulated.* are of the
        world alone.
    world : settings of the world that the configuration states otherwise: defects to be found.

    Raises
    ------
    RigError, UsageError, OutputError : see `flowrec emulate lab`.
    """
    output = Output(file, TOML, (), overwrite)
    output.check()
    given = _SETTINGS | settings_of(sets)
    config = load_config(None, given | settings_of(world))
    chip = load_chip(config.chip)
    resolved = resolve(config, chip)
    pipeline = assemble(resolved, chip)
    camera = resolved.camera
    say("compiling the firmware and solving the true flow")
    with TemporaryDirectory(prefix="flowrec-lab-") as folder:
        program = compiled_firmware(Path(folder), _TIMER_MS)
        with (
            emulated_board(program, Path(folder) / "outputs") as board,
            EmulatedCamera(camera.width_px, camera.height_px, camera.rate_hz) as images,
            emulated_world(pipeline, resolved, board.samples, images, camera_delay_s, _AGAIN_S),
        ):
            devices = {"lab.camera": "opencv", "lab.device": images.url}
            devices |= {"lab.amplifier": "serial", "lab.serial.port": board.port}
            of_recorder = {key: value for key, value in given.items() if not key.startswith("simulated.")}
            settings = dict(sorted((of_recorder | devices).items()))
            with output.new_file() as part:
                part.write_text('rig = "lab"\n' + as_toml(("Devices that flowrec emulate lab runs.",), settings))
            try:
                yield EmulatedLab(
                    file, images.url, board.port, EmulatedInstruments(board.samples, images, resolved.coils)
                )
            finally:
                file.unlink(missing_ok=True)
