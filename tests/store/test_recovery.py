"""What is saved of killed, cut and damaged sessions, and what is said of the rest."""

import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from flowrec.core import TOPICS, Role, SessionError, is_growing
from flowrec.run import RecordedRig
from flowrec.store import SLOTS, SessionReader, SessionWriter, WriterOptions, recover
from flowrec.store.channels import VIEW
from flowrec.store.mcap_reader import McapReader
from flowrec.store.scan import scan
from flowrec.store.session_file import SessionFile
from flowrec.verbs import Change
from flowrec.verbs import session_replay as verb
from flowrec.verbs.compare import compare
from tests.store.made_up import HEADER, same, ticks_of, write_session
from tests.store.test_damage import KILLED, names_in

TICKS = list(ticks_of(40, shape=(8, 8)))
OUTPUTS = [topic.field for topic in TOPICS if topic.role is Role.OUTPUT]


@pytest.fixture(scope="module")
def small(tmp_path_factory):
    """A made-up session of many chunks: three ticks a flush."""
    path = tmp_path_factory.mktemp("recovery") / "small.mcap"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(SessionFile, "flush_if_due", flush_every(3))
        return write_session(path, TICKS, outcome={"outcome": "reached", "note": "there"})


def flush_every(ticks):
    """Chunks that do not depend on the clock."""

    def flush_if_due(self):
        self.calls = getattr(self, "calls", 0) + 1
        if self.calls % ticks == 0:
            self.flush()

    return flush_if_due


DRAWN = {slot.channel for slot in SLOTS.values() if slot.group == VIEW}


def chunks_of(path, *, drawn=False):
    """Start, end and channels of each chunk that was recorded, or of those that were drawn from them."""
    source = McapReader(path)
    found = scan(source).summary.chunks
    every = [(c.chunk_start_offset, c.chunk_start_offset + c.chunk_length, set(c.message_index_offsets)) for c in found]
    return [chunk for chunk in every if (chunk[2] <= DRAWN) == drawn]


def cut(path, length, to):
    to.write_bytes(path.read_bytes()[:length])
    return to


def same_ticks(one, other):
    return len(one) == len(other) and all(map(same, one, other))


@pytest.mark.parametrize(
    "place", [0.15, "after images", pytest.param(0.97, marks=pytest.mark.slow("replays nearly a whole session"))]
)
def test_a_real_recording_cut_anywhere_is_replayed_exactly_after_recovery(session, tmp_path, place):
    frames = SLOTS["/camera/frame"].channel
    size = max(end for _, end, _ in chunks_of(session))  # what follows can be made again
    images_end = [end for _, end, channels in chunks_of(session) if channels == {frames}][5]
    length = images_end if place == "after images" else int(place * size)
    path = cut(session, length, tmp_path / "cut.mcap.partial")
    done = recover(path)
    assert done.path == tmp_path / "cut.mcap" and not path.exists()
    assert not done.complete and (done.lost_bytes > 0 or length == images_end)
    reader = SessionReader(done.path)
    assert reader.outcome["outcome"] == "cut" and "lost:" in reader.outcome["note"]
    assert reader.header == SessionReader(session).header
    assert reader.outcome["ticks"] == str(done.ticks)
    replayed = verb.replay_session(done.path, Change(), verify=True)
    same, lines = replayed.same, replayed.lines()
    assert same, lines
    assert replayed.report.ticks == done.ticks > 0
    assert ("all but the image" in done.lost) == (reader.counts["frame"] > done.ticks)
    assert length != images_end or reader.counts["frame"] > done.ticks


def test_a_recovered_session_begins_exactly_as_the_original(small, tmp_path):
    length = chunks_of(small)[-7][1]
    done = recover(cut(small, length, tmp_path / "s.mcap"))
    assert done.path == tmp_path / "s_recovered.mcap"
    assert sorted(names_in(tmp_path)) == ["s.mcap", "s_recovered.mcap"]
    saved = list(SessionReader(done.path).ticks())
    assert 0 < len(saved) < len(TICKS)
    assert same_ticks(saved, TICKS[: len(saved)])
    assert SessionReader(done.path).header == HEADER


