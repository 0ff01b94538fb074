"""Any question about a session at a URL takes three requests in two round trips; the copies for it are right."""

from __future__ import annotations

import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import zstandard
from mcap.reader import NonSeekingReader, make_reader

import flowrec
from flowrec.core import UsageError
from flowrec.store import is_copy, recover
from flowrec.store.channels import SessionContents
from flowrec.store.lookup import LOOKUP_OPCODE, GatheredCopies
from flowrec.store.mcap_format import CRC, RECORD_HEAD
from flowrec.store.mcap_reader import McapReader
from tests.extras import needs
from tests.perf.large import LOADS, write_sparse
from tests.store.far_questions import MOST_REQUESTS, MOST_TRIPS, QUESTIONS, Trips, ask, write_session
from tests.store.s3_server import BUCKET, s3_server
from tests.store.static_server import static_server

_LATENCY_S = 0.1


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("far") / "far.mcap"
    write_session(path)
    return path


@pytest.fixture
def static(session: Path) -> Iterator[tuple[str, Trips]]:
    trips = Trips(_LATENCY_S)
    with static_server(session.parent, trips.arrive) as url:
        yield f"{url}/{session.name}", trips


def same(one: Any, other: Any) -> bool:
    return bool(one == other or (hasattr(one, "same_as") and one.same_as(other)))


def test_a_question_takes_three_requests_in_two_round_trips(session: Path, static: tuple[str, Trips]) -> None:
    for question, answer in QUESTIONS.items():
        cost = ask(question, *static)
        assert cost.requests <= MOST_REQUESTS and cost.trips <= MOST_TRIPS, (question, cost)
        assert cost.megabytes < session.stat().st_size / 2e6, (question, cost)
        assert same(cost.answer, answer(str(session)))


