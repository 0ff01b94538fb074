"""A run in several files: nothing is lost between them, each can be read alone, and nothing stale stays behind."""

import contextlib
import errno
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader

from flowrec.core import NS_PER_S, SessionError, seconds
from flowrec.store import SLOTS, SessionReader, SessionWriter, WriterOptions, part_path, recover
from flowrec.store.mcap_reader import McapReader
from flowrec.store.mcap_writer import McapWriter
from flowrec.store.parts import Parts
from flowrec.store.run_files import run_files
from flowrec.store.scan import scan
from flowrec.store.segments import RecordingPlan
from flowrec.store.session_file import Split
from tests.store.made_up import HEADER, PERIOD_NS, START_UNIX_NS, entry_of, fails, same, ticks_of, write_session
from tests.store.test_damage import names_in
from tests.store.test_durability import GatedDisk, slow_disk

TICKS = list(ticks_of(120, shape=(96, 96)))
APPLIED = SLOTS["/coils/applied"].channel
SPAN_S = seconds(TICKS[-1].stamp_ns - TICKS[0].stamp_ns)


def record(path, split, *, ticks=TICKS, **options):
    writer = SessionWriter(path, HEADER, WriterOptions(files=split, **options))
    for tick in ticks:
        writer.write(tick)
    writer.close({"outcome": "reached"})
    return writer


def messages_in(path):
    """Topic, time, stamp and bytes of every message, as any MCAP reader finds them; and the file's own account."""
    with path.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        told = {metadata.name: metadata.metadata for metadata in reader.iter_metadata()}
        found = [
            (channel.topic, message.log_time - START_UNIX_NS, message.publish_time - START_UNIX_NS, message.data)
            for _, channel, message in reader.iter_messages()
        ]
        assert reader.get_summary().statistics.message_count == len(found)
    return found, told


def recorded(messages):
    """Without the verdict, which each part has of its own end."""
    return [message for message in messages if message[0] != "/verdict"]


def news_of(paths):
    """The same of all parts without what is told twice, in order."""
    found = []
    for path in paths:
        messages, told = messages_in(path)
        carried = told["flowrec.part"].get("carried_ns")
        found += [message for message in messages if carried is None or message[1] > int(carried)]
        # What is told twice was new at or before that tick, all of it logged there.
        assert carried is None or min(log for _, log, _, _ in messages) == int(carried)
    return found


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    path = tmp_path_factory.mktemp("parts") / "whole.mcap"
    record(path, None)
    return path


@settings(max_examples=4, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    split=st.builds(
        Split, st.one_of(st.none(), st.floats(0.02, 1.5)), st.one_of(st.none(), st.floats(0.5 * PERIOD_NS / 1e9, 2.5))
    ),
    disk=st.sampled_from([None, 4e6, 8e6]),
    frames=st.sampled_from(["zstd", "raw"]),
    block=st.booleans(),
)
def test_nothing_is_lost_or_doubled_between_parts_and_each_can_be_read_alone(whole, split, disk, frames, block):
    with tempfile.TemporaryDirectory() as folder, pytest.MonkeyPatch.context() as patch:
        if disk is not None:
            slow_disk(patch, disk)  # images are some 0.1 to 0.4 s behind
        path = Path(folder) / "x.mcap"
        writer = record(path, split, frames=frames, block=block)
        files = writer.files
        assert files == ([part_path(path, n + 1) for n in range(len(files))] if split else [path])
        assert run_files(path) == sorted(files) and writer.dropped_frames == 0
        everything = sorted(recorded(messages_in(whole)[0]))
        assert sorted(recorded(news_of(files) if split else messages_in(path)[0])) == everything
        reader = SessionReader(whole)
        for number, piece in enumerate(files if split else [], start=1):
            messages, told = messages_in(piece)
            outcome, part = told["flowrec.outcome"], told["flowrec.part"]
            new = {log for _, log, _, _ in messages if log > int(part.get("carried_ns", -1))}
            assert int(part["number"]) == number and int(outcome["ticks"]) == len(new) > 0
            if number < len(files):
                assert (outcome["outcome"], outcome["next"]) == ("continued", files[number].name)
            else:
                assert outcome["outcome"] == "reached"
            if number > 1:
                carried_ns = int(part["carried_ns"])
                with SessionReader(piece) as alone:
                    assert same(alone.tick_before(carried_ns), reader.tick_before(carried_ns))


def test_parts_by_time_begin_where_they_would_without_gaps_and_parts_by_size_have_about_that_size(tmp_path):
    by_time = record(tmp_path / "t.mcap", Split(seconds=0.5), block=True).files
    begins = [min(log for _, log, _, _ in news_of([piece])) for piece in by_time]
    assert len(begins) == int(SPAN_S / 0.5) + 1
    for number, begin_ns in enumerate(begins):
        assert 0 <= begin_ns - TICKS[0].stamp_ns - number * 500_000_000 < PERIOD_NS
    by_size = record(tmp_path / "s.mcap", Split(megabytes=0.2), frames="raw", block=True).files
    sizes = [piece.stat().st_size for piece in by_size]
    # Index and copies are a fifth of so small a part; what the encoders hold when it ends varies with their threads.
    assert len(sizes) > 4 and all(0.1e6 < size < 0.4e6 for size in sizes[:-1])


