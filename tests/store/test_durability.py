"""Disks that are slow, full, refusing, gone, or lose their power; files are written for real and read back."""

import contextlib
import itertools
import math
import os
import shutil
import subprocess
import sys
import threading
import time
from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest

from flowrec.core import NS_PER_S, Frame, SessionError, Tick, seconds
from flowrec.stages import load_config
from flowrec.store import SLOTS, SessionReader, SessionWriter, WriterOptions, recover
from flowrec.store.mcap_reader import McapReader
from flowrec.store.mcap_writer import McapWriter
from flowrec.store.parts import Parts
from flowrec.store.scan import scan
from flowrec.store.segments import RecordingPlan
from flowrec.store.write_queue import Entry, FrameDecimation, WriteQueue
from tests.conftest import HANG_S
from tests.store.made_up import HEADER, PERIOD_NS, entry_of, fails, ticks_of


class GatedDisk:
    """A disk that takes as many bytes as the test allows; who writes more waits. How slow it is needs no clock."""

    def __init__(self, monkeypatch):
        self.allowed, self.taken, self.full = math.inf, 0, False
        self._changed = threading.Condition()
        put = McapWriter._put

        def gated(file, parts):
            with self._changed:
                self.full = self.taken >= self.allowed
                self._changed.notify_all()
                self._changed.wait_for(lambda: not self.full)
                self.taken += sum(map(len, parts))
            put(file, parts)

        drop = WriteQueue.drop_images

        def given_up(backlog):
            count = drop(backlog)
            self.allow(math.inf)  # who waits for the images all the same waits for ever
            return count

        monkeypatch.setattr(McapWriter, "_put", gated)
        monkeypatch.setattr(WriteQueue, "drop_images", given_up)

    def allow(self, nbytes):
        """So many more; from the first call on only what was allowed."""
        with self._changed:
            self.allowed = nbytes + (self.taken if math.isinf(self.allowed) else self.allowed)
            self.full = self.full and self.taken >= self.allowed
            self._changed.notify_all()

    def until_idle(self, writer):
        """Until the writer's thread waits, for the disk or for something to do."""
        with self._changed:
            while not self.full and writer.queue_bytes:
                self._changed.wait(0.001)


TICKS_BEGIN_NS = next(ticks_of(1)).stamp_ns


def slow_disk(monkeypatch, bytes_s):
    """Every write takes as long as its bytes would at that rate."""
    put = McapWriter._put

    def slowly(self, parts):
        time.sleep(sum(map(len, parts)) / bytes_s)
        put(self, parts)

    monkeypatch.setattr(McapWriter, "_put", slowly)


def test_a_slow_disk_costs_evenly_spaced_images_and_nothing_else(tmp_path, monkeypatch):
    disk = GatedDisk(monkeypatch)
    ticks = list(ticks_of(240, shape=(256, 256)))  # 65 kB each, three times what the disk takes
    with SessionWriter(tmp_path / "s.mcap", HEADER, WriterOptions(frames="raw", queue_limit_bytes=1 << 20)) as writer:
        for tick in ticks:
            writer.write(tick)
            disk.allow(22_000)
            disk.until_idle(writer)
        disk.allow(math.inf)
    reader = SessionReader(tmp_path / "s.mcap")
    others = [field.name for field in fields(Tick) if field.name not in ("stamp_ns", "frame", "drops", "extra")]
    for told, found in zip(ticks, reader.ticks(), strict=True):
        for name in others:
            mine, theirs = getattr(told, name), getattr(found, name)
            assert mine is theirs is None or mine.same_as(theirs)
    kept = [frame.index for frame in reader.messages("frame")]
    assert 0 < writer.dropped_frames == len(ticks) - len(kept) == int(reader.outcome["dropped_frames"])
    # Gaps are 1, 2, 4, ... and a gap of n begins or ends at a multiple of n: no bursts, also across a change.
    assert all(b - a in (1, 2, 4, 8) or (b - a) % 16 == 0 for a, b in itertools.pairwise(kept))
    assert all(a % min(b - a, 16) == 0 or b % min(b - a, 16) == 0 for a, b in itertools.pairwise(kept))
    drops = list(reader.messages("drops"))
    assert drops[0].topic == "/camera/frame" and drops[0].kept_every > 1
    assert drops[0].stamp_ns <= ticks[next(i for i in range(240) if i not in kept)].stamp_ns
    assert [drop.by_backlog for drop in drops] == sorted(drop.by_backlog for drop in drops)
    assert 0 < drops[-1].by_backlog <= writer.dropped_frames and all(drop.by_camera == 0 for drop in drops)


