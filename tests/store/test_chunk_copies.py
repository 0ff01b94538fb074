"""Chunks that recovery copies as they are stored, and those that it has to put together anew."""

import os
import struct
import zlib
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from mcap.opcode import Opcode

from flowrec.core import SessionError
from flowrec.store import SLOTS, SessionReader, recover
from flowrec.store.file_reader import FileReader
from flowrec.store.mcap_format import CHUNK_HEAD, LONG, MESSAGE_HEAD, RECORD_HEAD, records_in
from flowrec.store.mcap_reader import McapReader
from flowrec.store.merged_chunks import _overlapping, in_time
from flowrec.store.scan import scan
from flowrec.store.session_file import SessionFile, Snapshot, Split
from flowrec.store.session_metadata import DIGEST, OUTCOME
from flowrec.store.viewer_scene import ViewerScene
from flowrec.store.viewer_topics import ViewerTopics
from tests.store.made_up import START_UNIX_NS, ticks_of, write_session
from tests.store.test_damage import names_in
from tests.store.test_recovery import DRAWN, chunks_of, cut, flush_every

FRAMES, TRACK = SLOTS["/camera/frame"].channel, SLOTS["/robot/track"].channel
AT_END = (OUTCOME, DIGEST)
GOLDEN = Path(__file__).parents[2] / "sessions" / "golden.mcap"
RUNS = {
    "raw": {"frames": "raw"},
    "zstd": {"frames": "zstd"},
    "delta": {"frames": "delta"},
    "jpeg": {"frames": "jpeg"},
    "live": {"frames": "delta", "block": False},
    "no views": {"frames": "zstd", "leave_out": ("/view/*",)},
    "part": {"frames": "delta", "files": Split(seconds=0.3)},
    "snapshot": {"frames": "delta", "files": Snapshot(0.2, 0.2)},
}


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """The last file of each run, with three ticks a flush."""
    found = {}
    for name, options in RUNS.items():
        folder = tmp_path_factory.mktemp("copies")
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(SessionFile, "flush_if_due", flush_every(3))
            write_session(folder / "s.mcap", ticks_of(40, shape=(8, 8)), **options)
        found[name] = sorted(folder.iterdir())[-1]
    return found


def contents_of(source):
    for chunk in scan(source).summary.chunks:
        yield chunk, source.content(chunk.chunk_start_offset, chunk.chunk_length)


def messages_of(path):
    """Head and payload of each message by channel."""
    messages = {}
    for _, content in contents_of(McapReader(path)):
        for _, at, length in records_in(content):
            channel, *head = MESSAGE_HEAD.unpack_from(content, at)
            messages.setdefault(channel, []).append((head, bytes(content[at + MESSAGE_HEAD.size : at + length])))
    return messages


def stored_chunks(path, channels=None):
    """The chunks as they are in the file, all but the drawn ones or those of just some channels."""
    source = McapReader(path)
    return [
        bytes(source.body(chunk.chunk_start_offset, chunk.chunk_length, Opcode.CHUNK))
        for chunk, _ in contents_of(source)
        if channels == (found := set(chunk.message_index_offsets)) or (channels is None and not found <= DRAWN)
    ]


def head_of(path):
    """All that a file declares, without what its end says."""
    source = McapReader(path)
    index = scan(source).summary
    metadata = [(each.name, source.metadata(each)) for each in index.metadata if each.name not in AT_END]
    return metadata, [source.attachment(each) for each in index.attachments], index.channels, index.schemas


