"""GigE Vision cameras on the loopback: the fake of Aravis, a program that nobody here wrote, and that of viva-genicam.

Both want UDP port 3956, so they are used by one test at a time.
"""

from __future__ import annotations

import fcntl
import os
import shutil
import signal
import socket
import struct
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from tests.conftest import until
from tests.twins.coils import environment

_ROOT = Path(__file__).parents[2]
PROGRAM = "arv-fake-gv-camera-0.8"
# Registers of the fake of Aravis, as its GenICam description states them.
WIDTH, HEIGHT, OFFSET_X, OFFSET_Y, PIXEL_FORMAT = 0x100, 0x104, 0x130, 0x134, 0x128
EXPOSURE_US, PERIOD_US = 0x120, 0x138
MONO16 = 0x01100007  # PFNC
installed = shutil.which(PROGRAM) is not None


@contextmanager
def port() -> Iterator[None]:
    """The port, for one test of this machine."""
    with (Path(tempfile.gettempdir()) / "gige-port-3956.lock").open("w") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        yield


def register(address: int, host: str = "127.0.0.1", timeout_s: float = 5.0) -> int:
    """A register of a GigE camera, read by the standard's own READREG: by nobody who may have cached it."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as line:
        line.settimeout(timeout_s)
        line.sendto(struct.pack(">BBHHHI", 0x42, 1, 0x80, 4, 7, address), (host, 3956))
        status, command, _, _, value = struct.unpack(">HHHHI", line.recv(100))
    assert (status, command) == (0, 0x81)
    return int(value)


class Aravis:
    """The fake of Aravis in its process; a context manager.

    Parameters
    ----------
    lost_packets : of a thousand.
    shown : the file of what it shows, see gige_images.py; None: a pattern. With one, no packets are lost.
    """

    def __init__(
        self, lost_packets: int = 0, serial: str = "T1", address: str = "127.0.0.1", shown: Path | None = None
    ) -> None:
        self._command = [PROGRAM, "-i", address, "-s", serial, "-r", str(lost_packets)]
        if shown is not None:
            self._command = [sys.executable, "-m", "tests.twins.gige_images", str(shown), serial]
        self._speaks, self._address = shown is not None, address
        self._process: subprocess.Popen[bytes] | None = None

    def __enter__(self) -> Aravis:
        self.plug_in()
        return self

    def __exit__(self, *error: object) -> None:
        self.unplug()

    def plug_in(self) -> None:
        """Start it, and wait until it answers."""
        silent = subprocess.DEVNULL
        told = subprocess.PIPE if self._speaks else silent
        self._process = subprocess.Popen(self._command, stdout=told, stderr=silent, cwd=_ROOT, env=environment())
        if self._process.stdout is not None:
            with self._process.stdout:
                self._process.stdout.readline()
        until(lambda: self._process is None or self._process.poll() is not None or self._speaks or self._answers())
        assert self._process.poll() is None, f"{PROGRAM} has ended; is port 3956 in use?"

    def _answers(self) -> bool:
        try:
            return register(WIDTH, self._address, timeout_s=0.1) > 0
        except OSError:
            return False

    def unplug(self) -> None:
        """kill -9: nothing is said to anybody."""
        assert self._process is not None
        self._process.kill()
        self._process.wait()

    def freeze(self) -> None:
        """It does nothing any more, as behind a cable that is pulled."""
        assert self._process is not None
        os.kill(self._process.pid, signal.SIGSTOP)

    def thaw(self) -> None:
        """It goes on."""
        assert self._process is not None
        os.kill(self._process.pid, signal.SIGCONT)
