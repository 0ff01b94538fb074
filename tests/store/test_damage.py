"""Paths that can not be written, disks that fail, runs that are killed, files that are damaged or foreign."""

import errno
import os
import resource
import shlex
import signal
import subprocess
import sys
import threading
from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import zstandard
from google.protobuf import descriptor_pb2
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mcap.exceptions import McapError
from mcap.records import Channel, Message
from mcap.stream_reader import StreamReader
from mcap.writer import Writer

import flowrec
from flowrec.core import Currents, SessionError
from flowrec.store import SessionReader, SessionWriter, WriterOptions, channels, merged_chunks, session_metadata
from flowrec.store.mcap_writer import McapWriter, new_mcap
from tests.conftest import HANG_S
from tests.store.made_up import HEADER, fails, ticks_of, write_session

TICKS = list(ticks_of(30, shape=(8, 8)))


@pytest.fixture(scope="module")
def session(tmp_path_factory):
    path = tmp_path_factory.mktemp("trouble") / "session.mcap"
    return write_session(path, TICKS, block=False)


def names_in(directory):
    return [path.name for path in directory.iterdir()]


def one_line(error):
    assert "\n" not in str(error.value), error.value
    return str(error.value)


def test_a_command_that_an_error_suggests_works_for_a_name_with_blanks_and_quotes(session, tmp_path):
    cut = tmp_path / "it's cut off.mcap"
    cut.write_bytes(session.read_bytes()[:-500])
    with pytest.raises(SessionError, match="flowrec recover") as error:
        SessionReader(cut)
    assert shlex.split(one_line(error).split("`")[1]) == ["flowrec", "recover", str(cut)]


def test_the_second_of_two_runs_that_begin_one_file_together_is_told_of_the_other(tmp_path):
    path = tmp_path / "s.mcap.partial"
    new_mcap(path, overwrite=False).close()
    with pytest.raises(SessionError, match="another process meanwhile; choose another name") as error:
        new_mcap(path, overwrite=False)
    assert one_line(error).startswith(str(path))


def test_an_existing_session_is_refused_before_anything_is_made(tmp_path):
    path = tmp_path / "s.mcap"
    path.write_bytes(b"precious")
    with pytest.raises(SessionError, match="--overwrite") as error:
        SessionWriter(path, HEADER)
    assert one_line(error).startswith(str(path))
    assert names_in(tmp_path) == ["s.mcap"] and path.read_bytes() == b"precious"
    SessionWriter(path, HEADER, WriterOptions(overwrite=True)).close()
    assert SessionReader(path).outcome["outcome"] == "ended"


def test_the_remains_of_an_unfinished_run_are_refused_as_well(tmp_path):
    partial = tmp_path / "s.mcap.partial"
    partial.write_bytes(b"precious")
    with pytest.raises(SessionError, match="flowrec recover"):
        SessionWriter(tmp_path / "s.mcap", HEADER)
    assert partial.read_bytes() == b"precious"


def test_a_missing_directory_is_told_in_one_line(tmp_path):
    with pytest.raises(SessionError, match="missing") as error:
        SessionWriter(tmp_path / "missing" / "s.mcap", HEADER)
    one_line(error)


@pytest.mark.parametrize(
    ("number", "told"),
    [(errno.ENOSPC, "the disk is full; free some space, then"), (errno.EIO, r"failed \(Input/output error\); see to")],
)
@pytest.mark.parametrize("block", [True, False])
def test_a_full_or_broken_disk_is_told_at_the_next_write_and_at_close(tmp_path, monkeypatch, block, number, told):
    writer = SessionWriter(tmp_path / "s.mcap", HEADER, WriterOptions(flush_s=0.0, block=block, queue_limit_bytes=2000))

    def refuse(*_):
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(McapWriter, "add_chunks", refuse)
    fails(writer, told)
    assert not writer.path.exists() and writer.partial_path.exists()


KILLED = """
import sys, time
from dataclasses import replace
from flowrec.store.session_file import WriterOptions
from flowrec.store.writer import SessionWriter
sys.path.insert(0, sys.argv[2])
from made_up import HEADER, ticks_of
writer = SessionWriter(sys.argv[1], HEADER, WriterOptions(flush_s=10.0, sync_s=20.0))
for number, tick in enumerate(ticks_of(150, shape=(8, 8))):
    writer.write(replace(tick, stamp_ns=(number + 1) * 10**9))
    while writer.queue_bytes:
        time.sleep(0.001)
print("handed over", flush=True)
sys.stdin.read()
"""


