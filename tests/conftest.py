"""What several test files use: missions that are flown once, waiting, and the profile of hypothesis."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Callable
from pathlib import Path

import pytest
from hypothesis import settings

from flowrec.commands.record import record
from flowrec.commands.run_summary import Recorded
from flowrec.config import load_config

# A shell that starts the tests in the background has SIGINT ignored, and so would all that they start.
signal.signal(signal.SIGINT, signal.default_int_handler)

# A busy machine is no failure.
settings.register_profile("flowrec", deadline=None)
settings.load_profile("flowrec")

HANG_S = 120.0  # a wait as long as this one hangs; no test asserts how quick something is
# A short survey: most tests are about something else.
SMALL = [
    "camera.width_px=320",
    "camera.height_px=256",
    "simulated.seed=1",
    "simulated.world=kind",
    "survey.method=downstream",
]

# For tests of what happens in real time: other tests beside them would be the cause of their failures.
needs_quiet = pytest.mark.skipif(
    "PYTEST_XDIST_WORKER" in os.environ, reason="needs a quiet machine: pytest -n 0 tests/rigs/lab"
)


def pytest_xdist_auto_num_workers() -> int:
    """One worker more than processors: many tests only wait for a process that they watch."""
    return (os.cpu_count() or 1) + 1


@pytest.fixture(scope="session")
def mission(tmp_path_factory: pytest.TempPathFactory) -> Recorded:
    """A whole mission on the bifurcation, seen by a small camera."""
    path = tmp_path_factory.mktemp("mission") / "mission.mcap"
    return record(load_config(None, SMALL), path)


@pytest.fixture(scope="session")
def session(mission: Recorded) -> Path:
    return mission.path


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
    path = tmp_path_factory.mktemp("realtime") / "realtime.mcap"
    sets = [*SMALL, "survey.method=information", "mission.phases=survey,refine,plan", "worker.adopt_after_s=100"]
    return record(load_config(None, sets), path, realtime=True).path
