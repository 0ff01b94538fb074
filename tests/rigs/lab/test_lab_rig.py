"""The rig of a lab: what it makes of a camera that comes and goes, and what it lets through to the coils."""

from __future__ import annotations

import sys
import threading
import time
from collections import deque
from collections.abc import Iterator
from dataclasses import replace
from itertools import islice
from pathlib import Path
from types import SimpleNamespace, TracebackType

import numpy as np
import pytest

from flowrec.core import Applied, Currents, FlowrecError, Measured, RigError, UsageError
from flowrec.physics import chip_files, load_chip
from flowrec.rigs import CameraInfo, Grabbed, Wanted, checked_images
from flowrec.rigs.lab.cameras.grabber import Grabber
from flowrec.rigs.lab.drive import BEAT_S
from flowrec.rigs.lab.rig import LabRig
from flowrec.stages import ResolvedConfig, Sight, assemble, load_config, look
from flowrec.stages.resolve import resolve
from flowrec.verbs.record import record
from tests.conftest import HANG_S, until
from tests.extras import why
from tests.stages.vision import shaky
from tests.twins.emulator import emulated, showing

SHAPE = (48, 64)
MEASURED = (
    "rig=lab",
    "camera.width_px=64",
    "camera.height_px=48",
    "camera.um_per_px=100.0",
    "camera.rate_hz=50.0",
    "robot.radius_um=70.0",
    "robot.max_speed_um_s=900.0",
    "robot.step_out_hz=40.0",
    "robot.delay_s=0.05",
)


class Paced:
    """A camera of 50 Hz that is absent while `gone` holds times in s since it was first opened."""

    def __init__(self, gone: tuple[float, float], info: CameraInfo) -> None:
        self.began_s, self.gone, self.info, self.number = 0.0, gone, info, 0

    def open(self) -> CameraInfo:
        self.began_s = self.began_s or time.monotonic()
        if self._absent():
            raise RigError("unplugged")
        return self.info

    def _absent(self) -> bool:
        return self.gone[0] <= time.monotonic() - self.began_s < self.gone[1]

    def grab(self, timeout_s: float) -> Grabbed | None:
        time.sleep(min(0.02, timeout_s))
        if self._absent():
            raise RigError("unplugged")
        self.number += 1
        image = np.full(SHAPE, self.number % 251, np.uint8)
        return Grabbed(image, 8, self.number, None, time.monotonic_ns())

    def alive(self) -> bool:
        return not self._absent()

    def discarded(self) -> int:
        return 0

    def trigger(self) -> None: ...

    def close(self) -> None: ...


class Noted:
    """Coils that note what they are asked for."""

    def __init__(self) -> None:
        self.calls: deque[str] = deque()
        self.beats: list[float] = []
        self.beats_before_rest = self.looked_at = 0
        self.latest: Measured | None = None
        self.field_ms: float | None = None

    def __enter__(self) -> Noted:
        self.calls.append("enter")
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.calls.append("exit")

    def beat(self) -> None:
        self.beats.append(time.monotonic())

    def apply(self, currents: Currents) -> None:
        self.calls.append(f"apply {currents.amplitude_mt:g}")

    def let_go(self) -> None:
        self.calls.append("let go")

    def rest(self) -> None:
        if "rest" not in self.calls:
            self.beats_before_rest = len(self.beats)
        self.calls.append("rest")

    def zero(self) -> None:
        self.calls.append("zero")

    def read_back(self) -> Measured | None:
        """Another measurement for every second frame."""
        if self.looked_at % 2 == 0:
            self.latest = Measured(time.monotonic_ns(), np.full(3, 0.1 * self.looked_at), np.zeros(3))
        return self.latest

    def applied_at(self, stamp_ns: int, before_ns: int | None) -> Applied:
        self.looked_at += 1
        lasted_s = 0.0 if before_ns is None else (stamp_ns - before_ns) / 1e9
        return Applied(stamp_ns, 2.0, 0.0, 4.0, np.zeros(3), [2.0 * lasted_s, 0.0])


def config_of(*sets: str) -> ResolvedConfig:
    config = load_config(None, [*MEASURED, *sets])
    return resolve(config, load_chip(config.chip))


def rig_of(config: ResolvedConfig, gone: tuple[float, float], duration_s: float | None) -> tuple[LabRig, Noted]:
    info = CameraInfo("Paced", "1", config.camera.width_px, config.camera.height_px, 8, 50.0, id_bits=64)
    camera, coils = Paced(gone, info), Noted()
    wanted = Wanted(width_px=64, height_px=48, rate_hz=50.0)
    return LabRig(lambda: Grabber(lambda: camera, wanted), coils, config, duration_s), coils  # type: ignore[arg-type, return-value]


