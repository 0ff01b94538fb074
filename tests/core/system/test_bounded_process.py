"""What a file of another program may cost: beyond its limits, the child that reads it ends, and one line says so."""

import operator
import os
import signal
import sys
import time
from pathlib import Path

import pytest

from flowrec.core import BoundedProcess, MovieError, UsageError, read_toml
from tests.conftest import until


def test_a_result_comes_back_and_the_next_call_finds_the_same_process():
    with BoundedProcess("a.bin", 10.0) as process:
        assert process.call(divmod, 17, 5) == (3, 2)
        assert process.call(os.getpid) == process.call(os.getpid) != os.getpid()


def test_an_error_for_people_comes_back_as_it_is_and_any_other_names_the_file():
    with BoundedProcess("a.bin", 10.0, error=MovieError) as process:
        with pytest.raises(MovieError, match=r"^a\.bin: .*KeyError: 1"):
            process.call(operator.getitem, {}, 1)
        with pytest.raises(UsageError, match=r"^no\.toml: "):
            process.call(read_toml, Path("no.toml"))
        assert process.call(abs, -3) == 3  # it goes on


@pytest.mark.skipif(sys.platform != "linux", reason="the system limits no memory")
def test_a_file_that_asks_for_more_memory_than_it_may_is_refused():
    with (
        BoundedProcess("a.bin", 10.0, memory_bytes=1 << 28) as process,
        pytest.raises(UsageError, match=r"^a\.bin: .*0\.27 GB"),
    ):
        process.call(bytearray, 1 << 30)


def test_a_file_that_takes_more_time_than_it_may_is_refused():
    with BoundedProcess("a.bin", 0.1) as process, pytest.raises(UsageError, match=r"^a\.bin: .*0\.1 s"):
        process.call(sum, range(10**12))


def test_work_that_waits_for_a_disk_is_ended_by_the_clock():
    late = pytest.raises(UsageError, match=r"^a\.bin: .*0\.5 s")
    with BoundedProcess("a.bin", 0.5, by_clock=True) as process, late:
        process.call(time.sleep, 60.0)
    assert process._child.process.poll() is not None


@pytest.mark.skipif(sys.platform == "win32", reason="a process ends by no signal there")
def test_a_reader_that_crashes_takes_nobody_with_it():
    with BoundedProcess("a.bin", 10.0, by_clock=True) as process:
        for work in (os.abort, os.getpid):  # the second one does not wait for a process that has ended
            with pytest.raises(UsageError, match="SIGABRT"):
                process.call(work)


@pytest.mark.skipif(sys.platform == "win32", reason="a process ends by no signal there")
def test_a_reader_that_the_system_kills_was_short_of_memory():
    with BoundedProcess("a.bin", 10.0) as process, pytest.raises(UsageError, match=r"^a\.bin: needs more than"):
        process.call(signal.raise_signal, signal.SIGKILL)


def test_what_nobody_waits_for_is_done_beside_and_ends_with_the_process(tmp_path):
    with BoundedProcess("a.bin", 10.0) as process:
        process.begin(os.mkdir, tmp_path / "made")
        until((tmp_path / "made").exists)


def test_nothing_is_left_running_once_it_is_closed():
    with BoundedProcess("a.bin", 10.0) as process:
        pid = process.call(os.getpid)
    if sys.platform != "win32":
        with pytest.raises(ProcessLookupError):
            os.kill(pid, 0)
