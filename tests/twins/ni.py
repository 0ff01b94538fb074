"""Twin of an NI gRPC Device Server with a module of a cDAQ: `python -m tests.twins.ni FILE [COILS]` prints its port.

The client is NI's own package. What is modelled: buffers that are put out at the sample clock and, with regeneration
off, run dry (-200290); values outside the range (-200077); outputs that another task has reserved (-50103); names that
do not exist (-200220, -200170); a reset, which aborts every task (-88709) and takes the outputs to zero; and outputs
that hold their last value when a task stops, runs dry, or its client dies. FILE gets every sample (firmware.sample)
of as many coils as are said,
with the time at which it is put out. A third argument makes the product type of the reset that leaves the outputs as
they are, as S Series does.
Inputs of a second module of the chassis read the voltage of the output of the same number, as a sensor of 1 V/A behind
an amplifier of 1 A/V; while there is a file TWIN_FAULT, the first one reads half.
"""

from __future__ import annotations

import os
import re
import sys
import threading
import time
from concurrent import futures
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import grpc
import numpy as np
import session_pb2
from nidaqmx._stubs import nidaqmx_pb2 as pb
from nidaqmx._stubs import nidaqmx_pb2_grpc as rpc

from flowrec.core import Priority, prioritise_process
from flowrec.rigs.emulated.coils import sample

DEVICE, RANGE_V, MAX_RATE_HZ = "cDAQ1Mod1", 10.0, 100_000.0
SENSORS = "cDAQ1Mod2"
_STEP_S = 0.001
_REGENERATE = 10097
_TYPES = {0x631: "NI 9263", 0x632: 0x1D2C3B4A}  # attributes of a device: product type, serial number
_MAX_RATE, _RANGES = 0x2997, 0x2F9B


class NiError(Exception):
    """An error of NI-DAQmx."""


@dataclass
class Task:
    """A task on the server."""

    channels: list[int] = field(default_factory=list)
    inputs: list[int] = field(default_factory=list)
    low: float = -RANGE_V
    high: float = RANGE_V
    rate: float = 0.0
    regenerates: bool = True
    blocks: list[np.ndarray] = field(default_factory=list)  # (n, channels) that are not put out yet
    written: int = 0
    played: int = 0
    began_ns: int | None = None
    error: int = 0  # that every call returns from now on

    def generated(self, now_ns: int) -> int:
        return 0 if self.began_ns is None else int((now_ns - self.began_ns) * 1e-9 * self.rate) + 1


