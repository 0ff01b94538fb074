"""Outputs beside the coils on a pseudo terminal: set before the run, by a person, after it; read back, and refused."""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import ExitStack
from typing import Any

import numpy as np
import pytest
import serial

from flowrec.core import SAMPLES, SILENT, STREAMS, RigError, UsageError
from flowrec.rigs import RunLog
from flowrec.rigs.streams.serial_output import SerialOutput, SerialOutputSettings
from flowrec.run import RunControl, StreamInputs, obey
from flowrec.stages import load_config
from tests.real_time import Clock, ticks
from tests.twins.terminal import TerminalTwin

MOST_TICKS = 1500  # 30 s
GENERATOR = {
    "lines": ["VOLT {:.2f}", "FREQ {:.0f}"],
    "values": [2.0, 1e6],
    "rest": [0.0, 1e6],
    "least": [0.0, 1e3],
    "most": [5.0, 3e6],
    "period_s": 0.05,
}


class Device(TerminalTwin):
    """A function generator: keeps what it is set to, and answers when it is asked; its amplitude stops at 3 V."""

    def __init__(self) -> None:
        self.state = {"VOLT": 0.0, "FREQ": 0.0}
        super().__init__()

    def answer(self, line: str) -> None:
        if line.endswith("?"):
            self.send(f"{line[:-1]} {self.state[line[:-1]]:.3e} V\r\nREADY 9\r\n")  # of which nobody takes the second
        else:
            name, value = line.split()
            self.state[name] = min(float(value), 3.0 if name == "VOLT" else 1e9)


def streams_of(control: RunControl, told: list[str], **device: Any) -> tuple[StreamInputs, Clock, RunLog]:
    clock, log = Clock(time.monotonic_ns()), RunLog()
    sets = {
        "kind": "serial",
        "channels": ["volt", "hertz"],
        "on_silence": "stop",
        "wait_s": 0.3,
        "device": {**GENERATOR, **device},
    }
    config = load_config(None, {f"streams.generator.{name}": value for name, value in sets.items()})
    return StreamInputs(config.streams, clock, control, told.append, log, realtime=True), clock, log  # type: ignore[arg-type]


def flown(
    device: Device, act: Callable[[RunControl, RunLog], None], last: list[float], **settings: Any
) -> tuple[np.ndarray, RunControl]:
    """The values of both channels, (n, 2): something is done after the first, and the run ends with those of `last`."""
    control, told, found = RunControl(), list[str](), list[list[float]]()
    streams, clock, log = streams_of(control, told, port=device.port, **settings)
    with ExitStack() as stack:
        streams.connect(stack)
        assert device_has(device, "VOLT 2.00", "FREQ 1000000"), device.lines  # before the run
        stack.enter_context(streams)
        acted = False
        for number, joined in enumerate(streams.join(ticks(clock))):
            if SAMPLES in joined.extra:
                found += joined.extra[SAMPLES].value.reshape(-1, 2).tolist()  # type: ignore[attr-defined]
            if found and not acted:
                acted = True
                act(control, log)
            if (acted and found[-1] == last) or number > MOST_TICKS:
                break
    assert not told
    return np.array(found), control


def device_has(device: Device, *lines: str, last: int = 0) -> bool:
    """True if the device gets these lines within 5 s, among all or as the last ones."""
    end_s = time.monotonic() + 5.0
    while not (there := set(lines) <= set(device.lines[-last:])) and time.monotonic() < end_s:
        time.sleep(0.01)
    return there


def test_an_output_is_set_before_the_run_by_console_and_program_in_it_and_to_rest_after_it() -> None:
    device = Device()

    def act(control: RunControl, log: RunLog) -> None:
        assert obey(control, {"command": "output", "name": "generator/volt", "value": 4.5}) == ""
        log.set("generator/hertz", 2e6)

    values, control = flown(device, act, [4.5, 2e6])
    assert values[0].tolist() == [2.0, 1e6] and values[-1].tolist() == [4.5, 2e6]
    assert device_has(device, "VOLT 4.50", "FREQ 2000000")
    assert device_has(device, "VOLT 0.00", "FREQ 1000000", last=2)  # however the run ends
    noted = [control.next_event(1, held=False), control.next_event(2, held=False)]
    assert [each.text for each in noted if each] == ["generator/volt set to 4.5", "generator/hertz set to 2e+06"]


