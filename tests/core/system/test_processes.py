"""The control loop's priority, and processes that end with the one that started them."""

import contextlib
import os
import signal
import subprocess
import sys
import threading
from pathlib import Path

import pytest

from flowrec.core import interrupted_too, realtime_priority
from tests.conftest import until

pytestmark = pytest.mark.skipif(not hasattr(os, "sched_getscheduler"), reason="a matter of Linux")

SHARED_OUT = """
import sys, time
from flowrec.core.system.processes import pool
works = "import os, sys, time; open(f'{folder}/{os.getpid()}', 'x').close(); time.sleep(600)"
if __name__ == "__main__":
    with pool(2) as processes:
        list(processes.map(exec, [works] * 3, [{"folder": sys.argv[1]}] * 3))
"""


def lives(pid: int) -> bool:
    """Whether a process runs; one that has ended and is not yet waited for does not."""
    with contextlib.suppress(OSError):
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    return False


@pytest.mark.parametrize("blow", [signal.SIGKILL, signal.SIGTERM, signal.SIGINT])
def test_the_processes_of_a_bench_end_with_the_one_that_is_killed_or_interrupted(blow, tmp_path):
    with subprocess.Popen([sys.executable, "-c", SHARED_OUT, tmp_path]) as bench:
        try:
            until(lambda: len(list(tmp_path.iterdir())) == 2)
        finally:
            bench.send_signal(blow)
    workers = [int(path.name) for path in tmp_path.iterdir()]
    try:
        until(lambda: not any(map(lives, workers)))
    finally:
        for pid in filter(lives, workers):
            os.kill(pid, signal.SIGKILL)


def test_only_the_loop_itself_is_in_real_time_and_only_while_it_runs():
    policies = []
    before = os.sched_getscheduler(0)
    with realtime_priority() as granted:
        during = os.sched_getscheduler(0) & ~os.SCHED_RESET_ON_FORK
        thread = threading.Thread(target=lambda: policies.append(os.sched_getscheduler(0)))
        thread.start()
        thread.join()
    assert during == (os.SCHED_FIFO if granted else before)
    assert policies == [before]
    assert os.sched_getscheduler(0) == before


def test_where_it_is_not_allowed_the_run_goes_on_as_it_is(monkeypatch):
    def refuse(*_):
        raise PermissionError(1, "Operation not permitted")

    monkeypatch.setattr(os, "sched_setscheduler", refuse)
    with realtime_priority() as granted:
        assert not granted


def test_what_interrupts_the_wait_for_a_child_interrupts_the_child_which_may_complete_its_work(tmp_path: Path) -> None:
    code = (
        "import sys, time\ntry:\n    print('ready', flush=True)\n    time.sleep(60)\n"
        f"except KeyboardInterrupt:\n    time.sleep(0.3)\n    open({str(tmp_path / 'whole')!r}, 'w').close()\n"
    )
    child = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, start_new_session=True)
    assert child.stdout is not None and child.stdout.readline() == b"ready\n"
    with pytest.raises(KeyboardInterrupt), interrupted_too(child):
        raise KeyboardInterrupt
    assert child.returncode == 0 and (tmp_path / "whole").exists()
