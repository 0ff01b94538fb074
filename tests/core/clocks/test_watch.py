"""The clocks of a run side by side: a wall clock that is set, a source that goes back, and what is told of it."""

import itertools
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace

import numpy as np
import pytest

from flowrec.core import MCAP, ClockMonitor, Output, RigError
from flowrec.core.clocks.clock_monitor import read_clocks
from flowrec.core.clocks.device_clock import SLEW
from flowrec.rigs import SimulatedRig
from flowrec.run import LockstepWorker, run
from flowrec.stages import Inputs, load_config
from flowrec.store import Session, SessionReader, recover
from flowrec.store.session_writer import session_writer
from flowrec.verbs import prepare
from flowrec.verbs.check import check
from flowrec.verbs.info import facts_for_people, info
from tests.conftest import until
from tests.short_missions import SMALL

S = 1_000_000_000
SHORT = [*SMALL, "duration_s=2.0", "simulated.image.debris=0"]


class TwoClocks:
    """A monotonic clock that ticks by the stamps it is given, and a wall clock that somebody sets."""

    def __init__(self):
        self.now_ns, self.wall_off_ns = 0, 10**18

    def __call__(self):
        return self.now_ns, self.now_ns + self.wall_off_ns


def test_a_wall_clock_that_is_set_is_told_at_once_and_with_its_size():
    clocks = TwoClocks()
    watch = ClockMonitor(clocks)
    said = []
    for n in range(100):
        clocks.now_ns = n * S // 20
        clocks.wall_off_ns += {37: -3600 * S, 61: 2 * S}.get(n, 50)  # besides, it is slewed by 1 ppm
        message = watch.update(n * S // 20, None)
        if not said or message is not said[-1]:
            said.append(message)
    jumps = [message for before, message in itertools.pairwise(said) if message.wall_jumps > before.wall_jumps]
    assert [message.stamp_ns for message in jumps] == [37 * S // 20, 61 * S // 20]
    assert [round(message.wall_set_s, 3) for message in jumps] == [-3600.0, -3598.0]
    assert 5 <= len(said) <= 7
    outcome = watch.outcome()
    assert int(outcome["wall_ns"]) - int(outcome["monotonic_ns"]) == clocks.wall_off_ns
    assert "2 times, by -3598.000 s" in outcome["clocks"]


@pytest.mark.parametrize(("set_ms", "told"), [(50, 1), (-50, 1), (5, 0)])
def test_a_wall_clock_that_is_set_by_50_ms_is_told_and_one_that_is_slewed_is_not(set_ms, told):
    clocks = TwoClocks()
    watch = ClockMonitor(clocks)
    for n in range(40):
        clocks.now_ns = n * S // 20
        clocks.wall_off_ns += set_ms * 1_000_000 * (n == 20)
        message = watch.update(n * S // 20, None)
    assert message.wall_jumps == told
    assert ("wall clock set" in watch.outcome().get("clocks", "")) == bool(told)


def test_both_clocks_are_read_at_one_moment():
    before = time.monotonic_ns(), time.time_ns()
    monotonic_ns, wall_ns = read_clocks()
    assert before[0] <= monotonic_ns <= time.monotonic_ns() and before[1] <= wall_ns <= time.time_ns()


class Stumbling(SimulatedRig):
    """A rig some of whose frames come twice or late; from `lost` on all of them do."""

    lost = 1 << 30

    def inputs(self):
        for n, arrived in enumerate(super().inputs()):
            self.turned = getattr(self, "turned", 0.0) + arrived.applied.turns
            back = -1 if n >= self.lost else 0 if n in (20, 21, 40) else None
            yield arrived if back is None else stamped(arrived, back)


def stamped(arrived: Inputs, stamp_ns: int) -> Inputs:
    return replace(arrived, stamp_ns=stamp_ns, frame=replace(arrived.frame, stamp_ns=stamp_ns))


def flown(path, rig_of=Stumbling, watch=None, **more):
    config, chip, pipeline, *_ = prepare(load_config(None, SHORT))
    rig = rig_of.of(pipeline, config, config.duration_s)
    for name, value in more.items():
        setattr(rig, name, value)
    clocks = watch or ClockMonitor()
    with session_writer(Output(path, MCAP), config, chip) as writer:
        report = run(pipeline, rig, LockstepWorker(pipeline, 0.5), [writer], clocks=clocks)
        writer.close({"outcome": report.outcome, **clocks.outcome()})
    return rig, report


def test_frames_that_go_back_in_time_enter_no_stage_and_are_counted_and_told(tmp_path):
    rig, report = flown(tmp_path / "s.mcap")
    assert report.passed_over == 3 and report.ticks == 58
    ticks = list(SessionReader(tmp_path / "s.mcap").ticks())
    assert np.all(np.diff([tick.stamp_ns for tick in ticks]) > 0)
    assert np.allclose(sum(tick.applied.turns for tick in ticks), rig.turned)  # what the field has turned is not lost
    assert ticks[-1].clocks.passed_over == 3
    verdict = check(tmp_path / "s.mcap")
    assert verdict.exit_status == 3
    assert any(finding.text.startswith("3 frames") for finding in verdict.findings)
    assert "camera's clock" in verdict.facts["camera"]
    facts, counts = info(tmp_path / "s.mcap"), Session(tmp_path / "s.mcap").topics
    assert "3 frames" in facts["clocks"]
    assert counts["/run/clocks"] >= 3 and "wall ns" not in dict(facts_for_people(facts))


def test_a_rig_that_stays_back_in_time_ends_the_run_because_nobody_steers(tmp_path):
    with pytest.raises(RigError, match=r"0\.\d+ s, 50 in a row"):
        flown(tmp_path / "s.mcap", lost=10, duration_s=5.0, _frames=100)


@pytest.mark.slow("flies a mission whose clocks are set")
def test_wall_clocks_set_in_a_run_are_in_its_verdict_and_nothing_else_changes(tmp_path):
    calm, troubled = TwoClocks(), TwoClocks()

    class Set(ClockMonitor):
        def update(self, stamp_ns, fit):
            troubled.now_ns = stamp_ns
            troubled.wall_off_ns -= 7200 * S * (stamp_ns == S)
            return super().update(stamp_ns, fit)

    flown(tmp_path / "a.mcap", SimulatedRig, ClockMonitor(calm))
    flown(tmp_path / "b.mcap", SimulatedRig, Set(troubled))
    verdict = check(tmp_path / "b.mcap")
    ((about, text),) = [(finding.about, finding.text) for finding in verdict.findings]
    assert about == "clocks" and "-7200.000 s at 1.00 s" in text
    assert not check(tmp_path / "a.mcap").findings
    for one, other in zip(
        SessionReader(tmp_path / "a.mcap").ticks(), SessionReader(tmp_path / "b.mcap").ticks(), strict=True
    ):
        assert one.stamp_ns == other.stamp_ns and one.frame.same_as(other.frame)
        assert (one.clocks.device, one.clocks.arrival_ns) == (other.clocks.device, other.clocks.arrival_ns)


SHIM = r"""
#define _GNU_SOURCE
#include <stdlib.h>
#include <sys/syscall.h>
#include <sys/time.h>
#include <time.h>
#include <unistd.h>
static long set_s(void) {
    const char *file = getenv("SET_WHEN");
    return file && access(file, F_OK) == 0 ? -3600 : 0;
}
int clock_gettime(clockid_t clock, struct timespec *now) {
    int done = syscall(SYS_clock_gettime, clock, now);
    if (clock == CLOCK_REALTIME) now->tv_sec += set_s();
    return done;
}
int gettimeofday(struct timeval *restrict now, void *restrict zone) {
    struct timespec fine;
    clock_gettime(CLOCK_REALTIME, &fine);
    now->tv_sec = fine.tv_sec; now->tv_usec = fine.tv_nsec / 1000;
    return 0;
}
time_t time(time_t *to) {
    struct timespec fine;
    clock_gettime(CLOCK_REALTIME, &fine);
    if (to) *to = fine.tv_sec;
    return fine.tv_sec;
}
"""
CHILD = """
import sys, time
from dataclasses import replace
from flowrec.core.clocks.clock_monitor import ClockMonitor
from flowrec.store.writer import SessionWriter
from tests.store.made_up import HEADER, ticks_of

watch = ClockMonitor()
tick = next(ticks_of(1, shape=(64, 64)))
with SessionWriter(sys.argv[1], HEADER) as writer:
    for number in range(100_000):
        now = time.monotonic_ns()
        frame, applied = replace(tick.frame, stamp_ns=now, index=number), replace(tick.applied, stamp_ns=now)
        track, clocks = replace(tick.track, stamp_ns=now), watch.update(now, None)
        writer.write(replace(tick, stamp_ns=now, frame=frame, applied=applied, track=track, clocks=clocks))
        time.sleep(0.01)
"""


@pytest.mark.slow("a mission in a process with another clock")
@pytest.mark.skipif(sys.platform != "linux" or shutil.which("cc") is None, reason="needs a C compiler and Linux")
def test_a_clock_really_set_back_an_hour_neither_delays_a_flush_nor_touches_a_stamp(tmp_path):
    (tmp_path / "shim.c").write_text(SHIM)
    shim, when, path = tmp_path / "shim.so", tmp_path / "set", tmp_path / "s.mcap"
    subprocess.run(["cc", "-shared", "-fPIC", "-o", str(shim), str(tmp_path / "shim.c")], check=True)
    said = {**os.environ, "LD_PRELOAD": str(shim), "SET_WHEN": str(when), "PYTHONPATH": os.pathsep.join(sys.path)}
    child = subprocess.Popen([sys.executable, "-c", CHILD, str(path)], env=said)
    partial = path.with_name("s.mcap.partial")
    until(lambda: partial.exists() and partial.stat().st_size > 100_000)
    when.touch()
    # A flush that waited for the wall clock would come in an hour; here four come after the clock was set.
    for _ in range(4):
        size = partial.stat().st_size
        until(lambda size=size: partial.stat().st_size > size)
    child.send_signal(signal.SIGKILL)
    child.wait()
    saved = recover(partial)
    ticks = list(SessionReader(saved.path).ticks())
    stamps = [tick.stamp_ns for tick in ticks]
    assert np.all(np.diff(stamps) > 0)
    last = ticks[-1].clocks
    assert last.wall_jumps == 1 and last.wall_set_s == pytest.approx(-3600.0, abs=0.01)
    findings = json.dumps(check(saved.path).as_json()["findings"])
    assert "-3600.0" in findings


def test_the_same_seed_gives_the_same_camera_clock_and_real_time_dates_frames_by_it():
    config, _, pipeline, *_ = prepare(load_config(None, SHORT))
    first, again = (list(SimulatedRig.of(pipeline, config, 1.0).inputs()) for _ in range(2))
    assert [one.clock for one in first] == [one.clock for one in again]
    quick = replace(
        config, camera=replace(config.camera, rate_hz=100.0), simulated=replace(config.simulated, clock_skew_ppm=0.0)
    )
    live = list(SimulatedRig.of(pipeline, quick, 0.6, realtime=True).inputs())
    assert all(one.stamp_ns == one.frame.stamp_ns == one.applied.stamp_ns == one.truth.stamp_ns for one in live)
    steps_ns = np.diff([one.stamp_ns for one in live])
    assert np.all(abs(steps_ns / 1e7 - 1.0) <= SLEW + 1e-6)  # arrivals jitter far more