def test_a_killed_run_loses_no_more_than_the_last_moments(tmp_path):
    path = tmp_path / "s.mcap"
    with subprocess.Popen(
        [sys.executable, "-c", KILLED, path, Path(__file__).parent],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    ) as run:
        assert run.stdout.readline() == "handed over\n"
        run.send_signal(signal.SIGKILL)
        run.stdout.read()
    assert names_in(tmp_path) == ["s.mcap.partial"]
    with pytest.raises(SessionError, match="flowrec recover"):
        SessionReader(tmp_path / "s.mcap.partial")
    topics, counts = {}, Counter()
    with (tmp_path / "s.mcap.partial").open("rb") as stream:
        try:
            for record in StreamReader(stream, validate_crcs=True).records:
                if isinstance(record, Channel):
                    topics[record.id] = record.topic
                if isinstance(record, Message):
                    counts[topics[record.channel_id]] += 1
        except McapError:
            pass  # the end, wherever it is
    # A tick a second, much quicker than that: what is not older than 10 s in stamps may be missing.
    assert min(counts["/camera/frame"], counts["/robot/estimate"]) > 150 - 10


def test_what_is_no_session_is_named_as_what_it_is(tmp_path, session):
    empty, text, foreign, cut = (tmp_path / name for name in ("empty", "text", "foreign", "cut"))
    empty.touch()
    text.write_text("hello, world")
    cut.write_bytes(session.read_bytes()[:-1000])
    for library, profile in (("other", "ros2"), ("pretender", "flowrec")):
        with foreign.with_suffix(f".{library}").open("wb") as stream:
            writer = Writer(stream)
            writer.start(profile=profile, library=library)
            writer.finish()
    expected = {
        tmp_path / "missing.mcap": "no such file",
        tmp_path: "is a directory",
        empty: "is empty",
        text: "is not an MCAP file",
        cut: "was not finished .*flowrec recover",
        foreign.with_suffix(".other"): "ros2.* 'other'",
        foreign.with_suffix(".pretender"): "without the record 'flowrec.session'",
    }
    for path, message in expected.items():
        with pytest.raises(SessionError, match=message) as error:
            SessionReader(path)
        assert one_line(error).startswith(str(path))


def test_a_session_of_a_later_format_says_which_flowrec_it_needs(tmp_path, monkeypatch):
    monkeypatch.setattr(session_metadata, "FORMAT_VERSION", 2)
    monkeypatch.setattr("flowrec.store.session_metadata.__version__", "9.9.0")
    SessionWriter(tmp_path / "s.mcap", HEADER).close()
    monkeypatch.undo()
    with pytest.raises(SessionError, match=r"format '2'.*install flowrec 9\.9\.0 or later"):
        SessionReader(tmp_path / "s.mcap")


@pytest.mark.parametrize(("name", "told"), [("", r"Track\.score"), ("likeness", r"Track\.likeness, Track\.score")])
def test_a_file_without_a_field_that_has_no_default_or_with_another_is_refused(tmp_path, monkeypatch, name, told):
    slot = channels.SLOTS["/robot/track"]
    files = descriptor_pb2.FileDescriptorSet.FromString(slot.schema.data)
    fields = files.file[0].message_type[0].field
    fields[3].name = name
    if not name:
        del fields[3]
    other = replace(slot, schema=replace(slot.schema, data=files.SerializeToString()))
    monkeypatch.setitem(channels.SLOTS, "/robot/track", other)
    SessionWriter(tmp_path / "s.mcap", HEADER).close()
    with pytest.raises(SessionError, match=rf"/robot/track .*\({told}\)"):
        SessionReader(tmp_path / "s.mcap")


def test_a_file_from_before_a_message_gained_a_field_that_may_be_missing_is_read(tmp_path, monkeypatch):
    slot = channels.SLOTS["/coils/command"]
    files = descriptor_pb2.FileDescriptorSet.FromString(slot.schema.data)
    message = files.file[0].message_type[0]
    while message.field[-1].name != "saturated":
        del message.field[-1]
    older = replace(slot, schema=replace(slot.schema, data=files.SerializeToString(deterministic=True)))
    monkeypatch.setitem(channels.SLOTS, "/coils/command", older)
    currents = Currents(
        0, 7.0, 0.2, 3.0, 1.0, np.ones(3), False, voltages_v=np.zeros(0)
    )  # as these leave nothing behind
    tick = replace(TICKS[0], currents=replace(currents, stamp_ns=TICKS[0].stamp_ns))
    with SessionWriter(tmp_path / "s.mcap", HEADER) as writer:
        writer.write(tick)
    read = [tick.currents for tick in SessionReader(tmp_path / "s.mcap").ticks()]
    assert read[0].same_as(tick.currents)