def test_images_ahead_of_the_rest_are_kept_without_it(small, tmp_path):
    frames = SLOTS["/camera/frame"].channel
    ends = [end for _, end, channels in chunks_of(small) if channels == {frames}]
    done = recover(cut(small, ends[5], tmp_path / "s.mcap.partial"))
    assert done.ticks == 15 and "all but the image of the last 3 ticks" in done.lost
    assert names_in(tmp_path) == ["s.mcap"]
    ticks = list(SessionReader(done.path).ticks())
    assert [tick.frame.stamp_ns for tick in ticks] == [tick.frame.stamp_ns for tick in TICKS[:18]]
    assert all(mine.frame.same_as(theirs.frame) for mine, theirs in zip(ticks, TICKS[:18], strict=True))
    assert [tick.applied.stamp_ns for tick in ticks[14:]] == [TICKS[14].stamp_ns] * 4
    assert SessionReader(done.path).outcome["ticks"] == "15" and not recover(done.path).changed


def test_a_last_tick_of_inputs_alone_is_not_taken_for_a_whole_one(tmp_path):
    # What a stage that failed leaves; then the file was cut before its end.
    last = replace(TICKS[5], **{name: getattr(TICKS[4], name) for name in OUTPUTS})
    path = tmp_path / "s.mcap"
    write_session(path, (*TICKS[:5], last), block=False, frames="raw", outcome={"outcome": "failed"})
    footer_bytes = 9 + 20 + 8  # with the magic after it
    done = recover(cut(path, path.stat().st_size - footer_bytes, tmp_path / "t.mcap.partial"))
    ticks = list(SessionReader(done.path).ticks())
    assert done.ticks == 5
    # They are kept, and said not to be a whole tick.
    assert ticks[-1].applied.stamp_ns == ticks[-1].frame.stamp_ns == TICKS[5].stamp_ns
    until_s = (TICKS[4].stamp_ns - TICKS[0].stamp_ns) / 1e9
    assert f"recovered up to {until_s:.2f} s" in SessionReader(done.path).outcome["note"]


def test_a_replay_takes_no_image_of_a_tick_that_it_passes_over_for_one_of_the_next(tmp_path):
    whole, alone, blind = TICKS[:3]
    with SessionWriter(tmp_path / "s.mcap", HEADER, WriterOptions(block=True)) as writer:
        writer.write(whole)
        writer.write(replace(whole, stamp_ns=alone.stamp_ns, frame=alone.frame))
        writer.write(replace(blind, frame=alone.frame))
    inputs = list(RecordedRig(SessionReader(tmp_path / "s.mcap")).inputs())
    assert [each.stamp_ns for each in inputs] == [whole.stamp_ns, blind.stamp_ns]
    assert inputs[1].frame is None and inputs[1].track.same_as(blind.track)


def test_a_replay_misses_the_images_that_were_lost_and_not_those_of_an_absent_camera(tmp_path):
    seen, lost, absent = TICKS[:3]
    with SessionWriter(tmp_path / "s.mcap", HEADER, WriterOptions(block=True)) as writer:
        writer.write(seen)
        writer.write(replace(lost, frame=seen.frame))
        applied = replace(absent.applied, absent_until_ns=absent.stamp_ns)
        assert applied.without_image and not lost.applied.without_image
        writer.write(replace(absent, frame=seen.frame, applied=applied))
    with RecordedRig(SessionReader(tmp_path / "s.mcap")) as rig:
        assert [each.frame is None for each in rig.inputs()] == [False, True, True]
    assert rig.frames_missing == 1


