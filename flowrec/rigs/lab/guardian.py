"""The guardian: a process that takes the coils to zero when the recorder dies, stops or hangs.

It is started before anything is energised. The loop sends it a byte at every step of its work (`Guardian.beat`); no
thread does, because a thread may outlive a loop that hangs. The guardian takes the output to zero
- at the end of its pipe: the recorder is gone, whatever ended it. The kernel closes the pipe of a killed process after
  its memory, which takes 0.1 s and more on a busy computer: then the silence below comes first;
- after `silence_s` without a byte while a field is on: the recorder is stopped, stuck, or keeps the interpreter's lock;
- when it is asked to, because the amplifier does not confirm a zero.
It runs in a session of its own and ignores the signals that end a terminal's processes. If it dies first, the next beat
raises an error, and the recorder takes the output to zero itself.

The child is `python -m flowrec.rigs.lab.guardian SILENCE_S BEATS STATUS KIND ...`, with one of
    serial FD                 newline and Z on a descriptor of the open port
    ni SERVER CHANNELS        reset of the devices, by the local driver ('') or the gRPC server at host:port
    call MODULE:NAME WORD...  what the function of another package makes of the words: called without arguments, it
                              takes the output to zero and returns how that went; an exception: it did not

What it can not do: it is a process of the same computer. It can not help when the kernel, the computer's power or the
cable fails. A serial amplifier then has its own timer; an NI device holds its last voltage. Only an interlock in
hardware covers that: an amplifier with an enable input, an emergency stop in its supply.
"""

from __future__ import annotations

import contextlib
import gc
import importlib
import os
import select
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from typing import Self

from flowrec.core import Priority, RigError, prioritise_process, start_child

SILENCE_S = 0.1
ONLY_HARDWARE = (
    "no program covers a dead computer or cable: a serial amplifier then has its own timer, an NI device holds its "
    "last voltage; use amplifiers with an enable input and an emergency stop in their supply"
)
SERIAL_ZERO = b"\nZ\n"  # as in serial_protocol.py, which would load much more
_START_S = 60.0  # NI's package takes seconds to load on a busy computer
_ANSWER_S = 0.5  # a guardian that has not read a beat for so long does not guard
_REPORT_S = 3.0
_TRY_S = 2.0  # for the guardian's attempts
_ON, _OFF, _TRIP, _QUIT, _PROBE = b"1", b"0", b"T", b"Q", b"P"


