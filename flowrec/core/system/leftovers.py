"""Temporary files and folders: their names say which process made them, and those of killed processes are removed.

A name is `.flowrec-HOST-PID-START-RANDOM`. HOST is a hash of the machine and of what the numbers of processes mean
there (a container has its own), START is when the process began, because numbers are given again. What another host
has made is never touched, because nobody here can tell whether that process lives.
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
import json
import os
import re
import shutil
import socket
import sys
from pathlib import Path

PREFIX = ".flowrec-"
OLD = "-old"  # behind the name: a folder that a new one is taking the place of
MARKER = "flowrec_export.json"  # in a folder of an export
_NAME = re.compile(r"\.flowrec-(?P<host>[0-9a-f]{8})-(?P<pid>\d{1,10})-(?P<start>\d{1,20})-[0-9a-f]{12}(-old)?(\.\w+)*")


def temporary_name(suffix: str = "") -> str:
    """A new name for a file or folder that this process makes and renames or removes."""
    return f"{PREFIX}{_host()}-{os.getpid()}-{_start(os.getpid())}-{os.urandom(6).hex()}{suffix}"


@functools.cache
def remove_leftovers_once(folder: Path) -> None:
    """Do `remove_leftovers` before this process writes into a folder for the first time."""
    remove_leftovers(folder)


def remove_leftovers(folder: Path) -> list[Path]:
    """Remove what killed processes of this host have left in a folder; what can not be removed stays.

    A folder of which only the last step was missing gets its name instead.

    Returns
    -------
    What was removed, in order of name.
    """
    found, removed = [], []
    with contextlib.suppress(OSError):  # who writes into the folder says what is wrong with it
        found = sorted(folder.glob(f"{PREFIX}*"))
    for path in found:
        if _is_abandoned(path.name) and path.exists():
            with contextlib.suppress(OSError):  # of another user: nothing is lost, and it is no matter of this command
                _complete_replacement(path)
                if path.is_dir():
                    shutil.rmtree(path)
                else:
                    path.unlink()
                removed.append(path)
    return removed


def _complete_replacement(path: Path) -> None:
    """Name a folder whose process was killed after it had moved the former one away: it was whole by then."""
    former = path.with_name(path.name + OLD)
    if not former.is_dir():
        return
    try:
        name = json.loads((path / MARKER).read_text(encoding="utf-8"))["name"]
    except (ValueError, KeyError, TypeError):
        return
    target = path.with_name(Path(str(name)).name)
    if not os.path.lexists(target):
        path.rename(target)


def _is_abandoned(name: str) -> bool:
    """True if a name is that of a temporary file whose process, of this host, has ended."""
    found = _NAME.fullmatch(name)
    ended = False
    if sys.platform != "win32" and found is not None and found["host"] == _host():  # there asking would end the process
        ended = _has_ended(int(found["pid"]), int(found["start"]))
    return ended


def _has_ended(pid: int, start: int) -> bool:
    """True if a process is gone; another one that was given its number began at another time."""
    try:
        os.kill(pid, 0)
    except (ProcessLookupError, OverflowError):
        return True
    except OSError:  # of another user
        return False
    return _start(pid) != start


@functools.cache
def _host() -> str:
    places = Path("/etc/machine-id"), Path("/var/lib/dbus/machine-id")
    machine = next((place.read_text(errors="replace") for place in places if place.is_file()), "")
    try:
        processes = str(Path("/proc/self/ns/pid").readlink())
    except OSError:
        processes = ""
    return hashlib.sha256(f"{socket.gethostname()} {machine} {processes}".encode()).hexdigest()[:8]


def _start(pid: int) -> int:
    """Start time of a process, in ticks since the machine started; 0 where the system does not say."""
    try:
        text = Path(f"/proc/{pid}/stat").read_text(errors="replace")
    except OSError:
        return 0
    return int(text.rpartition(")")[2].split()[19])  # the name of the program is in parentheses, and may hold any
