"""A child process that parses what another program wrote, within limits of time and memory.

A file of a kilobyte can ask for gigabytes: a sheet that names row 2,000,000,000, a chunk that unpacks a million times.
What the child can not do within its limits is refused in one line, and the caller's process is as it was. The child
protects against cost, not against malice: what it answers is trusted. Of an ordinary file the limits are never felt.

Linux limits both CPU time and memory, macOS CPU time; elsewhere the time is that of the clock.
"""

from __future__ import annotations

import math
import pickle
import queue
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

from flowrec.core.closing import Closing
from flowrec.core.errors import FlowrecError, UsageError
from flowrec.core.system.child_process import ChildEndedError, ChildProcess, Parent

Answer = TypeVar("Answer")

MEMORY_BYTES = 3 << 30  # for one file, beyond what the libraries take


class BoundedProcess(Closing):
    """The child process; it is started by the first call, and ends with `close` or with this process.

    Parameters
    ----------
    where : the file, for errors.
    cpu_s : CPU time of each call.
    memory_bytes : of the child, beyond what it takes before it reads anything.
    error : what is raised when the file can not be read within the limits, or at all.
    by_clock : the time is that of the clock on every system: of work that may wait for a disk.
    """

    def __init__(
        self,
        where: str,
        cpu_s: float,
        memory_bytes: int = MEMORY_BYTES,
        error: type[FlowrecError] = UsageError,
        *,
        by_clock: bool = False,
    ) -> None:
        self._where, self._cpu_s, self._memory_bytes, self._error = where, cpu_s, memory_bytes, error
        self._clock_s = cpu_s if by_clock or sys.platform == "win32" else None
        self._child: ChildProcess | None = None

    def call(self, function: Callable[..., Answer], *given: Any) -> Answer:
        """The result of a function of a module, called in the child.

        Raises FlowrecError: that of the function; or `error`, where it raised another, or went beyond a limit.
        """
        child = self._child = self._child or self._start_child()
        try:
            self.begin(function, *given)
            answer, failure = child.receive(self._clock_s)
        except queue.Empty:
            child.process.kill()
            answer, failure = None, "time"
        except ChildEndedError as error:
            raise self._error(f"{self._where}: {self._cause(error)}") from error
        if isinstance(failure, FlowrecError):
            raise failure
        if failure:
            raise self._error(f"{self._where}: {self._words(failure)}")
        return answer

    def begin(self, function: Callable[..., object], *given: Any) -> None:
        """Have a function called of which only an effect is wanted, such as a filled cache: nobody waits for it."""
        self._child = self._child or self._start_child()
        self._child.send((self._cpu_s, self._memory_bytes, function, given))

    def close(self) -> None:
        """End the child at once."""
        if self._child is not None:
            self._child.close()

    def _start_child(self) -> ChildProcess:
        try:
            one_thread = {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}
            return ChildProcess("flowrec.core.system.bounded_process", environment=one_thread)
        except OSError as error:
            raise self._error(f"{self._where}: no process starts to read it ({error.strerror or error})") from error

    def _cause(self, ended: ChildEndedError) -> str:
        """Reason that the child has ended without an answer."""
        limit = {"killed by SIGXCPU": "time", "killed by SIGKILL": "memory"}.get(ended.how)
        if limit is not None:
            return self._words(limit)
        how = str(ended).removeprefix("killed by ").removeprefix("exit ")
        return f"its reader has ended ({how}); the file is damaged"

    def _words(self, failure: str) -> str:
        if failure == "time":
            return f"takes more than {self._cpu_s:g} s to read, far more than a file of its size should; is it damaged?"
        if failure == "memory":
            return f"needs more than {self._memory_bytes / 1e9:.2g} GB of memory to be read; is it damaged?"
        return f"can not be read ({failure}); it is damaged, or not what its name says"


def _limit_time(cpu_s: float) -> None:
    """Limit the CPU time that is spent from now on."""
    if sys.platform != "win32":
        import resource

        usage = resource.getrusage(resource.RUSAGE_SELF)
        until_s = math.ceil(usage.ru_utime + usage.ru_stime + cpu_s)
        resource.setrlimit(resource.RLIMIT_CPU, (until_s, resource.getrlimit(resource.RLIMIT_CPU)[1]))
        resource.setrlimit(resource.RLIMIT_CORE, (0, resource.getrlimit(resource.RLIMIT_CORE)[1]))


def _limit_memory(memory_bytes: int) -> None:
    """Limit the memory that is taken from now on."""
    if sys.platform == "linux":
        import resource

        pages = Path("/proc/self/statm").read_text(encoding="ascii").split()
        used_bytes = int(pages[5]) * resource.getpagesize()  # data and stack
        hard = resource.getrlimit(resource.RLIMIT_DATA)[1]
        resource.setrlimit(resource.RLIMIT_DATA, (used_bytes + memory_bytes, hard))


def _serve() -> None:
    """Answer calls until the caller has ended."""
    caller = Parent()
    limited = False
    while True:
        cpu_s, memory_bytes, function, given = caller.order()
        _limit_time(cpu_s)
        if not limited:  # once, so that what one call leaves behind counts in the next
            _limit_memory(memory_bytes)
            limited = True
        answer: tuple[Any, Any] = None, None
        try:
            answer = function(*given), None
        except FlowrecError as error:  # a reader may have taken the lack of memory for damage
            answer = None, "memory" if isinstance(error.__cause__, MemoryError) else error
        except MemoryError:
            answer = None, "memory"
        except Exception as error:  # noqa: BLE001  of as many kinds as there are libraries
            answer = None, f"{type(error).__name__}: {error}"[:500]
        caller.answer(pickle.dumps(answer, pickle.HIGHEST_PROTOCOL))


if __name__ == "__main__":
    _serve()
