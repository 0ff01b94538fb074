"""The process that keeps an NI analog output in samples, so that nothing the loop does can make it run dry.

It is `python -m flowrec.rigs.lab.amplifiers.ni_process CONNECTION ZERO DONE`, with open descriptors: a connection of
multiprocessing for orders and reports, a pipe whose bytes ask for zero, and one whose bytes confirm it. The orders are
("open", NiSettings), ("arm",) and ("command", FieldCommand); the reports ("info", AmplifierInfo), ("armed",),
("block", Played), ("measured", Measured), where there are inputs, and ("fault", text).

Blocks of 50 ms are written two ahead and are not generated again. An output that runs dry, a device that was reset, a
sample beyond a limit, or no order for `silence_s` while a field is on: all end in zero, and only a new "arm" leads out.
"""

from __future__ import annotations

import gc
import os
import select
import signal
import sys
import time
from collections import deque
from collections.abc import Sequence
from dataclasses import replace
from multiprocessing.connection import Connection
from typing import Any

import numpy as np

from flowrec.core import (
    NS_PER_S,
    DeviceClock,
    Fit,
    Floats,
    FlowrecError,
    Measured,
    Priority,
    RigError,
    prioritise_process,
    seconds,
)
from flowrec.rigs.lab.amplifiers.limits import CommandLimits
from flowrec.rigs.lab.amplifiers.ni import NiSettings, Played
from flowrec.rigs.lab.amplifiers.ni_device import NiDevice, NiInputs, reason
from flowrec.rigs.lab.amplifiers.waveform import Waveform
from flowrec.stages import FieldCommand

BLOCK_S = 0.05
BLOCKS_AHEAD = 2  # in the device's buffer: with one, a late block would end the output
LATENCY_S = (BLOCKS_AHEAD + 0.5) * BLOCK_S  # mean time from an order to its samples
_READ_S = 0.01  # between measurements of the currents
_KEPT_BLOCKS = 2 * BLOCKS_AHEAD + 2  # of which a measurement may be
_REST = FieldCommand()


class Stream:
    """The output of blocks, from the start to zero."""

    def __init__(self, device: NiDevice, limits: CommandLimits) -> None:
        self._device = device
        self._rate_hz = device.start(BLOCK_S)
        self._count = round(BLOCK_S * self._rate_hz)
        self._waveform = Waveform(limits, self._rate_hz)
        self._written = 0
        self._clock = DeviceClock(unit=NS_PER_S / self._rate_hz, wrap=1 << 63)
        self._fit: Fit | None = None
        # First samples, and currents (n, coils), of the latest blocks.
        self._blocks: deque[tuple[int, Floats]] = deque(maxlen=_KEPT_BLOCKS)
        for _ in range(BLOCKS_AHEAD):
            self._write(_REST)
        self._began_ns = device.run()

    @property
    def amplitude_mt(self) -> float:
        """Amplitude of the field at the end of what is written."""
        return self._waveform.amplitude_mt

    def due_s(self) -> float:
        """Time until the next block is to be written."""
        ahead_s = seconds(self._stamp_ns(self._written) - time.monotonic_ns())
        return ahead_s - BLOCKS_AHEAD * BLOCK_S

    def refill(self, command: FieldCommand) -> list[Played]:
        """Write what is missing of two blocks ahead. Returns it.

        Raises
        ------
        RigError : a sample beyond a limit. DaqError : the output ran dry, or was stopped.
        """
        played = []
        while self.due_s() <= 0.0:  # by the clock: the block comes first, the question how far the output is second
            from_ns = self._stamp_ns(self._written)
            block = self._write(command)
            played.append(Played(from_ns, block.segments, block.amplitude_mt, block.currents_a[0]))
        generated, arrival_ns = self._device.samples_generated()
        self._fit = self._clock.take(self._fit, generated, arrival_ns)
        if self._written - generated > 2 * BLOCKS_AHEAD * self._count:
            raise RigError(f"the output stands still at sample {generated}: was the device reset?")
        return played

    def _write(self, command: FieldCommand) -> Any:
        block = self._waveform.block(command, self._count)
        self._device.write(block.voltages_v)
        self._blocks.append((self._written, block.currents_a))
        self._written += self._count
        return block

    def currents_a(self, at_ns: int) -> Floats:
        """Currents (coils,) that are put out at a time of the host's monotonic clock."""
        fit = self._fit
        period_ns = NS_PER_S / self._rate_hz if fit is None else fit.rate
        since = (0, self._began_ns) if fit is None else (fit.last[0], fit.stamp_ns)
        at = since[0] + (at_ns - since[1]) / period_ns
        first, currents = next((each for each in reversed(self._blocks) if each[0] <= at), self._blocks[0])
        return currents[int(np.clip(at - first, 0, len(currents) - 1))]

    def _stamp_ns(self, sample: int) -> int:
        """Time at which a sample is put out."""
        if self._fit is None:
            return self._began_ns + round(sample * NS_PER_S / self._rate_hz)
        return self._fit.stamp_ns + round((sample - self._fit.last[0]) * self._fit.rate)


