"""Files made to do harm, with every checksum right: one line, bounded memory and time, nothing written, nothing run."""

import itertools
import pickle
import re
import resource
import struct
import tracemalloc
import zipfile
import zlib
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
import zstandard
from mcap.records import Schema
from typer.testing import CliRunner

from flowrec.chip.io import chip_from_files
from flowrec.chip.vessel_case import KEYS as CASE_KEYS
from flowrec.chip.vessel_case import read_vessel_case
from flowrec.cli import app
from flowrec.commands.check import check
from flowrec.commands.export import export
from flowrec.config import config_from_toml
from flowrec.declarations import Message, invalid_numbers, message_fields, shape_error
from flowrec.errors import ChipError, FlowError, SessionError, UsageError, printable
from flowrec.messages import Estimate, Frame
from flowrec.refine.weights import read_weights
from flowrec.store import SessionReader, SessionWriter, WriterOptions, recover
from flowrec.store.channels import SLOTS
from flowrec.topics import BY_FIELD, TOPICS
from tests.store.drafts import (
    ATTACHMENT,
    CHANNEL,
    CHUNK_INDEX,
    MESSAGE,
    METADATA,
    PERIOD_NS,
    SCHEMA,
    TICKS,
    made_up,
    record,
    small_draft,
    text,
)
from tests.store.made_up import encode

_CHUNK_OPCODE = 6
DRAFT = small_draft()
STATE = SLOTS["/robot/estimate"].channel
FRAMES = SLOTS["/camera/frame"].channel


def file_of(tmp_path, draft):
    path = tmp_path / "hostile.mcap"
    path.write_bytes(draft.build())
    return path


def refused(path, match):
    """Reading says so in one line."""

    def read():
        with SessionReader(path) as reader:
            _ = reader.header
            for _tick in reader.ticks():
                pass

    with pytest.raises(SessionError, match=match) as error:
        read()
    assert str(error.value) == printable(str(error.value)) and str(path) in str(error.value)


def with_piece(holding, change):
    """The draft with its first chunk of a channel changed."""
    pieces = list(DRAFT.pieces)
    number = next(i for i, piece in enumerate(pieces) if any(sent.channel == holding for sent in piece.messages))
    pieces[number] = change(pieces[number])
    return replace(DRAFT, pieces=tuple(pieces))


def with_message(holding, change):
    """The draft with the first message of a channel changed, and packed again."""

    def changed(piece):
        first = next(sent for sent in piece.messages if sent.channel == holding)
        return replace(piece, messages=tuple(change(sent) if sent is first else sent for sent in piece.messages))

    return with_piece(holding, changed)


def with_head(opcode, body):
    """The draft with one more record in its head, before the first of its kind."""
    head = list(DRAFT.head)
    head.insert(next(i for i, part in enumerate(head) if part[0] == opcode), (opcode, body))
    return replace(DRAFT, head=tuple(head))


def with_index(change):
    return replace(DRAFT, change_index=change)


def attached(name, data):
    body = struct.pack("<QQ", 0, 0) + text(name) + text("text/plain") + struct.pack("<Q", len(data)) + data
    return body + struct.pack("<I", zlib.crc32(body))


def saved(path, tmp_path):
    out = tmp_path / "saved.mcap"
    out.unlink(missing_ok=True)
    return recover(path, out)


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
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 50 << 10


@pytest.mark.parametrize("compression", ["lz4", "bz2", "ZSTD"])
def test_other_compressions_are_not_even_tried(tmp_path, compression):
    piece = with_piece(STATE, lambda p: replace(p, compression=compression, packed=bytes(100), told_size=2**40))
    refused(file_of(tmp_path, piece), "more than|is not known to flowrec")
    piece = with_piece(STATE, lambda p: replace(p, compression=compression, packed=bytes(100), told_size=100))
    refused(file_of(tmp_path, piece), "is not known to flowrec")