@pytest.mark.parametrize("block", [True, False])
def test_a_run_that_must_end_soon_drops_the_images_that_wait_and_counts_them(tmp_path, monkeypatch, block):
    disk = GatedDisk(monkeypatch)
    ticks = list(ticks_of(120, shape=(256, 256)))  # 8 MB
    # With less of flush_s a run that may block would wait for the disk, which here takes no more.
    writer = SessionWriter(tmp_path / "s.mcap", HEADER, WriterOptions(frames="raw", block=block, flush_s=10.0))
    disk.allow(2_000_000)
    for tick in ticks:
        writer.write(tick)
    writer.close({"outcome": "stopped"}, timeout_s=0.3)
    reader = SessionReader(tmp_path / "s.mcap")
    kept = [frame.index for frame in reader.messages("frame")]
    again = list(reader.ticks())
    assert len(again) == len(ticks) and kept == list(range(len(kept)))
    assert all(told.track.same_as(found.track) for told, found in zip(ticks, again, strict=True))
    assert 0 < writer.dropped_frames == len(ticks) - len(kept) == int(reader.outcome["dropped_frames"])
    assert again[-1].drops.by_backlog == writer.dropped_frames


def kept_by(disk_share, seconds=60.0, rate_hz=60.0, room_s=1.0):
    """What is kept, in a model of a queue of that many seconds and a disk that takes that share of the frames."""
    thinning, waiting, kept = FrameDecimation(), 0.0, []
    for number in range(round(seconds * rate_hz)):
        waiting = max(0.0, waiting - disk_share)
        if thinning.keeps(waiting / (room_s * rate_hz), number * PERIOD_NS):
            waiting += 1.0
            kept.append(number)
        assert waiting <= room_s * rate_hz
    return kept


@pytest.mark.parametrize("disk_share", [0.07, 0.2, 0.45, 0.6, 0.9])
def test_thinning_uses_the_disk_and_keeps_the_queue_from_ever_being_full(disk_share):
    kept = kept_by(disk_share)
    assert len(kept) >= 0.5 * disk_share * 3600  # a step of two below what the disk takes is the worst
    gaps = [b - a for a, b in itertools.pairwise(kept)]
    assert set(gaps) <= {1, 2, 4, 8, 16}
    assert sum(a != b for a, b in itertools.pairwise(gaps)) < 60  # it changes its mind seldom


def test_a_try_that_failed_is_repeated_ever_more_seldom():
    # Six in ten: every second image always finds room, all of them never do for long.
    gaps = [b - a for a, b in itertools.pairwise(kept_by(0.6, seconds=240.0))]
    assert sum(a != b for a, b in itertools.pairwise(gaps)) < 40  # 100 where it is tried again at once


def test_a_disk_that_takes_all_is_given_all_also_after_a_hiccup():
    assert len(kept_by(1.0)) == 3600
    thinning, fill = FrameDecimation(), 0.0
    kept = []
    for number in range(1200):
        fill = max(0.0, fill - (0.0 if 100 < number < 150 else 1.5 / 60))  # 0.8 s in which nothing is taken
        if thinning.keeps(fill, number * PERIOD_NS):
            kept.append(number)
            fill += 1.0 / 60
    assert thinning.every == 1 and kept[-600:] == list(range(600, 1200))


def test_frames_that_the_camera_never_delivered_are_counted_apart(tmp_path):
    with SessionWriter(tmp_path / "s.mcap", HEADER) as writer:
        for number in (5, 6, 9, 10):
            now = 10**9 + number * PERIOD_NS
            writer.write(Tick(now, frame=Frame(now, number, np.zeros((4, 4), np.uint8))))
    reader = SessionReader(tmp_path / "s.mcap")
    (drops,) = reader.messages("drops")
    assert (drops.by_camera, drops.by_backlog, drops.kept_every) == (2, 0, 1)
    assert reader.outcome["frames_missing_from_camera"] == "2" and reader.outcome["dropped_frames"] == "0"


@pytest.mark.parametrize("flush_s", [0.1, 0.5, 10.0])
@pytest.mark.parametrize("sync_s", [0.2, 1.0, 30.0])
def test_what_waits_for_a_flush_and_then_for_a_sync_is_no_older_than_was_promised(flush_s, sync_s):
    options = WriterOptions(flush_s=flush_s, sync_s=sync_s)
    assert options.flush_interval_s <= 0.5 * flush_s
    assert options.flush_interval_s + options.sync_interval_s < sync_s, "and an fsync takes a while itself"


