"""`flowrec check`: the verdict, and that it is the one that a person would come to."""

import json
import re
import signal
import struct
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import Writer

import flowrec
from flowrec.core import CameraLosses, Ended, SessionError, Tick
from flowrec.store import SLOTS, SessionReader, SessionWriter, WriterOptions, recover
from flowrec.verbs.check import check
from flowrec.verbs.verdict import Tally
from tests.conftest import typed
from tests.store.drafts import METADATA, PERIOD_NS, STATISTICS, TICKS, packed_map, small_draft, text
from tests.store.made_up import HEADER, ticks_of, write_session
from tests.store.test_run_files import in_parts

GOLDEN = Path(__file__).parents[2] / "sessions" / "golden_moderate.mcap"
FRAMES, TRACK = SLOTS["/camera/frame"].channel, SLOTS["/robot/track"].channel
APPLIED, TIMING = SLOTS["/coils/applied"].channel, SLOTS["/run/timing"].channel


def file_of(tmp_path, draft, name="s.mcap"):
    path = tmp_path / name
    path.write_bytes(draft.build())
    return path


def only(keep):
    """The draft with the messages that are to be kept, given channel and number of the tick."""
    pieces = []
    for piece in small_draft().pieces:
        kept = tuple(s for s in piece.messages if keep(s.channel, (s.log_ns - 10**9) // PERIOD_NS))
        pieces.append(replace(piece, messages=kept))
    return replace(small_draft(), pieces=tuple(piece for piece in pieces if piece.messages))


def ending(**said):
    return ((METADATA, text("flowrec.outcome") + packed_map(said)),)


def found(verdict):
    return [(finding.about, finding.text) for finding in verdict.findings]


def test_a_real_mission_is_good_and_its_verdict_comes_first(session):
    done = typed("check", session)
    assert done.exit_code == 0
    lines = done.stdout.splitlines()
    assert lines[0].startswith(f"{session.name}: GOOD") and len(lines) < 24
    told = json.loads(typed("check", session, "--json").stdout)
    assert (told["verdict"], told["exit_status"], told["findings"], told["gap_count"]) == ("good", 0, [], 0)
    assert told["topics"] == json.loads(typed("info", session, "--json").stdout)["topics"]
    covered = told["covered"]
    assert covered["whole"] and covered["done"] == covered["total"] == session.stat().st_size
    assert covered["topics"] == list(told["topics"]) and covered["head"]


def test_a_check_that_is_stopped_judges_what_it_has_read_and_no_more(session):
    def stopped_half_way(at):
        if at > session.stat().st_size / 2:
            raise Ended(signal.SIGTERM)

    with pytest.raises(Ended) as stopped:
        check(session, stopped_half_way)
    verdict = stopped.value.result
    assert (verdict.word, verdict.exit_status, verdict.findings) == ("stopped", 143, [])
    assert 0.5 < verdict.covered.done / session.stat().st_size < 1.0 and not verdict.as_json()["covered"]["whole"]
    assert "SIGTERM" in verdict.lines()[0]
    assert all(word not in " ".join(verdict.lines()) for word in ("GOOD", "consistent", "can be replayed"))


def cut_off(session, channel, path):
    """Write the beginning of a session: up to the first chunk of a channel that ends behind 60 % of the file."""
    with session.open("rb") as file:
        chunks = make_reader(file).get_summary().chunk_indexes
    ends = [
        chunk.chunk_start_offset + chunk.chunk_length + chunk.message_index_length
        for chunk in chunks
        if channel in chunk.message_index_offsets
    ]
    path.write_bytes(session.read_bytes()[: next(end for end in sorted(ends) if end > 0.6 * session.stat().st_size)])


# A flush writes the images before the state. A file that ends between the two has images of ticks that it lacks.
@pytest.mark.parametrize(("last", "expected"), [(APPLIED, ["end"]), (FRAMES, ["end", "replay"])])
def test_the_same_session_cut_off_is_not_usable_and_recovered_it_is_with_a_loss(last, expected, session, tmp_path):
    path = tmp_path / "s.mcap.partial"
    cut_off(session, last, path)
    done = typed("check", path)
    assert done.exit_code == 1 and "flowrec recover" in done.stdout
    saved = recover(path)
    verdict = check(saved.path)
    assert verdict.exit_status == 3
    assert [about for about, _ in found(verdict)] == expected
    assert "s.mcap.partial" in found(verdict)[0][1]


def test_a_run_that_is_going_on_is_told_as_such(tmp_path):
    with SessionWriter(tmp_path / "s.mcap", HEADER) as writer:
        for tick in ticks_of(3, shape=(8, 8)):
            writer.write(tick)
        verdict = check(tmp_path / "s.mcap.partial")
        assert verdict.exit_status == 1
        assert any("just now" in said for _, said in found(verdict))


def test_what_is_no_session_is_told_in_one_line_and_in_json(tmp_path):
    foreign = tmp_path / "foreign.mcap"
    with foreign.open("wb") as stream:
        writer = Writer(stream)
        writer.start(profile="ros2", library="other")
        writer.finish()
    with pytest.raises(SessionError, match="ros2"):
        typed("check", foreign)
    for path in (foreign, tmp_path / "missing.mcap", tmp_path):
        done = typed("check", path, "--json")
        told = json.loads(done.stdout)
        assert done.exit_code == 1 and told["verdict"] == "bad" and len(told["findings"]) == 1


def test_a_gap_is_a_time_of_more_than_one_and_a_half_periods(tmp_path):
    verdict = check(file_of(tmp_path, only(lambda channel, tick: tick != 3)))
    assert verdict.exit_status == 3 and verdict.gap_count == 1
    assert (verdict.gaps[0].at_s, verdict.gaps[0].length_s) == pytest.approx((2 / 30, 2 / 30), rel=1e-6)
    assert {"gaps", "drops"} <= {about for about, _ in found(verdict)}


def test_gaps_of_a_later_part_are_told_at_the_time_of_the_run(tmp_path):
    ticks = [tick for number, tick in enumerate(ticks_of(60, shape=(8, 8))) if number not in (10, 50)]
    in_parts(tmp_path / "run.mcap", [30], ticks)
    verdict = check(tmp_path / "run.mcap")
    assert [gap.at_s for gap in verdict.gaps] == pytest.approx([9 / 60, 49 / 60], rel=1e-6)


@pytest.mark.parametrize(("rate_hz", "told"), [(28.0, True), (29.0, False), (31.0, False), (32.0, True)])
def test_another_rate_than_the_stated_one_is_told_from_five_per_cent_on(tmp_path, rate_hz, told):
    golden = flowrec.open(GOLDEN)
    stated_hz = golden.config.camera.rate_hz
    with SessionWriter(tmp_path / "s.mcap", golden.header, WriterOptions(block=True)) as writer:
        for number, tick in enumerate(ticks_of(30, shape=(8, 8))):
            now = round(10**9 * (1.0 + number / (rate_hz / 30.0 * stated_hz)))
            frame = replace(tick.frame, stamp_ns=now)
            track, applied = replace(tick.track, stamp_ns=now), replace(tick.applied, stamp_ns=now)
            writer.write(Tick(now, frame=frame, track=track, applied=applied))
    assert any(about == "rate" for about, _ in found(check(tmp_path / "s.mcap"))) == told


def test_images_that_were_dropped_are_told_apart_from_those_that_are_missing(tmp_path):
    two_missing = only(lambda channel, tick: channel != FRAMES or tick not in (2, 3))
    counted = replace(two_missing, tail=ending(outcome="reached", dropped_frames="2"))
    ((about, told),) = found(check(file_of(tmp_path, counted)))
    ((_, missing),) = [each for each in found(check(file_of(tmp_path, two_missing))) if each[0] == "drops"]
    assert about == "drops" and told.startswith("2 ") and missing.startswith("2 ") and told != missing


def test_what_a_camera_has_lost_is_told_by_cause(tmp_path):
    losses = [
        CameraLosses(at_ns, *of)
        for at_ns, of in ((10**9, (10, 10, 0, 0, 0, 0, 0, 0)), (2 * 10**9, (90, 60, 3, 20, 0, 7, 2, 1)))
    ]
    write_session(
        tmp_path / "s.mcap", (replace(tick, losses=losses[number >= 10]) for number, tick in enumerate(ticks_of(20)))
    )
    verdict = check(tmp_path / "s.mcap")
    assert re.findall(r"\d+", verdict.facts["losses"]) == ["90", "1", "0", "60", "3", "20", "7"]
    said = " ".join(text for _, text in found(verdict))
    assert "2 triggers" in said and "absent 1 times" in said


def test_ticks_that_lack_inputs_are_counted(tmp_path):
    verdict = check(file_of(tmp_path, only(lambda channel, tick: channel != APPLIED or tick != 4)))
    told = dict(found(verdict))
    assert told["replay"].startswith(f"1 of {TICKS} ") and "1 messages of /coils/applied" in told["content"]
    assert verdict.facts["replay"].startswith("yes, but not exact")
    verdict = check(file_of(tmp_path, only(lambda channel, tick: channel == FRAMES)))
    assert verdict.exit_status == 1 and verdict.facts["replay"] == "no"


def test_a_replay_without_images_is_good(tmp_path):
    bare = only(lambda channel, tick: channel != FRAMES)
    pairs = text("file") + text("parent.mcap")
    parent = METADATA, text("flowrec.parent") + struct.pack("<I", len(pairs)) + pairs
    head = tuple(part for part in bare.head if not part[1].startswith(text("flowrec.parent")))
    verdict = check(file_of(tmp_path, replace(bare, head=(*head, parent))))
    assert found(verdict) == [] and "tracks" in verdict.facts["images"]


def test_statistics_that_are_not_what_is_there_are_not_believed(tmp_path):
    def change(index):
        number = next(i for i, part in enumerate(index) if part[0] == STATISTICS)
        body = bytearray(index[number][1])
        at = body.index(struct.pack("<HQ", TRACK, TICKS)) + 2
        body[at : at + 8] = struct.pack("<Q", TICKS + 1)
        index[number] = STATISTICS, bytes(body)
        return index

    path = file_of(tmp_path, replace(small_draft(), change_index=change))
    with pytest.raises(SessionError, match=f"{TICKS + 1} messages of /robot/track .*{TICKS}"):
        list(SessionReader(path).ticks())
    verdict = check(path)
    assert verdict.exit_status == 1 and verdict.findings[0].about == "index"


@pytest.mark.parametrize("jump_s", [0, 3600, -86400])
def test_a_jump_of_the_wall_clock_is_told_and_does_no_harm(tmp_path, jump_s):
    # The draft's head says that both clocks read 1 ns at its beginning.
    ended = ending(outcome="reached", monotonic_ns=str(10**14), wall_ns=str(10**14 + jump_s * 10**9))
    path = file_of(tmp_path, replace(small_draft(), tail=ended))
    verdict = check(path)
    said = [text for about, text in found(verdict) if about == "clocks"]
    assert len(said) == bool(jump_s) and all(f"{jump_s:+.1f} s" in text for text in said)
    assert f" {1000 * jump_s:+d} ms apart" in verdict.facts["clocks"]
    assert [tick.stamp_ns for tick in SessionReader(path).ticks()] == [10**9 + i * PERIOD_NS for i in range(TICKS)]


def test_how_a_run_ended_is_part_of_the_verdict(tmp_path):
    for tail, cause in (((), ""), (ending(outcome="failed", reason="RuntimeError: the pump fell off"), "RuntimeError")):
        verdict = check(file_of(tmp_path, replace(small_draft(), tail=tail)))
        assert verdict.exit_status == 3 and any(about == "end" and cause in text for about, text in found(verdict))


def test_a_configuration_that_is_not_understood_can_not_be_replayed(tmp_path):
    verdict = check(write_session(tmp_path / "made_up.mcap", ticks_of(20, shape=(8, 8))))
    assert verdict.exit_status == 1 and verdict.findings[0].about == "head"


def test_a_track_at_the_border_is_doubted_also_where_the_session_states_no_doubt(tmp_path):
    ticks = list(ticks_of(20, shape=(8, 8)))
    at_border = [replace(tick, track=replace(tick.track, position_um=np.array([0.0, 100.0]))) for tick in ticks]
    for name, recorded, doubted in (("a.mcap", at_border, True), ("b.mcap", ticks, False)):
        (file,) = in_parts(tmp_path / name, [], recorded)
        assert any("border" in finding.text for finding in check(file).findings) is doubted


@pytest.mark.parametrize("frame", [True, False])
@pytest.mark.parametrize("track", [True, False])
@pytest.mark.parametrize("applied", ["", "with an image", "of an absent camera"])
def test_a_tick_can_be_replayed_with_a_report_of_the_coils_and_an_image_or_a_track(frame, track, applied):
    tally, tick = Tally(), next(ticks_of(1))
    if frame:
        tally.add("frame", 1, tick.frame)
    if applied:
        absent = {"absent_until_ns": tick.stamp_ns} if "absent" in applied else {}
        tally.add("applied", 1, replace(tick.applied, **absent))
    if track:
        tally.add("track", 1, tick.track)
    tally.close()
    alone = frame and not applied and not track
    missing = not alone and (not applied or not (frame or track or "absent" in applied))
    none = not (frame or track or applied)
    assert (tally.ticks, tally.images_alone) == (int(not alone and not none), int(alone))
    assert tally.inputs_missing == int(missing and not none)