def test_where_the_device_is_asked_its_answer_is_recorded_and_not_the_wish() -> None:
    device = Device()
    asked = {"ask": ["VOLT?", "FREQ?"]}
    values, _ = flown(device, lambda control, _: control.set_output("generator/volt", 4.5), [3.0, 1e6], **asked)
    assert values[0].tolist() == [2.0, 1e6] and values[-1].tolist() == [3.0, 1e6]  # 3 V is all that it gives


def test_a_value_beyond_its_limits_an_unknown_output_and_one_without_a_run_are_refused() -> None:
    control, told = RunControl(), list[str]()
    _, _, log = streams_of(control, told)
    refused = {
        ("generator/volt", 5.1): "generator/volt = 5.1: must be from 0 to 5",
        ("generator/volt", float("nan")): "generator/volt = nan: must be from 0 to 5",
        ("lamp/light", 1.0): "'lamp/light' is no output of this run; its outputs are generator/volt, generator/hertz",
    }
    for (name, value), complaint in refused.items():
        assert obey(control, {"command": "output", "name": name, "value": value}) == complaint
    with pytest.raises(UsageError, match="no run"):
        log.set("generator/volt", 1.0)
    assert control.next_event(1, held=False) is None  # nothing is noted of what was not done
    control.stop("enough")
    assert obey(control, {"command": "output", "name": "generator/volt", "value": 4.5}) == "the run ends: enough"


@pytest.mark.parametrize("settings", [{}, {"rest": []}, {"ask": ["VOLT?", "FREQ?"]}])
def test_a_device_that_is_unplugged_is_silent_and_ends_the_run_where_its_stream_says_so(
    settings: dict[str, Any],
) -> None:
    device, control, told, states = Device(), RunControl(), list[str](), list[Any]()
    streams, clock, _ = streams_of(control, told, port=device.port, **settings)
    with ExitStack() as stack:
        streams.connect(stack)
        stack.enter_context(streams)
        for number, joined in enumerate(streams.join(ticks(clock))):
            states += [joined.extra[STREAMS]] if STREAMS in joined.extra else []
            if number == 10:
                device.unplug()
            if (states and states[-1].state[0] == SILENT) or number > MOST_TICKS:
                break
    assert states[-1].state[0] == SILENT and control.reason == "stream generator is silent"
    assert any("the device on" in line and "does not answer" in line for line in told), told
    assert sum("looked for again" in line for line in told) == 1, told


def test_a_device_that_comes_back_gets_the_value_that_was_set_last() -> None:
    device = Device()
    settings = SerialOutputSettings(device.port, **GENERATOR)
    output = SerialOutput("generator", ("volt", "hertz"), "", settings)
    output.open()
    output.set(0, 4.5)
    output.read(0.0)
    output.close()
    assert device_has(device, "VOLT 0.00", "FREQ 1000000", last=2)  # at rest
    device.lines.clear()
    output.open()
    assert device_has(device, "VOLT 4.50", "FREQ 1000000")
    output.close()


def test_a_port_that_another_has_opened_such_as_the_amplifier_gets_no_line() -> None:
    device, told = Device(), list[str]()
    streams, _, _ = streams_of(RunControl(), told, port=device.port)
    refused = pytest.raises(RigError, match=r"streams\.generator: ")
    with ExitStack() as stack, serial.Serial(device.port, exclusive=True), refused:
        streams.connect(stack)
    assert device.lines == []


@pytest.mark.parametrize(
    ("changes", "complaint"),
    [
        ({"lines": ["VOLT {:.2f}"]}, r"streams\.generator\.device\.lines has 1 elements, where there are 2 channels"),
        ({"rest": [0.0]}, r"device\.rest has 1 elements"),
        ({"lines": ["VOLT 2", "FREQ {}"]}, r"'VOLT 2' for volt has no place for the value, such as \{:\.3f\}"),
        ({"lines": ["VOLT {:d}", "FREQ {}"]}, r"device\.lines: 'VOLT \{:d\}' for volt: Unknown format code"),
        ({"values": [9.0, 1e6]}, r"streams\.generator\.device: volt = 9: must be from 0 to 5"),
        ({"rest": [-1.0, 1e6]}, r"volt = -1: must be from 0 to 5"),
        ({"volts": 1}, r"streams\.generator\.device: unknown key volts"),
        ({"baud": 1}, r"streams\.generator\.device\.baud = 1: must be from 300"),
    ],
)
def test_settings_that_do_not_fit_are_refused_in_one_line_before_the_port_is_opened(
    changes: dict[str, Any], complaint: str
) -> None:
    with pytest.raises(UsageError, match=complaint) as caught:
        streams_of(RunControl(), [], **changes)
    assert "\n" not in str(caught.value)