class Server:
    """Obeys orders until the connection ends."""

    def __init__(self, connection: Connection, zero: int, done: int) -> None:
        self._connection, self._zero, self._done = connection, zero, done
        self._settings: NiSettings | None = None
        self._device: NiDevice | None = None
        self._inputs: NiInputs | None = None
        self._read_s = 0.0
        self._stream: Stream | None = None
        self._command = _REST
        self._ordered_s = 0.0

    def serve(self) -> None:
        """The whole life of the process."""
        try:
            while True:
                wait_s = max(self._stream.due_s(), 0.0) if self._stream is not None else None
                wait_s = min(wait_s, _READ_S) if wait_s is not None and self._inputs is not None else wait_s
                ready = select.select([self._zero, self._connection.fileno()], [], [], wait_s)[0]
                if self._zero in ready:
                    os.read(self._zero, 4096)
                    self._stop()
                    os.write(self._done, b".")
                if self._connection.fileno() in ready:
                    self._take()
                if self._stream is not None and self._stream.due_s() <= 0.0:
                    self._play()
                if self._inputs is not None and time.monotonic() - self._read_s >= _READ_S:
                    self._measure(self._inputs)
        except (EOFError, OSError):  # the recorder is gone
            pass
        finally:
            self._stop()
            if self._inputs is not None:
                self._inputs.close()

    def _take(self) -> None:
        while self._connection.poll():
            order, *given = self._connection.recv()
            self._ordered_s = time.monotonic()
            if order == "command":
                self._command = given[0]
                continue
            try:
                if order == "open":
                    self._open(given[0])
                else:
                    self._arm()
            except Exception as error:  # noqa: BLE001  whatever a driver raises: the recorder states it
                self._fault(error)

    def _open(self, settings: NiSettings) -> None:
        self._settings = settings
        coils = settings.coils
        device = NiDevice(settings.channels, settings.server, coils.amplifier, coils.count, LATENCY_S)
        device.take()
        self._device = device  # from now on its outputs are taken to zero at the end, whoever uses them
        if settings.inputs:
            _inputs_of(settings).close()  # that they are there; the guardian resets a device that has outputs, too
        prioritise_process(Priority.DEVICE)  # now that the driver has started its threads
        self._connection.send(("info", replace(device.info, measures=bool(settings.inputs))))

    def _arm(self) -> None:
        assert self._settings is not None and self._device is not None
        s = self._settings
        self._command = _REST
        if self._inputs is not None:
            self._inputs.close()
        self._inputs = _inputs_of(s) if s.inputs else None
        self._stream = Stream(self._device, CommandLimits(s.coils, s.robot, s.output))
        self._connection.send(("armed",))

    def _play(self) -> None:
        assert self._stream is not None and self._settings is not None
        silent_s = time.monotonic() - self._ordered_s
        try:
            on = self._command.amplitude_mt > 0.0 or self._stream.amplitude_mt > 0.0
            if on and silent_s > self._settings.silence_s:
                raise RigError(f"no order of the loop for {1e3 * self._settings.silence_s:.0f} ms")
            for played in self._stream.refill(self._command):
                self._connection.send(("block", played))
        except (BrokenPipeError, ConnectionError):
            raise
        except Exception as error:  # noqa: BLE001  whatever a driver raises ends in zero
            self._fault(error)

    def _measure(self, inputs: NiInputs) -> None:
        """Read the currents while there is an output; where they are not read, the output goes to zero."""
        if self._stream is None:
            return
        try:
            currents_a, at_ns = inputs.currents_a()
            self._read_s = time.monotonic()
            measured = Measured(at_ns, currents_a, self._stream.currents_a(at_ns))
            self._connection.send(("measured", measured))
        except (BrokenPipeError, ConnectionError):
            raise
        except Exception as error:  # noqa: BLE001  whatever a driver raises ends in zero
            self._fault(error)

    def _stop(self) -> None:
        self._stream, self._command = None, _REST
        if self._device is not None:
            self._device.zero()

    def _fault(self, error: Exception) -> None:
        """Zero first, then say why."""
        text = str(error) if isinstance(error, FlowrecError) else reason(error)
        try:
            self._stop()
        except Exception as failure:  # noqa: BLE001
            text += f"; zero failed: {reason(failure)}"
        self._connection.send(("fault", text))


def _inputs_of(settings: NiSettings) -> NiInputs:
    volts_per_a = np.atleast_1d(settings.volts_per_a)
    return NiInputs(settings.inputs, settings.server, volts_per_a, settings.coils.count)


assert sys.platform != "win32"  # there is no SIGHUP; NiAmplifier refuses to start this process


def main(arguments: Sequence[str]) -> None:
    """The process; see above."""
    gc.disable()  # a collection takes as long as a write
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)  # the end of its connection ends it
    connection, zero, done = (int(word) for word in arguments)
    Server(Connection(connection), zero, done).serve()


if __name__ == "__main__":
    main(sys.argv[1:])
