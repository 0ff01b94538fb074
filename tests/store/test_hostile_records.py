"""Made-up files, every checksum right, whose records are wrong about sizes, places and declarations.

They are refused in one line, within bounded memory and time.
"""

import re
import resource
import struct
import zlib
from dataclasses import replace

import pytest
import zstandard
from mcap.records import Schema

from flowrec.core import SessionError
from flowrec.store import SessionReader, recover
from flowrec.verbs.check import check
from tests.conftest import invoke
from tests.store.drafts import (
    CHANNEL,
    CHUNK_INDEX,
    MESSAGE,
    METADATA,
    SCHEMA,
    TICKS,
    packed_map,
    record,
    small_draft,
    text,
)
from tests.store.hostile import _CHUNK_OPCODE, FRAMES, STATE, file_of, refused, saved, with_head, with_index, with_piece


@pytest.mark.parametrize("crc", ["right", None])
def test_a_bomb_that_is_told_as_one_is_not_unpacked(tmp_path, crc):
    content = bytes(70 << 20)
    told = zlib.crc32(content) if crc else 0
    bomb = zstandard.compress(content)
    path = file_of(
        tmp_path, with_piece(STATE, lambda p: replace(p, packed=bomb, told_size=len(content), told_crc=told))
    )
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    refused(path, "a chunk that unpacks")
    assert check(path).word == "bad"
    assert saved(path, tmp_path).lost
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 60 << 10


@pytest.mark.parametrize("compression", ["lz4", "bz2", "ZSTD"])
def test_other_compressions_are_not_even_tried(tmp_path, compression):
    piece = with_piece(STATE, lambda p: replace(p, compression=compression, packed=bytes(100), told_size=2**40))
    refused(file_of(tmp_path, piece), "more than|is not known to flowrec")
    piece = with_piece(STATE, lambda p: replace(p, compression=compression, packed=bytes(100), told_size=100))
    refused(file_of(tmp_path, piece), "is not known to flowrec")


@pytest.mark.slow("makes a file of a million messages")
def test_a_million_empty_messages_are_not_made(tmp_path):
    tiny = record(MESSAGE, struct.pack("<HIQQ", STATE, 0, 10**9, 10**9)) * 140_000
    packed = zstandard.compress(tiny)
    path = file_of(
        tmp_path, with_piece(STATE, lambda p: replace(p, packed=packed, told_size=len(tiny), told_crc=zlib.crc32(tiny)))
    )
    refused(path, "more than 131072 messages in one chunk")


@pytest.mark.parametrize("place", ["chunk", "index"])
@pytest.mark.parametrize("length", [2**31, 2**62, 2**63, 2**64 - 1])
def test_a_length_beyond_the_file_is_told(tmp_path, place, length):
    path = tmp_path / "hostile.mcap"
    if place == "index":

        def change(index):
            return [(op, body[:24] + struct.pack("<Q", length) + body[32:] if op == CHUNK_INDEX else body)
                    for op, body in index]  # fmt: skip

        path.write_bytes(with_index(change).build())
        refused(path, "do not fit into the file")
    else:
        data = bytearray(small_draft().build())
        marks = (found.start() - 9 - 28 for found in re.finditer(rb"\x04\x00\x00\x00zstd", data))
        at = next(mark for mark in marks if data[mark] == _CHUNK_OPCODE)
        data[at + 1 : at + 9] = struct.pack("<Q", length)
        path.write_bytes(data)
        refused(path, "no chunk of")
    assert check(path).exit_status == 1
    assert saved(path, tmp_path).ticks >= TICKS - 2


@pytest.mark.parametrize("kind", ["twice", "looping", "overlapping", "behind the index"])
def test_an_index_that_would_be_read_for_ever_is_refused(tmp_path, kind):
    def change(index):
        chunks = [i for i, (opcode, _) in enumerate(index) if opcode == CHUNK_INDEX]
        opcode, body = index[chunks[0]]
        if kind == "twice":
            return [*index[:-1], index[chunks[0]]]
        if kind == "looping":  # each leads to the first
            return [(op, body if op == CHUNK_INDEX else other) for op, other in index]
        (following,) = struct.unpack_from("<Q", index[chunks[1]][1], 16)
        moved = following - 30 if kind == "overlapping" else 10**9
        index[chunks[0]] = opcode, body[:16] + struct.pack("<Q", moved) + body[24:]
        return index

    path = file_of(tmp_path, with_index(change))
    with pytest.raises(SessionError, match=r"lies over something else|reaches to byte|are announced"):
        SessionReader(path)
    assert check(path).exit_status == 1
    assert saved(path, tmp_path).ticks == TICKS


