"""Analog outputs and inputs of NI devices, one a coil, through NI-DAQmx or an NI gRPC Device Server."""

from __future__ import annotations

import contextlib
import re
import time
from typing import Any

import nidaqmx
import numpy as np
from nidaqmx.constants import AcquisitionType, RegenerationMode
from nidaqmx.errors import DaqError, DaqNotFoundError, DaqNotSupportedError, RpcError
from nidaqmx.stream_readers import AnalogMultiChannelReader
from nidaqmx.system import Device

from flowrec.core import Floats, RigError, coil_names
from flowrec.rigs.lab.amplifiers.amplifier import AmplifierInfo
from flowrec.stages import AmplifierSettings

_CONNECT_S = 10.0
_READ_S = 0.1  # for a sample of the inputs
UNDERFLOWS = (-200290, -200621, -200018, -200016)  # of the buffer in the computer, and of those in devices
# Codes of NI-DAQmx (NIDAQmx.h).
_NO_DEVICE, _NO_CHANNEL, _RESERVED = (-200220, -201003), (-200170,), (-50103, -200022)


class NiDevice:
    """The outputs, at zero or playing.

    Parameters
    ----------
    channels : as NI-DAQmx names them: 'cDAQ1Mod1/ao0:2'.
    server : host:port of a gRPC server; '': the local driver.
    amplifier : range and rate of the outputs.
    coils : their number.
    latency_s : that is stated in `info`.

    Raises
    ------
    RigError : no driver, server or device, or not one output a coil; one line.
    """

    def __init__(self, channels: str, server: str, amplifier: AmplifierSettings, coils: int, latency_s: float) -> None:
        self._channels, self._amplifier, self._coils = channels, amplifier, coils
        if not channels:
            names = ", ".join(coil_names(coils))
            raise RigError(
                f"lab.ni.channels: which outputs drive the coils {names}? For instance 'cDAQ1Mod1/ao0:{coils - 1}'"
            )
        self._options = grpc_options(server) if server else None
        self._task: nidaqmx.Task | None = None
        try:
            self.info = self._describe(latency_s)
        except (DaqNotFoundError, DaqNotSupportedError) as error:
            raise RigError(
                "NI-DAQmx is not installed on this computer; install National Instruments' driver, or set lab.ni.server"
            ) from error
        except DaqError as error:
            raise RigError(f"lab.ni.channels = {channels!r}: {reason(error)}") from error

    def take(self) -> None:
        """Take the outputs to zero before the first use. Nothing is taken away from another program that uses them.

        Raises
        ------
        RigError : another program does; one line.
        """
        try:
            write_zeros(self._channels, self._options)
        except DaqError as error:
            if int(error.error_code) in _RESERVED:
                raise RigError(f"lab.ni.channels = {self._channels!r}: {reason(error)}") from error
            reset(self._channels, self._options)

    def start(self, block_s: float) -> float:
        """Prepare the output of blocks; returns the sample rate, which the device may have rounded."""
        task = self._task = self._new_task(self._amplifier.max_voltage_v)
        rate_hz = self._amplifier.output_hz
        count = round(block_s * rate_hz)
        task.timing.cfg_samp_clk_timing(rate_hz, sample_mode=AcquisitionType.CONTINUOUS, samps_per_chan=4 * count)
        task.out_stream.regen_mode = RegenerationMode.DONT_ALLOW_REGENERATION
        task.out_stream.output_buf_size = 4 * count
        return float(task.timing.samp_clk_rate)

    def run(self) -> int:
        """Start the output of what is written. Returns when, in ns of the host's monotonic clock."""
        assert self._task is not None
        before_ns = time.monotonic_ns()
        self._task.start()
        return (before_ns + time.monotonic_ns()) // 2

    def write(self, voltages_v: Floats) -> None:
        """Append samples (n, coils)."""
        assert self._task is not None
        self._task.write(np.ascontiguousarray(voltages_v.T), auto_start=False)

    def samples_generated(self) -> tuple[int, int]:
        """Number of samples put out so far, and when that was, in ns of the host's monotonic clock.

        Raises
        ------
        DaqError : the output ran dry. RigError : it was stopped.
        """
        assert self._task is not None
        before_ns = time.monotonic_ns()
        generated = int(self._task.out_stream.total_samp_per_chan_generated)
        arrival_ns = (before_ns + time.monotonic_ns()) // 2
        if self._task.is_task_done():
            raise RigError("the output was stopped by another program, or by the guardian")
        return generated, arrival_ns

    def zero(self) -> None:
        """Stop the output and take it to zero. If that fails, reset the device."""
        task, self._task = self._task, None
        try:
            if task is not None:
                with contextlib.suppress(DaqError):  # a task that has failed
                    task.stop()
                task.close()
            write_zeros(self._channels, self._options)
        except Exception:  # noqa: BLE001  whatever it was, a reset is the next thing to try
            reset(self._channels, self._options)

    def _describe(self, latency_s: float) -> AmplifierInfo:
        device = Device(devices(self._channels)[0], grpc_options=self._options)
        edges = device.ao_voltage_rngs  # lowest and highest of each range
        offered_v = max((min(-low, high) for low, high in zip(edges[::2], edges[1::2], strict=True)), default=0.0)
        # Within what the device offers: what is asked for beyond it is refused later, with the name of the setting.
        with self._new_task(min(self._amplifier.max_voltage_v, offered_v)) as task:
            names = task.ao_channels.channel_names
        if len(names) != self._coils:
            raise RigError(
                f"lab.ni.channels = {self._channels!r}: {len(names)} outputs, where the coils of coils.mt_per_a need "
                f"{self._coils}"
            )
        if len(set(names)) != self._coils:
            raise RigError(
                f"lab.ni.channels = {self._channels!r}: an output is named twice; each coil needs one of its own"
            )
        return AmplifierInfo(
            model=device.product_type,
            serial=f"{device.serial_num:X}",
            max_current_a=np.inf,
            max_voltage_v=float(offered_v),
            max_output_hz=float(device.ao_max_rate),
            latency_s=latency_s,
            timer_s=0.0,
        )

    def _new_task(self, most_v: float) -> nidaqmx.Task:
        task = nidaqmx.Task(grpc_options=self._options)
        try:
            task.ao_channels.add_ao_voltage_chan(self._channels, min_val=-most_v, max_val=most_v)
        except BaseException:
            task.close()
            raise
        return task


