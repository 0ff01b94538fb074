"""Cameras of viva-genicam against the fake camera of Aravis, and against viva's own where that shows what it sends."""

from __future__ import annotations

import re
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from flowrec.core import RigError
from flowrec.rigs import Grabbed, Wanted
from flowrec.rigs.lab.cameras.grabber import Grabber
from tests.conftest import until
from tests.extras import why
from tests.rigs.lab.cameras.watching import absent, adds_up, frames_of, frames_until, rest_of
from tests.twins.gige import (
    EXPOSURE_US,
    HEIGHT,
    MONO16,
    OFFSET_X,
    OFFSET_Y,
    PERIOD_US,
    PIXEL_FORMAT,
    WIDTH,
    Aravis,
    installed,
    port,
    register,
)

vg = pytest.importorskip("viva_genicam", reason=why("viva_genicam"))
from viva_genicam.testing import FakeGigeCamera, FakeU3vCamera  # noqa: E402

from flowrec.rigs.lab.cameras.genicam import GenicamCamera  # noqa: E402

aravis = pytest.mark.skipif(not installed, reason="needs aravis-tools")
WANTED = Wanted(width_px=128, height_px=96, rate_hz=100.0, exposure_s=0.002, gain=3.0)


class Watched(GenicamCamera):
    """Keeps what the library counts, after every call: it may be asked in the thread of the camera only."""

    stats: Any = None

    def grab(self, timeout_s: float) -> Grabbed | None:
        grabbed = super().grab(timeout_s)
        assert self._stream is not None
        self.stats = self._stream.stats()
        return grabbed


@contextmanager
def grabbing(wanted: Wanted = WANTED) -> Iterator[tuple[Grabber, list[Watched]]]:
    """A grabber, and the drivers it has made."""
    made: list[Watched] = []

    def make() -> Watched:
        made.append(Watched(wanted))
        return made[-1]

    with Grabber(make, wanted) as grabber:
        yield grabber, made


@pytest.fixture
def port_3956() -> Iterator[None]:
    with port():
        yield


@aravis
@pytest.mark.parametrize("lost_packets", [0, 50])
def test_what_aravis_sends_is_handed_on_or_counted_and_the_library_counts_the_same(
    port_3956: None, lost_packets: int
) -> None:
    # 512 x 512 pixels are several packets, of which 5 % are lost.
    wanted = replace(WANTED, width_px=512, height_px=512)
    with Aravis(lost_packets) as camera, grabbing(wanted) as (grabber, (driver,)):
        frames_of(grabber, 40)
        camera.freeze()  # nothing is on its way any more

        def all_handed_on() -> bool:
            rest_of(grabber)
            assert grabber.losses is not None
            return bool(driver.stats.frames_complete == grabber.losses.frames + grabber.losses.backlog)

        until(all_handed_on)
        losses, stats = grabber.losses, driver.stats
        camera.thaw()
    assert losses is not None and adds_up(losses)
    assert (losses.incomplete > 0) == (lost_packets > 0)
    # After the last whole frame there may be incomplete ones, which no frame reports.
    assert 0 <= stats.frames_incomplete - losses.incomplete <= 5
    assert stats.frames_backpressure == losses.driver


@aravis
@pytest.mark.parametrize(
    "kill",
    [
        pytest.param(True, marks=pytest.mark.slow("loses a camera in the other way"), id="killed"),
        pytest.param(False, id="cable pulled"),
    ],
)
def test_an_unplugged_camera_is_recognised_and_resumed(port_3956: None, kill: bool) -> None:
    with Aravis() as camera, grabbing() as (grabber, _):
        before = frames_of(grabber, 5)[-1]
        if kill:
            camera.unplug()
        else:
            camera.freeze()
        assert re.search(r"no frame for \d", absent(grabber))
        assert len(rest_of(grabber)) < 9 and grabber.absent
        if kill:
            camera.plug_in()
        else:
            camera.thaw()
        after = frames_of(grabber, 5)
        assert grabber.absent == ""
    assert after[0].index > before.index and after[0].stamp_ns > before.stamp_ns
    assert after[-1].losses.reconnections == 1 and adds_up(after[-1].losses)


@aravis
def test_what_is_asked_is_what_the_registers_of_aravis_hold(port_3956: None) -> None:
    with Aravis() as _, grabbing(replace(WANTED, offset_px=(64, 32), pixel_format="Mono16")) as (grabber, _made):
        (frame,) = frames_of(grabber, 1)
        told = [register(at) for at in (WIDTH, HEIGHT, OFFSET_X, OFFSET_Y, PIXEL_FORMAT, EXPOSURE_US, PERIOD_US)]
    assert told == [128, 96, 64, 32, MONO16, 2_000, 10_000]
    assert frame.image.dtype == np.uint16 and frame.image.shape == (96, 128) and frame.bits == 16
    assert grabber.info.gain == 3.0 and grabber.info.serial == "T1" and grabber.notes == ()