FIELD = Currents(0, 2.0, 0.0, 4.0, 0.0, [0.0, 0.0, 1.0], False)


def driven(rig: LabRig) -> Iterator[tuple[object, list[str]]]:
    with rig.connected(), rig:
        for inputs in checked_images(rig.inputs(), SHAPE):
            before = len(rig.drive.calls)  # type: ignore[union-attr]
            rig.apply(FIELD)
            yield inputs, list(rig.drive.calls)[before:]  # type: ignore[union-attr]


def test_while_a_camera_is_absent_the_field_is_off_and_ticks_without_an_image_go_on_until_it_is_back() -> None:
    rig, coils = rig_of(config_of(), gone=(0.6, 1.8), duration_s=2.4)
    told: list[str] = []
    rig.tell = told.append
    seen = list(driven(rig))
    assert coils.calls[0] == "enter" and list(coils.calls)[-2:] == ["zero", "exit"]
    stamps = [inputs.stamp_ns for inputs, _ in seen]
    assert stamps[0] == 0 and all(np.diff(stamps) > 0)
    blind = [inputs.frame is None for inputs, _ in seen]
    first, last = blind.index(True), len(blind) - blind[::-1].index(True)
    assert all(blind[first:last]) and last < len(blind), "it goes on with images"
    assert all(inputs.applied.without_image and inputs.applied.repeats_image for inputs, _ in seen[first:last])
    assert all(calls == ["rest"] for _, calls in seen[first:last])
    assert all(calls == ["apply 4"] for _, calls in seen[:first] + seen[last:])
    assert not any(inputs.applied.without_image for inputs, _ in seen[last:])
    assert {inputs.applied.absent_until_ns for inputs, _ in seen[last:]} == {stamps[last - 1]}
    assert coils.calls.count("rest") > sum(blind), "at once, before the tick that tells it"
    assert coils.beats_before_rest >= 4, "the guardian hears the loop while it waits with a field on"
    assert max(np.diff(coils.beats)) < 1.0
    turns = sum(inputs.applied.turns[0] for inputs, _ in seen)
    assert turns == pytest.approx(2.0 * stamps[-1] / 1e9), "no turn is lost between frames"
    assert seen[-1][0].losses.reconnections == 1
    measured = [(inputs.stamp_ns, each) for inputs, _ in seen if (each := inputs.measured) is not None]
    assert 0 < len(measured) <= 0.5 * len(seen) + 1, "each measurement once"
    assert all(abs(each.stamp_ns - stamp_ns) < 1e9 for stamp_ns, each in measured), "on the clock of the session"
    off, back = (line for line in told if "clock" not in line)
    assert "the field is off until" in off and "back after" in back


class Shaken(Paced):
    """A camera over the drawn chip on a stage that shakes; the robot goes along the channel. It keeps its numbers."""

    def __init__(self, gone: tuple[float, float], info: CameraInfo) -> None:
        super().__init__(gone, info)
        self.number_of: dict[bytes, int] = {}  # by image

    def grab(self, timeout_s: float) -> Grabbed | None:
        grabbed = super().grab(timeout_s)
        assert grabbed is not None
        n = self.number
        picture = shaky.image(shaky.chip(), [(40.0 + 1.5 * n, 80.0)], shake_px(n), seed=n)
        self.number_of[picture.tobytes()] = n
        return replace(grabbed, image=picture)


def shake_px(number: int) -> tuple[float, float]:
    return 2.0 * float(np.sin(0.63 * number)), 1.4 * float(np.cos(0.63 * number))


