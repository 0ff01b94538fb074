"""Made-up files, every checksum right, whose messages, names and texts make no sense.

They are refused or flagged; nothing is written, nothing is run.
"""

import itertools
import re
import struct
from dataclasses import fields, replace

import numpy as np
import pytest

from flowrec.core import (
    BY_FIELD,
    TOPICS,
    Estimate,
    FlowField,
    Frame,
    Message,
    SessionError,
    Tick,
    UsageError,
    as_read,
    invalid_numbers,
    message_fields,
    printable,
    shape_error,
)
from flowrec.exports.export import export
from flowrec.physics import chip_from_files
from flowrec.stages import config_from_toml
from flowrec.store import SessionReader, SessionWriter, WriterOptions, recover
from flowrec.verbs.check import check
from tests.conftest import invoke
from tests.store.drafts import ATTACHMENT, CHANNEL, METADATA, PERIOD_NS, TICKS, made_up, packed_map, small_draft, text
from tests.store.hostile import FRAMES, STATE, attached, file_of, refused, saved, with_head, with_message, with_piece
from tests.store.made_up import HEADER, encode, write_session

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
    (tmp_path / "secret.mcap").write_bytes(small_draft().build())
    drawn = []

    def drawn_beside(_part, _scene, ticks, *_, **__):
        drawn.append(len(ticks) > 1)

    monkeypatch.setattr("flowrec.exports.rrd.write_rrd", drawn_beside)
    for name in ("../secret.mcap", str(tmp_path / "secret.mcap"), "..", "a\0b", ""):
        parent = text("flowrec.parent") + packed_map({"file": name, "sha256": "0"})
        head = tuple(part for part in small_draft().head if not part[1].startswith(text("flowrec.parent")))
        export(file_of(inner, replace(small_draft(), head=(*head, (METADATA, parent)))), overwrite=True)
    assert drawn == [False] * 5


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


@pytest.mark.parametrize("number", [float("nan"), float("inf"), -float("inf")])
def test_a_pose_that_is_no_number_is_flagged(tmp_path, number):
    estimate = made_up(Estimate, 10**9, 0, np.random.default_rng(0))
    with as_read():
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
    with as_read():
        other = replace(said, **{name: np.full_like(getattr(said, name), value) for name, value in changes.items()})
    path = tmp_path / "spoiled.mcap"
    return write_session(
        path, (replace(tick, **{field: other}) if getattr(tick, field) is said else tick for tick in ticks), header
    )


@pytest.mark.parametrize(
    ("verb", "field", "changes", "done"),
    [
        ("replay", "applied", {"turns": float("nan")}, "replayed"),
        ("replay", "assumed", {"velocity_um_s": float("nan")}, "replayed"),
        ("replay", "assumed", {"velocity_um_s": 1e300}, "replayed"),
        ("replay", "demand", {"velocity_um_s": 1e300}, "replayed"),
        ("export", "assumed", {"velocity_um_s": 1e300}, "exported"),
    ],
)
@pytest.mark.filterwarnings("ignore::RuntimeWarning")
def test_numbers_that_can_not_be_are_named_where_a_verb_fails_over_them(session, tmp_path, verb, field, changes, done):
    path = spoiled(session, tmp_path, field, **changes)
    words = ["replay", str(path), "--verify"] if verb == "replay" else ["export", str(path)]
    error = invoke(*words).exception
    assert isinstance(error, SessionError), error
    (name,) = changes
    told = rf"{BY_FIELD[field].path} {name} at \d\.\d+ s holds NaN, infinity or an impossibly large number, .* {done}"
    assert re.search(told, str(error)) and len(str(error).splitlines()) == 1


HARMFUL = "\x1b[2J\x1b]0;owned\x07<script>alert(1)</script>\r\n\u202egnp.exe\x9b31m"


def test_text_in_a_file_can_not_steer_a_terminal(tmp_path):
    outcome = text("flowrec.outcome") + packed_map({"outcome": HARMFUL, "note": HARMFUL, "route": HARMFUL})
    path = file_of(tmp_path, replace(small_draft(), tail=((METADATA, outcome),)))
    for words in (["info", path], ["ls", tmp_path], ["check", path]):
        shown = invoke(*words).output
        assert "owned" in shown or "\\x1b" in shown
        assert not set(shown) & set("\x1b\x07\r\u202e\x9b")
    channel = struct.pack("<HH", 900, 777) + text(HARMFUL) + text("protobuf") + bytes(4)
    with pytest.raises(SessionError) as error:
        SessionReader(file_of(tmp_path, with_head(CHANNEL, channel)))
    assert str(error.value) == printable(str(error.value))


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
    done = invoke("record", "--dry-run", tmp_path / "a.toml")
    assert isinstance(done.exception, UsageError) and said in str(done.exception)


@pytest.mark.slow("makes a message of 176 MB")
def test_a_state_of_more_than_176_mb_is_refused_whichever_way_it_is_read(tmp_path):
    # Three flow fields of 66 MB: each fits into a chunk, and all of them are known at the last tick.
    shape = (1800, 1850)
    velocity, pressure = np.zeros((*shape, 2), np.float32), np.zeros(shape, np.float32)
    velocity[::32] = np.random.default_rng(0).normal(size=velocity[::32].shape)  # or it compresses too well
    path = tmp_path / "large.mcap"
    with SessionWriter(path, HEADER, WriterOptions(leave_out=("/view/*",), block=True)) as writer:
        tick = Tick()
        for number, field in enumerate(("assumed", "refined", "true_field")):
            stamp_ns = 10**9 + number * PERIOD_NS
            flow = FlowField(stamp_ns, 1, "fvm", 2.0, velocity, pressure, velocity, np.zeros(1), 1.0, 998.0, "")
            tick = replace(tick, stamp_ns=stamp_ns, **{field: flow})
            writer.write(tick)
    with SessionReader(path) as reader:
        assert next(reader.ticks()).assumed is not None
        for read in (lambda: list(reader.ticks()), lambda: reader.tick_before(reader.last_ns)):
            with pytest.raises(SessionError, match=r"199\d{6} bytes.* 184549376"):
                read()
