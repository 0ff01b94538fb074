"""The recorder in a process of its own: the run, the recorder or both are killed, stopped, or meet a bad disk."""

import contextlib
import itertools
import os
import resource
import signal
import subprocess
import sys
import threading
import time
from collections import deque
from dataclasses import replace

import numpy as np
import psutil
import pytest

from flowrec.core import NS_PER_S, OperatorEvent, SessionError
from flowrec.store import (
    Session,
    SessionReader,
    SessionWriter,
    WriterOptions,
    files_of,
    recorder_process,
    recover,
    shared_queue,
)
from flowrec.store.session_file import Snapshot, Split
from flowrec.store.write_queue import End, Entry
from tests.conftest import HANG_S, until
from tests.store.made_up import HEADER, PERIOD_NS, ticks_of
from tests.store.test_chunk_copies import messages_of
from tests.store.test_declared_topics import TOPICS, same_extra, sent_ticks

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="descriptors are inherited by POSIX processes only")
OWN = WriterOptions(own_process=True, block=True, frames="raw")
TICKS = list(ticks_of(60))


def record(path, options=OWN, ticks=TICKS):
    with SessionWriter(path, HEADER, options) as writer:
        for tick in ticks:
            writer.write(tick)
        writer.close({"outcome": "reached"})
    return writer


def write_all(writer, ticks):
    for tick in ticks:
        writer.write(tick)
        time.sleep(0.002)


def recorder_of(writer: SessionWriter) -> int:
    return writer._recorder._child.process.pid


@pytest.mark.parametrize("block", [True, pytest.param(False, marks=pytest.mark.slow("the same without waiting"))])
def test_a_process_writes_the_messages_that_a_thread_writes(tmp_path, block):
    for name, own in (("process", True), ("thread", False)):
        record(tmp_path / f"{name}.mcap", replace(OWN, own_process=own, block=block))
    assert messages_of(tmp_path / "process.mcap") == messages_of(tmp_path / "thread.mcap")
    with SessionReader(tmp_path / "process.mcap") as file:
        assert file.header == HEADER and file.outcome == {"outcome": "reached", "ticks": "60", "dropped_frames": "0"}


def test_parts_snapshots_and_declared_topics_pass_through_a_process(tmp_path):
    ticks = list(sent_ticks())
    parts = record(tmp_path / "p.mcap", replace(OWN, files=Split(seconds=0.3), topics=TOPICS), ticks)
    assert len(parts.files) > 1 and files_of(tmp_path / "p.mcap") == parts.files
    read = list(Session(tmp_path / "p.mcap").ticks())
    assert len(read) == len(ticks) and all(same_extra(one, other) for one, other in zip(ticks, read, strict=True))
    marked = replace(TICKS[40], operator=OperatorEvent(TICKS[40].stamp_ns, "mark", "here"))
    ring = record(tmp_path / "r.mcap", replace(OWN, files=Snapshot(0.2, 0.1)), [*TICKS[:40], marked, *TICKS[41:]])
    assert "mark: here" in [SessionReader(file).part.why for file in ring.files]
    assert any("whole" in text for text in ring.remarks)


@pytest.mark.parametrize("block", [True, pytest.param(False, marks=pytest.mark.slow("the same without waiting"))])
def test_a_part_begins_with_the_last_image_before_it_whatever_its_memory_is_used_for(tmp_path, monkeypatch, block):
    monkeypatch.setattr(shared_queue, "_STATE_BYTES" if block else "_IMAGE_BYTES", 50_000)
    monkeypatch.setattr(shared_queue, "_MARGIN_BYTES", 1000)
    monkeypatch.setattr(shared_queue, "_END_BYTES", 100)
    options = replace(OWN, block=block, files=Split(seconds=0.2), queue_limit_bytes=1 << 20)
    with SessionWriter(tmp_path / "p.mcap", HEADER, options) as writer:
        for tick in ticks_of(200):  # faster than they are written: the memory is always full
            writer.write(tick)
    last, repeated = None, 0
    for part in writer.files:
        frames = list(SessionReader(part).messages("frame"))
        if last is not None and frames[0].index == last.index:
            assert np.array_equal(frames[0].image, last.image)
            repeated += 1
        last = frames[-1]
    assert repeated == len(writer.files) - 1 > 5