@aravis
def test_a_camera_that_another_program_controls_is_busy(port_3956: None) -> None:
    with Aravis(), grabbing() as (grabber, _):
        frames_of(grabber, 1)
        with pytest.raises(RigError, match=r"Aravis Fake T1 127\.0\.0\.1 is busy"):
            GenicamCamera.of(WANTED).open()
        assert len(frames_of(grabber, 20)) == 20  # the one that has it is not disturbed


@aravis
def test_which_cameras_there_are_is_said(port_3956: None) -> None:
    with pytest.raises(RigError, match="no camera found"):
        GenicamCamera.of(WANTED).open()
    with Aravis():
        for wrong, told in (
            ({"device": "XY"}, r"lab\.device = 'XY'.* Aravis Fake T1 127\.0\.0\.1"),
            ({"width_px": 4000}, r"camera\.width_px = 4000: .* 2048"),
            ({"pixel_format": "Mono12"}, r"Mono12.* Mono8, Mono16"),
        ):
            with pytest.raises(RigError, match=told):
                GenicamCamera.of(replace(WANTED, **wrong)).open()


def test_blocks_that_lost_packets_are_known_by_their_ids(port_3956: None) -> None:
    dropped = {3, 5, 9}
    fake = FakeGigeCamera(128, 96, 100, packet_resend=False, drop_packets=[(block, 1) for block in dropped])
    with fake, grabbing() as (grabber, _):
        frames = frames_until(grabber, lambda frames: bool(frames) and frames[-1].index >= 20)
    assert [frame.index + 1 for frame in frames][:17] == [n for n in range(1, 21) if n not in dropped]
    assert frames[-1].losses.incomplete == 3 and adds_up(frames[-1].losses)


def test_a_software_trigger_exposes_one_frame_each(port_3956: None) -> None:
    with FakeGigeCamera(128, 96, 100) as fake:
        before_ns = time.monotonic_ns()
        with grabbing(replace(WANTED, rate_hz=20.0, trigger="software")) as (grabber, _):
            frames = frames_of(grabber, 8)
        assert fake.software_triggers() >= 8
    # Not at the 100 Hz of a camera that runs freely.
    assert all(frame.arrival_ns > before_ns + 50_000_000 * frame.index for frame in frames)
    assert frames[-1].losses.triggers == 0


@pytest.mark.parametrize("bits", [8, 12])
def test_a_usb3_camera_counts_from_zero_and_packed_pixels_are_unpacked(bits: int) -> None:
    fake = FakeU3vCamera(64, 48, {8: "Mono8", 12: "Mono12p"}[bits])
    camera = GenicamCamera.of(replace(WANTED, width_px=64, height_px=48, pixel_format=f"Mono{bits}", gain=None))
    try:
        info = camera.use(fake.connect(), "U3V")
        grabbed = [camera.grab(2.0) for _ in range(3)]
    finally:
        camera.close()
    assert [one.block_id for one in grabbed if one is not None] == [0, 1, 2]
    assert (info.id_bits, info.bits, info.ticks_per_s) == (64, bits, 1e9)
    for one in grabbed:
        assert one is not None and one.image is not None and one.image.shape == (48, 64)
        assert one.image.dtype == (np.uint8 if bits == 8 else np.uint16) and one.image.max() < 1 << bits
    assert not fake.acquiring()


@pytest.mark.parametrize("name", ["Mono10p", "Mono12p", "Mono12Packed", "Mono10Packed"])
def test_both_libraries_unpack_as_the_standard_says(name: str) -> None:
    warn = pytest.importorskip("flowrec.rigs.lab.cameras.pylon")
    bits, packed = int(name[4:6]), name.endswith("Packed")
    values = np.random.default_rng(bits).integers(0, 1 << bits, (48, 64)).astype(np.uint16)
    if packed:  # GigE Vision: two pixels in three bytes, the low bits of both in the middle one
        a, b, low = values.reshape(-1, 2)[:, 0], values.reshape(-1, 2)[:, 1], bits - 8
        middle = (a & ((1 << low) - 1)) | (b & ((1 << low) - 1)) << 4
        raw = np.stack([a >> low, middle, b >> low], axis=1).astype(np.uint8).tobytes()
    else:  # PFNC: the bits of all pixels in a row, the lowest first
        ones = (values.reshape(-1, 1) >> np.arange(bits)) & 1
        raw = np.packbits(ones.astype(np.uint8).ravel(), bitorder="little").tobytes()
    assert np.array_equal(vg.Frame.from_bytes(raw, 64, 48, name).to_numpy(), values)
    pylon = warn.pylon
    kind = getattr(pylon, f"PixelType_{name.replace('Packed', 'packed')}")
    image = pylon.PylonImage()
    image.AttachMemoryView(memoryview(bytearray(raw)), kind, 64, 48, 0)
    assert np.array_equal(image.GetArray(), values)
