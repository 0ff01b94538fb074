"""The firmware itself, compiled for this computer and run by a clock of the test: its outputs, and when they end."""

from __future__ import annotations

import math
import subprocess
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from flowrec.rigs.emulated.coils import OutputSamples
from flowrec.rigs.lab.amplifiers.serial_protocol import ZERO, Reply, configuration, field_line, line, reply, telemetry
from flowrec.rigs.lab.guardian import SERIAL_ZERO
from flowrec.stages import Coils, FieldCommand, FieldState, field_motion
from tests.twins.coils import compiled

COILS = Coils(
    mt_per_a=((2.1, 0.2, 0.1), (-0.3, 1.9, 0.2), (0.1, 0.2, 1.5)), bias_mt=(0.1, -0.05, 0.04), surface="ceiling"
)


class Board:
    """The firmware, by the clock of the caller."""

    def __init__(self, process: subprocess.Popen[str], file: Path) -> None:
        self.process, self.file = process, file
        self.number = 0

    def text(self, text: str) -> None:
        assert self.process.stdin is not None
        for part in text.splitlines():
            self.process.stdin.write(f"> {part}\n")

    def run(self, us: int = 400) -> list[Reply | None]:
        """What it sends meanwhile."""
        assert self.process.stdin is not None and self.process.stdout is not None
        self.process.stdin.write(f"+ {us}\n")
        self.process.stdin.flush()
        received = []
        for said in self.process.stdout:
            if said == ".\n":
                break
            received.append(reply(said.encode()))
        return received

    def send(self, verb: str, *numbers: int) -> list[Reply | None]:
        self.number += 1
        self.text(line(verb, self.number, *numbers).decode())
        return self.run()

    def field(self, command: FieldCommand) -> list[Reply | None]:
        self.number += 1
        self.text(field_line(self.number, command).decode())
        return self.run(200)

    def arm(self) -> None:
        for verb, numbers in configuration(COILS):
            assert verbs(self.send(verb, *numbers)) == [verb]
        assert verbs(self.send("A")) == ["A"]

    def currents(self) -> np.ndarray:
        return OutputSamples(self.file).outputs()[1]


def verbs(replies: list[Reply | None]) -> list[str]:
    return [one.verb if one is not None else "?" for one in replies]


@pytest.fixture(scope="module")
def program(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return compiled(tmp_path_factory.mktemp("firmware"))


@pytest.fixture
def board(program: Path, tmp_path: Path) -> Iterator[Board]:
    with subprocess.Popen(
        [program, "clock", tmp_path / "samples"], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as process:
        yield Board(process, tmp_path / "samples")
        assert process.stdin is not None
        process.stdin.close()


ON = FieldCommand(10.0, 0.5, 4.0, 20.0, 1000.0)


def test_it_puts_out_the_field_of_field_rotation_and_counts_its_turns(board: Board) -> None:
    board.arm()
    rng = np.random.default_rng(3)
    state, wanted, turns, begun = FieldState(), [], np.zeros(2), len(board.currents())
    # A heading that needs no turn at first: with the plane free, firmware and closed form agree from the start.
    for number in range(60):
        heading = rng.uniform(-math.pi, math.pi) if number else 0.5
        command = FieldCommand(round(rng.uniform(0.0, 15.0), 3), heading, 4.0, 20.0, 40.0)
        (answer,) = board.field(command)
        assert answer is not None and answer.verb == "F"
        board.run(49_800)
        motion = field_motion(state, command)
        time_s = np.arange(1, 251) * 2e-4
        amplitude = motion.amplitude(time_s)
        wanted.append(
            COILS.currents_a(COILS.field_mt(motion.phase(time_s), motion.plane(time_s), amplitude), amplitude)
        )
        for part in motion.segments(0.05):
            direction = np.array([math.cos(part.heading_rad), math.sin(part.heading_rad)])
            turns += part.frequency_hz * part.duration_s * direction
        state = motion.after(0.05)
    found = board.currents()[begun : begun + 60 * 250]
    error = np.abs(found - np.concatenate(wanted))
    # A sample is 0.2 ms, in which the field turns by 1.4 degrees: where the plane is free the two may differ by one.
    assert np.percentile(error, 99) < 0.06 and error.max() < 0.25
    (last,) = board.field(ON)
    assert last is not None
    counted = telemetry(last, COILS.count)
    assert counted is not None
    np.testing.assert_allclose(np.array(counted.turns) * 1e-6, turns, atol=0.03)


def test_it_goes_to_zero_100_ms_after_the_last_valid_line_and_stays_there(board: Board) -> None:
    board.arm()
    for _ in range(5):
        board.field(ON)
        board.run(40_000)
    before = len(board.currents())
    board.text("F 99 10000 0 4000 20000 1000000*0000\nnonsense\n")  # neither is valid
    board.run(200_000)
    on = np.flatnonzero((board.currents()[before:] != 0.0).any(axis=1))
    assert 0.2 * (on[-1] + 1) + 40.0 == pytest.approx(100.0, abs=1.5)  # ms
    answers = board.field(ON)
    assert answers[-1] is not None and (answers[-1].verb, answers[-1].words) == ("E", ("timer",))
    board.run(20_000)
    assert not board.currents()[-50:].any()


@pytest.mark.parametrize("zero", [ZERO, SERIAL_ZERO])
@pytest.mark.parametrize("half", ["", "F 7 1000", "F 7 10000 0 4000 20000 1000000*12", "x" * 500])
def test_newline_and_z_take_it_to_zero_at_once_after_any_half_line(board: Board, half: str, zero: bytes) -> None:
    board.arm()
    board.field(ON)
    board.run(20_000)
    assert board.currents()[-1].any()
    board.text(half + zero.decode())
    assert "Z" in verbs(board.run(400))
    assert not board.currents()[-1].any()
    assert verbs(board.field(ON)) == ["E"]  # only A leads out of it
    assert not board.currents()[-1].any()
    board.send("A")
    board.field(ON)
    board.run(20_000)
    assert board.currents()[-1].any()


def test_it_obeys_no_old_or_damaged_line_and_is_not_armed_without_its_configuration(board: Board) -> None:
    assert verbs(board.send("A")) == ["E"]
    board.arm()
    good = field_line(board.number + 1, ON).decode()
    damaged = good.replace("4000", "4001")
    board.text(damaged)
    assert verbs(board.run()) == ["E"]
    board.text(good + good)
    assert verbs(board.run()) == ["F", "E"]
    assert verbs(board.send("F", -5, 0, 4000, 9000, 1)) == ["E"]


def test_it_holds_the_currents_to_the_limit_whatever_it_is_told(board: Board) -> None:
    board.arm()
    for _ in range(10):
        board.field(FieldCommand(10.0, 0.0, 900.0, 20.0, 1e6))
        board.run(20_000)
    largest = np.abs(board.currents()).max()
    assert largest == pytest.approx(COILS.max_current_a, rel=1e-4)
    assert largest <= COILS.max_current_a
