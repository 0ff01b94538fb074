"""Cameras of Micro-Manager against its demonstration devices (mm-test-adapters)."""

from __future__ import annotations

import gc
import threading
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from flowrec.core import RigError
from flowrec.rigs import Grabbed, Wanted
from flowrec.rigs.lab.cameras.grabber import Grabber
from tests.extras import why
from tests.rigs.lab.cameras.watching import adds_up, frames_of

pytest.importorskip("pymmcore_plus", reason=why("pymmcore_plus"))
adapters = pytest.importorskip("mm_test_adapters", reason=why("mm_test_adapters"))
from flowrec.rigs.lab.cameras.mmcore import MmcoreCamera  # noqa: E402

WANTED = Wanted(width_px=64, height_px=48, rate_hz=100.0, exposure_s=0.01, config="DemoCamera:DCam")


@pytest.fixture(autouse=True)
def micro_manager(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MICROMANAGER_PATH", str(adapters.device_adapter_path()))


@pytest.mark.parametrize("bits", [8, 10, 12, 14, 16])
def test_the_demonstration_camera_delivers_every_depth(bits: int) -> None:
    wanted = replace(WANTED, pixel_format=f"Mono{bits}", offset_px=(100, 50), gain=2.0)
    with Grabber(lambda: MmcoreCamera.of(wanted), wanted) as grabber:
        frames = frames_of(grabber, 10)
    assert [frame.index for frame in frames] == list(range(10)) and adds_up(frames[-1].losses)
    for frame in frames:
        assert frame.bits == bits and frame.image.shape == (48, 64) and frame.image.max() < 1 << bits
        assert frame.image.dtype == (np.uint8 if bits == 8 else np.uint16)
    assert (grabber.info.exposure_s, grabber.info.gain) == (0.01, 2.0)


def test_no_thread_of_micro_manager_runs_python_where_a_garbage_collection_would_end_the_process() -> None:
    collected_in: set[str] = set()

    def note(phase: str, info: dict[str, int]) -> None:
        collected_in.add(threading.current_thread().name)

    threshold, enabled = gc.get_threshold(), gc.isenabled()
    gc.callbacks.append(note)
    gc.set_threshold(20, 2, 2)
    gc.enable()
    try:
        for _ in range(20):
            camera = MmcoreCamera.of(WANTED)
            camera.open()
            assert camera.grab(1.0) is not None
            camera.close()
    finally:
        gc.callbacks.remove(note)
        gc.set_threshold(*threshold)
        if not enabled:
            gc.disable()
    assert collected_in and not [name for name in collected_in if name.startswith("Dummy")]  # a foreign thread


def test_stamps_are_the_times_at_which_micro_manager_received_the_images() -> None:
    with Grabber(lambda: MmcoreCamera.of(WANTED), WANTED) as grabber:
        frames = frames_of(grabber, 30)
    intervals_ms = np.diff([frame.stamp_ns for frame in frames]) / 1e6
    assert (intervals_ms > 0).all() and np.median(intervals_ms) > 5.0


def test_images_that_micro_manager_throws_away_because_its_buffer_is_full_are_counted() -> None:
    wanted = replace(WANTED, exposure_s=0.001)

    class Slow(MmcoreCamera):
        """A driver whose thread stands still until the buffer has been emptied once."""

        stood = False

        def grab(self, timeout_s: float) -> Grabbed | None:
            core = self._core
            if not self.stood and core is not None:
                self.stood = True
                core.stopSequenceAcquisition()
                core.setCircularBufferMemoryFootprint(1)
                core.startContinuousSequenceAcquisition(1)
                first = super().grab(5.0)
                most = waiting = 0
                while waiting >= most:
                    most = waiting
                    time.sleep(0.01)
                    waiting = core.getRemainingImageCount()
                return first
            return super().grab(timeout_s)

    with Grabber(lambda: Slow.of(wanted), wanted, length=2000) as grabber:
        frames = frames_of(grabber, 3)
    losses = frames[-1].losses
    assert losses.driver >= 300 and losses.link == losses.reconnections == 0 and adds_up(losses)


def test_a_configuration_file_and_the_label_of_a_camera_choose_it(tmp_path: Path) -> None:
    file = tmp_path / "lab.cfg"
    file.write_text(
        "Device,THub,SequenceTester,THub\nDevice,Left,SequenceTester,TCamera-0\nParent,Left,THub\n"
        "Device,Right,DemoCamera,DCam\nProperty,Core,Initialize,1\nProperty,Core,Camera,Left\n"
    )
    wanted = replace(WANTED, config=str(file), device="Right")
    with Grabber(lambda: MmcoreCamera.of(wanted), wanted) as grabber:
        assert frames_of(grabber, 2)[-1].image.shape == (48, 64)
    assert grabber.info.model == "DemoCamera DCam"


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        ({"config": "DemoCamera:Nothing"}, 'failed to instantiate device "Nothing"'),
        ({"config": "missing.cfg"}, "no such file; name a configuration file of Micro-Manager, or adapter:device"),
        ({"device": "Other"}, 'invalid value "Other"'),
        ({"width_px": 600}, "600 x 48"),
        ({"trigger": "Line1"}, "set the trigger in the configuration file"),
    ],
)
def test_what_micro_manager_refuses_is_one_line(change: dict[str, object], complaint: str) -> None:
    camera = MmcoreCamera.of(replace(WANTED, **change))  # type: ignore[arg-type]
    with pytest.raises(RigError) as raised:
        camera.open()
    camera.close()
    assert complaint in str(raised.value) and "\n" not in str(raised.value)
