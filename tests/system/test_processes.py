"""The control loop's priority."""

import os
import threading

import pytest

from flowrec.system.processes import realtime_priority

pytestmark = pytest.mark.skipif(not hasattr(os, "sched_getscheduler"), reason="a matter of Linux")


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
