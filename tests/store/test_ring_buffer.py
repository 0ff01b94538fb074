"""What is kept of a run around an event, and nothing else."""

import errno
import resource
import signal
import subprocess
import sys
from dataclasses import replace
from itertools import islice
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader

from flowrec.core import NS_PER_S, Event, Frame, OperatorEvent, SessionError
from flowrec.store import FRAME_PATH, SessionReader, SessionWriter, WriterOptions, recover
from flowrec.store.chunk import ChunkBuilder
from flowrec.store.mcap_writer import McapWriter
from flowrec.store.run_files import snapshot_path
from flowrec.store.session_file import SessionFile, Snapshot, Split
from tests.store.made_up import HEADER, PERIOD_NS, START_UNIX_NS, same, ticks_of, write_session
from tests.store.test_damage import names_in
from tests.store.test_durability import slow_disk
from tests.store.test_split import messages_in

QUIET = [replace(tick, operator=None) for tick in ticks_of(600)]  # 10 s
ABOUT = Snapshot(before_s=2.0, after_s=1.0)
SEGMENT_NS = NS_PER_S // 4


def with_events(*events, ticks=QUIET):
    """Marks and notes by tick number; each stays the latest until the next."""
    told = dict(events)
    operator = None
    for number, tick in enumerate(ticks):
        if number in told:
            operator = OperatorEvent(tick.stamp_ns, *told[number])
        yield replace(tick, operator=operator)


def record(path, ticks, snapshot=ABOUT, outcome=None, why="", **options):
    writer = SessionWriter(path, HEADER, WriterOptions(files=snapshot, **options))
    for tick in ticks:
        writer.write(tick)
    writer.close(outcome or {"outcome": "reached"}, why=why)
    return writer


def fly_until_the_pump_falls_off(writer):
    with writer:
        for tick in QUIET[:30]:
            writer.write(tick)
        raise RuntimeError("the pump fell off")