def test_topics_that_an_older_file_never_had_are_not_lost(tmp_path):
    golden = Path(__file__).parents[2] / "sessions" / "golden.mcap"
    done = recover(cut(golden, golden.stat().st_size // 2, tmp_path / "s.mcap.partial"))
    assert SessionReader(golden).counts.keys().isdisjoint({"clocks"})
    assert "the last moments" in done.lost and "/run/clocks" not in done.lost and "all of" not in done.lost


def test_messages_of_a_damaged_declaration_are_counted_as_lost(small, tmp_path):
    content = bytearray(small.read_bytes())
    content[content.index(b"/robot/estimate") - 6] ^= 0x40  # the number of its schema
    path = tmp_path / "s.mcap.partial"
    path.write_bytes(content[: chunks_of(small)[-1][1]])  # without the index, in which it is declared once more
    lost = recover(path).lost
    assert f"{len(TICKS)} messages of topics whose declaration is damaged (/robot/estimate)" in lost


def test_topics_that_another_flowrec_recorded_are_kept(small, tmp_path):
    content = small.read_bytes().replace(b"/truth/robot", b"/truth/other")
    path = tmp_path / "s.mcap.partial"
    path.write_bytes(content[: chunks_of(small)[-7][1]])
    done = recover(path)
    assert "other" not in done.lost and names_in(tmp_path) == ["s.mcap"]
    index = McapReader(done.path).read_summary()
    other = next(number for number, channel in index.channels.items() if channel.topic == "/truth/other")
    assert index.statistics.channel_message_counts[other] == done.ticks > 0


def test_only_the_index_missing_is_no_loss(small, tmp_path):
    done = recover(cut(small, small.stat().st_size - 100, tmp_path / "s.mcap.partial"))
    assert done.complete and done.changed and done.lost_bytes == 0
    reader = SessionReader(done.path)
    assert (reader.outcome["outcome"], reader.outcome["note"]) == ("reached", "there")
    assert compare(reader.path, small, ignore=["outcome"]).identical


def test_a_whole_session_is_left_alone(small, tmp_path):
    before = small.read_bytes()
    done = recover(small, tmp_path / "never.mcap")
    assert done.path == small and done.complete and not done.changed
    assert small.read_bytes() == before and not names_in(tmp_path)


def test_a_whole_session_that_got_no_name_gets_it(small, tmp_path):
    done = recover(cut(small, small.stat().st_size, tmp_path / "s.mcap.partial"))
    assert done.complete and done.ticks == len(TICKS)
    assert names_in(tmp_path) == ["s.mcap"] and done.path.read_bytes() == small.read_bytes()


def test_a_damaged_chunk_costs_no_more_than_itself(small, tmp_path):
    state, frames = SLOTS["/robot/track"].channel, SLOTS["/camera/frame"].channel
    chunks = chunks_of(small)
    for name, wanted, said in (("frames", frames, "3 images"), ("state", state, "3 ticks on the way")):
        start, end, _ = [chunk for chunk in chunks if wanted in chunk[2]][4]
        content = bytearray(small.read_bytes())
        content[(start + end) // 2] ^= 0xFF
        path = tmp_path / f"{name}.mcap"
        path.write_bytes(content)
        done = recover(path)
        assert said in done.lost and not done.complete
        reader = SessionReader(done.path)
        assert reader.outcome["outcome"] == "cut" and reader.outcome["ended_as"] == "reached"
        assert len(list(reader.ticks())) == len(TICKS)
        assert done.ticks == len(TICKS) - (3 if name == "state" else 0)


def test_after_a_length_that_makes_no_sense_the_next_chunk_is_found(small, tmp_path):
    start = chunks_of(small)[6][0]
    content = bytearray(small.read_bytes())
    content[start + 1 : start + 9] = b"\xff" * 8
    path = tmp_path / "s.mcap"
    path.write_bytes(content)
    assert recover(path).ticks >= len(TICKS) - 3


def test_zeros_of_a_lost_page_at_the_end_are_passed_over(small, tmp_path):
    end = chunks_of(small)[-1][1]
    path = tmp_path / "s.mcap.partial"
    path.write_bytes(small.read_bytes()[:end] + bytes(5000))
    done = recover(path)
    assert done.ticks == len(TICKS) and done.lost_bytes == 5000


def test_a_taken_name_is_refused_and_nothing_is_changed(small, tmp_path):
    path = cut(small, chunks_of(small)[-4][1], tmp_path / "s.mcap.partial")
    (tmp_path / "s.mcap").write_bytes(b"precious")
    before = path.read_bytes()
    with pytest.raises(SessionError, match=r"s\.mcap: .*--out") as error:
        recover(path)
    assert "\n" not in str(error.value)
    assert (tmp_path / "s.mcap").read_bytes() == b"precious" and path.read_bytes() == before
    other = recover(path, tmp_path / "other.mcap")
    assert other.path.exists() and path.read_bytes() == before
    with pytest.raises(SessionError, match="exists already"):
        recover(path, other.path)


def test_what_can_not_be_saved_is_told_in_one_line_without_sending_in_circles(small, tmp_path):
    first = chunks_of(small)[0][0]
    for length in (0, 5, 20, 60, 600, first - 1, first, first + 30):
        path = cut(small, length, tmp_path / "s.mcap.partial")
        with pytest.raises(SessionError) as error:
            recover(path)
        said = str(error.value)
        assert said.startswith(str(path)) and "\n" not in said and "flowrec recover" not in said
        assert names_in(tmp_path) == ["s.mcap.partial"]
    for path in (tmp_path / "missing.mcap", tmp_path):
        with pytest.raises(SessionError):
            recover(path)


def test_a_full_disk_leaves_the_remains_as_they_were(small, tmp_path, monkeypatch):
    path = cut(small, chunks_of(small)[-4][1], tmp_path / "s.mcap.partial")

    def refuse(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("flowrec.store.mcap_writer.McapWriter.add_chunks", refuse)
    with pytest.raises(SessionError, match="disk is full") as error:
        recover(path)
    assert "flowrec recover" not in str(error.value)
    assert names_in(tmp_path) == ["s.mcap.partial"]


def test_a_running_recording_is_not_taken_for_remains_and_a_killed_one_is_saved(tmp_path):
    path = tmp_path / "s.mcap"
    partial = tmp_path / "s.mcap.partial"
    with subprocess.Popen(
        [sys.executable, "-c", KILLED, path, Path(__file__).parent],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    ) as run:
        assert run.stdout.readline() == "handed over\n"
        assert is_growing(partial)
        with pytest.raises(SessionError, match="just now"):
            recover(partial)
        run.send_signal(signal.SIGKILL)
        run.stdout.read()
    done = recover(partial)
    assert done.ticks > 150 - 10 and "the last moments" in done.lost
    assert names_in(tmp_path) == ["s.mcap"]
    ticks = list(SessionReader(path).ticks())
    flown = [replace(tick, stamp_ns=(n + 1) * 10**9) for n, tick in enumerate(ticks_of(len(ticks), shape=(8, 8)))]
    assert same_ticks(ticks, flown)


@settings(max_examples=30, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.data())
def test_damage_anywhere_leaves_a_readable_session_or_one_line(small, tmp_path, data):
    content = bytearray(small.read_bytes())
    del content[data.draw(st.integers(len(content) // 2, len(content))) :]
    for _ in range(data.draw(st.integers(1, 3))):
        content[data.draw(st.integers(0, len(content) - 1))] = data.draw(st.integers(0, 255))
    path, out = tmp_path / "damaged.mcap", tmp_path / "out.mcap"
    path.write_bytes(content)
    out.unlink(missing_ok=True)
    told = ""
    try:
        done = recover(path, out)
    except SessionError as error:
        told = str(error)
    if told:
        assert "\n" not in told and str(path) in told and "flowrec recover" not in told
        assert not out.exists()
    else:
        with SessionReader(done.path) as reader:
            assert {tick.stamp_ns for tick in reader.ticks()} <= {tick.stamp_ns for tick in TICKS}
