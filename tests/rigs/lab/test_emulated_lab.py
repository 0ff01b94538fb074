"""`flowrec emulate lab`: a closed loop on this computer, with what flowrec brings, a compiler and pyserial."""

from __future__ import annotations

import json
import math
import re
import signal
import subprocess
import sys
import threading
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from flowrec.core import Currents, RigError, Tick, Timing
from flowrec.measure.calibrate_motion import calibrate_motion
from flowrec.rigs import CommandLimits, EmulatedCamera, Wanted, compiled_firmware
from flowrec.rigs.emulated import coils as emulated_coils
from flowrec.rigs.emulated.coils import OutputSamples, sample
from flowrec.rigs.emulated.world import Rolled
from flowrec.rigs.lab.amplifiers.amplifier import AmplifierInfo
from flowrec.rigs.lab.cameras.opencv import OpencvCamera
from flowrec.rigs.lab.drive import Drive
from flowrec.stages import Coils, FieldCommand, FieldLog, RunStatistics
from flowrec.stages.run_figures import chain_ms
from flowrec.store import Session
from flowrec.verbs import replay_session
from tests.conftest import needs_quiet, run, until
from tests.perf.guardian_trial import COILS, OUTPUT, ROBOT, currents
from tests.short_missions import set_words
from tests.twins.coils import needs_compiler
from tests.twins.lab import PATIENT

SIZE = {"width_px": 64, "height_px": 48, "rate_hz": 40.0}


def shown(number: int) -> np.ndarray:
    """An image that tells its number, with every grey level in it."""
    image = (np.arange(64 * 48, dtype=np.int64).reshape(48, 64) * 7 + number) % 256
    return image.astype(np.uint8)


def test_the_images_of_the_emulated_camera_arrive_whole_and_in_order_again_after_a_reconnection() -> None:
    over = threading.Event()
    with EmulatedCamera(**SIZE) as camera:

        def show() -> None:
            number = 0
            while not over.wait(0.025):
                camera(shown(number))
                number += 1

        thread = threading.Thread(target=show)
        thread.start()
        try:
            for _ in range(2):
                driver = OpencvCamera(Wanted(device=camera.url, **SIZE))
                info = driver.open()
                assert (info.width_px, info.height_px, info.bits, info.notes) == (64, 48, 8, ())
                assert info.rate_hz == pytest.approx(40.0)
                images = [driver.grab(1.0) for _ in range(20)]
                driver.close()
                numbers = [int(each.image[0, 0]) for each in images]
                assert numbers == list(range(numbers[0], numbers[0] + 20))
                assert all(np.array_equal(each.image, shown(n)) for each, n in zip(images, numbers, strict=True))
        finally:
            over.set()
            thread.join()


def test_the_emulated_robot_rolls_with_the_field_that_was_put_out_and_is_let_go_without_one(tmp_path: Path) -> None:
    """Three turns a second at a heading of 30 degrees: B = z cos(theta) + h sin(theta)."""
    at_s = np.arange(0.0, 2.0, 1e-3)
    theta, heading = 2.0 * math.pi * 3.0 * at_s, math.radians(30.0)
    field_mt = 4.0 * np.stack([np.sin(theta) * np.cos(heading), np.sin(theta) * np.sin(heading), np.cos(theta)], axis=1)
    rows = np.zeros(len(at_s) + 1, sample())
    rows["at_ns"] = np.append(np.rint(at_s * 1e9), 2_000_000_000)
    rows["coils"][:-1] = field_mt @ np.linalg.inv(np.array(Coils().mt_per_a)).T
    file = tmp_path / "outputs"
    file.write_bytes(b"")
    rolled = Rolled(OutputSamples(file, 1.0), np.array(Coils().mt_per_a))
    file.write_bytes(rows[:1500].tobytes())
    rolled.take()
    assert rolled.energised and rolled.off_s(1_500_000_000) == 0.0
    with file.open("ab") as more:
        more.write(rows[1500:].tobytes())
    rolled.take()
    begin, end = rolled.until(np.array([1_200_000_000, 1_700_000_000]))
    assert end - begin == pytest.approx(1.5 * np.array([math.cos(heading), math.sin(heading)]), abs=2e-3)
    assert rolled.off_s(5_000_000_000) == pytest.approx(3.0)


def test_without_a_compiler_one_line_says_what_to_install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(emulated_coils, "compiler", lambda: None)
    with pytest.raises(RigError, match=r"apt install g\+\+"):
        compiled_firmware(tmp_path)


@dataclass
class Late:
    """An amplifier whose field follows each command after a time."""

    late_s: float
    log: FieldLog = field(default_factory=FieldLog)

    def open(self) -> AmplifierInfo:
        return AmplifierInfo("late", "", math.inf, math.inf, math.inf, self.late_s, 1.0)

    def guard(self) -> tuple[tuple[str, ...], tuple[int, ...]]:
        return (), ()

    def arm(self) -> None:
        pass

    def apply(self, command: FieldCommand) -> None:
        at_ns = time.monotonic_ns() + round(1e9 * self.late_s)
        self.log.append(at_ns, command.frequency_hz, command.heading_rad, command.amplitude_mt)

    def put_out(self, _until_ns: int) -> FieldLog:
        return self.log

    def zero(self) -> None:
        pass

    def close(self) -> None:
        pass


class NoGuardian:
    """Stands where the guardian process would."""

    def __init__(self, *_words: Any, **_settings: Any) -> None:
        pass

    def __enter__(self) -> NoGuardian:
        return self

    def __exit__(self, *_error: object) -> None:
        pass

    def beat(self, *, energised: bool) -> None:
        pass