def test_whoever_waits_for_a_flush_goes_on_at_the_very_stamp_that_was_flushed():
    queue, (read, write) = shared_queue.SharedQueue(1 << 20, images=False), os.pipe()
    queue.wake_by(write)
    recorder = shared_queue.QueueReader(queue.handles, read)
    for stamp_ns in (0, 1, 5):  # a session may begin at 0
        waiting = threading.Thread(target=queue.wait_for_flush, args=(stamp_ns,), daemon=True)
        waiting.start()
        until(lambda: recorder.flush_wanted)
        recorder.mark_flushed(stamp_ns - 1)
        assert waiting.is_alive()
        recorder.mark_flushed(stamp_ns)
        waiting.join(HANG_S)
        assert not waiting.is_alive() and not recorder.flush_wanted
    os.close(read)
    os.close(write)


def test_a_run_whose_recorder_stands_still_until_nothing_has_room_still_tells_its_end(monkeypatch):
    monkeypatch.setattr(shared_queue, "_STATE_BYTES", 1 << 20)
    queue, (read, write) = shared_queue.SharedQueue(1 << 20, images=False), os.pipe()
    queue.wake_by(write)
    recorder = shared_queue.QueueReader(queue.handles, read)
    with pytest.raises(SessionError, match="behind"):
        deque(map(queue.put, itertools.repeat(Entry(0, {}, 0))), maxlen=0)
    end = End({"outcome": "failed", "note": 2000 * "x"})
    queue.close(end)
    while (entry := recorder.take(0.0)) is not None:
        recorder.release(entry)
    assert recorder.end == end
    os.close(read)
    os.close(write)


@pytest.mark.parametrize("own", [True, False])
def test_an_image_larger_than_what_may_wait_is_recorded_where_nothing_waits(tmp_path, own):
    options = WriterOptions(own_process=own, frames="raw", queue_limit_bytes=1000)
    with SessionWriter(tmp_path / "x.mcap", HEADER, options) as writer:
        for tick in TICKS[:5]:
            assert tick.frame.image.nbytes > 1000
            until(lambda: not writer.queue_bytes)
            writer.write(tick)
    assert writer.dropped_frames == 0


def test_what_can_not_be_made_is_refused_before_the_run_and_a_discarded_run_leaves_no_file(tmp_path):
    with pytest.raises(SessionError, match="no such directory"):
        SessionWriter(tmp_path / "nowhere" / "x.mcap", HEADER, OWN)
    writer = SessionWriter(tmp_path / "x.mcap", HEADER, OWN)
    writer.write(TICKS[0])
    writer.discard()
    assert list(tmp_path.iterdir()) == []


def test_a_recorder_that_ends_at_its_start_is_told_and_leaves_no_memory_behind(tmp_path, monkeypatch):
    monkeypatch.setattr(recorder_process, "MODULE", "flowrec.core")  # a package, which is no program
    before = psutil.Process().num_fds()
    with pytest.raises(SessionError, match=r"x\.mcap: its recorder does not start .*exit status 1"):
        SessionWriter(tmp_path / "x.mcap", HEADER, OWN)
    assert psutil.Process().num_fds() == before


RUN = """
import os, sys, time
from flowrec.store.session_file import Snapshot, Split, WriterOptions
from flowrec.store.writer import SessionWriter
from tests.store.made_up import HEADER, ticks_of
options, pause_s, side = eval(sys.argv[2]), float(sys.argv[3]), int(sys.argv[4])
writer = SessionWriter(sys.argv[1], HEADER, options)
if len(sys.argv) > 5 and not os.fork():  # a process that has all that is open here
    os.close(1)
    time.sleep(600.0)
    os._exit(0)
print(writer._recorder._child.process.pid, flush=True)
for number, tick in enumerate(ticks_of(100_000, shape=(side, side))):
    writer.write(tick)
    print(number, flush=True)
    time.sleep(pause_s)
"""


def started(path, options, pause_s=0.002, side=64, *more):
    words = [sys.executable, "-c", RUN, path, options, str(pause_s), str(side), *more]
    run = subprocess.Popen(words, stdout=subprocess.PIPE, text=True, process_group=0)
    return run, int(run.stdout.readline())


def written_by(run, ticks):
    """Wait for so many ticks; then the number of the last one that was told."""
    for line in run.stdout:
        if int(line) >= ticks:
            return int(line)
    raise AssertionError("the run has ended")


def last_told(run, number):
    """The last tick that a run has told before it was killed, after `number`."""
    return max([number, *(int(line) for line in run.stdout.read().split("\n")[:-1])])