def test_a_wrong_checksum_costs_its_chunk_and_is_counted(tmp_path):
    path = file_of(tmp_path, with_piece(FRAMES, lambda p: replace(p, told_crc=1)))
    refused(path, "the checksum of the chunk is wrong")
    assert any("bytes are damaged" in finding.text for finding in check(path).findings)
    done = saved(path, tmp_path)
    assert "2 images" in done.lost and done.ticks == TICKS


@pytest.mark.parametrize(
    ("opcode", "body", "match"),
    [
        (CHANNEL, struct.pack("<HH", FRAMES, 3) + text("/robot/track") + text("protobuf") + bytes(4), "declared twice"),
        (CHANNEL, struct.pack("<HH", 900, 777) + text("/x") + text("protobuf") + bytes(4), "has no schema"),
        (CHANNEL, struct.pack("<HHI", 900, 1, 2) + b"\xff\xfe" + text("protobuf") + bytes(4), "invalid start byte"),
        (SCHEMA, struct.pack("<H", 1) + text("other") + text("protobuf") + text(""), "declared twice"),
    ],
)
def test_declarations_that_make_no_sense_are_refused_and_passed_over_by_recovery(tmp_path, opcode, body, match):
    head = list(small_draft().head)
    last = max(i for i, part in enumerate(head) if part[0] == opcode)
    head.insert(last + 1, (opcode, body))
    path = file_of(tmp_path, replace(small_draft(), head=tuple(head)))
    refused(path, match)
    assert check(path).exit_status == 1
    done = saved(path, tmp_path)
    assert done.ticks == TICKS and check(done.path).word in ("good", "usable")


def with_session(**said):
    """The draft with another account of its format."""
    head = [
        (opcode, text("flowrec.session") + packed_map(said))
        if opcode == METADATA and body[4:].startswith(b"flowrec.session")
        else (opcode, body)
        for opcode, body in small_draft().head
    ]
    return replace(small_draft(), head=tuple(head))


def test_a_version_of_thousands_of_digits_is_cut_and_does_not_hide_the_other_sessions(tmp_path):
    path = file_of(tmp_path, with_session(format_version="9" * 5000, flowrec_version="8" * 5000))
    refused(path, "is a session of format '9999.*install flowrec 8888")
    done = invoke("ls", tmp_path, "--json")
    assert done.exit_code == 0 and len(done.stdout) < 1000 and "of format" in done.stdout


@pytest.mark.parametrize("where", ["file", "index"])
def test_schemas_without_end_are_refused_before_all_are_read(tmp_path, where, monkeypatch):
    schema = struct.pack("<H", 900) + text("a") + text("") + bytes(4)
    many = 30_000
    if where == "index":
        draft = with_index(lambda parts: [(SCHEMA, schema)] * many + parts)
    else:
        draft = replace(small_draft(), head=((SCHEMA, schema),) * many + small_draft().head)
    path, parsed, read = file_of(tmp_path, draft), [], Schema.read
    monkeypatch.setattr(Schema, "read", lambda stream: (parsed.append(1), read(stream))[1])
    refused(path, "more than 10000 records besides chunks")
    assert len(parsed) <= 2 * 10_000  # of the file, and of the file at a URL
    parsed.clear()
    with pytest.raises(SessionError, match="20000"):
        check(path)
    assert len(parsed) <= 10_000 + 20_000


def test_chunk_shapes_planted_in_damage_do_not_cost_more_than_they_hold(tmp_path):
    # Behind some ticks. Each one announces megabytes that follow: to look at all for each would take hours.
    shape = struct.pack("<BQQQQI", 6, 4 << 20, 0, 0, 4 << 20, 1) + b"\x04\x00\x00\x00zstd" + struct.pack("<Q", 4 << 20)
    path = tmp_path / "hostile.mcap.partial"
    path.write_bytes(small_draft().build()[:120_000] + b"\xff" * 20 + shape * 90_000)
    assert "damaged or cut-off bytes" in recover(path, tmp_path / "saved.mcap").lost


def test_large_records_besides_chunks_are_refused(tmp_path):
    path = file_of(tmp_path, with_head(METADATA, text("flowrec.note") + packed_map({"note": "x" * (5 << 20)})))
    refused(path, "a metadata of .* bytes, more than")
    path.write_bytes(path.read_bytes() + record(METADATA, b""))
    assert check(path).exit_status == 1
