"""What is refused of an NI device before anything is put out, on the twin of its server."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from flowrec.core import RigError, UsageError
from flowrec.rigs import CommandLimits
from flowrec.stages import OutputLimits
from tests.extras import why
from tests.perf.guardian_trial import COILS, ROBOT

nidaqmx = pytest.importorskip("nidaqmx", reason=why("nidaqmx"))
from nidaqmx.constants import AcquisitionType  # noqa: E402

from flowrec.rigs.lab.amplifiers.ni_device import NiDevice, NiInputs, grpc_options  # noqa: E402
from tests.twins.ni import NiTwin, serve  # noqa: E402


@pytest.fixture
def server(tmp_path: Path) -> Iterator[tuple[str, NiTwin]]:
    running, port, twin = serve(tmp_path / "samples")
    yield f"127.0.0.1:{port}", twin
    running.stop(None).wait()
    twin.close()


@pytest.mark.parametrize(
    ("channels", "told"),
    [
        ("", "lab.ni.channels: which outputs"),
        ("cDAQ1Mod1/ao2:4", "the device has no such channel"),
        ("Dev9/ao0:2", "NI knows no such device"),
        ("cDAQ1Mod1/ao0:1", "2 outputs, where the coils of coils.mt_per_a need 3"),
        ("cDAQ1Mod1/ao0,cDAQ1Mod1/ao0,cDAQ1Mod1/ao1", "an output is named twice"),
    ],
)
def test_outputs_that_are_not_three_of_a_device_are_refused(
    channels: str, told: str, server: tuple[str, NiTwin]
) -> None:
    with pytest.raises(RigError, match=told) as refused:
        NiDevice(channels, server[0], COILS.amplifier, 3, 0.1)
    assert "\n" not in str(refused.value)


def test_a_voltage_beyond_the_range_of_the_device_is_refused_by_the_name_of_its_setting(
    server: tuple[str, NiTwin],
) -> None:
    strong = replace(COILS, amplifier=replace(COILS.amplifier, max_voltage_v=20.0))
    info = NiDevice("cDAQ1Mod1/ao0:2", server[0], strong.amplifier, 3, 0.1).info
    with pytest.raises(UsageError, match=r"coils\.amplifier\.max_voltage_v = 20 V: NI 9263.* 10 V"):
        CommandLimits(strong, ROBOT, OutputLimits()).check(info)


def test_outputs_that_another_program_uses_are_not_taken_from_it(server: tuple[str, NiTwin]) -> None:
    address, twin = server
    with nidaqmx.Task(grpc_options=grpc_options(address)) as other:
        other.ao_channels.add_ao_voltage_chan("cDAQ1Mod1/ao1")
        other.timing.cfg_samp_clk_timing(1000.0, sample_mode=AcquisitionType.CONTINUOUS, samps_per_chan=1000)
        other.write(np.full(1000, 2.0))
        other.start()
        device = NiDevice("cDAQ1Mod1/ao0:2", address, COILS.amplifier, 3, 0.1)
        with pytest.raises(RigError, match=r"lab\.ni\.channels = "):
            device.take()
        assert not other.is_task_done() and twin.outputs[1] == 2.0, "the other program goes on"


@pytest.mark.parametrize(
    ("inputs", "volts_per_a", "told"),
    [
        ("cDAQ1Mod2/ai0:1", [1.0], r"lab\.ni\.inputs = .*: 2 inputs, where 3 coils need one each"),
        ("cDAQ1Mod2/ao0:2", [1.0], r"lab\.ni\.inputs = .*: the device has no such channel"),
        ("cDAQ1Mod2/ai0:2", [1.0, 2.0], r"lab\.ni\.volts_per_a: 2 numbers, where there are 3 coils"),
    ],
)
def test_inputs_that_are_not_one_for_each_coil_are_refused(
    inputs: str, volts_per_a: list[float], told: str, server: tuple[str, NiTwin]
) -> None:
    with pytest.raises(RigError, match=told) as refused:
        NiInputs(inputs, server[0], np.array(volts_per_a), 3)
    assert "\n" not in str(refused.value)


def test_currents_are_the_volts_at_the_inputs_over_the_volts_of_an_ampere(server: tuple[str, NiTwin]) -> None:
    address, twin = server
    inputs = NiInputs("cDAQ1Mod2/ai0:2", address, np.array([0.5, 1.0, 2.0]), 3)
    twin.outputs[:] = [1.0, 2.0, -3.0, 9.0]
    currents_a, _ = inputs.currents_a()
    inputs.close()
    assert currents_a.tolist() == [2.0, 2.0, -1.5]
