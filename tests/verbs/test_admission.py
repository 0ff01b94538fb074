"""What is done before a live run: kernels compiled, worker warm, images tried; a machine too slow is refused."""

from __future__ import annotations

import contextlib
import json
import subprocess
import sys
from collections.abc import Generator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from flowrec.core import FlowrecError, RigError, Tick
from flowrec.rigs import SimulatedRig
from flowrec.run import LockstepWorker, RunControl
from flowrec.stages import Inputs, load_config
from flowrec.verbs import admission, prepare
from flowrec.verbs.admission import Held, admit
from flowrec.verbs.interactive import Unattended
from flowrec.verbs.preparation import Prepared
from flowrec.verbs.record import record
from tests.short_missions import SMALL

HZ = 5000.0  # more than any machine holds


@pytest.fixture(scope="module")
def prepared() -> Prepared:
    return prepare(load_config(None, [*SMALL, "recording.admission_s=0.01", f"camera.rate_hz={HZ:g}"]), aloud=False)


def tried(prepared: Prepared, folder: Path, rig: SimulatedRig, *, accept: bool = False) -> dict[str, str]:
    config = prepared.config
    config = replace(config, recording=replace(config.recording, accept_losses=accept))
    worker = LockstepWorker(prepared.pipeline, 0.0)
    return admit(rig, worker, (config, prepared.chip, prepared.pipeline), {}, folder, RunControl())


@pytest.mark.slow("rehearses a recording of large images")
def test_images_that_the_machine_does_not_hold_are_refused_before_there_is_a_file(tmp_path: Path) -> None:
    config = load_config(None, [*SMALL, "recording.admission_s=0.01", f"camera.rate_hz={HZ:g}", "duration_s=0.02"])
    with pytest.raises(RigError, match=rf"holds \d+ of {HZ:g} images a second.*close other programs.*--accept-losses"):
        record(config, tmp_path / "never.mcap", realtime=True)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("status", [130, 143])
def test_a_run_that_is_stopped_before_it_begins_leaves_no_file_and_says_so(status: int, tmp_path: Path) -> None:
    control = RunControl()
    control.stop("stopped by SIGTERM", status=status)
    with pytest.raises(FlowrecError, match="SIGTERM") as refused:
        record(load_config(None, SMALL), tmp_path / "never.mcap", control=Unattended(control))
    assert refused.value.exit_status == status and not list(tmp_path.iterdir())


def test_whoever_accepts_losses_goes_on_and_the_session_says_what_the_machine_held(
    prepared: Prepared, tmp_path: Path
) -> None:
    code = "from flowrec.core.system.leftovers import temporary_name as name; print(name('.mcap.partial'))"
    ended = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    (tmp_path / ended.stdout.strip()).write_bytes(b"of a process that was killed")
    rig = SimulatedRig.of(prepared.pipeline, prepared.config, realtime=True)
    said = tried(prepared, tmp_path, rig, accept=True)
    assert said["admission"].startswith("holds ") and said["admission"].endswith(f"of {HZ:g} images a second")
    assert not list(tmp_path.iterdir())
    first = next(rig.inputs())
    fresh = next(SimulatedRig.of(prepared.pipeline, prepared.config, realtime=True).inputs())
    assert first.frame is not None and fresh.frame is not None
    np.testing.assert_array_equal(first.frame.image, fresh.frame.image, "the trial leaves the run's world as it was")


def test_the_images_are_tried_with_the_flow_that_the_worker_has_solved_and_without_a_command(
    prepared: Prepared, tmp_path: Path
) -> None:
    ticks: list[Inputs] = []

    class Watched(SimulatedRig):
        def tried(self) -> Generator[Inputs]:
            for arrived in super().tried():
                ticks.append(arrived)
                yield arrived

        def apply(self, _currents: object) -> None:
            raise AssertionError("nothing is energised before the run")

    orders = []

    class Told(LockstepWorker):
        def submit(self, order):  # type: ignore[no-untyped-def]
            orders.append(order.mission.wanted)
            super().submit(order)

    config = replace(prepared.config, recording=replace(prepared.config.recording, accept_losses=True))
    rig, worker = Watched.of(prepared.pipeline, config, realtime=True), Told(prepared.pipeline, 0.0)
    admit(rig, worker, (config, prepared.chip, prepared.pipeline), {}, tmp_path, RunControl())
    assert orders == ["solve"], "the first order of the mission, and only that one"
    assert [one.frame.index for one in ticks if one.frame is not None].count(0) >= 2, "each trial begins anew"


