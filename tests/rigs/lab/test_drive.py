"""The coils of a lab on twins: the log is what was put out, and whatever happens to the recorder they go to zero."""

from __future__ import annotations

import contextlib
import math
import os
import signal
import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from multiprocessing import Pipe
from multiprocessing.connection import Connection
from pathlib import Path

import numpy as np
import pytest

from flowrec.core import FlowrecError, RigError
from flowrec.rigs import CommandLimits, Guardian
from flowrec.rigs.lab.drive import Drive
from flowrec.stages import FieldCommand, OutputLimits
from tests.conftest import feeds_an_output, needs_quiet, until
from tests.extras import why
from tests.perf.guardian import sleeper, trial
from tests.perf.guardian_trial import COILS, OUTPUT, ROBOT, SIX_COILS, amplifier, coils_of, currents
from tests.twins.coils import Device, channels, device

pytestmark = [needs_quiet, feeds_an_output]

SLACK_S = 0.25  # of a busy machine, besides the delay of a sleep that is measured meanwhile


@pytest.fixture(scope="module")
def serial(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Device]:
    """The firmware without its own timer: what goes to zero does so by the guardian."""
    with device("serial", tmp_path_factory.mktemp("serial")) as on:
        yield on


@pytest.fixture(scope="module")
def ni(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Device]:
    pytest.importorskip("nidaqmx", reason=why("nidaqmx"))
    with device("ni", tmp_path_factory.mktemp("ni")) as on:
        yield on


@pytest.fixture(scope="module")
def serial_of_six(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Device]:
    with device("serial", tmp_path_factory.mktemp("serial6"), coils=6) as on:
        yield on


@pytest.fixture(scope="module")
def ni_of_six(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Device]:
    pytest.importorskip("nidaqmx", reason=why("nidaqmx"))
    with device("ni", tmp_path_factory.mktemp("ni6"), coils=6) as on:
        yield on


@pytest.fixture(params=["serial", "ni", "serial_of_six", "ni_of_six"])
def on(request: pytest.FixtureRequest) -> Device:
    found: Device = request.getfixturevalue(request.param)
    return found


@contextlib.contextmanager
def driven(on: Device, seconds: float = 0.0) -> Iterator[tuple[Drive, int, int]]:
    """A drive after so many seconds of commands, and the times of its first and last command."""
    coils = coils_of(on.coils)
    with Drive(amplifier(on.kind, on.address, 5.0, coils), CommandLimits(coils, ROBOT, OUTPUT), 1.0, 5.0) as drive:
        begin_ns, number = time.monotonic_ns(), 0
        while time.monotonic_ns() < begin_ns + seconds * 1e9:
            drive.apply(currents(8.0 + 6.0 * math.sin(0.05 * number), 0.03 * number))
            number += 1
            time.sleep(0.015)
        yield drive, begin_ns, time.monotonic_ns()


def test_the_turns_that_are_logged_are_those_of_the_field_that_was_put_out(on: Device) -> None:
    """The judge integrates the rotation of the field from the outputs alone."""
    begin = on.end()
    with driven(on, 2.0) as (drive, begin_ns, _):
        drive.apply(currents(8.0, 1.0))
        now_ns = time.monotonic_ns() - 300_000_000
        full_ns = begin_ns + 600_000_000  # after the ramp and the latency: the bias compensation is complete
        found = drive.put_out(time.monotonic_ns()).turns(full_ns, now_ns)
    times, outputs = on.outputs(begin)
    coils = coils_of(on.coils)
    assert np.abs(outputs).max() <= coils.max_current_a * 1.00001, "also on the ways up and down"
    kept = (times >= full_ns) & (times <= now_ns)
    field = outputs[kept] @ np.array(coils.mt_per_a).T + np.array(coils.bias_mt)
    np.testing.assert_allclose(np.linalg.norm(field, axis=1), coils.full_mt(ROBOT), rtol=0.005)
    # The horizontal heading h of a roller: z turns towards h, so z x h is the axis, and b x db its direction.
    b = field / np.linalg.norm(field, axis=1)[:, None]
    axis = np.cross(b[:-1], b[1:]).sum(axis=0) / (2 * math.pi)
    wanted = np.array([axis[1], -axis[0]])
    assert np.hypot(*wanted) > 5.0
    assert np.hypot(*(found - wanted)) < 0.5


def test_a_recorder_that_is_killed_stopped_or_stuck_has_no_field_within_the_timer(on: Device) -> None:
    faults = ["kill"] * 3 + ["stop", "hang"] if on.kind == "serial" else ["kill", "stop"]
    with sleeper() as delays:
        ended = [(fault, trial(on, fault)) for fault in faults]
    for fault, one in ended:
        assert one is not None and one.off_s is not None, fault
        assert one.off_s < 0.1 + max(delays) + SLACK_S, fault
        assert one.stayed_off, fault
        # Two timers of the same length watch the loop, the guardian's and that of NI's process: either comes first.
        timers = ("guardian has switched the coils off: no beat", "no order of the loop for 100 ms")
        assert any(timer in one.said for timer in timers[: 1 if on.kind == "serial" else 2]) or fault != "stop"


