"""The process of the slow stages: the same results as at home, never in the way, never left behind."""

from __future__ import annotations

import os
import signal
import time

import numpy as np
import pytest

from flowrec.config import load_config
from flowrec.errors import FlowrecError
from flowrec.messages import Mission, Tick
from flowrec.record import prepare
from flowrec.work import work
from flowrec.work_process import WorkProcess
from tests.conftest import SMALL


def answer(process: WorkProcess):  # type: ignore[no-untyped-def]
    end = time.monotonic() + 60
    while (result := process.result()) is None:
        assert time.monotonic() < end
        time.sleep(0.02)
    return result


def test_orders_are_answered_as_at_home_and_a_process_that_dies_is_told_of() -> None:
    pipeline = prepare(load_config(None, SMALL))[2]
    nowhere = np.zeros(2)
    mission = Mission(0, "start", 0, 1, "solve", 0, nowhere, nowhere, False, "", "")
    process = WorkProcess(pipeline)
    try:
        order = Tick(0, mission=mission)
        process.submit(order)
        process.submit(order)
        assert answer(process).same_as(work(pipeline, order))
        assert answer(process).request == 1
        os.kill(process._process.pid, signal.SIGKILL)
        with pytest.raises(FlowrecError, match="ended unasked"):
            answer(process)
    finally:
        process.close()