def memory_mb():
    """Resident memory of this process."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize() / 1e6


def span_of(path):
    """First and last tick that the file itself recorded, by their place in QUIET; and what it says of itself."""
    messages, told = messages_in(path)
    carried_ns = int(told["flowrec.part"].get("carried_ns", -1))
    stamps = sorted({log for _, log, _, _ in messages if log > carried_ns})
    first, last = ((stamp - QUIET[0].stamp_ns) // PERIOD_NS for stamp in (stamps[0], stamps[-1]))
    assert len(stamps) == last - first + 1 == int(told["flowrec.outcome"]["ticks"])
    assert carried_ns == (QUIET[first - 1].stamp_ns if first else -1)
    return first, last, told


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    path = tmp_path_factory.mktemp("snapshots") / "whole.mcap"
    return write_session(path, with_events((400, ("mark", ""))))


@pytest.mark.parametrize("disk", [None, 1e6])
@pytest.mark.parametrize("frames", ["zstd", "raw"])
def test_a_mark_keeps_the_seconds_before_and_after_it_as_they_were(tmp_path, monkeypatch, whole, disk, frames):
    if disk is not None:
        slow_disk(monkeypatch, disk)
    writer = record(tmp_path / "x.mcap", with_events((400, ("mark", ""))), frames=frames)
    assert names_in(tmp_path) == ["x.snap001.mcap"] and writer.dropped_frames == 0
    (path,) = writer.files
    first, last, told = span_of(path)
    event_ns = QUIET[400].stamp_ns
    assert event_ns - 2 * NS_PER_S - SEGMENT_NS - PERIOD_NS <= QUIET[first].stamp_ns <= event_ns - 2 * NS_PER_S
    assert QUIET[last].stamp_ns <= event_ns + NS_PER_S < QUIET[last + 1].stamp_ns
    assert told["flowrec.part"] | {"run": ""} == {
        "run": "",
        "number": "1",
        "kind": "snapshot",
        "carried_ns": str(QUIET[first - 1].stamp_ns),
        "why": "mark",
    }
    assert told["flowrec.outcome"]["outcome"] == "snapshot" and told["flowrec.outcome"]["note"] == "mark"
    with SessionReader(whole) as all_of_it, SessionReader(path) as reader:
        before = QUIET[first - 1].stamp_ns
        assert same(reader.tick_before(before), all_of_it.tick_before(before))
        expected = all_of_it.ticks(QUIET[first].stamp_ns)
        found = list(reader.ticks(QUIET[first].stamp_ns))
        assert len(found) == last - first + 1
        assert all(same(mine, theirs) for mine, theirs in zip(found, expected, strict=False))
    for topic in ("/camera/frame", "/coils/applied"):  # as check wants it: in order, and with nothing between
        with path.open("rb") as stream:
            messages = make_reader(stream).iter_messages([topic], log_time_order=False)
            order = [message.sequence for _, _, message in messages]
        assert order == list(range(order[0], order[0] + len(order)))


@pytest.mark.parametrize("in_time", [True, False])
def test_a_snapshot_begins_with_the_image_before_its_first_tick_whenever_that_reached_the_ring(tmp_path, in_time):
    """In time: with its tick. Otherwise behind all ticks, as where the disk is slow."""
    (path,) = record(tmp_path / "x.mcap", with_events((400, ("mark", ""))), block=in_time).files
    first, last, _ = span_of(path)
    with path.open("rb") as stream:
        images = [message.log_time - START_UNIX_NS for _, _, message in make_reader(stream).iter_messages([FRAME_PATH])]
    assert images == [tick.stamp_ns for tick in QUIET[first - 1 : last + 1]]


def test_events_that_meet_share_a_snapshot_and_later_ones_get_their_own(tmp_path):
    ticks = with_events((150, ("mark", "")), (200, ("note", "a bubble")), (450, ("mark", "again")))
    first, second = record(tmp_path / "x.mcap", ticks).files
    assert second == snapshot_path(tmp_path / "x.mcap", 2)
    _, last, told = span_of(first)
    assert told["flowrec.outcome"]["also"] == "note: a bubble" and last == 259
    begins, last, told = span_of(second)
    assert told["flowrec.part"]["why"] == "mark: again" and last == 509 and 450 - 120 - 16 <= begins <= 450 - 120


def test_an_event_soon_after_a_snapshot_goes_on_from_where_that_ended(tmp_path):
    first, second = record(tmp_path / "x.mcap", with_events((200, ("mark", "")), (280, ("mark", "")))).files
    assert span_of(first)[1] + 1 == span_of(second)[0]


def test_alarms_lost_images_and_bad_ends_are_events_and_what_a_person_is_told_is_none(tmp_path):
    assert record(tmp_path / "quiet.mcap", QUIET).files == [] and names_in(tmp_path) == []

    def told(level):
        for number, tick in enumerate(QUIET):
            at = QUIET[min(number, 300)].stamp_ns
            yield replace(tick, event=Event(at, level if number >= 300 else "info", "NIS"))

    assert record(tmp_path / "info.mcap", told("info")).files == []
    for level in ("warning", "error"):
        (alarm,) = record(tmp_path / f"{level}.mcap", told(level)).files
        assert span_of(alarm)[2]["flowrec.part"]["why"] == "NIS"
    lost = [replace(tick, frame=replace(tick.frame, index=n + (n > 300) + (n > 500))) for n, tick in enumerate(QUIET)]
    (lost,) = record(tmp_path / "lost.mcap", lost, Snapshot(4.0, 1.0)).files  # the second is no news after the first
    assert span_of(lost)[2]["flowrec.part"]["why"] == "images are lost"
    (bad,) = record(tmp_path / "bad.mcap", QUIET, outcome={"outcome": "lost"}, why="the run ended lost").files
    first, last, said = span_of(bad)
    assert last == 599 and 600 - 120 - 17 <= first <= 600 - 120 and said["flowrec.outcome"]["outcome"] == "lost"
    writer = SessionWriter(tmp_path / "raised.mcap", HEADER, WriterOptions(files=ABOUT))
    with pytest.raises(RuntimeError):
        fly_until_the_pump_falls_off(writer)
    first, last, said = span_of(writer.files[0])
    assert (first, last) == (0, 29) and said["flowrec.outcome"]["outcome"] == "failed"
    assert said["flowrec.part"]["why"] == "RuntimeError: the pump fell off"


def test_the_ring_takes_no_more_memory_than_it_may_and_says_what_it_holds(tmp_path):
    rng = np.random.default_rng(0)
    images = [rng.integers(0, 256, (256, 256), dtype=np.uint8) for _ in range(8)]  # 65 kB that do not pack
    ticks = (
        replace(tick, frame=Frame(tick.stamp_ns, n, images[n % 8]))
        for n, tick in enumerate(with_events((590, ("mark", ""))))
    )
    writer = SessionWriter(
        tmp_path / "x.mcap",
        HEADER,
        WriterOptions(files=Snapshot(8.0, 5.0, megabytes=4.0), block=True, queue_limit_bytes=1 << 20),
    )
    highest = memory_mb()
    began = highest
    for tick in ticks:
        writer.write(tick)
        highest = max(highest, memory_mb())
    writer.close({"outcome": "reached"})
    assert highest - began < 25.0  # all of it would be 39 MB
    first, last, told = span_of(writer.files[0])
    assert last == 599 and 590 - 64 < first < 590 - 40  # 4 MB less the segment that is being filled
    assert "of 8 s before the event" in told["flowrec.outcome"]["short_of_memory"]
    (remark,) = [remark for remark in writer.remarks if "fit into" in remark]
    assert "of 8 s fit into 4 MB; set recording.snapshot_mb" in remark


def test_only_a_snapshot_that_lacks_what_did_not_fit_into_memory_says_so(tmp_path):
    rng = np.random.default_rng(0)
    noise = [rng.integers(0, 256, (256, 256), dtype=np.uint8) for _ in range(8)]  # 65 kB that do not pack, ...
    black = np.zeros((256, 256), np.uint8)  # ... and nothing that does
    options = WriterOptions(files=Snapshot(2.0, 0.5, megabytes=3.0), block=True, queue_limit_bytes=1 << 20)
    with SessionWriter(tmp_path / "x.mcap", HEADER, options) as writer:
        for n, tick in enumerate(with_events((200, ("mark", "")), (500, ("mark", "")))):
            writer.write(replace(tick, frame=Frame(tick.stamp_ns, n, noise[n % 8] if n < 240 else black)))
    short = ["short_of_memory" in span_of(file)[2]["flowrec.outcome"] for file in writer.files]
    assert short == [True, False]


def test_a_place_that_may_not_be_written_or_is_taken_is_told_before_the_run(tmp_path):
    with pytest.raises(SessionError, match="no such directory"):
        SessionWriter(tmp_path / "missing" / "x.mcap", HEADER, WriterOptions(files=ABOUT))
    snapshot_path(tmp_path / "x.mcap", 3).touch()
    with pytest.raises(SessionError, match=r"snap003\.mcap: exists already"):
        SessionWriter(tmp_path / "x.mcap", HEADER, WriterOptions(files=ABOUT))
    record(tmp_path / "x.mcap", QUIET, overwrite=True)  # nothing has come of it, so nothing is taken away
    assert names_in(tmp_path) == ["x.snap003.mcap"]
    record(tmp_path / "x.mcap", with_events((300, ("mark", ""))), overwrite=True)
    assert names_in(tmp_path) == ["x.snap001.mcap"]


KILLED = """
import sys, time
from flowrec.store.session_file import SessionFile, Snapshot, WriterOptions
from flowrec.store.writer import SessionWriter
from tests.store.test_ring_buffer import HEADER, with_events
writer = SessionWriter(sys.argv[1], HEADER, WriterOptions(flush_s=0.1, files=Snapshot(2.0, 8.0)))
for number, tick in enumerate(with_events((200, ("mark", "")))):
    writer.write(tick)
    while writer.queue_bytes:
        time.sleep(0.001)
    print(number, flush=True)
