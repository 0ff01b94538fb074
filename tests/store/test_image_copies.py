"""Images that recovery copies in the chunks in which they are stored: the file is as if it had encoded them again."""

import os
import struct
import zlib
from pathlib import Path

import pytest
from mcap.opcode import Opcode

from flowrec.errors import SessionError
from flowrec.store.channels import SLOTS
from flowrec.store.mcap_format import CHUNK_HEAD, LONG, MESSAGE_HEAD, RECORD_HEAD, records_in
from flowrec.store.mcap_reader import McapReader
from flowrec.store.recovery import recover
from flowrec.store.scan import scan
from flowrec.store.session_file import Snapshot, Split, WriterOptions
from flowrec.store.split import PartFile
from flowrec.store.writer import SessionWriter
from tests.store.made_up import HEADER, ticks_of
from tests.store.test_damage import names_in
from tests.store.test_recovery import chunks_of, cut, flush_every

FRAMES = SLOTS["/camera/frame"].channel
GOLDEN = Path(__file__).parents[2] / "sessions" / "golden.mcap"
RUNS = {
    "raw": WriterOptions(frames="raw", block=True),
    "zstd": WriterOptions(frames="zstd", block=True),
    "delta": WriterOptions(frames="delta", block=True),
    "jpeg": WriterOptions(frames="jpeg", block=True),
    "live": WriterOptions(frames="delta"),
    "no views": WriterOptions(frames="zstd", block=True, leave_out=("/view/*",)),
    "part": WriterOptions(frames="delta", block=True, files=Split(seconds=0.3)),
    "snapshot": WriterOptions(frames="delta", block=True, files=Snapshot(0.2, 0.2)),
}


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """The last file of each run, with three ticks a flush."""
    found = {}
    for name, options in RUNS.items():
        folder = tmp_path_factory.mktemp("copies")
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(PartFile, "flush_if_due", flush_every(3))
            with SessionWriter(folder / "s.mcap", HEADER, options) as writer:
                for tick in ticks_of(40, shape=(8, 8)):
                    writer.write(tick)
        found[name] = sorted(folder.iterdir())[-1]
    return found


def content_of(path):
    """All that a file holds but for its division into chunks: head, declarations, statistics, messages by channel."""
    source = McapReader(path)
    index = source.read_summary()
    messages = {}
    for _, content in contents_of(source):
        for _, at, length in records_in(content):
            channel, *head = MESSAGE_HEAD.unpack_from(content, at)
            messages.setdefault(channel, []).append((head, bytes(content[at + MESSAGE_HEAD.size : at + length])))
    index.statistics.chunk_count = 0
    metadata = [(each.name, source.metadata(each)) for each in index.metadata]
    return messages, metadata, [source.attachment(a) for a in index.attachments], (
        index.channels, index.schemas, index.statistics,
    )  # fmt: skip


def contents_of(source):
    for chunk in scan(source).summary.chunks:
        yield chunk, source.content(chunk.chunk_start_offset, chunk.chunk_length)


def stored_images(path):
    """The chunks of images, compressed as they are in the file."""
    source = McapReader(path)
    return [
        bytes(source.body(chunk.chunk_start_offset, chunk.chunk_length, Opcode.CHUNK))
        for chunk, _ in contents_of(source)
        if set(chunk.message_index_offsets) == {FRAMES}
    ]


def both(path, tmp_path):
    """A file recovered with its images copied, and with all of them encoded again."""
    copied = recover(path, tmp_path / "copied.mcap")
    encoded = recover(path, tmp_path / "encoded.mcap", copy_images=False)
    assert (copied.ticks, copied.duration_s, copied.lost, copied.lost_bytes) == (
        encoded.ticks, encoded.duration_s, encoded.lost, encoded.lost_bytes,
    )  # fmt: skip
    for mine, theirs in zip(content_of(copied.path), content_of(encoded.path), strict=True):
        assert mine == theirs
    assert not recover(copied.path).changed
    return copied