def test_a_million_empty_messages_are_not_made(tmp_path):
    tiny = record(MESSAGE, struct.pack("<HIQQ", STATE, 0, 10**9, 10**9)) * 140_000
    packed = zstandard.compress(tiny)
    path = file_of(
        tmp_path,
        with_piece(STATE, lambda p: replace(p, packed=packed, told_size=len(tiny), told_crc=zlib.crc32(tiny))),
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
        data = bytearray(DRAFT.build())
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
    head = list(DRAFT.head)
    last = max(i for i, part in enumerate(head) if part[0] == opcode)
    head.insert(last + 1, (opcode, body))
    path = file_of(tmp_path, replace(DRAFT, head=tuple(head)))
    refused(path, match)
    assert check(path).exit_status == 1
    done = saved(path, tmp_path)
    assert done.ticks == TICKS and check(done.path).word in ("good", "usable")


NAMES = ["../../x", "/etc/flowrec", "C:\\x", "weights/../../../x", "a\0b", "\x1b[2J"]


@pytest.mark.parametrize("name", NAMES)
def test_names_of_attachments_lead_nowhere(tmp_path, name):
    inner = tmp_path / "a" / "b"
    inner.mkdir(parents=True)
    path = file_of(inner, with_head(ATTACHMENT, attached(name, b"owned")))
    with SessionReader(path) as reader:
        assert len(list(reader.ticks())) == TICKS and b"owned" not in reader.header.chip_png
    data = path.read_bytes()
    path.write_bytes(data[: len(data) - 200])
    assert recover(path, inner / "saved.mcap").ticks == TICKS
    check(inner / "saved.mcap")
    assert sorted(p.name for p in tmp_path.rglob("*") if p.is_file()) == ["hostile.mcap", "saved.mcap"]


def test_the_parent_of_a_replay_is_looked_for_beside_it_only(tmp_path, monkeypatch):
    inner = tmp_path / "inner"
    inner.mkdir()
    (tmp_path / "secret.mcap").write_bytes(DRAFT.build())
    drawn = []

    def drawn_beside(_target, _scene, _ticks, replayed, *_, **__):
        drawn.append(replayed)

    monkeypatch.setattr("flowrec.commands.export.write_rrd", drawn_beside)
    for name in ("../secret.mcap", str(tmp_path / "secret.mcap"), "..", "a\0b", ""):
        parent = text("flowrec.parent") + _map({"file": name, "sha256": "0"})
        head = tuple(part for part in DRAFT.head if not part[1].startswith(text("flowrec.parent")))
        export(file_of(inner, replace(DRAFT, head=(*head, (METADATA, parent)))))
    assert drawn == [None] * 5


def test_an_image_that_promises_more_than_it_has_is_refused(tmp_path):
    wire = made_up(Frame, 10**9, 0, np.random.default_rng(0))
    sound = encode(wire)
    from flowrec.store.schema import foxglove_schema

    parsed = foxglove_schema("RawImage").wire.FromString(sound)
    for width, height, data in ((65535, 65535, bytes(10)), (2**32 - 1, 2**32 - 1, b""), (0, 2**32 - 1, b"")):
        parsed.width, parsed.height, parsed.step, parsed.data = width, height, width, data
        forged = parsed.SerializeToString()
        path = file_of(tmp_path, with_message(FRAMES, lambda sent, forged=forged: replace(sent, payload=forged)))
        refused(path, r"an image of|has the shape")
        assert "make no sense" in saved(path, tmp_path).lost


def test_a_mask_that_promises_more_than_it_has_is_refused():
    for width, height in ((65535, 65535), (32767, 32767), (2**31, 1)):
        head = b"\x89PNG\r\n\x1a\n" + struct.pack(">I4sIIBBBBB", 13, b"IHDR", width, height, 8, 0, 0, 0, 0)
        with pytest.raises(ChipError, match="at most"):
            chip_from_files(head + bytes(10), "um_per_px = 1.0")
    for data in (b"BM" + bytes(100), b"\xff\xd8\xff" + bytes(100), b"II*\0" + bytes(100)):
        with pytest.raises(ChipError, match="is no PNG"):
            chip_from_files(data, "um_per_px = 1.0")


@pytest.mark.parametrize("number", [float("nan"), float("inf"), -float("inf")])
def test_a_pose_that_is_no_number_is_flagged(tmp_path, number):
    estimate = made_up(Estimate, 10**9, 0, np.random.default_rng(0))
    payload = encode(replace(estimate, position_um=np.array([number, 1.0])))
    path = file_of(tmp_path, with_message(STATE, lambda sent: replace(sent, payload=payload)))
    verdict = check(path)
    assert verdict.word == "usable"
    assert [f.text for f in verdict.findings] == ["NaN or infinity in /robot/estimate position_um, 1 times"]


def test_an_array_of_another_shape_is_refused_before_anybody_computes_with_it(tmp_path):
    estimate = made_up(Estimate, 10**9, 0, np.random.default_rng(0))
    payload = encode(replace(estimate, position_um=np.zeros(0)))
    path = file_of(tmp_path, with_message(STATE, lambda sent: replace(sent, payload=payload)))
    refused(path, r"position_um has the shape \(0,\) where \(2\) belongs")
    done = saved(path, tmp_path)
    assert done.ticks == TICKS and "1 messages that make no sense" in done.lost
    assert len(list(SessionReader(done.path).ticks())) == TICKS


def test_every_array_of_every_message_has_a_shape_and_sound_messages_fit():
    for kind in {topic.type for topic in TOPICS}:
        message = made_up(kind, 10**9, 1, np.random.default_rng(0))
        assert shape_error(message) == "" and invalid_numbers(message) == ()
        arrays = {field.name for field in fields(message) if isinstance(getattr(message, field.name), np.ndarray)}
        shaped = {each.name for each in message_fields(kind) if each.dtype is not None and each.shape is not None}
        assert shaped == arrays and isinstance(message, Message)


def test_time_that_goes_backwards_is_flagged_or_refused(tmp_path):
    # Within what the index tells: read in order of time, and flagged.
    frames = with_piece(FRAMES, lambda p: replace(p, messages=p.messages[::-1]))
    path = file_of(tmp_path, frames)
    assert [t.stamp_ns for t in SessionReader(path).ticks()] == [10**9 + i * PERIOD_NS for i in range(TICKS)]
    verdict = check(path)
    assert verdict.exit_status == 3
    assert any("time goes backwards 1 times in /camera/frame" in finding.text for finding in verdict.findings)
    # Beyond it: the ticks would come out of order.
    early = with_message(STATE, lambda sent: replace(sent, log_ns=5))
    early = replace(early, pieces=tuple(replace(p, told_times=(10**9, 2 * 10**9)) for p in early.pieces))
    refused(file_of(tmp_path, early), "messages of other times than the index tells")


def test_a_source_that_stamps_back_in_time_is_flagged(tmp_path):
    late = made_up(Frame, 9 * 10**9, 0, np.random.default_rng(0))
    payload = encode(late)
    path = file_of(tmp_path, with_message(FRAMES, lambda sent: replace(sent, payload=payload)))
    assert any("the source of /camera/frame stamped 1 messages back" in f.text for f in check(path).findings)


def spoiled(session, tmp_path, field, **changes):
    """The first 40 ticks of a mission with other numbers in a message of a topic."""
    with SessionReader(session) as reader:
        header, ticks = reader.header, list(itertools.islice(reader.ticks(), 40))
    said = getattr(ticks[-5], field)
    other = replace(said, **{name: np.full_like(getattr(said, name), value) for name, value in changes.items()})
    path = tmp_path / "spoiled.mcap"
    with SessionWriter(path, header, WriterOptions(block=True)) as writer:
        for tick in ticks:
            writer.write(replace(tick, **{field: other}) if getattr(tick, field) is said else tick)
    return path


@pytest.mark.parametrize(
    ("verb", "field", "changes", "done"),
    [
        ("replay", "applied", {"turns": float("nan")}, "replayed"),
        ("replay", "assumed", {"velocity_um_s": float("nan")}, "replayed"),
        ("replay", "assumed", {"velocity_um_s": 1e300}, "replayed"),
        ("replay", "demand", {"velocity_um_s": 1e300}, "replayed"),
        ("export", "assumed", {"velocity_um_s": 1e300}, "drawn"),
    ],
)
@pytest.mark.filterwarnings("ignore::RuntimeWarning")
def test_numbers_that_can_not_be_are_named_where_a_verb_fails_over_them(session, tmp_path, verb, field, changes, done):
    path = spoiled(session, tmp_path, field, **changes)
    words = ["replay", str(path), "--verify"] if verb == "replay" else ["export", str(path)]
    error = CliRunner().invoke(app, words).exception
    assert isinstance(error, SessionError), error
    (name,) = changes
    told = rf"{BY_FIELD[field].path} {name} at \d\.\d+ s holds NaN, infinity or a number beyond all measure, .* {done}"
    assert re.search(told, str(error)) and len(str(error).splitlines()) == 1


HARMFUL = "\x1b[2J\x1b]0;owned\x07<script>alert(1)</script>\r\n\u202egnp.exe\x9b31m"


def test_text_in_a_file_can_not_steer_a_terminal(tmp_path):
    outcome = text("flowrec.outcome") + _map({"outcome": HARMFUL, "note": HARMFUL, "route": HARMFUL})
    path = file_of(tmp_path, replace(DRAFT, tail=((METADATA, outcome),)))
    for words in (["info", path], ["ls", tmp_path], ["check", path]):
        shown = CliRunner().invoke(app, [*map(str, words)]).output
        assert "owned" in shown or "\\x1b" in shown
        assert not set(shown) & set("\x1b\x07\r\u202e\x9b")
    channel = struct.pack("<HH", 900, 777) + text(HARMFUL) + text("protobuf") + bytes(4)
    with pytest.raises(SessionError) as error:
        SessionReader(file_of(tmp_path, with_head(CHANNEL, channel)))
    assert str(error.value) == printable(str(error.value))


def _map(pairs):
    data = b"".join(text(key) + text(value) for key, value in pairs.items())
    return struct.pack("<I", len(data)) + data


@pytest.mark.parametrize(
    "toml",
    [
        'rig = "os.system"', '[control]\nlaw = "subprocess:run"', '[plan]\nmethod = "__import__(\'os\')"',
        '[refine]\nmethod = "pickle.loads"', '__class__ = "os"', "a = " + "[" * 5000, "a = " + "9" * 5000,
    ],
)  # fmt: skip
def test_a_configuration_names_no_code_and_breaks_no_parser(toml):
    with pytest.raises(UsageError) as error:
        config_from_toml(toml, "config.toml inside")
    assert len(str(error.value).splitlines()) == 1


@pytest.mark.parametrize(
    ("toml", "said"),
    [
        ("a" + ".a" * 3000 + " = 1", "a line with more than 2000 dots"),
        ("".join(f"a{number}.b.c = 1\n" for number in range(12_000)), "24000 dots, more than"),
        ("".join(f"a{number} = 1\n" for number in range(60_000)), "characters, more than"),
    ],
)
def test_a_text_that_would_become_gigabytes_of_tables_is_not_parsed(tmp_path, toml, said):
    for parse in (lambda: config_from_toml(toml, "config.toml inside"), lambda: chip_from_files(b"", toml)):
        with pytest.raises(UsageError, match=f"not valid TOML .*{said}") as error:
            parse()
        assert len(str(error.value)) < 200
    (tmp_path / "a.toml").write_text(toml)
    done = CliRunner().invoke(app, ["record", "--dry-run", str(tmp_path / "a.toml")])
    assert isinstance(done.exception, UsageError) and said in str(done.exception)


def vessel_case(path, mask_header, zeros):
    """A case whose mask announces itself like this and has so many MB of zeros."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as case:
        for key in CASE_KEYS:
            with case.open(f"{key}.npy", "w") as file:
                if key == "mask":
                    np.lib.format.write_array_header_1_0(file, mask_header)
                    for _ in range(zeros):
                        file.write(bytes(1 << 20))
                else:
                    np.lib.format.write_array(file, np.zeros(3))
    return path


@pytest.mark.parametrize(
    ("shape", "zeros", "said"),
    [((270, 1 << 20), 270, "arrays of 2831.* bytes, more than"), ((10**6, 10**6), 0, "announces an array of shape")],
)
def test_a_vessel_case_that_would_fill_the_memory_is_refused_before_it_is_unpacked(tmp_path, shape, zeros, said):
    header = {"descr": "|u1", "fortran_order": False, "shape": shape}
    path = vessel_case(tmp_path / "case.npz", header, zeros)
    tracemalloc.start()
    try:
        with pytest.raises(ChipError, match=said):
            read_vessel_case(path)
        assert tracemalloc.get_traced_memory()[1] < 8 << 20
    finally:
        tracemalloc.stop()


def with_session(**said):
    """The draft with another account of its format."""
    head = [
        (opcode, text("flowrec.session") + _map(said))
        if opcode == METADATA and body[4:].startswith(b"flowrec.session")
        else (opcode, body)
        for opcode, body in DRAFT.head
    ]
    return replace(DRAFT, head=tuple(head))


def test_a_version_of_thousands_of_digits_is_cut_and_does_not_hide_the_other_sessions(tmp_path):
    path = file_of(tmp_path, with_session(format_version="9" * 5000, flowrec_version="8" * 5000))
    refused(path, "is a session of format '9999.*install flowrec 8888")
    done = CliRunner().invoke(app, ["ls", str(tmp_path), "--json"])
    assert done.exit_code == 0 and len(done.stdout) < 1000 and "of format" in done.stdout


@pytest.mark.parametrize("where", ["file", "index"])
def test_schemas_without_end_are_refused_before_all_are_read(tmp_path, where, monkeypatch):
    schema = struct.pack("<H", 900) + text("a") + text("") + bytes(4)
    many = 30_000
    if where == "index":
        draft = with_index(lambda parts: [(SCHEMA, schema)] * many + parts)
    else:
        draft = replace(DRAFT, head=((SCHEMA, schema),) * many + DRAFT.head)
    path, parsed, read = file_of(tmp_path, draft), [], Schema.read
    monkeypatch.setattr(Schema, "read", lambda stream: (parsed.append(1), read(stream))[1])
    refused(path, "more than 10000 records besides chunks")
    assert len(parsed) <= 10_000
    parsed.clear()
    with pytest.raises(SessionError, match="more than 20000 records besides chunks"):
        check(path)
    assert len(parsed) <= 10_000 + 20_000


def test_weights_that_are_a_pickle_are_refused_unopened(tmp_path):
    class Harm:
        def __reduce__(self):
            return (Path.touch, (tmp_path / "owned",))

    path = tmp_path / "weights.safetensors"
    path.write_bytes(pickle.dumps(Harm()))
    with pytest.raises(FlowError, match="not a sound safetensors file"):
        read_weights(path, None)
    assert not (tmp_path / "owned").exists()


def test_chunk_shapes_planted_in_damage_do_not_cost_more_than_they_hold(tmp_path):
    # Each one announces megabytes that follow: looking at all of them for each would take hours, and hang this test.
    shape = struct.pack("<BQQQQI", 6, 4 << 20, 0, 0, 4 << 20, 1) + b"\x04\x00\x00\x00zstd" + struct.pack("<Q", 4 << 20)
    path = tmp_path / "hostile.mcap.partial"
    path.write_bytes(DRAFT.build()[:60_000] + b"\xff" * 20 + shape * 90_000)
    assert "damaged or cut-off bytes" in recover(path, tmp_path / "saved.mcap").lost


def test_large_records_besides_chunks_are_refused(tmp_path):
    path = file_of(tmp_path, with_head(METADATA, text("flowrec.note") + _map({"note": "x" * (5 << 20)})))
    refused(path, "a metadata of .* bytes, more than")
    path.write_bytes(path.read_bytes() + record(METADATA, b""))
    assert check(path).exit_status == 1