class NiInputs:
    """Inputs that read the currents of the coils, one sample of all when it is asked for.

    Parameters
    ----------
    channels : as NI-DAQmx names them: 'cDAQ1Mod2/ai0:2'.
    server : as of NiDevice.
    volts_per_a : (coils,) or (1,) volts at an input for one ampere of its coil.
    coils : their number.

    Raises
    ------
    RigError : no such inputs, or not one a coil; one line.
    """

    def __init__(self, channels: str, server: str, volts_per_a: Floats, coils: int) -> None:
        if volts_per_a.size not in (1, coils):
            raise RigError(
                f"lab.ni.volts_per_a: {volts_per_a.size} numbers, where there are {coils} coils; give one number for "
                "all coils, or one for each"
            )
        self._volts_per_a = volts_per_a
        self._task = nidaqmx.Task(grpc_options=grpc_options(server) if server else None)
        try:
            self._task.ai_channels.add_ai_voltage_chan(channels)
            count = len(self._task.ai_channels.channel_names)
            if count != coils:
                raise RigError(f"lab.ni.inputs = {channels!r}: {count} inputs, where {coils} coils need one each")
            self._count = count
            self._reader = AnalogMultiChannelReader(self._task.in_stream)
            self._reader.verify_array_shape = False  # asks the device for what is known here, each time
            self._task.start()
        except DaqError as error:
            self._task.close()
            raise RigError(f"lab.ni.inputs = {channels!r}: {reason(error)}") from error
        except BaseException:
            self._task.close()
            raise

    def currents_a(self) -> tuple[Floats, int]:
        """Currents (coils,) now, and when that was, in ns of the host's monotonic clock.

        Raises
        ------
        DaqError : the inputs do not answer, or were stopped.
        """
        volts = np.zeros(self._count)
        before_ns = time.monotonic_ns()
        self._reader.read_one_sample(volts, _READ_S)
        return volts / self._volts_per_a, (before_ns + time.monotonic_ns()) // 2

    def close(self) -> None:
        """Release the inputs."""
        with contextlib.suppress(DaqError):  # a task that has failed
            self._task.close()


def devices(channels: str) -> list[str]:
    """Names of the devices in a list of channels."""
    return sorted({part.strip().partition("/")[0] for part in channels.split(",")})


def grpc_options(server: str) -> Any:
    """Options of a session on a gRPC server.

    Raises
    ------
    RigError : no server there.
    """
    import grpc

    channel = grpc.insecure_channel(server)
    try:
        grpc.channel_ready_future(channel).result(timeout=_CONNECT_S)
    except grpc.FutureTimeoutError as error:
        raise RigError(f"lab.ni.server = {server!r}: no NI gRPC Device Server answers there") from error
    return nidaqmx.GrpcSessionOptions(channel, "")


def write_zeros(channels: str, options: Any) -> None:
    """Zero volts on outputs that no task uses."""
    with nidaqmx.Task(grpc_options=options) as task:
        task.ao_channels.add_ao_voltage_chan(channels)
        task.write([[0.0]] * len(task.ao_channels.channel_names), auto_start=True)


def reset(channels: str, options: Any) -> None:
    """Abort every task of the devices, whoever owns it, and take the outputs to zero.

    A reset itself takes the outputs of C, M and X Series to zero, and leaves those of others as they are (NI-DAQmx
    Device Considerations, "Initialized States for Terminals and Output Channels").
    """
    for name in devices(channels):
        Device(name, grpc_options=options).reset_device()
    write_zeros(channels, options)


def reason(error: Exception) -> str:
    """An error of NI-DAQmx in one line."""
    if isinstance(error, DaqError):
        code = int(error.error_code)
        if code in UNDERFLOWS:
            return f"the output ran dry (NI error {code}): the computer was too busy"
        if code in _NO_DEVICE:
            return f"NI knows no such device (error {code}); see NI MAX or nilsdev for its name"
        if code in _NO_CHANNEL:
            return f"the device has no such channel (error {code})"
        if code in _RESERVED:
            return f"another program uses the outputs (NI error {code}); close it"
        return f"NI error {code}: {_first_line(error)}"
    if isinstance(error, RpcError):
        return f"the NI gRPC Device Server: {_first_line(error)}"
    return f"{type(error).__name__}: {_first_line(error)}"


def _first_line(error: Exception) -> str:
    return re.sub(r"\s+", " ", str(error)).strip()[:160]