def test_a_part_whose_beginning_is_larger_than_a_part_still_gets_as_much_again(tmp_path):
    files = record(tmp_path / "x.mcap", Split(megabytes=0.001), block=True).files
    assert 2 < len(files) < len(TICKS) / 2


def test_the_image_before_a_part_counts_to_its_beginning_and_not_to_what_it_adds(tmp_path):
    ticks = list(ticks_of(12, shape=(400, 400)))  # an image is larger than head and state
    files = record(tmp_path / "x.mcap", Split(megabytes=0.001), ticks=ticks, frames="raw", block=True).files
    assert 3 < len(files) <= 1 + len(ticks) / 2


def test_a_part_counts_the_images_that_still_wait_for_it_until_they_have_come(tmp_path):
    options = WriterOptions(files=Split(megabytes=0.2), frames="raw")
    parts = Parts(RecordingPlan(tmp_path / "x.mcap", HEADER, options, None, "run", {}), print)
    first = parts.open[0]
    ticks = list(ticks_of(12, shape=(200, 200)))
    image = {tick.stamp_ns: entry_of(tick.stamp_ns, tick.frame, nbytes=40_000, late=True) for tick in ticks}
    for tick in ticks[:4]:
        parts.add(entry_of(tick.stamp_ns, tick.track, nbytes=500, ticks=1, image_bytes=40_000))
    assert (first.awaited, first.awaited_bytes) == (4, 160_000)
    for number, tick in enumerate(ticks[:4]):
        parts.add(image[tick.stamp_ns])
        assert first.awaited_bytes == 40_000 * (3 - number)
    parts.close()


def test_an_end_in_a_hurry_counts_what_it_drops_in_the_part_that_lacks_it(tmp_path, monkeypatch):
    disk = GatedDisk(monkeypatch)
    writer = SessionWriter(tmp_path / "x.mcap", HEADER, WriterOptions(files=Split(seconds=0.4), frames="raw"))
    disk.allow(600_000)  # of 1.1 MB
    for tick in TICKS:
        writer.write(tick)
        disk.until_idle(writer)
    writer.close({"outcome": "stopped"}, timeout_s=0.4)
    kept = 0
    for piece in writer.files:
        messages, told = messages_in(piece)
        images = sum(
            topic == "/camera/frame" and log > int(told["flowrec.part"].get("carried_ns", -1))
            for topic, log, _, _ in messages
        )
        assert images + int(told["flowrec.outcome"]["dropped_frames"]) == int(told["flowrec.outcome"]["ticks"])
        kept += images
    assert 0 < kept == len(TICKS) - writer.dropped_frames


def test_any_piece_that_is_there_refuses_and_overwrite_leaves_none_of_them(tmp_path):
    path = tmp_path / "x.mcap"
    older = record(path, Split(seconds=0.2), block=True).files
    for split in (None, Split(seconds=1.0)):
        with pytest.raises(SessionError, match=r"x\.part001\.mcap: .*--overwrite"):
            SessionWriter(path, HEADER, WriterOptions(files=split))
    newer = record(path, Split(seconds=1.0), block=True, overwrite=True).files
    assert len(newer) < len(older) and run_files(path) == newer
    record(path, None, block=True, overwrite=True)
    assert names_in(tmp_path) == ["x.mcap"]


def test_a_next_part_that_can_not_be_made_ends_the_run_and_leaves_whole_parts(tmp_path, monkeypatch):
    made = McapWriter.__init__

    def refuse(self, path, **options):
        if "part003" in path.name:
            raise OSError(errno.ENOSPC, "No space left on device")
        made(self, path, **options)

    monkeypatch.setattr(McapWriter, "__init__", refuse)
    writer = SessionWriter(tmp_path / "x.mcap", HEADER, WriterOptions(files=Split(seconds=0.5)))
    fails(writer, r"part003\.mcap\.partial: can not be made \(No space", (96, 96))
    assert sorted(names_in(tmp_path)) == ["x.part001.mcap", "x.part002.mcap"]
    outcomes = [messages_in(piece)[1]["flowrec.outcome"] for piece in run_files(tmp_path / "x.mcap")]
    assert [outcome["outcome"] for outcome in outcomes] == ["continued", "failed"]


