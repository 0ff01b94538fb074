"""What several test files use: missions and kernels that are made once for all workers, waiting, hypothesis."""

from __future__ import annotations

import fcntl
import gc
import os
import pickle
import signal
import time
from collections.abc import Callable, Generator, Iterable, Iterator
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import Any, TypeVar
from unittest import mock

import pytest
from hypothesis import settings
from numba.core.compiler_lock import global_compiler_lock
from numba.core.dispatcher import Dispatcher
from threadpoolctl import threadpool_limits
from typer.testing import CliRunner, Result

from flowrec.core.system.numba_setup import _cache_folder
from flowrec.stages import load_config
from flowrec.verbs import main
from flowrec.verbs.cli import app
from flowrec.verbs.record import record
from flowrec.verbs.run_summary import Recorded
from tests.short_missions import SMALL

Made = TypeVar("Made")

# Collecting the tests imports half a million objects that stay: to look for garbage among them took a fifth of it.
gc.disable()

# The workers share the cores, and idle threads of BLAS spin.
threadpool_limits(limits=1, user_api="blas")

# A shell that starts the tests in the background has SIGINT ignored, and so would all that they start.
signal.signal(signal.SIGINT, signal.default_int_handler)

# A busy machine is no failure.
settings.register_profile("flowrec", deadline=None)
settings.load_profile("flowrec")

HANG_S = 120.0  # a wait as long as this one hangs; no test asserts how quick something is
# For tests of what happens in real time: other tests beside them would be the cause of their failures.
needs_quiet = pytest.mark.skipif(
    "PYTEST_XDIST_WORKER" in os.environ, reason="needs a quiet machine: pytest -n 0 tests/rigs/lab"
)
# An output is fed 0.1 s ahead: a machine that stands still for longer ends the run, and the test begins again.
feeds_an_output = pytest.mark.flaky(reruns=2, only_rerun="the computer was too busy")


def pytest_xdist_auto_num_workers() -> int:
    """One worker more than processors: many tests only wait for a process that they watch."""
    return (os.cpu_count() or 1) + 1


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """A slow test, which only .ci/run runs, states why it takes long."""
    for item in items:
        for mark in item.iter_markers("slow"):
            assert mark.args and isinstance(mark.args[0], str), f"{item.nodeid}: pytest.mark.slow says why"


@pytest.hookimpl(wrapper=True)
def pytest_make_collect_report(
    collector: pytest.Collector,
) -> Generator[None, pytest.CollectReport, pytest.CollectReport]:
    """One worker rewrites a file of tests and compiles what it imports; the others then read what it has stored."""
    with alone(collector.path) if isinstance(collector, pytest.Module) else nullcontext():
        return (yield)


def pytest_collection_finish() -> None:
    gc.freeze()
    gc.enable()


@contextmanager
def alone(lock: Path) -> Iterator[None]:
    """One process at a time."""
    with lock.open("r" if lock.exists() else "a") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        yield


def made_once(factory: pytest.TempPathFactory, name: str, make: Callable[[Path], Made]) -> Made:
    """What `make` returns, and writes into a folder: made by the first worker that asks, taken over by the others."""
    shared = factory.getbasetemp()
    if "PYTEST_XDIST_WORKER" in os.environ:
        shared = shared.parent  # of all workers
    with alone(shared / f"{name}.lock"):
        kept, folder = shared / f"{name}.pickle", shared / name
        if not kept.exists():
            folder.mkdir()
            kept.write_bytes(pickle.dumps(make(folder)))
        made: Made = pickle.loads(kept.read_bytes())
    return made


_compile = Dispatcher.compile
_compiling: set[str] = set()


def _compile_in_turn(kernel: Any, signature: Any) -> Any:
    """Compile a kernel of flowrec unless another worker does: then take that one's from the cache.

    All kernels take half a minute, which each worker would spend at its first mission in a new installation.
    """
    name = f"{kernel.py_func.__module__}.{kernel.py_func.__name__}"
    if not name.startswith("flowrec.") or not _cache_folder():
        return _compile(kernel, signature)
    with global_compiler_lock:  # threads of this process first, so that none waits for a lock of another's
        if name in _compiling:
            return _compile(kernel, signature)
        _compiling.add(name)
        try:
            with alone(Path(_cache_folder()) / f"{name}.lock"):
                return _compile(kernel, signature)
        finally:
            _compiling.remove(name)


Dispatcher.compile = _compile_in_turn


@pytest.fixture(scope="session")
def mission(tmp_path_factory: pytest.TempPathFactory) -> Recorded:
    """A whole mission on the bifurcation, seen by a small camera."""
    return made_once(
        tmp_path_factory, "mission", lambda folder: record(load_config(None, SMALL), folder / "mission.mcap")
    )


@pytest.fixture(scope="session")
def session(mission: Recorded) -> Path:
    return mission.path


def run(words: Iterable[object]) -> int:
    """Exit status of `flowrec` with these words in this process, because to start another one takes longer."""
    with mock.patch("sys.argv", ["flowrec", *map(str, words)]), pytest.raises(SystemExit) as ended:
        main()
    return int(ended.value.code or 0)


def invoke(*words: object, **options: Any) -> Result:
    """What `flowrec` with these words makes of them; what it raises is the result's `exception`."""
    return CliRunner().invoke(app, [*map(str, words)], **options)


def typed(*words: object) -> Result:
    """The same, but what it raises is raised."""
    return invoke(*words, catch_exceptions=False)


def answered(*words: object) -> tuple[int, str]:
    """Exit status and output of `flowrec` with these words."""
    done = invoke(*words)
    return done.exit_code, done.output


def until(happened: Callable[[], object], told: Callable[[], str] = lambda: "waited in vain") -> None:
    """Wait for something that another thread or process does; `told` says what was seen where it does not happen."""
    end = time.monotonic() + HANG_S
    while not happened():
        assert time.monotonic() < end, told()
        time.sleep(0.005)


@pytest.fixture(scope="session")
def realtime_session(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A survey, a refinement and a plan in real time, with a worker process: results come when they are done.

    A replay that does not know when each was adopted would wait for 100 s.
    """
    sets = [*SMALL, "survey.method=information", "survey.worth=0.06", "mission.phases=survey,refine,plan"]
    sets += ["worker.adopt_after_s=100", "safety.guard_timeout_s=20"]
    return made_once(
        tmp_path_factory,
        "realtime",
        lambda folder: record(load_config(None, sets), folder / "realtime.mcap", realtime=True).path,
    )