def places_of_a_cut(path):
    """In a chunk and after a chunk of each group of topics, and in the index."""
    ends = {}
    for start, end, channels in chunks_of(path)[6:]:
        ends.setdefault(FRAMES if channels == {FRAMES} else min(channels) > 21, (start, end))
    size = path.stat().st_size
    return [at for start, end in ends.values() for at in ((start + end) // 2, end)] + [size - 100, int(0.8 * size)]


@pytest.mark.parametrize("run", RUNS)
def test_a_cut_file_is_recovered_to_the_same_messages_whether_images_are_copied_or_encoded(files, run, tmp_path):
    for number, length in enumerate(places_of_a_cut(files[run])):
        folder = tmp_path / str(number)
        folder.mkdir()
        path = cut(files[run], length, folder / "s.mcap.partial")
        done = both(path, folder)
        copied = stored_images(done.path) == stored_images(path)
        assert copied == (run != "jpeg")  # of which the decoded pixels are stored


@pytest.mark.parametrize("which", [FRAMES, SLOTS["/robot/track"].channel])
def test_damage_on_the_way_is_recovered_as_if_all_images_were_encoded_again(files, which, tmp_path):
    start, end, _ = [chunk for chunk in chunks_of(files["delta"]) if which in chunk[2]][4]
    content = bytearray(files["delta"].read_bytes())
    content[(start + end) // 2] ^= 0xFF
    path = tmp_path / "s.mcap.partial"
    path.write_bytes(content)
    assert not both(path, tmp_path).complete


def test_an_image_that_makes_no_sense_under_a_right_checksum_is_left_out(files, tmp_path):
    content = bytearray(files["raw"].read_bytes())
    start, end, _ = [chunk for chunk in chunks_of(files["raw"]) if chunk[2] == {FRAMES}][3]
    at = content.index(b"mono8", start, end)
    content[at : at + 5] = b"mono9"
    begin = start + RECORD_HEAD.size + CHUNK_HEAD.size + LONG.size
    struct.pack_into("<I", content, start + RECORD_HEAD.size + 24, zlib.crc32(content[begin:end]))
    path = tmp_path / "s.mcap.partial"
    path.write_bytes(content[:-100])
    lost = both(path, tmp_path).lost
    assert "1 messages that make no sense, the first is /camera/frame" in lost and "1 images" in lost


def test_a_chunk_of_images_without_a_checksum_gets_one(files, tmp_path):
    content = bytearray(files["delta"].read_bytes())
    start = next(chunk[0] for chunk in chunks_of(files["delta"]) if chunk[2] == {FRAMES})
    struct.pack_into("<I", content, start + RECORD_HEAD.size + 24, 0)
    path = tmp_path / "s.mcap.partial"
    path.write_bytes(content[:-100])
    done = both(path, tmp_path)
    assert all(CHUNK_HEAD.unpack_from(chunk)[3] for chunk in stored_images(done.path))


def test_images_of_an_older_flowrec_are_stored_as_this_one_stores_them(tmp_path):
    both(cut(GOLDEN, GOLDEN.stat().st_size // 3, tmp_path / "s.mcap.partial"), tmp_path)


def test_what_reads_back_otherwise_than_it_was_written_is_no_session(files, tmp_path, monkeypatch):
    path = cut(files["delta"], int(0.8 * files["delta"].stat().st_size), tmp_path / "s.mcap.partial")
    before, write = path.read_bytes(), os.writev
    images = {chunk[CHUNK_HEAD.size + 4 + LONG.size :] for chunk in stored_images(path)}

    def damaging(handle, buffers):
        faulty = [bytes(each[:-9]) + b"\0" + bytes(each[-8:]) if bytes(each) in images else each for each in buffers]
        return write(handle, faulty)

    monkeypatch.setattr(os, "writev", damaging)
    with pytest.raises(SessionError, match=r"left as it was.*can not be read back"):
        recover(path)
    assert names_in(tmp_path) == ["s.mcap.partial"] and path.read_bytes() == before