def test_a_disk_that_fails_in_a_part_leaves_the_ones_before_it_whole(tmp_path, monkeypatch):
    plain = McapWriter.add_chunks

    def refuse(self, sealed):
        if "part002" in str(self._file.name) and self.size > 80_000:
            raise OSError(errno.ENOSPC, "No space left on device")
        plain(self, sealed)

    monkeypatch.setattr(McapWriter, "add_chunks", refuse)
    with pytest.raises(SessionError, match=r"part002\.mcap\.partial: the disk is full"):
        write_session(tmp_path / "x.mcap", TICKS, files=Split(seconds=1.0))
    assert sorted(names_in(tmp_path)) == ["x.part001.mcap", "x.part002.mcap.partial"]
    assert messages_in(part_path(tmp_path / "x.mcap", 1))[1]["flowrec.outcome"]["outcome"] == "continued"
    monkeypatch.undo()  # or what is recovered would fail as well
    assert recover(tmp_path / "x.part002.mcap.partial").ticks > 0


def test_a_run_that_is_not_to_be_kept_leaves_no_part_though_its_disk_has_failed(tmp_path, monkeypatch):
    def refuse(self, sealed, plain=McapWriter.add_chunks):
        if "part003" in str(self._file.name) and self.size > 80_000:
            raise OSError(errno.ENOSPC, "No space left on device")
        plain(self, sealed)

    monkeypatch.setattr(McapWriter, "add_chunks", refuse)
    with pytest.raises(SessionError, match="nothing is left"):
        write_session(tmp_path / "x.mcap", TICKS, files=Split(seconds=0.6), keep_failed=False)
    assert names_in(tmp_path) == []


KILLED = """
import sys, time
from flowrec.store.session_file import Split, WriterOptions
from flowrec.store.writer import SessionWriter
from tests.store.made_up import HEADER, ticks_of
writer = SessionWriter(sys.argv[1], HEADER, WriterOptions(flush_s=0.05, files=Split(seconds=0.1)))
for number, tick in enumerate(ticks_of(10_000, shape=(64, 64))):
    writer.write(tick)
    while writer.queue_bytes:
        time.sleep(0.001)
    print(number, flush=True)
"""


KILL = pytest.mark.slow("kills a recording in a process of its own, at another moment")


@pytest.mark.parametrize("moment", [40, *(pytest.param(each, marks=KILL) for each in (25, 61))])
def test_a_kill_at_or_about_a_split_leaves_whole_parts_and_a_last_one_to_be_saved(tmp_path, moment):
    path = tmp_path / "x.mcap"
    with subprocess.Popen([sys.executable, "-c", KILLED, path], stdout=subprocess.PIPE, text=True) as run:
        while int(run.stdout.readline()) < moment:
            pass
        run.send_signal(signal.SIGKILL)
        run.stdout.read()
    left = run_files(path)
    for piece in left:
        if piece.suffix == ".partial":
            try:
                recover(piece)
            except SessionError:
                piece.unlink()  # begun just now: it holds nothing that the others do not
    saved = run_files(path)
    assert saved == [part_path(path, number + 1) for number in range(len(saved))]
    stamps = sorted({log for _, log, _, _ in news_of(saved)})
    assert stamps == [tick.stamp_ns for tick in ticks_of(len(stamps), shape=(8, 8))]
    # Not in the file are what is younger than 0.05 s and what waits for the beginning of the last part.
    assert len(stamps) > moment - (0.05 + 0.1) * NS_PER_S / PERIOD_NS


def copy_as_it_is(folder, to):
    """The files of a folder in which one may get its name just now."""
    while True:
        try:
            shutil.copytree(folder, to, ignore=shutil.ignore_patterns("[0-9]*"))
        except shutil.Error:
            shutil.rmtree(to)
        else:
            return


def test_however_slow_the_disk_ends_a_part_a_kill_leaves_no_hole_before_the_next(tmp_path, monkeypatch):
    monkeypatch.setattr(os, "fsync", lambda number: time.sleep(0.08))  # longer than a part
    path, moments = tmp_path / "x.mcap", []
    with SessionWriter(path, HEADER, WriterOptions(files=Split(seconds=0.3), flush_s=0.1)) as writer:
        for number, tick in enumerate(TICKS):
            writer.write(tick)
            time.sleep(0.002)
            if number % 20 == 19:  # as a kill would find it
                moments.append(tmp_path / f"{number}")
                copy_as_it_is(tmp_path, moments[-1])
    for moment in moments:
        left = run_files(moment / "x.mcap")
        stamps = set()
        for piece in left:
            with contextlib.closing(McapReader(piece)) as source:
                found = scan(source)
                for chunk in found.summary.chunks:
                    stamps |= {record.log_ns for record in source.messages(chunk) if record.channel == APPLIED}
        assert stamps == {tick.stamp_ns for tick in TICKS[: len(stamps)]}
    assert len(left) > 1


def test_the_operating_system_has_a_part_before_the_next_one_begins_though_images_of_it_wait(tmp_path):
    options = WriterOptions(files=Split(seconds=0.3), flush_s=100.0)
    parts = Parts(RecordingPlan(tmp_path / "x.mcap", HEADER, options, None, "run", {}), print)
    for tick in TICKS[:30]:
        parts.add(entry_of(tick.stamp_ns, tick.track, nbytes=500, ticks=1, image_bytes=64))
    first, second = parts.open
    assert first.awaited and first.file.flushed_ns == second.keyframe_ns
    parts.close()