def test_the_images_of_a_labs_camera_are_stabilised_unless_somebody_turns_it_off(tmp_path: Path) -> None:
    png, toml = chip_files(shaky.chip())
    (tmp_path / "chip.png").write_bytes(png)
    (tmp_path / "chip.toml").write_text(toml, encoding="utf-8")
    size = f"camera.width_px={shaky.WIDTH}", f"camera.height_px={shaky.HEIGHT}"
    config = config_of(
        *size, f"camera.um_per_px={shaky.UM_PER_PX}", "robot.radius_um=20", f"chip.path={tmp_path / 'chip.toml'}"
    )
    info = CameraInfo("Shaken", "1", shaky.WIDTH, shaky.HEIGHT, 8, 50.0, id_bits=64)
    wanted, pipeline = Wanted(shaky.WIDTH, shaky.HEIGHT, rate_hz=50.0), assemble(config, load_chip(config.chip))
    camera = Shaken((60.0, 61.0), info)
    rig = LabRig(lambda: Grabber(lambda: camera, wanted), Noted(), config, None)  # type: ignore[arg-type, return-value]
    sight, shifts, numbers = Sight(), [], []
    with rig.connected(), rig:
        for inputs in islice((each for each in rig.inputs() if each.frame is not None), 12):
            sight = look(pipeline, sight, inputs.frame)
            assert sight.shift is not None
            shifts.append(sight.shift.shift_px)
            numbers.append(camera.number_of[inputs.frame.image.tobytes()])
    true_px = np.array([shake_px(number) for number in numbers])
    assert np.abs(np.array(shifts) - (true_px - true_px[0])).max() < 0.15


def test_images_are_tried_before_a_run_without_a_word_to_the_coils_and_the_run_counts_from_its_own_first() -> None:
    rig, coils = rig_of(config_of(), gone=(60.0, 61.0), duration_s=0.3)
    with rig.connected():
        tried = [inputs for inputs, _ in zip(rig.tried(), range(4), strict=False)]
        assert [one.frame.index for one in tried if one.frame is not None] == [0, 1, 2, 3]
        assert list(coils.calls) == ["enter"] and not coils.beats and not coils.looked_at
        with rig:
            first = next(rig.inputs())
    assert first.stamp_ns == 0 and first.frame is not None and first.frame.index == 0


def test_a_picture_before_a_run_is_an_image_of_the_camera_and_tells_the_coils_nothing(tmp_path: Path) -> None:
    """Against pylon's emulator, which shows it in a circle with other images."""
    pytest.importorskip("pypylon", reason=why("pypylon"))
    shown = [np.random.default_rng(n).integers(0, 256, SHAPE).astype(np.uint8) for n in range(3)]
    sets = ("lab.camera=pylon", f'lab.device_config="{showing(tmp_path, shown)}"', "mission.phases=observe")
    config = config_of(*sets)
    chip = load_chip(config.chip)
    with emulated():
        rig = LabRig.of(assemble(config, chip), config, None, realtime=True)
        with rig.connected():
            picture = rig.picture()
            with rig:
                first = next(rig.inputs())
    assert any(np.array_equal(picture, image) for image in shown)
    assert first.stamp_ns == 0 and first.frame is not None and first.frame.index == 0, "it belongs to no run"


def test_images_that_were_dropped_before_the_run_are_no_losses_of_it() -> None:
    """ids = frames + link + incomplete + driver + backlog, from the first frame of the run on."""
    rig, _ = rig_of(config_of(), gone=(60.0, 61.0), duration_s=None)
    with rig.connected(), rig:
        grabber = rig._grabber
        assert grabber is not None
        until(lambda: grabber.backlog >= 3)
        first = next(rig.inputs())
    losses = first.losses
    assert losses is not None and losses.ids == 1
    counted = losses.frames + losses.link + losses.incomplete + losses.driver + losses.backlog
    assert counted == losses.ids, "what the queue dropped while the run was prepared is not among them"


def test_the_guardian_hears_the_loop_while_it_waits_for_the_first_frame() -> None:
    """A guardian that has ended by then ends the run before there is a field."""
    rig, coils = rig_of(config_of(), gone=(60.0, 61.0), duration_s=0.2)
    camera = rig._make_grabber()._make()  # type: ignore[attr-defined]
    grab, begun_s = camera.grab, time.monotonic()
    camera.grab = lambda timeout_s: grab(timeout_s) if time.monotonic() > begun_s + 0.5 else time.sleep(0.02)  # type: ignore[method-assign]
    driven_once = driven(rig)
    next(driven_once)
    assert len(coils.beats) >= 5 and not any(call.startswith("apply 4") for call in list(coils.calls)[:-1])
    driven_once.close()


def test_a_camera_that_stays_away_ends_the_run_with_the_coils_at_zero() -> None:
    rig, coils = rig_of(config_of("lab.give_up_s=0.5"), gone=(0.3, 60.0), duration_s=None)
    with pytest.raises(RigError, match=r"0\.5 s \(lab\.give_up_s\): unplugged"):
        list(driven(rig))
    assert list(coils.calls)[-2:] == ["zero", "exit"]