"""


@pytest.mark.slow("kills a recording in a process of its own")
def test_a_snapshot_that_is_being_taken_outlives_a_kill(tmp_path):
    with subprocess.Popen(
        [sys.executable, "-c", KILLED, tmp_path / "x.mcap"], stdout=subprocess.PIPE, text=True
    ) as run:
        while int(run.stdout.readline()) < 320:
            pass
        run.send_signal(signal.SIGKILL)
        run.stdout.read()
    assert names_in(tmp_path) == ["x.snap001.mcap.partial"]
    saved = recover(tmp_path / "x.snap001.mcap.partial")
    with SessionReader(saved.path) as reader:
        assert "on the way" not in reader.outcome["note"]
        stamps = [tick.stamp_ns for tick in reader.ticks()]
    # The flush of a tick may still be under way when it has left the queue: at most the flush before it is there.
    assert QUIET[80].stamp_ns >= stamps[0] and stamps[-1] > QUIET[320].stamp_ns - 0.2 * NS_PER_S


@pytest.mark.parametrize("method", ["add_chunks", "finish", "sync"])
def test_a_disk_that_refuses_a_snapshot_is_an_error_of_the_run(tmp_path, monkeypatch, method):
    def refuse(*_):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(McapWriter, method, refuse)
    with pytest.raises(SessionError, match="flowrec recover"):
        record(tmp_path / "x.mcap", with_events((300, ("mark", ""))), sync_s=0.0)


def test_nothing_is_written_behind_what_the_disk_has_refused(tmp_path, monkeypatch):
    written = []

    def refuse_first(_file, chunks):
        written.append(chunks)
        if len(written) == 1:
            raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(McapWriter, "add_chunks", refuse_first)
    file, builder = SessionFile(tmp_path / "x.mcap", HEADER, WriterOptions(), limit_bytes=1 << 20), ChunkBuilder()
    for number in range(3):
        builder.add(1, number, number, number, (b"message",))
        file.put([builder.seal()])
    file.close()
    assert len(written) == 1
    with pytest.raises(SessionError, match="the disk is full"):
        file.check()


@pytest.mark.parametrize("files", [Split(seconds=0.6), Snapshot(0.8, 0.4)])
def test_no_number_of_a_message_is_missing_or_twice_between_a_keyframe_and_what_follows_it(files, tmp_path):
    with SessionWriter(tmp_path / "x.mcap", HEADER, WriterOptions(files=files, block=True)) as writer:
        for tick in islice(with_events((100, ("mark", "")), (250, ("mark", ""))), 300):
            writer.write(tick)
    assert len(writer.files) > 1
    for piece in writer.files:
        found = {}
        with piece.open("rb") as stream:
            for _, channel, message in make_reader(stream).iter_messages():
                if channel.metadata.get("role") not in (None, "view") and channel.topic != "/camera/frame":
                    found.setdefault(channel.topic, []).append(message.sequence)
        for topic, numbers in found.items():
            assert numbers == list(range(numbers[0], numbers[0] + len(numbers))), (piece.name, topic)