def test_a_stop_ends_the_trial_at_once(prepared: Prepared, tmp_path: Path) -> None:
    control = RunControl()

    class Stopping(SimulatedRig):
        def tried(self) -> Generator[Inputs]:
            for arrived in super().tried():
                yield arrived
                control.stop("enough")

    config, rig = prepared.config, Stopping.of(prepared.pipeline, prepared.config, realtime=True)
    worker = LockstepWorker(prepared.pipeline, 0.0)
    assert admit(rig, worker, (config, prepared.chip, prepared.pipeline), {}, tmp_path, control) == {}
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("lost", ["dropped", "waiting"])
def test_images_that_the_writer_drops_or_still_holds_are_not_written(
    lost: str, prepared: Prepared, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Full:
        """A writer that none of the images leaves for the disk."""

        queue_bytes = dropped_frames = 0

        def write(self, tick: Tick) -> None:
            assert tick.frame is not None
            if lost == "dropped":
                self.dropped_frames += 1
            else:
                self.queue_bytes += tick.frame.image.nbytes

        def prioritise(self) -> None:
            """It has no thread."""

    monkeypatch.setattr(admission, "_scratch", lambda *_: contextlib.nullcontext(Full()))
    monkeypatch.setattr(admission, "_PATIENCE_S", 0.0)
    rig = SimulatedRig.of(prepared.pipeline, prepared.config, realtime=True)
    with pytest.raises(RigError, match=rf"holds -?\d{{1,3}} of {HZ:g} images a second, and writing to .* is the limit"):
        tried(prepared, tmp_path, rig)


@pytest.mark.parametrize(
    ("held", "enough", "told"),
    [
        (Held(60.0, 59.9, 60.4), True, "60 of 60"),
        (Held(60.0, 57.5, 60.0), True, "60 of 60"),
        (Held(60.0, 60.0, 41.2), False, "41 of 60"),
        (Held(60.0, 41.2, 60.0), False, "41 of 60"),
        (Held(30.0, 60.0, 60.0), True, "30 of 30"),
    ],
)
def test_a_machine_holds_what_both_its_ticks_and_its_disk_hold(held: Held, enough: bool, told: str) -> None:
    assert held.enough is enough
    assert str(held) == f"{told} images a second"


SEEN = """
import json, sys
from flowrec.core.system.numba_setup import Kernel
from flowrec.verbs.admission import rehearse
from flowrec.verbs.replay_change import Change
from flowrec.verbs.session_replay import replay_session
from flowrec.stages.config import load_config

def known():
    return {
        f"{name}.{kernel.py_func.__name__}": len(kernel.dispatcher.signatures)
        for name, module in list(sys.modules.items()) if name.startswith("flowrec.")
        for kernel in vars(module).values() if isinstance(kernel, Kernel)
    }

rehearse(load_config())
before = known()
replay_session(SESSION, Change(), from_s=FROM_S, verify=True)
after = known()
print(json.dumps([sum(before.values()), [name for name in after if after[name] > before.get(name, 0)]]))
"""


@pytest.mark.slow("rehearses and replays a mission in a process of its own")
def test_a_rehearsal_compiles_every_kernel_that_a_mission_runs() -> None:
    """Otherwise the first run of an installation would compile while the camera delivers."""
    session = str(Path(__file__).parents[2] / "sessions" / "golden.mcap")
    code = SEEN.replace("SESSION", f"__import__('pathlib').Path({session!r})").replace("FROM_S", "1.5")
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    compiled, late = json.loads(done.stdout.splitlines()[-1])
    assert compiled > 20
    assert late == []