@pytest.mark.parametrize(
    ("sets", "told"),
    [
        (("camera.width_px=32",), "images of 64 x 48 pixels, where camera.width_px x camera.height_px = 32 x 48"),
        (("camera.bits=12",), r"images of 8 bit \(\), where camera.bits = 12"),
    ],
)
def test_a_camera_that_delivers_other_images_is_refused_before_the_coils_are_opened(
    sets: tuple[str, ...], told: str
) -> None:
    info = CameraInfo("Paced", "1", 64, 48, 8, 50.0)
    coils = Noted()
    make = lambda: Grabber(lambda: Paced((60.0, 61.0), info), Wanted(rate_hz=50.0))  # noqa: E731
    rig = LabRig(make, coils, config_of(*sets))  # type: ignore[arg-type]
    with pytest.raises(RigError, match=told), rig.connected():
        pass
    assert not coils.calls


@pytest.mark.parametrize(
    ("sets", "told"),
    [
        (("lab.camera=opencv", "lab.device=nowhere.avi"), "nowhere.avi"),
        (("lab.camera_timeout_s=0.6",), r"lab\.camera_timeout_s = 0\.6: must be .* less than safety\.guard_timeout_s"),
        (("lab.offset_x_px=4",), "lab.offset_x_px and lab.offset_y_px: set both"),
    ],
)
def test_a_lab_that_is_not_ready_is_one_line_and_leaves_no_file(
    sets: tuple[str, ...], told: str, tmp_path: Path
) -> None:
    with pytest.raises(FlowrecError, match=told) as caught:
        record(load_config(None, [*MEASURED, "lab.camera=opencv", *sets]), tmp_path / "s.mcap")
    assert "\n" not in str(caught.value)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("sets", "package", "module", "told"),
    [
        (("lab.camera=pylon",), "pypylon", "cameras.pylon", r"needs pypylon, .* pip install 'flowrec\[pylon\]'"),
        (("lab.camera=genicam",), "viva_genicam", "cameras.genicam", r"pip install 'flowrec\[genicam\]'"),
        (("lab.camera=opencv", "lab.amplifier=serial"), "serial", "amplifiers.serial_line", r"'flowrec\[serial\]'"),
        (("lab.camera=opencv", "lab.amplifier=ni"), "nidaqmx", "amplifiers.ni", r"'flowrec\[ni\]'"),
    ],
)
def test_a_package_that_is_not_installed_is_named_with_the_command(
    sets: tuple[str, ...], package: str, module: str, told: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setitem(sys.modules, package, None)
    monkeypatch.delitem(sys.modules, f"flowrec.rigs.lab.{module}", raising=False)
    with pytest.raises(UsageError, match=told):
        record(load_config(None, [*MEASURED, *sets]), tmp_path / "never.mcap")
    assert not list(tmp_path.iterdir())


def test_a_loop_that_waits_for_an_image_beats_at_once_when_the_field_is_to_rest() -> None:
    """With a wait as long as no run has: it does not end by itself."""

    class Blind(Paced):
        def grab(self, timeout_s: float) -> Grabbed | None:
            time.sleep(min(0.02, timeout_s))
            return None

    info, coils = CameraInfo("Blind", "1", 64, 48, 8, 50.0), Noted()
    make = lambda: Grabber(lambda: Blind((60.0, 61.0), info), Wanted(rate_hz=50.0))  # noqa: E731
    rig = LabRig(make, coils, config_of())  # type: ignore[arg-type]
    with rig.connected():
        grabber = rig._grabber
        assert grabber is not None
        waited: list[object] = []
        thread = threading.Thread(target=lambda: waited.append(grabber.next(10.0 * HANG_S)), daemon=True)
        thread.start()
        until(lambda: rig.rest() or waited)
        thread.join()
        assert waited == [None] and "let go" in coils.calls


def test_a_tick_without_an_image_comes_before_a_frame_whose_exposure_has_begun(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(time, "monotonic_ns", lambda: 10**10)
    config = SimpleNamespace(camera=SimpleNamespace(exposure_s=0.2), lab=SimpleNamespace(camera_delay_s=0.05))
    before_ns = 10**10 - LabRig._absent_ns(SimpleNamespace(_config=config), SimpleNamespace(stamp_ns=int))  # type: ignore[arg-type]
    # Of one that arrives within a beat the middle of the exposure was so long ago.
    assert before_ns >= 1e9 * (0.5 * 0.2 + 0.05 + BEAT_S)
