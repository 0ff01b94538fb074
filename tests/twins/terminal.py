"""A device on a pseudo terminal, whose thread answers what comes in lines."""

from __future__ import annotations

import os
import select
import threading

import pytest

pty = pytest.importorskip("pty", reason="no pseudo terminals on this system")
tty = pytest.importorskip("tty", reason="no pseudo terminals on this system")


class TerminalTwin:
    """Subclasses answer lines, and may send by themselves every 10 ms."""

    def __init__(self) -> None:
        self._master, self._slave = pty.openpty()
        tty.setraw(self._slave)
        self.port = os.ttyname(self._slave)
        self.lines: list[str] = []
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def answer(self, line: str) -> None:
        """A line has come."""

    def idle(self) -> None:
        """What is sent unasked."""

    def send(self, text: str) -> None:
        os.write(self._master, text.encode())

    def _run(self) -> None:
        taken = b""
        while not self._closing.is_set():
            if select.select([self._master], [], [], 0.01)[0]:
                taken += os.read(self._master, 100)
                *lines, taken = taken.split(b"\n")
                for line in map(bytes.decode, lines):
                    self.lines.append(line)
                    self.answer(line)
            self.idle()

    def unplug(self) -> None:
        self._closing.set()
        self._thread.join()
        os.close(self._master)
        os.close(self._slave)
