"""Processes of flowrec: how a child or a pool of them is started, real-time (SCHED_FIFO) priority, and memory."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from enum import IntEnum
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from concurrent.futures import ProcessPoolExecutor


class Priority(IntEnum):
    """Real-time priorities of SCHED_FIFO: what must not wait for what.

    Above every ordinary thread, below those of the kernel and of sound and field-bus servers, which ask for more.
    """

    WRITER = 1  # an ordinary one would stand still, with the interpreter's lock, wherever the computer is busy
    LOOP = 2
    DEVICE = 3  # what reads devices, takes signals, or watches the loop
    GUARDIAN = 4


def child_command(module: str, *words: str) -> list[str]:
    """The command that runs a module of flowrec as a program, with the same interpreter."""
    return [sys.executable, "-P", "-m", module, *words]


def child_environment() -> dict[str, str]:
    """Environment of a child: it finds modules where this process does, except in the working directory.

    There a file of the user, such as filterpy.py, would shadow a library. If flowrec itself is imported from the
    working directory (a checkout), that stays.
    """
    home = str(Path(__file__).resolve().parents[3])
    here = Path.cwd()
    kept = [place for place in sys.path if place and (place == home or Path(place).resolve() != here)]
    return os.environ | {"PYTHONPATH": os.pathsep.join(kept if home in kept else [home, *kept])}


def start_child(
    module: str, *words: str, environment: Mapping[str, str] | None = None, **given: Any
) -> subprocess.Popen[bytes]:
    """Start a module of flowrec as a program in a session of its own: what ends the child is its parent, not Ctrl-C.

    Raises OSError: it does not start.

    Parameters
    ----------
    environment : variables besides those of every child.
    given : as of subprocess.Popen; by default there are pipes to and from the child.
    """
    process: subprocess.Popen[Any] = subprocess.Popen(  # noqa: S603 - our own module
        child_command(module, *words),
        start_new_session=True,
        env=child_environment() | dict(environment or {}),
        **({"stdin": subprocess.PIPE, "stdout": subprocess.PIPE} | given),
    )
    return process


@contextmanager
def interrupted_too(process: subprocess.Popen[bytes]) -> Iterator[None]:
    """Context in which a child is waited for: what leaves it, such as Ctrl-C, interrupts the child, which may end."""
    try:
        yield
    except BaseException:
        process.send_signal(signal.SIGINT)  # in a session of its own, it has not seen Ctrl-C
        process.communicate()  # it completes its file, and has its own limits for the rest
        raise


@contextmanager
def pool(processes: int) -> Iterator[ProcessPoolExecutor]:
    """New processes for work that is shared out.

    They end with the block: after their work, or at once, where an exception such as Ctrl-C leaves it. They end with
    this process, too, also where it is killed.
    """
    import multiprocessing
    from concurrent.futures import ProcessPoolExecutor

    executor = ProcessPoolExecutor(processes, multiprocessing.get_context("spawn"), _end_with_parent)
    try:
        yield executor
    except BaseException:
        running = list((getattr(executor, "_processes", None) or {}).values())
        executor.shutdown(wait=False, cancel_futures=True)
        for process in running:
            process.terminate()
        for process in running:
            process.join()
        raise
    executor.shutdown()


def _end_with_parent() -> None:
    """By itself the pool's process waits for work for ever, because its siblings keep its pipe open."""
    import multiprocessing
    import signal

    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches all of a terminal's processes; the parent decides
    parent = multiprocessing.parent_process()
    assert parent is not None

    def watch() -> None:
        parent.join()
        os._exit(1)  # the main thread may be in a long computation

    threading.Thread(target=watch, name="parent", daemon=True).start()


@contextmanager
def realtime_priority(priority: int = Priority.LOOP) -> Iterator[bool]:
    """Run this thread with real-time priority where that is allowed; yields whether it is.

    For loops that wait for a camera; one that never waits would occupy a core. Threads and processes that are started
    meanwhile are ordinary ones. Linux allows it to root and within the limit `rtprio` (/etc/security/limits.conf);
    on other systems nothing is changed.
    """
    with ExitStack() as stack:
        granted = False
        if sys.platform == "linux":
            with suppress(OSError):
                before = os.sched_getscheduler(0), os.sched_getparam(0)
                os.sched_setscheduler(0, os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, os.sched_param(priority))
                stack.callback(os.sched_setscheduler, 0, *before)
                granted = True
        yield granted


def prioritise_process(priority: int) -> bool:
    """Give every thread of this process real-time priority, and those that it starts later; whether that is allowed.

    For processes that wait nearly always, with libraries whose own threads do a part of the work.
    """
    granted = False
    if sys.platform == "linux":
        with suppress(OSError):
            for thread in Path("/proc/self/task").iterdir():
                os.sched_setscheduler(int(thread.name), os.SCHED_FIFO, os.sched_param(priority))
            granted = True
    return granted


def prioritise_thread(native_id: int, priority: int) -> bool:
    """Give a running thread of this process real-time priority; whether that is allowed. Its children have none."""
    granted = False
    if sys.platform == "linux":
        with suppress(OSError):
            os.sched_setscheduler(native_id, os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, os.sched_param(priority))
            granted = True
    return granted


def peak_mb(key: str = "VmHWM") -> float:
    """Largest memory of this process so far, in MB, or that now (`VmRSS`); NaN if not on Linux.

    getrusage would count the memory of the parent process before the exec.
    """
    status = Path("/proc/self/status")
    found = re.search(rf"{key}:\s+(\d+)", status.read_text(encoding="ascii")) if status.exists() else None
    return float(found[1]) / 1024.0 if found else float("nan")


def forget_peak() -> None:
    """Let the largest memory of this process count from now on, where the system can (Linux)."""
    with suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5", encoding="ascii")
