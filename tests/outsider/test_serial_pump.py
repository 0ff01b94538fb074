"""A pump's plugin on a pseudo terminal: set, measured, unplugged, and refused where its settings are wrong."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from flowrec.core import SAMPLES, SILENT, STREAMS, UsageError, outside
from flowrec.run import RunControl, StreamInputs
from flowrec.stages import STREAM_KINDS, load_config
from tests.real_time import Clock, ticks
from tests.twins.terminal import TerminalTwin


class Twin(TerminalTwin):
    """The pump: sends its flow rate all the time, its clock an hour behind ours."""

    flow = 0.0

    def answer(self, line: str) -> None:
        self.flow = float(line.split()[1])

    def idle(self) -> None:
        self.send(f"{1000.0 * time.monotonic() - 3.6e6:.0f} {self.flow:.2f}\n")
        time.sleep(0.01)


@pytest.fixture
def installed(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Installs the plugin of this folder."""
    found = (outside.Outside("serial_pump", "tests.outsider.serial_pump:SerialPump", "serial_pump", "1"),)

    def entry_points_of(group: str) -> dict[str, Any]:
        return {"serial_pump": found} if group == "flowrec.streams" else {}

    for where in ("core.outside", "core.methods"):
        monkeypatch.setattr(f"flowrec.{where}.entry_points_of", entry_points_of)
    yield
    STREAM_KINDS._others.clear()


@pytest.mark.usefixtures("installed")
def test_the_pump_is_set_its_flow_is_an_input_on_our_clock_and_it_is_silent_when_it_is_unplugged() -> None:
    twin, told, clock = Twin(), list[str](), Clock(time.monotonic_ns())
    device = {"port": twin.port, "flow_ul_min": 12.0}
    config = load_config(None, {"streams.pump.kind": "serial_pump", "streams.pump.device": device})
    streams = StreamInputs(config.streams, clock, RunControl(), told.append, realtime=True)  # type: ignore[arg-type]
    found, end_s = list[Any](), time.monotonic() + 20.0
    with ExitStack() as stack:
        streams.connect(stack)
        stack.enter_context(streams)
        plugged = True
        for joined in streams.join(ticks(clock)):
            found += [joined.extra[SAMPLES]] if plugged and SAMPLES in joined.extra else []
            states = joined.extra.get(STREAMS)
            if plugged and len(found) > 10:
                plugged = False
                twin.unplug()
            if states is not None and states.state[0] == SILENT:  # type: ignore[attr-defined]
                break
            assert time.monotonic() < end_s, told
    assert twin.lines == ["F 12.000"]
    values = np.concatenate([each.value[each.channel == 0] for each in found])
    stamps = np.concatenate([each.sample_ns[each.channel == 0] for each in found])
    ticked = np.concatenate([np.full((each.channel == 0).sum(), each.stamp_ns) for each in found])
    assert values[-1] == 12.0 and {each.value[-1] for each in found} == {12.0}
    assert (np.abs(ticked - stamps) < 0.5e9).all()
    assert any("the pump does not answer" in line or "SerialException" in line for line in told)


@pytest.mark.usefixtures("installed")
@pytest.mark.parametrize(
    ("device", "complaint"),
    [
        ({"ports": "x"}, r"streams\.pump\.device: unknown key ports; did you mean port"),
        ({"baud": 3}, r"streams\.pump\.device\.baud = 3: must be from 9600"),
        ({"baud": "fast"}, r"streams\.pump\.device\.baud: input should be a valid integer"),
    ],
)
def test_wrong_settings_of_the_pump_are_refused_in_one_line(device: dict[str, Any], complaint: str) -> None:
    config = load_config(None, {"streams.pump.kind": "serial_pump", "streams.pump.device": device})
    with pytest.raises(UsageError, match=complaint):
        StreamInputs(config.streams, Clock(0), RunControl(), print, realtime=True)  # type: ignore[arg-type]


def test_the_plugin_is_short_enough_to_be_read_in_the_documentation() -> None:
    lines = (Path(__file__).parent / "serial_pump.py").read_text(encoding="utf-8").splitlines()
    assert len(lines) <= 80