KINDS = {
    "faster than real time": ("WriterOptions(own_process=True, block=True)", 0.0, 64),
    "live": ("WriterOptions(own_process=True)", 0.002, 64),
    "large": ("WriterOptions(own_process=True, block=True, frames='raw')", 0.02, 2000),
    "forked": ("WriterOptions(own_process=True)", 0.002, 64, "fork"),
    "parts": ("WriterOptions(own_process=True, files=Split(seconds=0.5))", 0.002, 64),
}


MORE = pytest.mark.slow("kills a run in another way")


@pytest.mark.parametrize("kind", ["live", *(pytest.param(kind, marks=MORE) for kind in KINDS if kind != "live")])
def test_of_a_run_that_is_killed_every_tick_that_it_handed_over_is_in_a_complete_session(tmp_path, kind):
    path = tmp_path / "x.mcap"
    run, _ = started(path, *KINDS[kind])
    number = written_by(run, 60)
    run.kill()
    run.wait(HANG_S)
    number = last_told(run, number)
    run.stdout.close()
    try:
        until(lambda: not list(tmp_path.glob("*.partial")))
    finally:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(run.pid, signal.SIGKILL)  # what was forked
    ticks = [tick.stamp_ns for tick in SessionReader(path).ticks()]
    begin_ns = next(ticks_of(1)).stamp_ns
    assert ticks == [begin_ns + each * PERIOD_NS for each in range(len(ticks))]
    assert len(ticks) in (number + 1, number + 2)  # it may have been killed between handing over and telling
    with SessionReader(path) as file:
        assert file.outcome["outcome"] == "failed" and "its recorder has completed it" in file.outcome["note"]
        assert file.counts["frame"] == len(ticks)


def test_the_kill_of_a_recorder_is_told_at_once_and_costs_half_a_second(tmp_path):
    path = tmp_path / "x.mcap"
    writer = SessionWriter(path, HEADER, WriterOptions(own_process=True))
    began_s, ticks = time.monotonic(), ticks_of(100_000, shape=(64, 64))
    for number, tick in enumerate(ticks):
        writer.write(tick)
        time.sleep(max(0.0, began_s + number * PERIOD_NS / NS_PER_S - time.monotonic()))
        if number == 90:
            break
    os.kill(recorder_of(writer), signal.SIGKILL)
    with pytest.raises(SessionError, match=r"SIGKILL.*flowrec recover "):
        write_all(writer, itertools.islice(ticks, 500))
    with pytest.raises(SessionError, match="its recorder has ended"):
        writer.close()
    saved = list(SessionReader(recover(path.with_name("x.mcap.partial")).path).ticks())
    assert (91 - len(saved)) * PERIOD_NS < 0.5 * NS_PER_S


def test_a_run_that_accepts_losses_goes_on_without_its_recorder_says_so_once_and_does_not_end_well(tmp_path):
    writer = SessionWriter(tmp_path / "x.mcap", HEADER, WriterOptions(own_process=True, accept_losses=True))
    ticks = ticks_of(400)
    write_all(writer, itertools.islice(ticks, 20))
    os.kill(recorder_of(writer), signal.SIGKILL)
    write_all(writer, ticks)
    (remark,) = writer.remarks
    assert "killed by SIGKILL" in remark and "NOTHING IS RECORDED" in remark
    with pytest.raises(SessionError, match="its recorder has ended"):
        writer.close()


@pytest.mark.slow("stops a recorder")
def test_a_recorder_that_stands_still_costs_no_tick_and_delays_no_write(tmp_path):
    options = WriterOptions(own_process=True, frames="raw", queue_limit_bytes=1 << 20)
    writer = SessionWriter(tmp_path / "x.mcap", HEADER, options)
    os.kill(recorder_of(writer), signal.SIGSTOP)
    longest_s = 0.0
    for tick in ticks_of(300, shape=(128, 128)):  # 5 MB
        began_s = time.process_time()
        writer.write(tick)
        longest_s = max(longest_s, time.process_time() - began_s)
    os.kill(recorder_of(writer), signal.SIGCONT)
    writer.close()
    with SessionReader(tmp_path / "x.mcap") as file:
        assert file.counts["track"] == 300 and file.counts["frame"] == 300 - writer.dropped_frames
        assert 50 < writer.dropped_frames < 300 == int(file.outcome["ticks"])
    assert longest_s < 0.1  # of CPU time: it has not waited for room in a loop


