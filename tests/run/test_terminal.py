"""The real command on a pseudo-terminal: keys, Ctrl-Z, a terminal that freezes or vanishes; the file is whole."""

from __future__ import annotations

import contextlib
import os
import pty
import select
import signal
import sys
import termios
import threading
import time
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from flowrec.store import SessionReader
from tests.conftest import until
from tests.short_missions import LONG, set_words

WORDS = set_words(LONG)


class Command:
    """`flowrec record --realtime` on a terminal of its own; what it says is read unless the terminal is frozen."""

    def __init__(self, out: Path, outer: int, inner: int) -> None:
        self.out, self.keys, self.inner = out, outer, inner
        self.before = termios.tcgetattr(self.keys)
        self.said, self.frozen, self.reads, self.status = b"", False, True, None
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DeprecationWarning)  # of Python 3.12: other threads run
            self.pid = os.fork()
        if self.pid == 0:  # only what is safe after a fork, then another program
            signal.signal(signal.SIGHUP, signal.SIG_DFL)  # the tests themselves may run under nohup
            _login_tty(inner)
            words = [sys.executable, "-m", "flowrec", "record", "--realtime", "--out", str(out), *WORDS]
            os.execvp(words[0], words)
        threading.Thread(target=self._read, daemon=True).start()

    def _read(self) -> None:
        while True:
            self.reads = not self.frozen
            with contextlib.suppress(OSError, ValueError):
                if self.reads and select.select([self.keys], [], [], 0.05)[0]:
                    self.said += os.read(self.keys, 65536)
                    continue
            if self.status is not None or self.keys < 0:
                return
            time.sleep(0.01)

    def until(self, happened: Callable[[], bool]) -> None:
        until(happened, lambda: self.said.decode(errors="replace"))

    def ended(self) -> bool:
        if self.status is None:
            done, status = os.waitpid(self.pid, os.WNOHANG)
            self.status = os.waitstatus_to_exitcode(status) if done else None
        return self.status is not None

    def press(self, keys: str) -> None:
        os.write(self.keys, keys.encode())

    @property
    def raw(self) -> bool:
        return not termios.tcgetattr(self.keys)[3] & termios.ICANON

    def stopped(self) -> bool:
        done, status = os.waitpid(self.pid, os.WNOHANG | os.WUNTRACED)
        return bool(done) and os.WIFSTOPPED(status)

    def outcome(self) -> tuple[str, str]:
        reader = SessionReader(self.out)
        last = reader.tick_before(reader.last_ns, with_frames=False)
        assert last.currents is not None
        assert last.currents.amplitude_mt == 0.0
        return reader.outcome["outcome"], reader.outcome["note"]


def _login_tty(inner: int) -> None:
    import fcntl

    os.setsid()
    fcntl.ioctl(inner, termios.TIOCSCTTY, 0)
    for descriptor in (0, 1, 2):
        os.dup2(inner, descriptor)


@pytest.fixture
def command(tmp_path: Path) -> Iterator[Command]:
    outer, inner = pty.openpty()
    run = Command(tmp_path / "run.mcap", outer, inner)
    try:
        run.until(lambda: b"mission: start" in run.said)
        yield run
    finally:
        with contextlib.suppress(ProcessLookupError, ChildProcessError):
            if not run.ended():
                os.kill(run.pid, signal.SIGKILL)
                os.waitpid(run.pid, 0)
        run.status = run.status if run.status is not None else -9
        for descriptor in (outer, inner):
            with contextlib.suppress(OSError):
                os.close(descriptor)


@pytest.mark.slow("a process that records in real time in a terminal")
def test_keys_are_recorded_and_the_terminal_is_given_back_to_the_shell_at_the_end(command: Command) -> None:
    assert b"keys: q stop" in command.said
    command.until(lambda: command.raw)
    command.press("mnlooks g\x7fgood")
    command.until(lambda: b"looks good_" in command.said)
    command.press("\r ")
    command.until(lambda: b"HELD" in command.said)
    command.press(" q")
    command.until(command.ended)
    assert command.status == 0
    assert termios.tcgetattr(command.keys) == command.before
    assert command.outcome() == ("stopped", "stopped by the operator (q)")
    events = list(SessionReader(command.out).messages("operator"))
    # On a busy machine the watchdog takes the field away now and then; that is not the operator's.
    pressed = [event.action for event in events if event.action != "zero"]
    assert pressed == ["mark", "note", "pause", "resume", "stop"]
    assert events[1].text == "looks good"


@pytest.mark.slow("a process that records in real time in a terminal")
def test_ctrl_z_gives_the_terminal_back_to_the_shell_and_ends_the_run(command: Command) -> None:
    command.until(lambda: command.raw)
    command.press("\x1a")
    command.until(command.stopped)
    assert not command.raw
    os.kill(command.pid, signal.SIGCONT)  # fg
    command.until(command.ended)
    assert command.status == 0
    assert command.outcome() == ("stopped", "operator: zero field (SIGTSTP: Ctrl-Z)")
    assert termios.tcgetattr(command.keys) == command.before


@pytest.mark.slow("a process that records in real time in a terminal")
def test_a_frozen_terminal_neither_stops_the_run_nor_its_end(command: Command) -> None:
    command.frozen = True
    command.press("\x13")  # Ctrl-S: whatever is printed from now on waits for ever
    size = command.out.with_name(command.out.name + ".partial").stat
    grown = size().st_size + 1_000_000
    command.until(lambda: size().st_size > grown)
    os.kill(command.pid, signal.SIGTERM)
    command.until(command.ended)
    assert command.status == 0
    assert command.outcome() == ("stopped", "stopped by SIGTERM")
    assert termios.tcgetattr(command.keys) == command.before


@pytest.mark.slow("the real command on a terminal of its own")
def test_when_the_terminal_is_closed_the_run_ends_in_good_order(command: Command) -> None:
    command.frozen = True
    command.until(lambda: not command.reads)  # or the thread would read of a descriptor that is closed
    os.close(command.inner)
    os.close(command.keys)
    command.until(command.ended)
    assert command.outcome() == ("stopped", "stopped by SIGHUP: the terminal was closed")