def test_every_gap_of_the_camera_is_told_at_the_first_image_behind_it(tmp_path):
    numbers = [0, 1, 3, 4, 7, 8, 9, 15]  # within a fifth of a second
    with SessionWriter(tmp_path / "s.mcap", HEADER) as writer:
        for number in numbers:
            now = 10**9 + number * PERIOD_NS
            writer.write(Tick(now, frame=Frame(now, number, np.zeros((4, 4), np.uint8))))
    told = [
        ((drops.stamp_ns - 10**9) // PERIOD_NS, drops.by_camera)
        for drops in SessionReader(writer.path).messages("drops")
    ]
    assert told == [(3, 1), (7, 3), (15, 8)]


def test_a_run_that_waits_for_its_disk_is_never_more_than_flush_s_ahead_of_it(tmp_path, monkeypatch):
    put = McapWriter._put

    def slowly(self, parts):
        time.sleep(0.02)  # in which a run that does not wait would be far ahead
        put(self, parts)

    monkeypatch.setattr(McapWriter, "_put", slowly)
    ahead_s = []
    with SessionWriter(tmp_path / "s.mcap", HEADER, WriterOptions(block=True, flush_s=0.5)) as writer:
        for tick in ticks_of(90, shape=(8, 8)):
            writer.write(tick)
            # As a kill would find it now.
            with contextlib.closing(McapReader(writer.partial_path)) as source:
                held_ns = scan(source).last.get(SLOTS["/robot/track"].channel, (TICKS_BEGIN_NS,))[0]
            ahead_s.append(seconds(tick.stamp_ns - held_ns))
    assert 0.0 < max(ahead_s) <= 0.5


def test_poses_do_not_queue_behind_images():
    backlog = WriteQueue(1000)
    for stamp in range(3):
        backlog.put(Entry(stamp, {"track": None}, 1), Entry(stamp, {"frame": None}, 100))
    taken = [backlog.take(None) for _ in range(6)]
    expected = [(stamp, name) for name in ("track", "frame") for stamp in range(3)]
    assert [(entry.stamp_ns, *entry.messages) for entry in taken] == expected


@pytest.fixture
def disk_calls(monkeypatch):
    """What is asked of the disk, in order: ("fsync", name of file or folder), ("rename", new name)."""
    calls, fsync, replace, link = [], os.fsync, Path.replace, os.link

    def noted_fsync(descriptor):
        calls.append(("fsync", Path(f"/proc/self/fd/{descriptor}").readlink().name))
        fsync(descriptor)

    def noted_replace(path, target):
        calls.append(("rename", Path(target).name))
        return replace(path, target)

    def noted_link(path, target):
        calls.append(("rename", Path(target).name))
        link(path, target)

    monkeypatch.setattr(os, "fsync", noted_fsync)
    monkeypatch.setattr(os, "link", noted_link)
    monkeypatch.setattr(Path, "replace", noted_replace)
    monkeypatch.setattr(Path, "rename", noted_replace)
    return calls


@pytest.mark.skipif(not Path("/proc/self/fd").is_dir(), reason="file names of descriptors are those of Linux")
def test_the_disk_keeps_head_content_and_name_in_this_order(tmp_path, disk_calls):
    folder = tmp_path / "runs"
    folder.mkdir()
    writer = SessionWriter(folder / "s.mcap", HEADER)
    # The head and the name that it can be found by are on the disk before the first tick.
    assert disk_calls == [("fsync", "s.mcap.partial"), ("fsync", "runs")]
    writer.write(next(ticks_of(1)))
    before = len(disk_calls)
    writer.close()
    ending = disk_calls[before:]
    assert ending[-3:] == [("fsync", "s.mcap.partial"), ("rename", "s.mcap"), ("fsync", "runs")]
    disk_calls.clear()
    shutil.copyfile(folder / "s.mcap", folder / "t.mcap.partial")
    os.truncate(folder / "t.mcap.partial", (folder / "s.mcap").stat().st_size - 100)
    recover(folder / "t.mcap.partial")
    assert disk_calls[-2:] == [("rename", "t.mcap"), ("fsync", "runs")]
    assert ("fsync", "t.recovering.mcap.partial") in disk_calls[:-2]


def test_a_disk_that_can_not_keep_what_was_written_is_told_and_the_file_gets_no_name(tmp_path, monkeypatch):
    writer = SessionWriter(tmp_path / "s.mcap", HEADER)
    writer.write(next(ticks_of(1)))

    def refuse(_descriptor):
        raise OSError(5, "Input/output error")

    monkeypatch.setattr(os, "fsync", refuse)
    with pytest.raises(SessionError, match="flowrec recover"):
        writer.close()
    assert [path.name for path in tmp_path.iterdir()] == ["s.mcap.partial"]


def test_a_directory_that_disappears_ends_the_run(tmp_path):
    folder = tmp_path / "usb"
    folder.mkdir()
    writer = SessionWriter(folder / "s.mcap", HEADER, WriterOptions(sync_s=0.2))
    shutil.rmtree(folder)
    fails(writer, r"s\.mcap\.partial")


def test_a_directory_that_is_renamed_is_told_at_the_end_and_nothing_is_lost(tmp_path):
    folder = tmp_path / "monday"
    folder.mkdir()
    writer = SessionWriter(folder / "s.mcap", HEADER)
    for tick in ticks_of(5):
        writer.write(tick)
    folder.rename(tmp_path / "tuesday")
    with pytest.raises(SessionError, match="monday"):
        writer.close({"outcome": "reached"})
    assert recover(tmp_path / "tuesday" / "s.mcap.partial").complete


@pytest.mark.skipif(not Path("/sys/kernel").is_dir(), reason="no place that refuses even root")
def test_a_place_that_may_not_be_written_is_told_before_anything_runs():
    with pytest.raises(SessionError, match=r"can not be (made|written to).*choose another place"):
        SessionWriter(Path("/sys/kernel/s.mcap"), HEADER)


FULL = """
import resource, sys, time
from flowrec.core.errors import SessionError
from flowrec.store.session_file import WriterOptions
from flowrec.store.writer import SessionWriter
from tests.store.made_up import HEADER, ticks_of
resource.setrlimit(resource.RLIMIT_FSIZE, (200_000, 200_000))
writer = SessionWriter(sys.argv[1], HEADER, WriterOptions(flush_s=0.05))
for call in (lambda: [(writer.write(tick), time.sleep(0.002)) for tick in ticks_of(100_000)], writer.close):
    try:
        call()
    except SessionError as error:
        print(error)
"""


def test_a_file_that_may_not_grow_is_told_and_what_it_holds_is_saved(tmp_path):
    run = subprocess.run(
        [sys.executable, "-c", FULL, tmp_path / "s.mcap"], capture_output=True, text=True, check=True, timeout=HANG_S
    )
    first, second = run.stdout.splitlines()
    assert first == second and "s.mcap" in first and not run.stderr
    saved = recover(tmp_path / "s.mcap.partial")
    assert saved.ticks > 5 and not saved.complete


def test_the_operating_system_has_all_state_but_the_last_flush_s_of_stamps(tmp_path):
    ticks = list(ticks_of(150, shape=(8, 8)))
    with SessionWriter(tmp_path / "s.mcap", HEADER, WriterOptions(flush_s=0.5, sync_s=100.0)) as writer:
        for tick in ticks:
            writer.write(tick)
            while writer.queue_bytes:
                time.sleep(1e-4)
            assert (writer._recorder.run.flushed_ns or ticks[0].stamp_ns) >= tick.stamp_ns - NS_PER_S // 2


def test_with_the_shipped_settings_a_power_cut_costs_a_second_on_the_slowest_disk_that_the_promise_allows(
    tmp_path, monkeypatch
):
    """The clock is the test's: every fsync takes just less than half a second of it."""
    recording = load_config().recording
    now_s, done, sync = [100.0], threading.Semaphore(0), McapWriter.sync

    def slow(file):
        assert done.acquire(timeout=HANG_S)
        sync(file)

    options = WriterOptions(flush_s=recording.flush_s, sync_s=recording.sync_s, clock=lambda: now_s[0])
    parts = Parts(RecordingPlan(tmp_path / "s.mcap", HEADER, options, None, "run", {}), print)
    monkeypatch.setattr(McapWriter, "sync", slow)
    file = parts.open[-1].file
    kept_ns, asked, lost_s, syncs = TICKS_BEGIN_NS, None, [], 0
    for tick in ticks_of(400, shape=(8, 8)):  # 6.7 s
        parts.add(entry_of(tick.stamp_ns, tick.track, tick.truth, nbytes=500, ticks=1))
        parts.flush_if_due()
        if asked is None and file.is_syncing:  # for what the operating system has now
            asked = parts.flushed_ns, now_s[0] + 0.49
        elif asked is not None and now_s[0] >= asked[1]:
            done.release()
            while file.is_syncing:
                time.sleep(1e-4)
            kept_ns, asked, syncs = asked[0], None, syncs + 1
        lost_s.append(seconds(tick.stamp_ns - kept_ns))
        now_s[0] += seconds(PERIOD_NS)
    done.release()
    parts.close()
    assert syncs > 5
    assert max(lost_s) <= 1.0 + 2.0 * seconds(PERIOD_NS)