def places_of_a_cut(path):
    """In a chunk and after a chunk of each group of topics, and in the index."""
    ends = {}
    for start, end, channels in (*chunks_of(path)[6:], *chunks_of(path, drawn=True)):
        ends.setdefault(FRAMES if channels == {FRAMES} else channels <= DRAWN, (start, end))
    size = path.stat().st_size
    return [at for start, end in ends.values() for at in ((start + end) // 2, end)] + [size - 100, int(0.8 * size)]


@pytest.mark.parametrize("run", RUNS)
def test_of_a_cut_file_every_chunk_and_all_of_its_head_is_copied_as_it_is(files, run, tmp_path):
    for number, length in enumerate(places_of_a_cut(files[run])):
        folder = tmp_path / str(number)
        folder.mkdir()
        path = cut(files[run], length, folder / "s.mcap.partial")
        chunks, head = stored_chunks(path), head_of(path)
        done = recover(path)
        assert stored_chunks(done.path) == chunks and head_of(done.path) == head
        assert not recover(done.path).changed


@pytest.mark.parametrize("which", [FRAMES, TRACK])
def test_a_damaged_chunk_costs_no_byte_of_the_others(files, which, tmp_path):
    start, end, _ = [chunk for chunk in chunks_of(files["delta"]) if which in chunk[2]][4]
    content = bytearray(files["delta"].read_bytes())
    content[(start + end) // 2] ^= 0xFF
    path = tmp_path / "s.mcap.partial"
    path.write_bytes(content)
    done = recover(path)
    (lost,) = set(stored_chunks(files["delta"])) - set(stored_chunks(done.path))
    assert lost == files["delta"].read_bytes()[start + RECORD_HEAD.size : end] and not done.complete


def drawn_of(path):
    return {channel: messages for channel, messages in messages_of(path).items() if channel in DRAWN}


@pytest.mark.parametrize("harm", ["cut", "flipped"])
def test_drawings_that_are_lost_or_damaged_are_made_again_and_nothing_is_missing(files, harm, tmp_path):
    whole, content = files["delta"], bytearray(files["delta"].read_bytes())
    start, end, _ = chunks_of(whole, drawn=True)[0]
    content[(start + end) // 2] ^= 0xFF
    path = tmp_path / "s.mcap.partial"
    path.write_bytes(content if harm == "flipped" else content[: (start + end) // 2])
    done = recover(path)
    assert done.complete and SessionReader(done.path).outcome["outcome"] == "ended"
    assert drawn_of(done.path) == drawn_of(whole) and len(drawn_of(whole)) > 5


def test_drawings_follow_all_that_was_recorded_and_are_those_of_its_ticks(files):
    assert chunks_of(files["delta"], drawn=True)[0][0] > chunks_of(files["delta"])[-1][0]
    views, expected = ViewerTopics(ViewerScene(None, START_UNIX_NS)), {}
    with FileReader(files["delta"]) as file:
        first_ns, _ = next(iter(file.new_messages(None, set(file.fields.values()))))
        for log_ns, messages in file.new_messages(None, set(file.fields.values())):
            for topic, stamp_ns, payload in views.of(messages):
                times = log_ns + START_UNIX_NS, stamp_ns + START_UNIX_NS
                expected.setdefault(SLOTS[topic].channel, []).append((times, b"".join(payload)))
        for topic, stamp_ns, payload in views.of_end({"outcome": "ended"}, first_ns):
            times = START_UNIX_NS + stamp_ns, START_UNIX_NS + stamp_ns
            expected[SLOTS[topic].channel] = [(times, b"".join(payload))]
    found = drawn_of(files["delta"])
    assert {n: [(tuple(head[1:]), payload) for head, payload in each] for n, each in found.items()} == expected


def test_an_image_that_makes_no_sense_under_a_right_checksum_is_left_out_alone(files, tmp_path):
    content = bytearray(files["raw"].read_bytes())
    start, end, _ = [chunk for chunk in chunks_of(files["raw"]) if chunk[2] == {FRAMES}][3]
    at = content.index(b"mono8", start, end)
    content[at : at + 5] = b"mono9"
    begin = start + RECORD_HEAD.size + CHUNK_HEAD.size + LONG.size
    struct.pack_into("<I", content, start + RECORD_HEAD.size + 24, zlib.crc32(content[begin:end]))
    path = tmp_path / "s.mcap.partial"
    path.write_bytes(content[:-100])
    before = messages_of(path)
    done = recover(path)
    assert "1 messages that make no sense, the first is /camera/frame" in done.lost and "1 images" in done.lost
    (lost,) = [image for image in before[FRAMES] if b"mono9" in image[1]]
    before[FRAMES].remove(lost)
    after, verdict = messages_of(done.path), SLOTS["/verdict"].channel
    assert b"Ended" in before.pop(verdict)[0][1] and b"Cut\n\nRecovered" in after.pop(verdict)[0][1]
    assert after == before and not recover(done.path).changed


def test_a_chunk_without_a_checksum_gets_one(files, tmp_path):
    content = bytearray(files["delta"].read_bytes())
    start = next(chunk[0] for chunk in chunks_of(files["delta"]) if chunk[2] == {FRAMES})
    struct.pack_into("<I", content, start + RECORD_HEAD.size + 24, 0)
    path = tmp_path / "s.mcap.partial"
    path.write_bytes(content[:-100])
    before = messages_of(path)
    done = recover(path)
    assert all(CHUNK_HEAD.unpack_from(chunk)[3] for chunk in stored_chunks(done.path))
    assert messages_of(done.path) == before


def test_a_session_of_an_older_flowrec_stays_as_that_one_wrote_it(tmp_path):
    path = cut(GOLDEN, GOLDEN.stat().st_size // 3, tmp_path / "s.mcap.partial")
    messages, head = messages_of(path), head_of(path)
    done = recover(path)
    assert messages_of(done.path) == messages and head_of(done.path) == head and not recover(done.path).changed


def test_what_reads_back_otherwise_than_it_was_written_is_no_session(files, tmp_path, monkeypatch):
    path = cut(files["delta"], int(0.8 * files["delta"].stat().st_size), tmp_path / "s.mcap.partial")
    before, write = path.read_bytes(), os.writev
    images = {chunk[CHUNK_HEAD.size + 4 + LONG.size :] for chunk in stored_chunks(path, {FRAMES})}

    def damaging(handle, buffers):
        faulty = [bytes(each[:-9]) + b"\0" + bytes(each[-8:]) if bytes(each) in images else each for each in buffers]
        return write(handle, faulty)

    monkeypatch.setattr(os, "writev", damaging)
    with pytest.raises(SessionError, match=r"left as it was.*can not be read back"):
        recover(path)
    assert names_in(tmp_path) == ["s.mcap.partial"] and path.read_bytes() == before


def test_chunks_that_share_a_time_are_sorted_together_in_file_order_and_the_others_are_not():
    rng = np.random.default_rng(8)
    for _ in range(200):
        begins, lasts = rng.integers(0, 30, 6), rng.integers(0, 6, 6)
        chunks = [
            SimpleNamespace(message_start_time=a, message_end_time=a + b, chunk_start_offset=n, uncompressed_size=1)
            for n, (a, b) in enumerate(zip(begins.tolist(), lasts.tolist(), strict=True))
        ]
        bundles = list(_overlapping(None, sorted(chunks, key=in_time)))
        assert sorted(each.chunk_start_offset for bundle in bundles for each in bundle) == list(range(6))
        for bundle in bundles:
            places = [each.chunk_start_offset for each in bundle]
            assert places == sorted(places)
        ends = [max(each.message_end_time for each in bundle) for bundle in bundles]
        starts = [min(each.message_start_time for each in bundle) for bundle in bundles]
        assert all(end < start for end, start in zip(ends, starts[1:], strict=False))