class Guardian:
    """The guardian as the recorder sees it: a context in which its process runs.

    Parameters
    ----------
    action : KIND and its arguments, see above; descriptors : what the child inherits for them.
    silence_s : longest time between beats while a field is on.
    clock : monotonic time in s.
    """

    def __init__(
        self,
        action: Sequence[str],
        descriptors: Sequence[int] = (),
        silence_s: float = SILENCE_S,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._clock = clock
        self._action = tuple(action)
        self._descriptors = tuple(descriptors)
        self.silence_s = silence_s
        self._process: subprocess.Popen[bytes] | None = None
        self._beats = self._status = -1
        self._heard = b""
        self._unanswered_s: float | None = None  # since when the oldest beat that was not answered waits

    def __enter__(self) -> Self:
        """Start the process, and wait until it can act.

        Raises
        ------
        RigError : it does not start; nothing may be energised.
        """
        if os.name == "nt":
            raise RigError("the guardian process needs Linux or macOS; nothing is energised")
        read_beats, self._beats = os.pipe()  # not inheritable: no other child keeps the pipe open
        self._status, write_status = os.pipe()
        command = [f"{self.silence_s:g}", str(read_beats), str(write_status), *self._action]
        try:
            self._process = start_child(
                "flowrec.rigs.lab.guardian",
                *command,
                pass_fds=(read_beats, write_status, *self._descriptors),
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.PIPE,
            )
        except OSError as error:
            self._release()
            raise RigError(f"the guardian process does not start ({error}); nothing is energised") from error
        finally:
            os.close(read_beats)
            os.close(write_status)
        if sys.platform != "win32":
            for end in (self._beats, self._status):
                os.set_blocking(end, False)
        if self._report(b"ready", _START_S) is None:
            self._process.kill()
            lines = self._process.communicate()[1].decode(errors="replace").strip().splitlines()
            self._release()
            said = lines[-1] if lines else "it says nothing"
            raise RigError(f"the guardian process does not start: {said}; nothing is energised")
        return self

    def __exit__(self, *error: object) -> None:
        """End the process; the output is at zero by now."""
        with contextlib.suppress(OSError):  # it has ended already
            os.write(self._beats, _QUIT)
        self._release()

    def beat(self, energised: bool) -> None:
        """Tell the guardian that the loop works, and whether a field is on. Does not wait.

        Raises
        ------
        RigError : the guardian has acted, has ended or is stuck: the field must go, and the run must end.
        """
        self._hear()
        try:
            os.write(self._beats, _ON if energised else _OFF)
        except OSError as error:  # no reader, or a full pipe
            raise RigError(self.tripped or f"the guardian process has ended ({error}); the run ends") from error
        if self.tripped:
            raise RigError(self.tripped)
        now_s = self._clock()
        self._unanswered_s = now_s if self._unanswered_s is None else self._unanswered_s
        if now_s - self._unanswered_s > _ANSWER_S:
            raise RigError(f"the guardian process has not answered for {_ANSWER_S:g} s; the run ends")

    @property
    def tripped(self) -> str:
        """Sentence on the guardian's intervention and its reason; '' if it has not acted."""
        line = _line(self._heard, b"tripped")
        return f"the guardian has switched the coils off: {line}" if line else ""

    def trip(self) -> bool:
        """Have the output taken to zero now, and end the process; whether it confirms. Any thread."""
        with contextlib.suppress(OSError):  # it has acted already, or is gone
            os.write(self._beats, _TRIP)
        said = self._report(b"tripped", _REPORT_S)
        return said is not None and "failed" not in said

    def probe(self) -> float:
        """Time from a request until the output is confirmed to be at zero, in s; for an output that is at zero.

        Raises
        ------
        RigError : the guardian can not take the output to zero.
        """
        begin_s = time.monotonic()
        os.write(self._beats, _PROBE)
        said = self._report(b"probed", _REPORT_S)
        if said is None or "failed" in said:
            raise RigError(f"the guardian can not take the output to zero: {said or 'no answer'}")
        took_s = time.monotonic() - begin_s
        self._heard = self._heard.replace(b"probed", b"")
        return took_s

    def _report(self, word: bytes, timeout_s: float) -> str | None:
        """The rest of the guardian's line that begins with a word; None: there is none in that time."""
        end_s = time.monotonic() + timeout_s
        while (line := _line(self._heard, word)) is None:
            left_s = end_s - time.monotonic()
            if left_s <= 0.0 or self._status < 0:
                return None
            if select.select([self._status], [], [], left_s)[0] and not self._hear():
                return _line(self._heard, word)
        return line

    def _hear(self) -> bool:
        """Take in what the guardian has said; False at the end of its pipe."""
        with contextlib.suppress(BlockingIOError):
            said = os.read(self._status, 65_536)
            if not said:
                return False
            self._unanswered_s = None
            self._heard = (self._heard + said.replace(b".", b""))[-4096:]
        return True

    def _release(self) -> None:
        for end in (self._beats, self._status):
            if end >= 0:
                os.close(end)
        self._beats = self._status = -1
        if self._process is None:
            return
        assert self._process.stderr is not None
        try:
            self._process.wait(_REPORT_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._process.stderr.close()
        self._process = None


def _line(heard: bytes, word: bytes) -> str | None:
    """The rest of the line that begins with a word; None: there is none."""
    for line in heard.split(b"\n")[:-1]:
        if line.startswith(word):
            return line[len(word) :].strip().decode(errors="replace")
    return None


# ---- the process

assert sys.platform != "win32"  # there is no termios
import termios  # noqa: E402


def main(arguments: Sequence[str]) -> int:
    """The guardian process; see above. Returns its exit status: 0 after an orderly end, 3 after it has acted."""
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGQUIT, signal.SIGPIPE, signal.SIGTSTP):
        signal.signal(number, signal.SIG_IGN)
    silence_s, beats, status = float(arguments[0]), int(arguments[1]), int(arguments[2])
    kind, words = arguments[3], arguments[4:]
    kinds: dict[str, Callable[..., Callable[[], str]]] = {"serial": _serial_zero, "ni": _ni_zero, "call": _others_zero}
    zero = kinds[kind](*words)
    rehearsal = _try(zero)  # the output is at zero; whatever loads late, or does not work, does so now
    if "failed" in rehearsal:
        sys.stderr.write(rehearsal)
        return 1
    gc.freeze()
    gc.disable()
    # Above the recorder. Without the right to it the guardian is an ordinary process.
    prioritise_process(Priority.GUARDIAN)
    os.set_blocking(status, False)
    _say(status, "ready")
    cause = watch(
        lambda timeout_s: os.read(beats, 4096) if select.select([beats], [], [], timeout_s)[0] else None,
        silence_s,
        lambda: _say(status, ".", end=""),
        lambda: _say(status, f"probed {_try(zero)}"),
    )
    if not cause:
        return 0
    begin_s = time.monotonic()
    how = _try(zero)
    _say(status, f"tripped {cause}; {how} in {1e3 * (time.monotonic() - begin_s):.0f} ms")
    return 3


def watch(
    heard: Callable[[float | None], bytes | None],
    silence_s: float,
    answer: Callable[[], None],
    probe: Callable[[], None],
    clock: Callable[[], float] = time.monotonic,
) -> str:
    """Hear beats until there is a reason to act. Returns it; '' at an orderly end.

    Parameters
    ----------
    heard : waits at most so many seconds (None: for ever) for what the recorder says; b'' at the end of its pipe, None:
        nothing in that time.
    silence_s : longest time between beats while a field is on.
    answer, probe : called after each beat, and when a probe is asked for.
    clock : monotonic time in s.
    """
    energised, heard_s = False, clock()
    while True:
        left_s = heard_s + silence_s - clock() if energised else None
        said = heard(None if left_s is None else max(left_s, 0.0))
        if said is None:
            return f"no beat of the loop for {1e3 * silence_s:.0f} ms"
        if not said:
            return "the recorder has ended"
        if _TRIP in said:
            return "asked to"
        if _QUIT in said:
            return ""
        heard_s = clock()
        if _PROBE in said:
            probe()
        energised = said.endswith(_ON)
        answer()


def _try(zero: Callable[[], str]) -> str:
    """Take the output to zero, again and again if it fails; how it went."""
    end_s = time.monotonic() + _TRY_S
    while True:
        try:
            return zero()
        except Exception as error:  # noqa: BLE001  whatever a driver raises, it is tried again
            if time.monotonic() > end_s:
                return f"zero failed: {str(error).splitlines()[0] if str(error) else error!r}"
        time.sleep(0.01)


def _others_zero(target: str, *words: str) -> Callable[[], str]:
    """The function of another package that takes its own amplifier to zero."""
    module, _, name = target.partition(":")
    return getattr(importlib.import_module(module), name)(*words)


def _serial_zero(descriptor: str) -> Callable[[], str]:
    """Newline and Z. The newline ends a line that the recorder may have left half written."""
    port = int(descriptor)

    def zero() -> str:
        with contextlib.suppress(termios.error):
            termios.tcflush(port, termios.TCOFLUSH)  # what a stopped recorder has left in the queue
        for _ in range(5):
            os.write(port, SERIAL_ZERO)
            # A recorder that lives may read the answer first: then the repetitions have to do.
            if select.select([port], [], [], 0.02)[0]:
                with contextlib.suppress(BlockingIOError):
                    if b"Z" in os.read(port, 4096):
                        return "zero confirmed"
        return "zero sent"

    return zero


def _ni_zero(server: str, channels: str) -> Callable[[], str]:
    """Reset of the devices, which aborts every task of theirs, whoever owns it; then zero volts."""
    from flowrec.rigs.lab.amplifiers.ni_device import grpc_options, reset

    options = grpc_options(server) if server else None

    def zero() -> str:
        reset(channels, options)
        return "zero confirmed"

    return zero


def _say(status: int, text: str, end: str = "\n") -> None:
    with contextlib.suppress(OSError):  # nobody listens any more, or reads
        os.write(status, (text + end).encode())


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
