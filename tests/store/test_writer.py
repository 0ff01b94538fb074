"""Writer and reader together, and what other programs make of the file."""

import itertools
import os
import shutil
import struct
import subprocess
import sys
import threading
from collections import Counter
from dataclasses import fields, replace
from functools import partial
from importlib import import_module
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import zstandard
from mcap.opcode import Opcode
from mcap.reader import NonSeekingReader, make_reader

from flowrec.core import Clocks, Frame, Priority, SessionError, Tick
from flowrec.store import SessionReader, SessionWriter, WriterOptions, digest_faults
from flowrec.store.schema import foxglove_schema
from flowrec.store.session_file import Snapshot, Split
from flowrec.store.viewer_topics import VIEWER_TOPICS
from tests.conftest import HANG_S, until
from tests.store.made_up import HEADER, PERIOD_NS, START_UNIX_NS, same, ticks_of, write_session

session_writer = import_module("flowrec.store.session_writer")  # one of whose functions has its name
TICKS = list(ticks_of(150))


def record(path, ticks=TICKS, outcome=None, **options):
    return write_session(path, ticks, **options, outcome=outcome or {"outcome": "reached"})


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    return record(tmp_path_factory.mktemp("sessions") / "session.mcap")


def news(ticks, before=None):
    """Which fields are new in each tick, by identity."""
    before = before or Tick()
    for tick in ticks:
        yield {topic for topic in counts_of() if getattr(tick, topic) is not getattr(before, topic)}
        before = tick


def counts_of():
    return [field.name for field in fields(Tick) if field.name != "stamp_ns"]


def test_ticks_come_back_as_they_were_with_the_same_messages_new(path):
    reader = SessionReader(path)
    again = list(reader.ticks())
    assert all(itertools.starmap(same, zip(TICKS, again, strict=True)))
    assert list(news(again)) == list(news(TICKS))


def test_the_session_says_what_it_is(path):
    reader = SessionReader(path)
    assert reader.header == HEADER
    assert reader.outcome == {"outcome": "reached", "ticks": "150", "dropped_frames": "0"}
    assert (reader.first_ns, reader.last_ns) == (TICKS[0].stamp_ns, TICKS[-1].stamp_ns)
    assert reader.duration_s == pytest.approx(149 * PERIOD_NS / 1e9)
    assert reader.counts["frame"] == 150 and reader.counts["refined"] == 3 and reader.counts["event"] == 1
    assert [frame.index for frame in reader.messages("frame")] == list(range(150))
    assert len(list(reader.messages("refined"))) == 3


@pytest.mark.parametrize("number", [0, 1, 11, 12, 75, 149])
def test_starting_late_gives_the_tail_of_all_ticks(path, number):
    reader = SessionReader(path)
    start_ns = TICKS[number].stamp_ns
    tail, before = list(reader.ticks(start_ns)), reader.tick_before(start_ns - 1)
    assert all(itertools.starmap(same, zip(TICKS[number:], tail, strict=True)))
    # What is new in the first tick of the tail is told by the objects, too.
    assert list(news(tail, before)) == list(news(TICKS))[number:]


def test_the_state_between_two_ticks_is_that_of_the_earlier_one(path):
    reader = SessionReader(path)
    for number in (0, 10, 11, 149):
        assert same(reader.tick_before(TICKS[number].stamp_ns + 1), TICKS[number])
    assert same(reader.tick_before(TICKS[0].stamp_ns - 1), Tick())


def test_poses_are_read_without_touching_a_frame(path, monkeypatch):
    reader = SessionReader(path)
    source = reader.file(0).source
    frames = {c.chunk_start_offset for c in reader.file(0).chunks if 1 in c.message_index_offsets}
    read, pread = [], source.read
    monkeypatch.setattr(type(source), "read", lambda _, at, length: (read.append(at), pread(at, length))[1])
    ticks = list(reader.ticks(with_frames=False))
    assert all(same(a, b, but=("frame",)) and b.frame is None for a, b in zip(TICKS, ticks, strict=True))
    assert read and frames and frames.isdisjoint(read)


def test_a_replay_without_images_is_a_session_too(tmp_path):
    path = record(tmp_path / "replay.mcap", [replace(tick, frame=None) for tick in TICKS])
    assert all(same(a, b, but=("frame",)) for a, b in zip(TICKS, SessionReader(path).ticks(), strict=True))