class NiTwin(rpc.NiDAQmxServicer):
    """The server. Every call takes the lock and first puts out what is due."""

    def __init__(self, file: Path, reset_zeroes: bool = True, coils: int = 3) -> None:
        self.tasks: dict[str, Task] = {}
        self.outputs = np.zeros(coils + 1)  # one that drives no coil
        self._coils = coils
        self.lock = threading.Lock()
        self.underflows = 0
        self._file = file.open("wb", buffering=0)
        self._reset_zeroes = reset_zeroes
        self._names = 0
        self._log(np.array([time.monotonic_ns()]), self.outputs[None])
        self._ended = threading.Event()
        self._player = threading.Thread(target=self._play, daemon=True)
        self._player.start()

    def close(self) -> None:
        """End the device, after its server."""
        self._ended.set()
        self._player.join()
        self._file.close()

    # ---- the device

    def _play(self) -> None:
        while not self._ended.wait(_STEP_S):
            with self.lock:
                self._advance()

    def _advance(self) -> None:
        """Put out the samples that are due."""
        for task in self.tasks.values():
            if task.began_ns is None or task.error:
                continue
            due = task.generated(time.monotonic_ns())
            while task.blocks and task.played < due:
                block = task.blocks[0][: due - task.played]
                at_ns = task.began_ns + np.round((task.played + np.arange(len(block))) * 1e9 / task.rate).astype(int)
                values = np.tile(self.outputs, (len(block), 1))
                values[:, task.channels] = block
                self._log(at_ns, values)
                self.outputs = values[-1].copy()
                task.played += len(block)
                left = task.blocks[0][len(block) :]
                task.blocks[:1] = [left] if len(left) else []
            if task.played < due and not task.regenerates:
                self.underflows += 1
                task.error = -200290  # the outputs hold their last value

    def _log(self, at_ns: np.ndarray, values: np.ndarray) -> None:
        records = np.zeros(len(at_ns), sample(self._coils))
        records["at_ns"], records["coils"] = at_ns, values[:, : self._coils]
        self._file.write(records.tobytes())

    def _set(self, channels: list[int], values: Any) -> None:
        self.outputs = self.outputs.copy()
        self.outputs[channels] = values
        self._log(np.array([time.monotonic_ns()]), self.outputs[None])

    # ---- calls

    def call(self, name: str, request: Any, context: Any) -> Any:
        with self.lock:
            self._advance()
            try:
                answer = getattr(self, f"on_{name}")(request)
            except NiError as error:
                context.set_trailing_metadata((("ni-error", str(error)),))
                context.abort(grpc.StatusCode.UNKNOWN, f"twin: {name}")
        return getattr(pb, f"{name}Response")(status=0, **(answer or {}))

    def task(self, request: Any) -> Task:
        task = self.tasks.get(request.task.name)
        if task is None:
            raise NiError(-200088)
        if task.error:
            raise NiError(task.error)
        return task

    def on_CreateTask(self, request: Any) -> dict[str, Any]:  # noqa: N802
        self._names += 1
        name = request.session_name or f"task{self._names}"
        self.tasks[name] = Task()
        return {"task": session_pb2.Session(name=name), "new_session_initialized": True}

    def on_ClearTask(self, request: Any) -> None:  # noqa: N802
        self.tasks.pop(request.task.name, None)

    def on_CreateAOVoltageChan(self, request: Any) -> None:  # noqa: N802
        task = self.task(request)
        for part in request.physical_channel.split(","):
            device, _, outputs = part.strip().partition("/")
            if device != DEVICE:
                raise NiError(-200220)
            found = re.fullmatch(r"ao(\d+)(?::(?:ao)?(\d+))?", outputs)
            if found is None or int(found[2] or found[1]) >= len(self.outputs):
                raise NiError(-200170)
            task.channels += range(int(found[1]), int(found[2] or found[1]) + 1)
        if request.max_val > RANGE_V or request.min_val < -RANGE_V:
            raise NiError(-200077)
        task.low, task.high = request.min_val, request.max_val

    def on_CreateAIVoltageChan(self, request: Any) -> None:  # noqa: N802
        found = re.fullmatch(rf"{SENSORS}/ai(\d+)(?::(?:ai)?(\d+))?", request.physical_channel)
        if found is None or int(found[2] or found[1]) > self._coils:
            raise NiError(-200170)
        self.task(request).inputs += range(int(found[1]), int(found[2] or found[1]) + 1)

    def on_ReadAnalogF64(self, request: Any) -> dict[str, Any]:  # noqa: N802
        task = self.task(request)
        volts = self.outputs[task.inputs]
        if 0 in task.inputs and Path(os.environ.get("TWIN_FAULT", "")).is_file():
            volts[task.inputs.index(0)] *= 0.5
        return {"read_array": volts, "samps_per_chan_read": 1}

    def on_CfgSampClkTiming(self, request: Any) -> None:  # noqa: N802
        if request.rate > MAX_RATE_HZ:
            raise NiError(-200077)
        self.task(request).rate = request.rate

    def on_SetWriteAttributeInt32(self, request: Any) -> None:  # noqa: N802
        self.task(request).regenerates = request.value_raw == _REGENERATE

    def on_SetBufferAttributeUInt32(self, request: Any) -> None:  # noqa: N802
        self.task(request)

    def on_CfgOutputBuffer(self, request: Any) -> None:  # noqa: N802
        self.task(request)

    def on_GetTimingAttributeDouble(self, request: Any) -> dict[str, Any]:  # noqa: N802
        return {"value": self.task(request).rate}

    def on_GetTaskAttributeString(self, request: Any) -> dict[str, Any]:  # noqa: N802
        task = self.task(request)
        names = [*(f"{DEVICE}/ao{n}" for n in task.channels), *(f"{SENSORS}/ai{n}" for n in task.inputs)]
        return {"value": ", ".join(names)}

    def on_GetTaskAttributeUInt32(self, request: Any) -> dict[str, Any]:  # noqa: N802
        return {"value": len(self.task(request).channels)}

    def on_GetWriteAttributeUInt32(self, request: Any) -> dict[str, Any]:  # noqa: N802
        return {"value": len(self.task(request).channels)}

    def on_GetChanAttributeInt32(self, _request: Any) -> dict[str, Any]:  # noqa: N802
        return {"value_raw": 10102}

    def on_GetWriteAttributeUInt64(self, request: Any) -> dict[str, Any]:  # noqa: N802
        return {"value": self.task(request).played}

    def on_IsTaskDone(self, request: Any) -> dict[str, Any]:  # noqa: N802
        return {"is_task_done": self.task(request).began_ns is None}

    def on_GetDeviceAttributeString(self, request: Any) -> dict[str, Any]:  # noqa: N802
        return {"value": _TYPES[request.attribute_raw]}

    def on_GetDeviceAttributeUInt32(self, request: Any) -> dict[str, Any]:  # noqa: N802
        return {"value": _TYPES[request.attribute_raw]}

    def on_GetDeviceAttributeDouble(self, _request: Any) -> dict[str, Any]:  # noqa: N802
        return {"value": MAX_RATE_HZ}

    def on_GetDeviceAttributeDoubleArray(self, _request: Any) -> dict[str, Any]:  # noqa: N802
        return {"value": [-RANGE_V, RANGE_V]}

    def on_WriteAnalogF64(self, request: Any) -> dict[str, Any]:  # noqa: N802
        task = self.task(request)
        values = np.array(request.write_array).reshape(len(task.channels), -1).T
        if not (np.abs(values) <= task.high + 1e-9).all():
            raise NiError(-200077)
        if task.rate == 0.0:
            self._reserve(task)
            self._set(task.channels, values[-1])
        else:
            task.blocks.append(values)
            task.written += len(values)
        return {"samps_per_chan_written": len(values)}

    def on_StartTask(self, request: Any) -> None:  # noqa: N802
        task = self.task(request)
        self._reserve(task)
        task.began_ns = time.monotonic_ns()

    def on_StopTask(self, request: Any) -> None:  # noqa: N802
        task = self.tasks.get(request.task.name)
        if task is not None:
            task.began_ns = None
            if task.error:
                raise NiError(task.error)

    def on_ResetDevice(self, request: Any) -> None:  # noqa: N802
        if request.device_name != DEVICE:
            raise NiError(-200220)
        for task in self.tasks.values():
            task.error, task.began_ns = -88709, None
        if self._reset_zeroes:
            self._set(list(range(len(self.outputs))), 0.0)

    def _reserve(self, task: Task) -> None:
        for other in self.tasks.values():
            if other is not task and other.began_ns is not None and set(other.channels) & set(task.channels):
                raise NiError(-50103)


def _route(name: str) -> Any:
    def method(self: NiTwin, request: Any, context: Any) -> Any:
        return self.call(name, request, context)

    return method


for _name in [name.removeprefix("on_") for name in vars(NiTwin) if name.startswith("on_")]:
    setattr(NiTwin, _name, _route(_name))


def serve(file: Path, reset_zeroes: bool = True, coils: int = 3) -> tuple[grpc.Server, int, NiTwin]:
    """A running server, its port and what it serves."""
    server = grpc.server(futures.ThreadPoolExecutor(8))
    twin = NiTwin(file, reset_zeroes, coils)
    rpc.add_NiDAQmxServicer_to_server(twin, server)
    port = server.add_insecure_port("127.0.0.1:0")
    server.start()
    return server, port, twin


if __name__ == "__main__":
    running, bound, _twin = serve(Path(sys.argv[1]), reset_zeroes=len(sys.argv) < 4, coils=int((*sys.argv, 3)[2]))
    prioritise_process(Priority.GUARDIAN + 1)  # a device does not wait for the computer's other work
    print(bound, flush=True)
    sys.stdin.read()
