"""Amplifier `ni`: analog outputs of an NI device, one a coil, which a process keeps in samples (ni_process.py)."""

from __future__ import annotations

import os
import select
import subprocess
import time
from collections import deque
from dataclasses import dataclass
from multiprocessing import Pipe
from typing import TYPE_CHECKING, Any, Self

import nidaqmx  # noqa: F401  here, so that a missing package is stated before a process is started

from flowrec.core import NS_PER_S, Floats, Measured, RigError, start_child
from flowrec.physics import Robot
from flowrec.rigs.lab.amplifiers.amplifier import KEEP_S, AmplifierInfo, not_before
from flowrec.stages import Coils, FieldCommand, FieldLog, MotionSegment, OutputLimits

if TYPE_CHECKING:
    from flowrec.stages import ResolvedConfig  # with every stage: this module starts without them

_START_S = 60.0  # the package of NI takes seconds to load on a busy computer, and so does a device
_ZERO_S = 0.5  # time for the process to confirm zero
_SILENT_S = 0.5  # a process that has written no block for so long is stuck
_END_S = 5.0  # time for the process to end by itself


@dataclass(frozen=True, slots=True)
class NiSettings:
    """Settings of the process; `inputs` and `volts_per_a` as of [lab.ni]."""

    channels: str
    server: str
    coils: Coils
    robot: Robot
    output: OutputLimits
    silence_s: float
    inputs: str = ""
    volts_per_a: float | tuple[float, ...] = 1.0


@dataclass(frozen=True, slots=True)
class Played:
    """A block that was written: when its first sample is put out, on the host's monotonic clock, and what it does."""

    from_ns: int
    segments: tuple[MotionSegment, ...]
    amplitude_mt: float
    currents_a: Floats  # (n,) at the first sample


class NiAmplifier:
    """See amplifier.Amplifier."""

    @classmethod
    def of(cls, config: ResolvedConfig) -> Self:
        """The amplifier of a configuration."""
        lab, ni = config.lab, config.lab.ni
        of_run = (config.coils, config.robot, lab.output, lab.guardian_s)
        return cls(NiSettings(ni.channels, ni.server, *of_run, ni.inputs, ni.volts_per_a))

    def __init__(self, settings: NiSettings) -> None:
        self._settings = settings
        self._process: subprocess.Popen[bytes] | None = None
        self._connection: Any = None  # the end of a multiprocessing.Pipe
        self._zero_pipe = self._done_pipe = -1
        self._permitted = False
        self._fault = ""
        self._read_back: Measured | None = None
        self._played_s = 0.0
        self._played: deque[Played] = deque()  # blocks whose time has not come
        self._cuts: deque[int] = deque()  # when zero() took the output to zero; any thread appends
        self._log = FieldLog(coils=settings.coils.count)

    def open(self) -> AmplifierInfo:
        self._fault = ""
        if os.name == "nt":
            raise RigError("lab.amplifier = 'ni' needs Linux or macOS; run flowrec there and set lab.ni.server")
        here, there = os.pipe(), os.pipe()
        ours, theirs = Pipe()
        descriptors = (theirs.fileno(), here[0], there[1])
        try:
            self._process = start_child(
                "flowrec.rigs.lab.amplifiers.ni_process",
                *map(str, descriptors),
                pass_fds=descriptors,
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
            )
        finally:
            theirs.close()
            os.close(here[0])
            os.close(there[1])
        self._zero_pipe, self._done_pipe, self._connection = here[1], there[0], ours
        try:
            ours.send(("open", self._settings))
            info: AmplifierInfo = self._wait("info", _START_S)
        except BaseException:
            self.close()
            raise
        return info

    def guard(self) -> tuple[tuple[str, ...], tuple[int, ...]]:
        return ("ni", self._settings.server, self._settings.channels), ()

    def arm(self) -> None:
        assert self._connection is not None
        self._connection.send(("arm",))
        self._wait("armed", _START_S)
        self._played_s = time.monotonic()
        self._permitted = True

    def apply(self, command: FieldCommand) -> None:
        if not self._permitted or self._connection is None:
            return
        self._hear()
        if self._fault:
            raise RigError(f"NI output: {self._fault}")
        if time.monotonic() - self._played_s > _SILENT_S:
            raise RigError(f"the process of the NI output has written nothing for {_SILENT_S:g} s")
        try:
            self._connection.send(("command", command))
        except OSError as error:
            raise RigError("the process of the NI output has ended") from error

    def put_out(self, until_ns: int) -> FieldLog:
        self._hear()
        while self._cuts:
            # Blocks that were written for later than a cut were not put out.
            cut_ns = self._cuts.popleft()
            self._log_played(cut_ns)
            self._played.clear()
            self._log.append(not_before(self._log, cut_ns), 0.0, 0.0, 0.0)
        self._log_played(until_ns + 1)
        self._log.forget(until_ns - round(KEEP_S * NS_PER_S))
        return self._log

    def read_back(self) -> Measured | None:
        """The latest measurement of the inputs; None: there is none yet."""
        self._hear()
        return self._read_back

    def zero(self) -> None:
        self._permitted = False
        if self._process is None:
            return
        try:
            # Pipes, and no lock: the loop may be stuck in the middle of anything.
            os.write(self._zero_pipe, b"Z")
            answered = select.select([self._done_pipe], [], [], _ZERO_S)[0]
            confirmed = bool(answered) and os.read(self._done_pipe, 1) != b""
        except OSError:
            confirmed = False
        if not confirmed:
            raise RigError("the process of the NI output does not confirm that the output is at zero")
        self._cuts.append(time.monotonic_ns())

    def close(self) -> None:
        if self._connection is not None:
            self._connection.close()
            self._connection = None
        if self._process is not None:
            try:
                self._process.wait(_END_S)
            except subprocess.TimeoutExpired:
                self._process.kill()
                self._process.wait()
            self._process = None
        for end in (self._zero_pipe, self._done_pipe):
            if end >= 0:
                os.close(end)
        self._zero_pipe = self._done_pipe = -1

    def _hear(self) -> None:
        """Take in what the process reports. Does not wait."""
        while self._connection is not None and not self._fault and self._report(0.0) is not None:
            pass

    def _report(self, timeout_s: float) -> tuple[str, Any] | None:
        """Take in the next report, which is returned; None: there is none in that time, or the process has ended."""
        try:
            if not self._connection.poll(timeout_s):
                return None
            what, *given = self._connection.recv()
        except (EOFError, OSError):
            self._fault = "its process has ended"
            return None
        if what == "block":
            self._played.append(given[0])
            self._played_s = time.monotonic()
        elif what == "measured":
            self._read_back = given[0]
        elif what == "fault":
            self._fault = given[0]
            self._cuts.append(time.monotonic_ns())
        return what, given[0] if given else None

    def _wait(self, wanted: str, timeout_s: float) -> Any:
        end_s = time.monotonic() + timeout_s
        while not self._fault:
            report = self._report(max(end_s - time.monotonic(), 0.0))
            if report is not None and report[0] == wanted:
                return report[1]
            if report is None and not self._fault:
                raise RigError(f"the process of the NI output does not answer in {timeout_s:g} s")
            if report is None:
                raise RigError("the process of the NI output has ended")
        raise RigError(self._fault)

    def _log_played(self, before_ns: int) -> None:
        """Log the blocks that begin before a time."""
        while self._played and self._played[0].from_ns < before_ns:
            one = self._played.popleft()
            self._log.extend(not_before(self._log, one.from_ns), one.segments, one.amplitude_mt, one.currents_a)
