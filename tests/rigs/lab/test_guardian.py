"""The deadlines of guardian and drive on a clock that only the test moves: when a field goes, and when it stays."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import pytest

from flowrec.core import Currents, RigError, UsageError
from flowrec.physics import ChipSettings, Robot, load_chip
from flowrec.rigs import CommandLimits, Guardian
from flowrec.rigs.lab.amplifiers.amplifier import AmplifierInfo
from flowrec.rigs.lab.amplifiers.serial_line import SerialAmplifier
from flowrec.rigs.lab.amplifiers.serial_protocol import Telemetry
from flowrec.rigs.lab.drive import BEAT_S, Drive
from flowrec.rigs.lab.guardian import watch
from flowrec.stages import Coils, FieldCommand, FieldLog, OutputLimits, load_config, resolve

ON, OFF, TRIP, QUIT, PROBE = b"1", b"0", b"T", b"Q", b"P"


class Clock:
    now_s = 1000.0

    def __call__(self) -> float:
        return self.now_s


def judged(*said: tuple[float, bytes], silence_s: float = 0.1, answer_s: float = 0.0) -> tuple[str, float, int]:
    """What the guardian decides, after how many seconds, and its probes; each word comes so long after the one before.

    After the last word the recorder is silent; a guardian that would wait for ever is told to quit. To answer takes
    it `answer_s`.
    """
    clock, left, probes = Clock(), list(said), []

    def heard(timeout_s: float | None) -> bytes | None:
        after_s, word = left.pop(0) if left else (60.0, QUIT)
        if timeout_s is not None and after_s > timeout_s:
            clock.now_s += timeout_s
            return None
        clock.now_s += after_s
        return word

    def answer() -> None:
        clock.now_s += answer_s

    cause = watch(heard, silence_s, answer, lambda: probes.append(clock.now_s), clock)
    return cause, round(clock.now_s - Clock.now_s, 9), len(probes)


def test_a_field_without_a_beat_goes_after_the_silence_and_not_before() -> None:
    beats = [(0.099, ON)] * 20
    silent = ("no beat of the loop for 100 ms", pytest.approx(20 * 0.099 + 0.1), 0)
    assert judged(*beats) == judged(*beats, (0.101, ON)) == silent
    assert judged(*beats, (0.099, OFF)) == ("", pytest.approx(21 * 0.099 + 60.0), 0), "no field, no beat is missed"
    assert judged((30.0, ON), silence_s=0.5) == ("no beat of the loop for 500 ms", 30.5, 0)
    assert judged((0.05, ON), answer_s=0.04)[1] == 0.15, "from the beat, not from the answer to it"
    assert judged((0.0, ON + OFF)) == ("", 60.0, 0) and judged((0.0, OFF + ON))[1] == 0.1, "the last word counts"


def test_a_recorder_that_has_ended_or_asks_loses_the_field_at_once() -> None:
    assert judged((0.05, ON), (0.02, b"")) == ("the recorder has ended", 0.07, 0)
    assert judged((0.05, b"")) == ("the recorder has ended", 0.05, 0)
    assert judged((0.05, ON), (0.01, ON + TRIP)) == ("asked to", 0.06, 0)
    assert judged((0.05, OFF), (0.01, PROBE), (0.01, QUIT)) == ("", 0.07, 1)


@contextmanager
def linked(clock: Clock) -> Iterator[tuple[Guardian, int]]:
    """A guardian as the recorder sees it, whose process is the test: it writes to the descriptor."""
    guardian = Guardian((), clock=clock)
    (beats, guardian._beats), (guardian._status, status) = os.pipe(), os.pipe()
    ends = (beats, guardian._beats, guardian._status, status)
    for end in (guardian._beats, guardian._status):
        os.set_blocking(end, False)
    try:
        yield guardian, status
    finally:
        for end in ends:
            os.close(end)


def test_a_guardian_that_does_not_answer_for_half_a_second_ends_the_run() -> None:
    clock = Clock()
    with linked(clock) as (guardian, status):
        for _ in range(10):
            guardian.beat(energised=True)
            clock.now_s += 0.4
            os.write(status, b".")
        guardian.beat(energised=True)
        clock.now_s += 0.499
        guardian.beat(energised=True)
        clock.now_s += 0.002
        with pytest.raises(RigError, match=r"0\.5 s"):
            guardian.beat(energised=True)
        os.write(status, b"tripped no beat of the loop for 100 ms; zero confirmed in 3 ms\n")
        with pytest.raises(RigError, match="has switched the coils off: no beat"):
            guardian.beat(energised=False)


class Told:
    """An amplifier and its guardian, who note what they are told."""

    timer_s = 0.0

    def __init__(self) -> None:
        self.beats: list[bool] = []
        self.amplitudes_mt: list[float] = []
        self.log = FieldLog()

    def open(self) -> AmplifierInfo:
        return AmplifierInfo("told", "", 10.0, 100.0, 1e5, latency_s=0.01, timer_s=self.timer_s)

    def guard(self) -> tuple[tuple[str, ...], tuple[int, ...]]:
        return (), ()

    def apply(self, command: FieldCommand) -> None:
        self.amplitudes_mt.append(command.amplitude_mt)

    def put_out(self, until_ns: int) -> FieldLog:
        return self.log

    def arm(self) -> None: ...

    zero = close = arm

    def guardian(self, *_words: object, silence_s: float) -> Any:
        assert silence_s == 0.1
        return self

    def __enter__(self) -> Told:
        return self

    def __exit__(self, *error: object) -> None: ...

    def beat(self, energised: bool) -> None:
        self.beats.append(energised)


# Currents that may change so slowly only take a field away in a while.
ROBOT = Robot(radius_um=50.0, max_speed_um_s=500.0, step_out_hz=30.0)
LIMITS = CommandLimits(Coils(), ROBOT, OutputLimits(slew_a_s=600.0))


def driven(told: Told, clock: Callable[[], float]) -> Drive:
    return Drive(told, LIMITS, 0.1, 0.3, told.guardian, clock)  # type: ignore[arg-type]


def field(amplitude_mt: float) -> Currents:
    return Currents(0, 5.0, 0.0, amplitude_mt, 0.0, np.zeros(3), False, limit_hz=27.0)


def test_a_loop_that_only_waits_beats_no_longer_than_its_patience() -> None:
    told, clock = Told(), Clock()
    with driven(told, clock) as drive:
        drive.apply(field(4.0))
        for _ in range(14):
            clock.now_s += BEAT_S
            drive.beat()
        assert told.beats == [True] * 15
        clock.now_s += 2.0 * BEAT_S
        drive.beat()
        assert len(told.beats) == 15, "the guardian hears the loop no longer, and takes the field away"
        drive.apply(field(4.0))
        clock.now_s += BEAT_S
        drive.beat()
        assert len(told.beats) == 17, "a loop that commands again is heard again"


def test_the_guardian_watches_until_the_field_is_down_and_no_longer() -> None:
    told, clock = Told(), Clock()
    with driven(told, clock) as drive:
        drive.beat()
        assert told.beats == [False], "nothing is energised before the first command"
        drive.apply(field(4.0))
        drive.apply(field(0.0))
        assert LIMITS.off_s > 0.0
        down_s = LIMITS.off_s + 0.01
        clock.now_s += 0.99 * down_s
        drive.beat()
        clock.now_s += 0.02 * down_s
        drive.beat()
        assert told.beats == [False, True, True, True, False]
        clock.now_s += 60.0
        drive.beat()
        assert told.beats[-1] is False and len(told.beats) == 6, "without a field the loop may take its time"


def test_an_amplifier_whose_timer_is_shorter_than_two_beats_is_refused() -> None:
    told = Told()
    told.timer_s = 1.9 * BEAT_S
    with pytest.raises(UsageError, match=r"0\.02 s; .*0\.04 s"), driven(told, Clock()):
        pytest.fail("it opened")


def test_a_loop_may_wait_as_long_as_the_watchdog_of_its_ticks_allows_before_the_guardian_hears_it_no_more() -> None:
    told: list[float] = []

    class Asked(Drive):
        def __init__(self, amplifier: object, limits: CommandLimits, silence_s: float, patience_s: float) -> None:
            told.extend((silence_s, patience_s))

    config = resolve(load_config(None, ["safety.guard_timeout_s=0.7", "lab.guardian_s=0.2"]), load_chip(ChipSettings()))
    Asked.of(config)
    assert told == [0.2, pytest.approx(0.9)]


def test_the_turns_between_frames_add_up_to_those_of_the_log_however_late_it_was_written() -> None:
    told = Told()
    with driven(told, Clock()) as drive:
        told.log.append(0, 5.0, 0.0, 4.0, np.zeros(3))
        turns = [drive.applied_at(number * 10**8, (number - 1) * 10**8).turns for number in (1, 2)]
        np.testing.assert_allclose(turns, [[0.5, 0.0], [0.5, 0.0]])
        told.log.append(150_000_000, 2.0, 0.5 * math.pi, 4.0, np.zeros(3))  # only now it says what it did
        told.log.append(230_000_000, 3.0, math.pi, 4.0, np.zeros(3))
        turns += [drive.applied_at(number * 10**8, (number - 1) * 10**8).turns for number in (3, 4)]
    np.testing.assert_allclose(sum(turns), told.log.turns(0, 4 * 10**8), atol=1e-9)


def test_a_board_whose_counters_overflow_has_turned_as_far_in_the_middle_of_each_round_trip() -> None:
    board, wrap, hz, heading_rad = SerialAmplifier("", 115200, Coils()), 1 << 32, 5.0, 2.0
    for number in range(400):
        at_ns, began_ns = 10**9 + number * 10**7, 10**9  # the board answers in the middle
        turned = hz * 1e-9 * (at_ns - began_ns) * np.array([math.cos(heading_rad), math.sin(heading_rad)])
        offset = np.array([4 * 10**6, -9 * 10**6])
        x, y = np.rint(1e6 * turned + offset).astype(int).tolist()  # both pass 0 on their way
        clock_us = (at_ns // 1000 + wrap - 3 * 10**6) % wrap
        answer = Telemetry(clock_us, hz, heading_rad, 4.0, (x % wrap, y % wrap), np.zeros(3))
        board._measured.append((answer, at_ns - 3_000_000, at_ns + 3_000_000))
    log = board.put_out(at_ns)
    np.testing.assert_allclose(log.turns(2 * 10**9, 4 * 10**9), 2.0 * hz * np.array([-0.41615, 0.90930]), rtol=1e-3)
    late_ns = (log.times_ns[-100:] - 10**9) % 10**7
    assert np.minimum(late_ns, 10**7 - late_ns).max() < 300_000, "stamped when it was, not when its answer came"
