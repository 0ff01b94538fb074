"""Cameras of pypylon against pylon's own emulator."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from flowrec.core import RigError
from flowrec.rigs import Wanted
from flowrec.rigs.lab.cameras.grabber import Grabber
from tests.extras import why
from tests.rigs.lab.cameras.watching import adds_up, frames_of
from tests.twins.emulator import emulated, showing

pytest.importorskip("pypylon", reason=why("pypylon"))
from flowrec.rigs.lab.cameras.pylon import PylonCamera

WANTED = Wanted(width_px=64, height_px=48, rate_hz=100.0, exposure_s=0.002)


@pytest.fixture(autouse=True)
def one_camera() -> Iterator[None]:
    with emulated():
        yield


@pytest.mark.parametrize("bits", [8, 12])
def test_images_are_those_that_the_camera_is_given_bit_for_bit(bits: int, tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    shown = [rng.integers(0, 256, (48, 64)).astype(np.uint8) for _ in range(4)]
    wanted = replace(WANTED, config=str(showing(tmp_path, shown)), pixel_format=f"Mono{bits}")
    with Grabber(lambda: PylonCamera.of(wanted), wanted) as grabber:
        frames = frames_of(grabber, 9)
    assert [frame.index for frame in frames] == list(range(frames[0].index, frames[0].index + 9))
    for frame in frames:
        assert frame.bits == bits and frame.image.dtype == (np.uint8 if bits == 8 else np.uint16)
        # The emulator makes 12 bits of an image of 8 by a shift.
        assert np.array_equal(frame.image, shown[frame.index % 4].astype(frame.image.dtype) << (bits - 8))
    assert "no clock" in " ".join(grabber.notes)


def test_failed_buffers_of_the_camera_are_counted_and_not_handed_on() -> None:
    made: list[PylonCamera] = []

    def make() -> PylonCamera:
        made.append(PylonCamera.of(WANTED))
        return made[-1]

    with Grabber(make, WANTED) as grabber:
        before = frames_of(grabber, 3)[-1]
        made[0].device.ForceFailedBufferCount.Value = 5
        made[0].device.ForceFailedBuffer.Execute()
        after = frames_of(grabber, 20)
        statistics = made[0].device.GetStreamGrabberNodeMap().GetNode("Statistic_Failed_Buffer_Count").GetValue()
    assert before.losses.incomplete == 0
    assert after[-1].losses.incomplete == statistics == 5 and adds_up(after[-1].losses)
    assert after[-1].index == before.index + 25


def test_two_cameras_are_told_apart_by_their_serial_numbers_and_run_together() -> None:
    with emulated(2), ExitStack() as stack:
        with pytest.raises(RigError, match=r"lab\.device .*0000.*; .*0001"):
            PylonCamera.of(WANTED).open()
        each = [replace(WANTED, device=f"0815-000{n}", width_px=64 + 32 * n) for n in (0, 1)]
        grabbers = [stack.enter_context(Grabber(lambda one=one: PylonCamera.of(one), one)) for one in each]  # type: ignore[misc]
        shapes = [frames_of(grabber, 5)[-1].image.shape for grabber in grabbers]
    assert shapes == [(48, 64), (48, 96)]
    assert [grabber.info.serial for grabber in grabbers] == ["0815-0000", "0815-0001"]


def test_a_software_trigger_exposes_one_frame_each() -> None:
    wanted = replace(WANTED, trigger="software", rate_hz=25.0)
    before_ns = time.monotonic_ns()
    with Grabber(lambda: PylonCamera.of(wanted), wanted) as grabber:
        frames = frames_of(grabber, 6)
    assert [frame.index for frame in frames] == list(range(6))
    assert all(frame.arrival_ns > before_ns + 40_000_000 * frame.index for frame in frames)  # never before its time


def test_settings_are_read_back_and_differences_are_said() -> None:
    with Grabber(lambda: PylonCamera.of(replace(WANTED, gain=99.0, exposure_s=0.03)), WANTED) as grabber:
        info = grabber.info
    assert info.exposure_s == pytest.approx(0.03) and info.gain == pytest.approx(48.0)
    assert [note for note in info.notes if "gain" in note] == ["lab.gain = 99 asked, 48 reached"]


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        ({"pixel_format": "Mono14"}, "the camera has no Mono14; it has Mono8, Mono10, Mono12, Mono16"),
        ({"pixel_format": "RGB8"}, "lab.pixel_format = 'RGB8': must be one of Mono8"),
        (
            {"height_px": 9_999},
            "camera.height_px = 9999: the camera takes 1 to 4096 in steps of 1; the nearest is 4096",
        ),
        ({"trigger": "Line9"}, "lab.trigger = 'Line9': the camera has no such source of a trigger; it has Software"),
        ({"device": "nobody"}, "no camera matches lab.device = 'nobody'; found: Basler Emulation"),
        ({"config": "nowhere.pfs"}, "lab.device_config = nowhere.pfs: no such file"),
    ],
)
def test_what_the_camera_can_not_take_is_one_line(change: dict[str, object], complaint: str) -> None:
    camera = PylonCamera.of(replace(WANTED, **change))  # type: ignore[arg-type]
    with pytest.raises(RigError) as raised:
        camera.open()
    camera.close()
    assert complaint in str(raised.value) and "\n" not in str(raised.value)


def test_without_a_camera_it_says_so() -> None:
    with emulated(0), pytest.raises(RigError, match="pylon"):
        PylonCamera.of(WANTED).open()


def test_waiting_for_a_hardware_trigger_is_no_fault_and_ends_promptly() -> None:
    wanted = replace(WANTED, trigger="Line1")
    with Grabber(lambda: PylonCamera.of(wanted), wanted) as grabber:
        end_s = time.monotonic() + 1.0
        while time.monotonic() < end_s:
            assert grabber.next(0.1) is None and grabber.absent == ""