def test_a_session_without_ticks_can_be_read(tmp_path):
    reader = SessionReader(record(tmp_path / "empty.mcap", []))
    assert list(reader.ticks()) == [] and reader.counts == {} and same(reader.tick_before(5), Tick())


def test_the_same_ticks_make_the_same_messages_however_the_thread_was_timed(tmp_path):
    paths = [record(tmp_path / f"{flush_s}.mcap", flush_s=flush_s) for flush_s in (0.0, 10.0)]
    contents = []
    for path in paths:
        with path.open("rb") as stream:
            found = [
                (c.topic, m.log_time, m.publish_time, m.sequence, m.data)
                for _, c, m in make_reader(stream).iter_messages()
            ]
        contents.append(sorted(found, key=lambda message: message[1::-1]))
    assert contents[0] == contents[1]


def test_a_message_said_again_is_written_once(tmp_path):
    first = TICKS[0]
    copy = replace(first.assumed)
    changed = replace(first.assumed, note="same stamp, other words")
    ticks = [
        first,
        replace(first, stamp_ns=2 * 10**9, assumed=copy),
        replace(first, stamp_ns=3 * 10**9, assumed=changed),
    ]
    reader = SessionReader(record(tmp_path / "s.mcap", ticks))
    assert [field.note for field in reader.messages("assumed")] == ["made up", "same stamp, other words"]


def test_the_official_reader_sees_every_message_in_order(path):
    with path.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        times, counts = [], Counter()
        for schema, channel, message in reader.iter_messages():
            assert (schema.encoding, channel.message_encoding) in (("protobuf", "protobuf"), ("ros2msg", "cdr"))
            times.append(message.log_time)
            counts[channel.topic] += 1
        assert times == sorted(times)
        assert counts["/camera/frame"] == counts["/view/robot_pose"] == 150
        assert {record.name for record in reader.iter_metadata()} >= {"flowrec.session", "flowrec.outcome"}
        assert {record.name for record in reader.iter_attachments()} >= {"config.toml", "chip.png", "chip.toml"}
    with path.open("rb") as stream:  # front to back, with the checksum of all data
        assert sum(1 for _ in NonSeekingReader(stream, validate_crcs=True).iter_messages(log_time_order=False)) == len(
            times
        )


def seen_by_others(path):
    """Log and publish time, and the payload's own timestamp where it is one of foxglove's, by topic."""
    with path.open("rb") as stream:
        reader = make_reader(stream)
        found, summary = {}, reader.get_summary()
        for schema, channel, message in reader.iter_messages():
            payload_ns = None
            if schema.name.startswith("foxglove.") and schema.name != "foxglove.FrameTransforms":
                parsed = foxglove_schema(schema.name.removeprefix("foxglove.")).wire.FromString(message.data)
                payload_ns = parsed.timestamp.ToNanoseconds()
            found.setdefault(channel.topic, []).append((message.log_time, message.publish_time, payload_ns))
        return found, summary.statistics


def test_other_programs_read_unix_times_and_flowrec_reads_session_stamps(path):
    found, statistics = seen_by_others(path)
    times = [START_UNIX_NS + tick.stamp_ns for tick in TICKS]
    assert found["/camera/frame"] == found["/view/robot_pose"] == [(time, time, time) for time in times]
    assert found["/robot/track"] == [(time, time, None) for time in times]
    assert (statistics.message_start_time, statistics.message_end_time) == (times[0], times[-1])
    assert found["/run/events"] == found["/view/flow_assumed"] == [(times[0], times[0], times[0])]
    events = list(SessionReader(path).messages("event"))
    assert [event.stamp_ns for event in events] == [TICKS[0].stamp_ns]