def commanded(drive: Drive) -> None:
    """A second of commands."""
    for _ in range(100):
        drive.apply(currents(5.0, 0.0))
        time.sleep(0.01)


def test_a_recorder_whose_guardian_is_killed_takes_the_field_away_itself(on: Device) -> None:
    begin = on.end()
    with driven(on, 0.4) as (drive, begin_ns, _):
        assert drive._guardian is not None and drive._guardian._process is not None
        drive._guardian._process.kill()
        with pytest.raises(RigError, match="guardian"):
            commanded(drive)
        assert on.energised(begin) and on.off_ns(begin_ns, begin) is not None, "at once, not at the end of the run"


def test_a_loop_that_only_waits_stops_to_beat(serial: Device) -> None:
    begin = serial.end()
    limits = CommandLimits(COILS, ROBOT, OUTPUT)
    with Drive(amplifier("serial", serial.address), limits, 0.1, 0.3) as drive:
        drive.apply(currents(5.0, 0.0))
        begin_s = time.monotonic()
        while time.monotonic() < begin_s + 1.0:
            drive.beat()
            time.sleep(0.01)
        with pytest.raises(RigError, match="100 ms"):
            drive.apply(currents(5.0, 0.0))
    assert serial.off_ns(0, begin) is not None


def test_a_board_that_has_gone_to_zero_by_itself_ends_the_run(tmp_path: Path) -> None:
    with (
        device("serial+timer", tmp_path) as on,
        Drive(amplifier("serial", on.address), CommandLimits(COILS, ROBOT, OUTPUT), 5.0, 5.0) as drive,
    ):
        drive.apply(currents(5.0, 0.0))
        until(on.energised)
        time.sleep(0.3)
        with pytest.raises(RigError, match="by itself"):
            commanded(drive)
        assert on.off_ns(0) is not None


@pytest.mark.parametrize(
    ("kind", "named", "atol_a"),
    # The inputs of the NI twin are read from another process, between two questions for the time.
    [("serial+sensors", "flowrec-coils", 1e-4), ("ni", "NI 9263", 0.25)],
)
def test_a_coil_that_has_half_of_its_current_is_noticed_by_its_sensor_and_ends_in_zero(
    kind: str, named: str, atol_a: float, tmp_path: Path
) -> None:
    checked = OutputLimits(measured_within_a=0.3, measured_after_s=0.05)
    fault = tmp_path / "fault"
    if kind == "ni":
        pytest.importorskip("nidaqmx", reason=why("nidaqmx"))
    with (
        device(kind, tmp_path) as on,
        Drive(
            amplifier(on.kind, on.address, 1.0, sensors=True), CommandLimits(COILS, ROBOT, checked), 1.0, 5.0
        ) as drive,
    ):
        assert drive.info.measures
        for _ in range(60):
            drive.apply(currents(8.0, 0.0))
            time.sleep(0.015)
        measured = drive.read_back()
        assert measured is not None and np.abs(measured.currents_a).max() > 1.0
        np.testing.assert_allclose(measured.currents_a, measured.put_out_a, atol=atol_a)
        fault.touch()
        begin_ns = time.monotonic_ns()
        with pytest.raises(RigError, match=rf"{named}: coil x .* A .* A .*\d+ ms"):
            commanded(drive)
        assert time.monotonic_ns() - begin_ns < 1e9
        off_ns = on.off_ns(begin_ns)
        assert off_ns is not None and (off_ns - begin_ns) * 1e-9 < 0.2 + SLACK_S
        drive.apply(currents(8.0, 0.0))
        time.sleep(0.05)
        assert on.off_ns(begin_ns) == off_ns


def test_zero_lets_no_later_command_bring_the_field_back(on: Device) -> None:
    begin = on.end()
    with driven(on, 0.4) as (drive, begin_ns, _):
        drive.zero()
        off_ns = on.off_ns(begin_ns, begin)
        for _ in range(20):
            drive.apply(currents(5.0, 0.0))
            drive.beat()
            time.sleep(0.01)
        if on.kind == "serial":  # not by the amplifier's memory alone
            drive._amplifier._permitted = True  # type: ignore[attr-defined]
            for _ in range(10):
                drive.apply(currents(5.0, 0.0))
                time.sleep(0.01)
        drive.zero()
        log = drive.put_out(time.monotonic_ns())
        assert log.at(time.monotonic_ns()).amplitude_mt == 0.0 and log.at(begin_ns + 390_000_000).amplitude_mt > 3.0
    assert off_ns is not None and on.off_ns(begin_ns, begin) == off_ns


