"""A camera that is killed while a real `flowrec record --rig lab` navigates with its coils on, and comes back.

The camera is a GigE Vision camera in a process of its own, which shows the twin's world; kill -9 ends it. The coils are
the serial firmware, whose outputs tell when the field went and came.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from flowrec.physics import load_chip
from flowrec.rigs import emulated_world
from flowrec.stages import assemble, load_config
from flowrec.stages.resolve import resolve
from tests.twins.coils import device
from tests.twins.gige import Aravis, port
from tests.twins.lab import COMMON, RATE, recorder
from tests.twins.world import FileView

GOAL_UM = (1996.0, 3152.0)
# A busy computer delays the loop by more than a lab's may; the camera's silence is told by the usual time.
SETS = (
    *COMMON,
    RATE,
    f"mission.goal={list(GOAL_UM)}",
    "lab.guardian_s=1.0",
    "safety.guard_timeout_s=3.0",
    "recording.anonymous=true",
)
_AWAY_S = 0.5  # after the field has gone
_START_S, _WAIT_S, _END_S = 120.0, 15.0, 120.0


@dataclass
class Killed:
    """One run.

    Attributes
    ----------
    session : the file.
    off_s : from the kill until the outputs were at zero; they were for half a second when the camera was started again.
    back_s : from the start of the camera until there was a field again.
    closest_um : least distance of the robot of the world from the goal.
    status, said : of the recorder.
    """

    session: Path
    off_s: float
    back_s: float
    closest_um: float
    status: int
    said: str


def trial(folder: Path) -> Killed:
    """One run from its start to the goal, whose camera is killed on the way.

    Raises AssertionError: the run did not come so far.
    """
    config = load_config(None, [*COMMON, "camera.rate_hz=40.0", "simulated.seed=5"])
    chip = load_chip(config.chip)
    resolved = resolve(config, chip)
    view, out, errors = FileView(folder), folder / "s.mcap", folder / "stderr"
    with (
        port(),
        device("serial+timer", folder, timer_ms=1000) as coils,
        emulated_world(assemble(resolved, chip), resolved, coils, view) as (_, truths),
        Aravis(shown=view.file) as camera,
        recorder(out, *SETS, *view.sets, *coils.sets, errors=errors) as process,
    ):

        def wait(happened: Callable[[], bool], timeout_s: float) -> None:
            end_s = time.monotonic() + timeout_s
            while not happened():
                assert process.poll() is None and time.monotonic() < end_s, errors.read_text()[-2000:]
                time.sleep(0.01)

        wait(lambda: "mission: navigate" in errors.read_text(), _START_S)
        time.sleep(1.0)
        begin = coils.end()
        killed_ns = time.monotonic_ns()
        camera.unplug()
        wait(lambda: coils.energised(begin) and coils.off_ns(killed_ns, begin) is not None, _WAIT_S)
        time.sleep(_AWAY_S)
        off_ns, plugged_ns, again = coils.off_ns(killed_ns, begin), time.monotonic_ns(), coils.end()
        camera.plug_in()
        wait(lambda: coils.energised(again), _WAIT_S)
        times_ns, currents = coils.outputs(again)
        back_ns = int(times_ns[np.flatnonzero(currents.any(axis=1))[0]])
        process.wait(_END_S)
        status = process.returncode
    assert off_ns is not None
    away_um = np.hypot(*(np.array([truth.position_um for truth in truths]) - GOAL_UM).T)
    said, closest_um = errors.read_text(), float(away_um.min())
    return Killed(out, 1e-9 * (off_ns - killed_ns), 1e-9 * (back_ns - plugged_ns), closest_um, status, said)
