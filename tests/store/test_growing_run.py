"""A run is read from its files while another process writes them."""

import os
import signal
import sys
import threading
import time
from dataclasses import replace

import pytest

from flowrec.core import NS_PER_S, SessionError
from flowrec.store import GrowingRun, SessionReader, SessionWriter, WriterOptions, live_runs, recover
from flowrec.store.session_file import Split
from tests.conftest import HANG_S, until
from tests.store.made_up import HEADER, ticks_of

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="descriptors are inherited by POSIX processes only")
OPTIONS = WriterOptions(own_process=True, block=True, frames="delta", flush_s=0.05)
TICKS = list(ticks_of(90))


class Watcher(threading.Thread):
    """Takes the ticks of a run as they come."""

    def __init__(self, path):
        super().__init__()
        self.run_seen = GrowingRun(path)
        self.ticks, self.failure = [], None

    def run(self):
        try:
            for tick in self.run_seen.ticks():
                self.ticks.append(tick)
        except SessionError as error:
            self.failure = error


def begun(path, options=OPTIONS):
    """A writer that has written 40 ticks, and what watches it since then."""
    writer = SessionWriter(path, HEADER, options)
    for tick in TICKS[:40]:
        writer.write(tick)
    until(lambda: any(path.parent.iterdir()))
    watcher = Watcher(path)
    watcher.start()
    return writer, watcher


def same(seen, recorded):
    return all(
        one.stamp_ns == other.stamp_ns and one.frame.same_as(other.frame) and one.track.same_as(other.track)
        for one, other in zip(seen, recorded, strict=True)
    )


def test_ticks_are_seen_while_the_run_goes_on_and_in_the_end_all_of_them_as_they_are_in_the_file(tmp_path):
    path = tmp_path / "x.mcap"
    writer, watcher = begun(path)
    assert watcher.run_seen.header == HEADER
    until(lambda: len(watcher.ticks) > 30)
    assert path.with_name("x.mcap.partial").exists() and watcher.is_alive()
    for tick in TICKS[40:]:
        writer.write(tick)
    writer.close()
    watcher.join(HANG_S)
    assert watcher.failure is None and same(watcher.ticks, SessionReader(path).ticks()) and len(watcher.ticks) == 90


def test_a_tick_waits_for_its_image_but_no_longer_than_2_s_of_stamps(tmp_path):
    path, (first, *later, last) = tmp_path / "x.mcap", TICKS[:6]
    with SessionWriter(path, HEADER, WriterOptions(block=True)) as writer:
        writer.write(first)
        for tick in later:  # as if their images were still to be encoded
            writer.write(replace(tick, frame=None))
        writer._queue.wait_for_flush(later[-1].stamp_ns)
        seen = GrowingRun(path)
        assert [tick.stamp_ns for tick in seen._news()] == [first.stamp_ns]
        late_ns = first.stamp_ns + 2 * NS_PER_S + 1
        writer.write(replace(last, frame=None, stamp_ns=late_ns))  # the camera has stopped
        writer._queue.wait_for_flush(late_ns)
        seen._file.look()
        assert [tick.stamp_ns for tick in seen._news()] == [*(tick.stamp_ns for tick in later), late_ns]


@pytest.mark.slow("records a run in a process of its own")
def test_no_tick_is_seen_before_its_image_has_come(tmp_path):
    path = tmp_path / "x.mcap"
    writer, watcher = begun(path)
    for tick in TICKS[40:60]:  # as if their images were still to be encoded
        writer.write(replace(tick, frame=None))
    writer._queue.wait_for_flush(TICKS[59].stamp_ns)
    time.sleep(0.5)  # several looks
    assert [tick.stamp_ns for tick in watcher.ticks] == [tick.stamp_ns for tick in TICKS[:40]]
    writer.close()
    watcher.join(HANG_S)
    assert len(watcher.ticks) == 60


@pytest.mark.slow("records a run in a process of its own")
def test_a_run_in_parts_is_followed_from_part_to_part(tmp_path):
    path = tmp_path / "x.mcap"
    writer, watcher = begun(path, replace(OPTIONS, files=Split(seconds=0.3)))
    for tick in TICKS[40:]:
        writer.write(tick)
        time.sleep(0.005)
    writer.close()
    watcher.join(HANG_S)
    assert watcher.failure is None
    stamps = [tick.stamp_ns for tick in watcher.ticks]
    assert stamps == [tick.stamp_ns for tick in TICKS if tick.stamp_ns >= stamps[0]] and len(stamps) > 50


def test_a_recorder_that_is_killed_ends_the_view_with_what_to_do(tmp_path):
    writer, watcher = begun(tmp_path / "x.mcap")
    until(lambda: len(watcher.ticks) > 30)
    os.kill(writer._recorder._child.process.pid, signal.SIGKILL)
    watcher.join(HANG_S)
    assert "ended without completing" in str(watcher.failure) and "flowrec recover" in str(watcher.failure)
    with pytest.raises(SessionError):
        writer.close()
    seen = [tick.stamp_ns for tick in watcher.ticks]
    assert seen == [tick.stamp_ns for tick in SessionReader(recover(writer.partial_path).path).ticks()][: len(seen)]


@pytest.mark.slow("records two runs in processes of their own")
def test_runs_are_listed_while_they_are_recorded_and_only_those_can_be_watched(tmp_path):
    path = tmp_path / "x y.mcap"
    with SessionWriter(path, HEADER, OPTIONS) as writer, SessionWriter(tmp_path / ".trial.mcap", HEADER, OPTIONS):
        writer.write(TICKS[0])
        (run,) = [run for run in live_runs() if run.path.parent == tmp_path]
        assert run.process == writer._recorder._child.process.pid
    assert path not in [run.path for run in live_runs()]
    lost = SessionWriter(tmp_path / "lost.mcap", HEADER, OPTIONS)
    lost.partial_path.unlink()  # as when its folder is removed: there is nothing to be watched
    assert lost.path not in [run.path for run in live_runs()]
    lost.discard()
    with pytest.raises(SessionError, match="flowrec ls --live"):
        GrowingRun(path)