def test_a_hand_that_lets_go_has_no_field_after_the_next_beat_until_the_next_command(on: Device) -> None:
    begin = on.end()
    with driven(on, 0.4) as (drive, begin_ns, _):
        drive.let_go()
        let_go_ns = time.monotonic_ns()
        for _ in range(20):
            drive.beat()
            time.sleep(0.01)
        off_ns = on.off_ns(begin_ns, begin)
        assert off_ns is not None, "the outputs are at zero while the loop waits"
        assert 1e-9 * (off_ns - let_go_ns) < drive._limits.off_s + drive.info.latency_s + SLACK_S
        again = on.end()
        commanded(drive)
        assert on.energised(again)


def test_an_ni_output_that_runs_dry_is_counted_and_ends_in_zero(ni: Device) -> None:
    begin = ni.end()
    with driven(ni, 0.4) as (drive, begin_ns, _):
        process = drive._amplifier._process  # type: ignore[attr-defined]
        process.send_signal(signal.SIGSTOP)
        time.sleep(0.3)
        process.send_signal(signal.SIGCONT)
        until(lambda: drive._amplifier._hear() or "ran dry" in drive._amplifier._fault)  # type: ignore[attr-defined]
        with pytest.raises(RigError, match="ran dry"):
            drive.beat()
    assert ni.off_ns(begin_ns, begin) is not None


@contextlib.contextmanager
def obeying(on: Device, monkeypatch: pytest.MonkeyPatch, silence_s: float) -> Iterator[Connection]:
    """The process of the NI output as a thread, with a field on; yields the recorder's end of its connection."""
    from flowrec.rigs.lab.amplifiers import ni_process

    monkeypatch.setattr(ni_process, "prioritise_process", lambda _priority: None)
    ours, theirs = Pipe()
    zero, done = os.pipe(), os.pipe()
    thread = threading.Thread(target=ni_process.Server(theirs, zero[0], done[1]).serve)
    thread.start()
    begin = on.end()
    try:
        ours.send(("open", ni_process.NiSettings(channels(COILS.count), on.address, COILS, ROBOT, OUTPUT, silence_s)))
        assert ours.recv()[0] == "info"
        ours.send(("arm",))
        assert ours.recv()[0] == "armed"
        ours.send(("command", FieldCommand(5.0, 0.0, 4.0, 20.0, 20.0)))
        until(lambda: on.energised(begin))
        yield ours
    finally:
        ours.close()
        thread.join(5.0)
        theirs.close()
        for end in (*zero, *done):
            os.close(end)


def test_an_ni_output_whose_recorder_falls_silent_or_ends_goes_to_zero_without_a_guardian(
    ni: Device, monkeypatch: pytest.MonkeyPatch
) -> None:
    begin = ni.end()
    with obeying(ni, monkeypatch, silence_s=0.6) as recorder:
        reports = []
        while not reports or reports[-1][0] == "block":
            assert recorder.poll(10.0) and len(reports) < 100, "the field stays on"
            reports.append(recorder.recv())
        assert reports[-1] == ("fault", "no order of the loop for 600 ms")
        assert ni.off_ns(0, begin) is not None
    with obeying(ni, monkeypatch, silence_s=60.0):
        pass
    assert ni.off_ns(0, begin) is not None, "the connection has ended"


def test_a_guardian_that_can_not_act_does_not_start() -> None:
    read, write = os.pipe()
    os.close(read)
    with pytest.raises(RigError, match="zero failed"):
        Guardian(("serial", str(write)), (write,)).__enter__()
    os.close(write)


def test_what_is_wrong_with_an_amplifier_is_one_line_and_nothing_is_energised(
    serial: Device, ni: Device, tmp_path: Path
) -> None:
    begins = {one: one.end() for one in (serial, ni)}
    master, slave = os.openpty()
    strong = replace(COILS, max_current_a=7.0)
    cases = [
        (amplifier("serial", ""), COILS, "lab.serial.port: which serial port"),
        (amplifier("serial", str(tmp_path / "ttyNone")), COILS, "ports here"),
        (amplifier("serial", serial.address), strong, "coils.max_current_a = 7 A: flowrec-coils makes at most 5 A"),
        (amplifier("ni", "127.0.0.1:1"), COILS, "no NI gRPC Device Server"),
        (amplifier("serial", serial.address, coils=SIX_COILS), SIX_COILS, "drives 3 coils, where coils.mt_per_a has 6"),
        (amplifier("ni", ni.address, coils=SIX_COILS), SIX_COILS, "the device has no such channel"),
    ]
    for given, coils, words in cases:
        with (
            pytest.raises(FlowrecError) as refused,
            Drive(given, CommandLimits(coils, ROBOT, OutputLimits()), 0.1, 1.0),
        ):
            pytest.fail("it opened")
        assert words in str(refused.value) and "\n" not in str(refused.value)
    with driven(serial), pytest.raises(RigError, match="another program"), driven(serial):
        pass
    for one, begin in begins.items():
        assert not one.energised(begin)
    os.close(master)
    os.close(slave)