@pytest.mark.slow("asks a second server the same")
@needs("moto")
def test_a_question_to_a_bucket_takes_as_many(session: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    trips = Trips(_LATENCY_S)
    with s3_server(monkeypatch) as server:
        server.client.upload_file(str(session), BUCKET, session.name)
        server.fault = lambda *_: trips.arrive()
        for question in QUESTIONS:
            server.requests.clear()
            cost = ask(question, f"s3://{BUCKET}/{session.name}", trips)
            assert len(server.requests) == cost.requests <= MOST_REQUESTS, (question, cost)
            assert cost.trips <= MOST_TRIPS, (question, cost)


@pytest.mark.slow("writes a sparse session of 10 GB")
def test_a_session_of_ten_gigabytes_takes_no_more(tmp_path: Path) -> None:
    write_sparse(tmp_path / "large.mcap", LOADS[0], 10.0)
    trips = Trips(_LATENCY_S)
    with static_server(tmp_path, trips.arrive) as url:
        for question in QUESTIONS:
            if question not in ("one image", "one second of everything"):  # images are holes
                cost = ask(question, f"{url}/large.mcap", trips)
                assert cost.requests <= MOST_REQUESTS and cost.trips <= MOST_TRIPS, (question, cost)


def test_what_is_read_at_a_url_is_what_stands_in_the_file(session: Path, static: tuple[str, Trips]) -> None:
    static[1].latency_s = 0.0
    assert flowrec.compare(session, static[0]).identical
    assert flowrec.check(session).findings == flowrec.check(static[0]).findings


def test_ticks_end_before_the_time_that_is_given(session: Path) -> None:
    opened = flowrec.open(session)
    first_s = opened.run.first_ns / 1e9
    every = [tick.stamp_ns for tick in opened.ticks()]
    from_s, to_s = first_s + 1.0, first_s + 2.0
    assert [tick.stamp_ns for tick in opened.ticks(from_s, to_s)] == [
        stamp for stamp in every if from_s <= stamp / 1e9 < to_s
    ]
    assert [tick.stamp_ns for tick in opened.ticks(end_s=to_s)] == [stamp for stamp in every if stamp / 1e9 < to_s]
    assert [tick.stamp_ns for tick in opened.ticks(end_s=1e9)] == every
    with pytest.raises(UsageError, match="runs from"):
        next(opened.ticks(end_s=float("nan")))


def test_readers_of_other_programs_pass_over_the_copies(session: Path) -> None:
    count = flowrec.open(session).topics["/robot/track"]
    with session.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        assert sum(1 for _ in reader.iter_messages(topics=["/robot/track"])) == count
        assert sum(is_copy(each.name) for each in reader.iter_attachments()) == 1
        stream.seek(0)
        front_to_back = NonSeekingReader(stream, validate_crcs=True)
        assert sum(1 for _ in front_to_back.iter_messages(topics=["/robot/track"])) == count


def test_a_copy_that_is_of_something_else_is_found(session: Path, tmp_path: Path) -> None:
    with SessionContents(session) as contents:
        place = next(each for each in contents.attachments if is_copy(each.name))
    data = bytearray(session.read_bytes())
    end = place.offset + place.length - CRC.size
    data[end - place.data_size + 100] ^= 1
    data[end : end + CRC.size] = CRC.pack(zlib.crc32(data[place.offset + RECORD_HEAD.size : end]))
    (changed := tmp_path / "changed.mcap").write_bytes(data)
    assert "copies" not in str(flowrec.check(session).findings)
    found = flowrec.check(changed)
    assert found.word == "bad" and "1 records have other copies" in str(found.findings)


@pytest.mark.parametrize("right_checksum", [False, True])
def test_a_lookup_record_of_another_file_is_found(session: Path, tmp_path: Path, right_checksum: bool) -> None:
    data = bytearray(session.read_bytes())
    begin, end, between = lookup_of(session)
    content = bytearray(zstandard.ZstdDecompressor().decompress(bytes(data[begin + CRC.size : end])))
    content[-100] ^= 1  # in the digest
    body = zstandard.ZstdCompressor(level=9).compress(bytes(content))
    body = CRC.pack(zlib.crc32(body, zlib.crc32(between)) if right_checksum else 1) + body
    grown = len(body) - (end - begin)
    data[begin - 8 : end] = len(body).to_bytes(8, "little") + body
    footer = len(data) - 37 + RECORD_HEAD.size  # the summary begins where it did, its offsets follow the record
    data[footer + 8 : footer + 16] = (int.from_bytes(data[footer + 8 : footer + 16], "little") + grown).to_bytes(
        8, "little"
    )
    lookup_offset = data.rindex(bytes([LOOKUP_OPCODE]), 0, footer - RECORD_HEAD.size)
    data[lookup_offset + 9 : lookup_offset + 17] = (len(body) + RECORD_HEAD.size).to_bytes(8, "little")
    data[footer + 16 : footer + 20] = bytes(4)  # no checksum
    (changed := tmp_path / "changed.mcap").write_bytes(data)
    assert "the lookup record" in str(flowrec.check(changed).findings)


def lookup_of(path: Path) -> tuple[int, int, bytes]:
    """Begin and end of the body of the lookup record, and what stands between it and the list of chunks."""
    data = path.read_bytes()
    summary = int.from_bytes(data[-37 + 9 : -37 + 17], "little")
    at, between = summary, b""
    while data[at] != LOOKUP_OPCODE:
        opcode, length = RECORD_HEAD.unpack_from(data, at)
        between += b"" if opcode == 8 else data[at : at + RECORD_HEAD.size + length]
        at += RECORD_HEAD.size + length
    _, length = RECORD_HEAD.unpack_from(data, at)
    return at + RECORD_HEAD.size, at + RECORD_HEAD.size + length, between


def test_a_file_that_is_cut_in_its_copies_is_recovered_without_a_message_twice(session: Path, tmp_path: Path) -> None:
    with SessionContents(session) as contents:
        place = next(each for each in contents.attachments if is_copy(each.name))
    (cut := tmp_path / "cut.mcap.partial").write_bytes(session.read_bytes()[: place.offset + place.length // 2])
    done = recover(cut)
    assert done.complete
    assert flowrec.compare(session, done.path, ignore=["outcome"]).identical
    assert flowrec.check(done.path).word == flowrec.check(session).word
    source = McapReader(done.path)
    assert GatheredCopies(source.read_summary()).pieces  # it has its own
    source.close()


def test_copies_of_a_file_that_another_program_has_rewritten_are_passed_over(session: Path) -> None:
    with SessionContents(session) as contents:
        summary = contents.source.read_summary()
        assert GatheredCopies(summary).pieces
        summary.chunks[0].chunk_length += 1
        assert not GatheredCopies(summary).pieces