def test_a_run_that_waits_for_its_recorder_ends_when_that_is_killed(tmp_path):
    writer, failures = SessionWriter(tmp_path / "x.mcap", HEADER, replace(OWN, flush_s=0.05)), []
    os.kill(recorder_of(writer), signal.SIGSTOP)

    def run():
        try:
            write_all(writer, ticks_of(1000))
        except SessionError as error:
            failures.append(error)

    waiting = threading.Thread(target=run, daemon=True)
    waiting.start()
    until(lambda: writer._queue._state.words[1])  # it waits for a flush
    os.kill(recorder_of(writer), signal.SIGKILL)
    waiting.join(HANG_S)
    assert "its recorder has ended (killed by SIGKILL)" in str(failures[0])
    with pytest.raises(SessionError, match="killed by SIGKILL"):
        writer.close()


@pytest.mark.slow("waits for a recorder that writes nothing")
def test_a_recorder_that_writes_nothing_for_long_is_told_and_completes_the_file_when_it_can(tmp_path, monkeypatch):
    monkeypatch.setattr(recorder_process, "_SILENT_S", 0.5)
    writer = SessionWriter(tmp_path / "x.mcap", HEADER, OWN)
    for tick in TICKS:
        writer.write(tick)
    os.kill(recorder_of(writer), signal.SIGSTOP)
    with pytest.raises(SessionError, match=r"process \d+.* 0\.5 s"):
        writer.close()
    os.kill(recorder_of(writer), signal.SIGCONT)
    until((tmp_path / "x.mcap").exists)
    writer._recorder.wait(HANG_S)
    with SessionReader(tmp_path / "x.mcap") as file:
        assert file.counts["frame"] == len(TICKS)


@pytest.mark.slow("signals two recorders")
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_recorder_ends_with_its_run_and_by_no_signal_that_asks_it_to(tmp_path, number):
    with SessionWriter(tmp_path / "x.mcap", HEADER, OWN) as writer:
        for tick in TICKS:
            writer.write(tick)
            os.kill(recorder_of(writer), number)
    with SessionReader(tmp_path / "x.mcap") as file:
        assert file.counts["frame"] == len(TICKS)


@pytest.mark.slow("waits for two recorders")
def test_the_recorder_gives_way_to_a_run_that_waits_for_it_and_to_no_live_one(tmp_path):
    for block in (True, False):
        with SessionWriter(tmp_path / f"{block}.mcap", HEADER, replace(OWN, block=block)) as writer:
            assert (os.getpriority(os.PRIO_PROCESS, recorder_of(writer)) > 0) == block


@pytest.mark.slow("a small file system")
def test_a_disk_that_is_full_ends_the_run_with_its_reason_and_what_was_written_is_recovered(tmp_path):
    path = tmp_path / "x.mcap"
    writer = SessionWriter(path, HEADER, WriterOptions(own_process=True, flush_s=0.05))
    resource.prlimit(recorder_of(writer), resource.RLIMIT_FSIZE, (200_000, 200_000))
    with pytest.raises(SessionError, match=r"x\.mcap\.partial: "):
        write_all(writer, ticks_of(100_000))
    with pytest.raises(SessionError, match="no file may be larger here"):
        writer.close()
    assert recover(writer.partial_path).ticks > 10


@pytest.mark.slow("gives up the images of two runs")
@pytest.mark.parametrize("waiting", [60, 20])  # of 60 images; the others are dropped before
def test_a_run_whose_images_are_given_up_counts_them(tmp_path, waiting):
    limit = round((waiting + 0.5) * TICKS[0].frame.image.nbytes) + (1 << 18 if waiting == 60 else 0)
    options = WriterOptions(own_process=True, frames="raw", queue_limit_bytes=limit)
    writer = SessionWriter(tmp_path / "x.mcap", HEADER, options)
    os.kill(recorder_of(writer), signal.SIGSTOP)
    for tick in TICKS:
        writer.write(tick)
    assert (writer.dropped_frames > 20) == (waiting == 20)
    timer = subprocess.Popen(["sh", "-c", f"sleep 0.5; kill -CONT {recorder_of(writer)}"])
    writer.close(timeout_s=0.05)
    timer.wait()
    with SessionReader(tmp_path / "x.mcap") as file:
        assert writer.dropped_frames == 60 and file.counts.get("frame", 0) == 0 and file.counts["track"] == 60
        assert file.outcome["dropped_frames"] == "60" and list(file.messages("drops"))[-1].by_backlog == 60