def test_every_message_index_of_the_file_points_at_its_messages(path):
    # By the specification alone: https://mcap.dev/spec.
    content = path.read_bytes()
    with path.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert summary.chunk_indexes
    indexed = Counter()
    for chunk in summary.chunk_indexes:
        opcode, length = struct.unpack_from("<BQ", content, chunk.chunk_start_offset)
        assert (opcode, 9 + length) == (Opcode.CHUNK, chunk.chunk_length)
        packed = content[chunk.chunk_start_offset : chunk.chunk_start_offset + chunk.chunk_length]
        data = packed[-chunk.compressed_size :]
        if chunk.compression == "zstd":
            data = zstandard.decompress(data, chunk.uncompressed_size)
        for channel, offset in chunk.message_index_offsets.items():
            opcode, _, told, nbytes = struct.unpack_from("<BQHI", content, offset)
            assert (opcode, told) == (Opcode.MESSAGE_INDEX, channel)
            for entry in range(nbytes // 16):
                log_ns, at = struct.unpack_from("<QQ", content, offset + 15 + 16 * entry)
                assert struct.unpack_from("<BxxxxxxxxHxxxxQ", data, at) == (Opcode.MESSAGE, channel, log_ns)
                indexed[channel] += 1
    assert indexed == summary.statistics.channel_message_counts


def test_a_session_is_dated_by_the_day_on_which_it_was_recorded(session):
    found, statistics = seen_by_others(session)
    with SessionReader(session) as reader:
        said, last_ns, began_ns = reader.header.provenance, reader.last_ns, reader.header.start_unix_ns
        clocks = next(iter(reader.messages("clocks")))
    assert began_ns == clocks.wall_ns - clocks.stamp_ns >= int(said["wall_ns"])
    assert said["durability_state_s"] == said["durability_images_s"] == "0.5"  # it waited for its disk
    assert statistics.message_start_time >= began_ns and statistics.message_end_time == began_ns + last_ns
    assert all(time >= began_ns for messages in found.values() for time, _, _ in messages)


@pytest.mark.parametrize("files", [Split(), Split(seconds=0.2), Snapshot(before_s=10.0)])
def test_a_run_begins_at_the_time_of_its_first_tick_however_long_it_was_prepared(tmp_path, files):
    ticks = list(ticks_of(40, shape=(8, 8)))
    zeros = {field.name: 0 for field in fields(Clocks)}
    began_ns = START_UNIX_NS + 28_500_000_000
    clocks = Clocks(**zeros | {"stamp_ns": ticks[0].stamp_ns, "wall_ns": began_ns + ticks[0].stamp_ns})
    ticks = [replace(tick, clocks=clocks) for tick in ticks]
    with SessionWriter(
        tmp_path / "s.mcap", HEADER, WriterOptions(block=True, files=files, start_by_clocks=True)
    ) as out:
        for tick in ticks:
            out.write(tick)
        out.close(why="end")
    written = sorted(tmp_path.glob("*.mcap"))
    assert len(written) == (1 if not isinstance(files, Split) or not files else 4)
    for path in written:
        reader = SessionReader(path)
        assert reader.header.start_unix_ns == began_ns and not any(digest_faults(path).values())
        with path.open("rb") as file:
            for _, channel, message in make_reader(file).iter_messages():
                assert 0 <= message.log_time - began_ns - 10**9 <= 40 * PERIOD_NS, channel.topic
    read = [tick.track for path in written for tick in SessionReader(path).ticks()]
    assert len({track.stamp_ns for track in read}) == 40


def test_a_session_that_does_not_say_when_it_started_has_stamps_for_times(tmp_path):
    path = tmp_path / "old.mcap"
    write_session(path, TICKS[:20], replace(HEADER, start_unix_ns=0))
    found, _ = seen_by_others(path)
    assert [time for time, _, _ in found["/robot/track"]] == [tick.stamp_ns for tick in TICKS[:20]]
    assert all(itertools.starmap(same, zip(TICKS[:20], SessionReader(path).ticks(), strict=True)))


def test_other_viewers_get_pose_path_and_previews_on_one_scale(path):
    schemas = {view.path: view.schema for view in VIEWER_TOPICS if view.schema.wire is not None}
    with path.open("rb") as stream:
        messages = make_reader(stream).iter_messages(topics=list(schemas))
        found = {
            channel.topic: schemas[channel.topic].wire.FromString(message.data) for _, channel, message in messages
        }
    assert found["/view/robot_pose"].pose.position.x == 1e-3 * TICKS[-1].estimate.position_um[0]
    assert len(found["/view/path"].poses) == 20
    points = np.frombuffer(found["/camera/frame/path"].data, "<f4").reshape(-1, 4)
    assert np.array_equal(points[:, :2], (1e-3 * TICKS[-1].route.waypoints_um).astype("<f4"))
    grid = np.frombuffer(found["/view/flow_refined_grid"].data, "<f4").reshape(24, 32, 3)
    assert np.allclose(grid[..., :2], TICKS[-1].refined.velocity_um_s, rtol=2**-12)
    assert np.allclose(grid[..., 2], np.hypot(*np.moveaxis(TICKS[-1].refined.velocity_um_s, 2, 0)), rtol=2**-12)
    assert found["/view/flow_refined_grid"].cell_size.x == 1e-3 * TICKS[-1].refined.um_per_px
    colours = cv2.imdecode(np.frombuffer(found["/view/flow_refined"].data, np.uint8), cv2.IMREAD_COLOR)
    assert colours.shape == (24, 32, 3) and not colours[:3].any() and colours[3:].any()


def test_rerun_accepts_the_bare_file(path, tmp_path):
    beside = Path(sys.executable).with_name("rerun")
    rerun = str(beside) if beside.exists() else shutil.which("rerun")
    if rerun is None:
        pytest.skip("the rerun command is not installed")
    home = os.environ | {"HOME": str(tmp_path)}  # where Rerun notes that it was started
    run = partial(subprocess.run, capture_output=True, text=True, check=False, timeout=HANG_S, env=home)
    checked = run([rerun, "mcap", "check", path])
    assert checked.returncode == 0, checked.stdout + checked.stderr
    done = run([rerun, "mcap", "convert", path, "-o", tmp_path / "s.rrd"])
    assert done.returncode == 0 and "ERROR" not in done.stderr, done.stderr
    assert all(
        topic in done.stderr for topic in ("/camera/frame", "/robot/estimate", "/camera/frame/robot", "/view/path")
    )


def test_a_full_queue_of_a_live_run_drops_images_only(tmp_path):
    with SessionWriter(tmp_path / "s.mcap", HEADER, WriterOptions(queue_limit_bytes=10_000)) as writer:
        for tick in TICKS:
            writer.write(tick)
        writer.close({"outcome": "reached"})
    reader = SessionReader(tmp_path / "s.mcap")
    again = list(reader.ticks())
    assert all(same(a, b, but=("frame", "drops")) for a, b in zip(TICKS, again, strict=True))
    assert 0 < writer.dropped_frames < 150
    assert reader.counts["frame"] == 150 - writer.dropped_frames == sum("frame" in fresh for fresh in news(again))
    assert reader.outcome["dropped_frames"] == str(writer.dropped_frames)


def test_a_full_queue_of_a_simulation_waits(tmp_path):
    path = record(tmp_path / "s.mcap", queue_limit_bytes=10_000)
    assert SessionReader(path).counts["frame"] == 150


def test_an_exception_becomes_the_outcome(tmp_path):
    def fly():
        with SessionWriter(tmp_path / "s.mcap", HEADER) as writer:
            writer.write(TICKS[0])
            raise RuntimeError("the pump fell off")

    with pytest.raises(RuntimeError):
        fly()
    outcome = SessionReader(tmp_path / "s.mcap").outcome
    assert (outcome["outcome"], outcome["reason"]) == ("failed", "RuntimeError: the pump fell off")


def test_a_clock_that_goes_backwards_is_refused(tmp_path):
    with SessionWriter(tmp_path / "s.mcap", HEADER) as writer:
        writer.write(TICKS[1])
        for tick in (TICKS[1], TICKS[0], Tick(-1)):
            with pytest.raises(SessionError, match="stamps"):
                writer.write(tick)


def test_a_frame_that_can_not_be_stored_is_told_and_what_came_before_is_kept(tmp_path):
    writer = SessionWriter(tmp_path / "s.mcap", HEADER)
    writer.write(Tick(5, frame=Frame(5, -1, np.zeros((2, 2), np.uint8))))
    with pytest.raises(SessionError, match=r"flowrec recover .*s\.mcap\.partial"):
        writer.close()
    assert not writer.path.exists() and writer.partial_path.exists()


def test_a_file_of_the_run_that_another_one_replaced_meanwhile_is_not_removed(tmp_path):
    stale, newer = tmp_path / "x.part001.mcap", tmp_path / "newer"
    stale.write_bytes(b"of an older run")
    with SessionWriter(tmp_path / "x.mcap", HEADER, WriterOptions(overwrite=True)) as writer:
        newer.write_bytes(b"of another run")
        newer.replace(stale)
        writer.write(TICKS[0])
    assert stale.read_bytes() == b"of another run" and (tmp_path / "x.mcap").exists()


@pytest.mark.skipif(sys.platform != "linux", reason="only there has each thread a priority of its own")
def test_the_thread_of_a_live_run_is_never_behind_other_programs_and_in_real_time_it_is_behind_the_loop(tmp_path):
    """Behind them it would stand still with the interpreter's lock, and images and loop with it."""
    with SessionWriter(tmp_path / "live.mcap", HEADER, WriterOptions(block=False)) as writer:
        (thread,) = (one for one in threading.enumerate() if one.name == "session-writer")
        writer.write(TICKS[0])
        until(lambda: not writer.queue_bytes)
        assert os.getpriority(os.PRIO_PROCESS, thread.native_id) == os.getpriority(os.PRIO_PROCESS, 0)
        if writer.prioritise():
            assert os.sched_getscheduler(thread.native_id) == os.SCHED_FIFO | os.SCHED_RESET_ON_FORK
            assert 1 <= os.sched_getparam(thread.native_id).sched_priority < Priority.LOOP < Priority.DEVICE
        writer.write(TICKS[1])
    assert len(list(SessionReader(tmp_path / "live.mcap").ticks())) == 2


def test_a_chunk_is_sealed_before_it_outgrows_what_a_reader_takes_and_no_message_may(tmp_path, monkeypatch):
    monkeypatch.setattr("flowrec.store.chunk._MESSAGE_LIMIT_BYTES", 100_000)
    path = write_session(tmp_path / "x.mcap", ticks_of(12, shape=(200, 200)), frames="raw", flush_s=100.0, sync_s=100.0)
    with path.open("rb") as file:
        summary = make_reader(file).get_summary()
    frames = next(number for number, each in summary.channels.items() if each.topic == "/camera/frame")
    chunks = [chunk for chunk in summary.chunk_indexes if frames in chunk.message_index_offsets]
    assert len(chunks) == 6 and all(80_000 < chunk.uncompressed_size < 101_000 for chunk in chunks)
    with pytest.raises(SessionError, match=r"/camera/frame .*\d+ bytes"):
        write_session(tmp_path / "y.mcap", ticks_of(1, shape=(400, 300)), frames="raw")


@pytest.mark.skipif(sys.platform == "win32", reason="a system call of POSIX")
def test_a_system_call_that_writes_a_part_of_what_it_is_given_is_followed_by_one_that_writes_the_rest(
    tmp_path, monkeypatch
):
    write, rng = os.writev, np.random.default_rng(5)

    def partly(handle, buffers):
        taken = int(rng.integers(1, 1 + sum(map(len, buffers))))
        return write(handle, [b"".join(buffers)[:taken]])

    monkeypatch.setattr(os, "writev", partly)
    path = write_session(tmp_path / "s.mcap", TICKS)
    monkeypatch.undo()
    assert all(same(one, other) for one, other in zip(SessionReader(path).ticks(), TICKS, strict=True))
    assert digest_faults(path) == {path: []}


@pytest.mark.parametrize(
    ("sets", "queue_mb", "images_s"),
    [
        ({"width_px": 640, "height_px": 512, "rate_hz": 30.0}, 64.0, 0.5 + 64e6 / (640 * 512 * 30)),
        ({"width_px": 2448, "height_px": 2048, "rate_hz": 30.0}, 4.0 * 2448 * 2048 * 30e-6, 4.5),
        ({"width_px": 2448, "height_px": 2048, "rate_hz": 30.0, "bits": 12}, 8.0 * 2448 * 2048 * 30e-6, 4.5),
        ({"width_px": 4096, "height_px": 4096, "rate_hz": 100.0}, 1250.0, 0.5 + 1.25e9 / (4096 * 4096 * 100)),
    ],
)
def test_the_queue_holds_4_s_of_images_within_bounds_and_the_head_promises_no_less_a_loss(sets, queue_mb, images_s):
    config = SimpleNamespace(
        camera=SimpleNamespace(**{"bits": 8} | sets), recording=SimpleNamespace(queue_mb=None, flush_s=0.5)
    )
    assert session_writer.queue_bytes_of(config) == pytest.approx(1e6 * queue_mb, rel=1e-6)
    for live, lost_s in ((True, images_s), (False, 0.5)):
        told = session_writer._durability(config, live=live)
        assert float(told["durability_images_s"]) == pytest.approx(lost_s, rel=0.006)
        assert told["durability_state_s"] == "0.5"


def test_an_image_without_the_rest_of_its_tick_is_no_tick_of_the_count(tmp_path):
    whole, alone, other = TICKS[:3]
    with SessionWriter(tmp_path / "s.mcap", HEADER, WriterOptions(block=True)) as writer:
        writer.write(whole)
        writer.write(replace(whole, stamp_ns=alone.stamp_ns, frame=alone.frame))
        writer.write(other)
        assert writer.ticks == 2
    assert SessionReader(writer.path).outcome["ticks"] == "2"