@pytest.mark.parametrize("late_ms", [2.0, 60.0])
def test_the_time_from_a_command_to_its_field_is_that_of_the_amplifier(late_ms: float) -> None:
    """With commands that come faster than their fields: each is found by its frequency."""
    found: list[float | None] = []
    limits = CommandLimits(COILS, ROBOT, OUTPUT)
    with Drive(Late(1e-3 * late_ms), limits, 1.0, 5.0, guardian=NoGuardian) as drive:  # type: ignore[arg-type]
        before_ns = None
        assert drive.field_ms is None
        for number in range(40):
            command: Currents = currents(3.0 * 1.08 ** (5 * number % 12), 0.1 * number)
            drive.apply(command)
            now_ns = time.monotonic_ns()
            drive.applied_at(now_ns, before_ns)
            before_ns = now_ns
            found.append(drive.field_ms)
            time.sleep(0.01)
    known = np.array([each for each in found if each is not None])
    assert len(known) > 20
    assert np.quantile(known, (0.2, 0.8)) == pytest.approx([late_ms] * 2, abs=1.0)


def test_the_chain_of_latency_is_the_sum_of_its_stages_and_is_told_with_median_and_95_percent() -> None:
    statistics, rng = RunStatistics(), np.random.default_rng(1)
    for number in range(400):
        track_ms = 1.0 + float(rng.uniform(0.0, 1.0))
        control = {"observe_ms": 0.5, "control_ms": 1.25, "apply_ms": 0.25}
        delays = {"arrival_ms": 10.0, "wait_ms": 2.0, "field_ms": None if number < 10 else 40.0}
        timing = Timing(
            number, track_ms, sinks_ms=0.0, total_ms=0.0, queue_mb=0.0, dropped_frames=0, **control, **delays
        )
        statistics.write(Tick(stamp_ns=number, timing=timing))
    assert chain_ms(timing) == pytest.approx(
        np.array([0, 2 + track_ms, 3.5 + track_ms, 3.75 + track_ms, 43.75 + track_ms]) + 10
    )
    assert statistics.latency is not None
    stages = dict(re.findall(r"([a-z ]+) ([\d.]+ \([\d.]+\))", statistics.latency.replace(", ", ",")))
    assert stages["arrived"] == "10.0 (10.0)"
    assert stages["tracked"] in ("13.5 (13.9)", "13.5 (14.0)", "13.5 (13.8)")
    assert float(stages["field"].split()[0]) == pytest.approx(55.25, abs=0.1)
    assert RunStatistics().latency is None, "a rig that does not tell has none"


@needs_compiler
@needs_quiet
def test_the_command_starts_devices_that_the_doctor_finds_ready_and_ends_them_with_ctrl_c(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "lab.toml"
    command = [sys.executable, "-m", "flowrec", "emulate", "lab", "-o", str(file), "--set", "recording.admission_s=0"]
    with subprocess.Popen(command, stderr=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        try:
            until(lambda: file.exists() or process.poll() is not None)
            assert process.poll() is None
            status = run(["doctor", file, "--json"])
            findings = json.loads(capsys.readouterr().out)["findings"]
        finally:
            process.send_signal(signal.SIGINT)
            said = "".join(process.communicate(timeout=60.0))
    assert status == 0, findings
    texts = {each["what"]: each["text"] for each in findings if each["level"] == "ok"}
    assert "320 x 256 pixels" in texts["camera"] and "0.3 s" in texts["amplifier"]
    assert process.returncode == 130 and "Traceback" not in said
    assert f"flowrec record {file}" in said
    assert not file.exists()


@needs_compiler
@needs_quiet
@pytest.mark.slow("flies a mission in real time")
def test_a_mission_on_the_emulated_lab_arrives_states_its_latency_and_gives_back_the_delay_of_the_camera(
    tmp_path: Path,
) -> None:
    session, delay_s = tmp_path / "s.mcap", 0.03
    command = [
        sys.executable,
        "-m",
        "flowrec",
        "emulate",
        "lab",
        "-o",
        str(tmp_path / "lab.toml"),
        "--fly",
        str(session),
    ]
    command += ["--camera-delay-ms", str(1e3 * delay_s), "--set", "refine.method=gain", *set_words(PATIENT)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=400.0, check=False)
    said = done.stdout + done.stderr
    assert done.returncode in (0, 3), said[-2000:]
    assert "latency" in said
    again = subprocess.run(command, capture_output=True, text=True, timeout=400.0, check=False)
    assert again.returncode == 2 and "latency" not in again.stdout, "nothing was flown"
    with Session(session) as recorded:
        outcome = recorded.outcome
        assert outcome["outcome"] == "reached"
        chain = np.array([chain_ms(each) for each in recorded.messages("timing")])
    assert "field" in outcome["latency"]
    middle = np.nanmedian(chain, axis=0)
    assert (np.diff(middle) > 0.0).all(), "each stage comes after that before it"
    assert replay_session(session, verify=True).same
    found = calibrate_motion(session)
    assert found.camera_delay_s is not None
    delay, error = found.camera_delay_s
    assert error < 0.006
    # The stream itself takes up to a millisecond on the loopback, and more on a busy computer.
    assert delay == pytest.approx(delay_s + 5e-4, abs=3.0 * error + 3e-3)
    # Stamps are late by the delay of the camera, which the chain does not know as long as no setting states it.
    expected_s = delay_s + 1e-3 * middle[-1]
    assert found.sets["robot.delay_s"] == pytest.approx(expected_s, abs=0.008)