def test_a_bomb_is_not_unpacked(tmp_path, monkeypatch):
    bomb = zstandard.ZstdCompressor().compress(bytes(1 << 29))

    def plant(self, sealed):
        plain(self, [replace(chunk, data=bomb, uncompressed_size=1000) for chunk in sealed])

    plain = McapWriter.add_chunks
    monkeypatch.setattr(McapWriter, "add_chunks", plant)
    with SessionWriter(tmp_path / "s.mcap", HEADER, WriterOptions(leave_out=("/view/*",))) as writer:
        writer.write(TICKS[0])
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(SessionError, match="zstd"):
        list(SessionReader(tmp_path / "s.mcap").ticks())
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 100 << 10


@settings(max_examples=300, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.data())
def test_damage_anywhere_is_told_in_one_line_or_does_no_harm(session, tmp_path, data):
    content = bytearray(session.read_bytes())
    for _ in range(data.draw(st.integers(1, 3))):
        # Half of the blows go to the summary, where the sizes and offsets are.
        low = data.draw(st.sampled_from([0, max(0, len(content) - 4000)]))
        at = data.draw(st.integers(low, len(content) - 1))
        content[at] = data.draw(st.integers(0, 255))
    path = tmp_path / "damaged.mcap"
    path.write_bytes(content)
    told, stamps = None, None
    try:
        with SessionReader(path) as reader:
            _ = reader.header
            stamps = [tick.stamp_ns for tick in reader.ticks()]
    except SessionError as error:
        told = str(error)
    if told is None:
        assert stamps == [tick.stamp_ns for tick in TICKS]
    else:
        assert "\n" not in told and str(path) in told


def test_a_file_cut_off_anywhere_is_told_as_such(session, tmp_path):
    content, path = session.read_bytes(), tmp_path / "cut.mcap"
    for length in [*range(0, 80), *range(80, len(content), 997), len(content) - 1]:
        path.write_bytes(content[:length])
        with pytest.raises(SessionError):
            SessionReader(path)


def test_a_closed_reader_says_so(session):
    reader = SessionReader(session)
    reader.close()
    with pytest.raises(SessionError, match="has been closed"):
        next(reader.ticks())


def test_a_file_that_another_has_replaced_since_it_was_opened_is_told_as_such(session, tmp_path):
    path = tmp_path / "session.mcap"
    path.write_bytes(session.read_bytes())
    opened = flowrec.open(path)
    write_session(tmp_path / "longer.mcap", list(ticks_of(60, shape=(8, 8)))).replace(path)
    with pytest.raises(SessionError, match="has changed since it was opened") as error:
        next(iter(opened.ticks()))
    assert str(path) in one_line(error)
    assert sum(1 for _ in flowrec.open(path).ticks()) == 60


def test_reading_can_be_broken_off_and_begun_again(session):
    reader = SessionReader(session)
    first = next(iter(reader.ticks()))
    both = zip(reader.ticks(), reader.ticks(), strict=True)
    assert first.stamp_ns == TICKS[0].stamp_ns and all(one.stamp_ns == two.stamp_ns for one, two in both)


def test_an_index_that_was_changed_without_its_checksum_is_refused(tmp_path, session):
    content = bytearray(session.read_bytes())
    at = content.rfind(b"/truth/robot")  # the last one is in the index, and any letter makes sense there
    content[at + 8] ^= 1
    path = tmp_path / "changed.mcap"
    path.write_bytes(content)
    with pytest.raises(SessionError, match="checksum"):
        SessionReader(path)


def test_a_file_that_becomes_shorter_while_it_is_read_is_named(tmp_path, session):
    path = tmp_path / "shrinking.mcap"
    path.write_bytes(session.read_bytes())
    with SessionReader(path) as reader:
        os.truncate(path, 2000)
        with pytest.raises(SessionError, match="shorter"):
            list(reader.ticks())


def test_a_reading_that_is_abandoned_waits_for_no_thread_whichever_it_is_collected_in():
    def reading():
        with merged_chunks.threads() as executor:
            yield executor

    busy, abandoned = threading.Event(), reading()
    task = next(abandoned).submit(busy.wait, HANG_S)
    collector = threading.Thread(target=abandoned.close)
    collector.start()
    collector.join(HANG_S / 4)
    hangs = collector.is_alive()
    busy.set()
    assert not hangs and task.result()
