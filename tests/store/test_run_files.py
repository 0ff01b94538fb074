"""Names of the files of a run. A run in parts is read as if it had never been split; each part is readable alone."""

import json
import shutil
from dataclasses import replace
from functools import cache
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from flowrec.core import BY_FIELD, Frame, SessionError, Tick
from flowrec.physics import load_chip
from flowrec.stages import load_config
from flowrec.stages.resolve import resolve
from flowrec.store import (
    Part,
    Session,
    SessionReader,
    SessionWriter,
    WriterOptions,
    part_path,
    recover_run,
    run_path,
    session_header,
    session_sha256,
)
from flowrec.store.run_files import Run, RunFile, partial_path, parts, run_files, snapshot_path
from flowrec.store.session_file import Split
from flowrec.verbs import Change
from flowrec.verbs import session_replay as verb
from flowrec.verbs.check import check
from flowrec.verbs.compare import compare
from flowrec.verbs.info import info
from flowrec.verbs.ls import ls
from flowrec.verbs.record import record
from tests.conftest import typed
from tests.short_missions import SMALL
from tests.store.made_up import same, ticks_of, write_session

TICKS = list(ticks_of(60, shape=(8, 8)))
# What a simulator knows is in a tick only when it is new: the part after repeats less than was ever known.
SPARSE = [
    replace(now, true_field=None) if now.true_field is before.true_field else now
    for before, now in zip([Tick(), *TICKS], TICKS, strict=False)
]


@cache
def header_at_60_hz():
    config = load_config(None, ["camera.rate_hz=60"])
    chip = load_chip(config.chip)
    return session_header(resolve(config, chip), chip)


def in_parts(path, cuts, ticks=SPARSE, header=None, outcome=None):
    """Write ticks as the parts of a run that are cut before these; their files."""
    bounds = [0, *sorted(cuts), len(ticks)]
    files = []
    for number, (begin, end) in enumerate(pairwise(bounds), 1):
        carried = ticks[begin - 1] if begin else None
        part = Part("one run", number, keyframe_ns=None if carried is None else carried.stamp_ns)
        following = part_path(path, number + 1).name
        last = number == len(bounds) - 1
        write_session(
            part_path(path, number),
            [*([carried] if carried is not None else []), *ticks[begin:end]],
            replace(header or header_at_60_hz(), part=part),
            outcome=outcome or {"outcome": "reached"} if last else {"outcome": "continued", "next": following},
        )
        files.append(part_path(path, number))
    return files


def news(ticks, before):
    for tick in ticks:
        yield [field for field in BY_FIELD if getattr(tick, field) is not getattr(before, field)]
        before = tick


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    path = tmp_path_factory.mktemp("whole") / "x.mcap"
    write_session(path, SPARSE, header_at_60_hz(), outcome={"outcome": "reached"})
    return SessionReader(path)


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    return in_parts(tmp_path_factory.mktemp("parts") / "x.mcap", [11, 12, 40])


@pytest.fixture
def run(written, tmp_path):
    for file in written:
        shutil.copy(file, tmp_path)
    return tmp_path / "x.mcap"


@pytest.mark.slow("reads a session from many times, cut in many ways")
@settings(max_examples=12, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(cuts=st.sets(st.integers(1, len(TICKS) - 1), max_size=6), late=st.integers(-1, len(TICKS)), data=st.data())
def test_however_a_session_is_cut_its_ticks_are_the_same_from_any_time(whole, tmp_path_factory, cuts, late, data):
    path = tmp_path_factory.mktemp("cut") / "x.mcap"
    files = in_parts(path, cuts)
    start_ns = None if late < 0 else TICKS[min(late, len(TICKS) - 1)].stamp_ns + (late == len(TICKS))
    with_frames = data.draw(st.booleans())
    with SessionReader(path) as reader:
        before, expected = Tick(), Tick()
        if start_ns is not None:
            before = reader.tick_before(start_ns - 1, with_frames=with_frames)
            expected = whole.tick_before(start_ns - 1, with_frames=with_frames)
            assert same(before, expected)
        mine = list(reader.ticks(start_ns, with_frames=with_frames))
        theirs = list(whole.ticks(start_ns, with_frames=with_frames))
        assert len(mine) == len(theirs) and all(map(same, mine, theirs))
        assert list(news(mine, before)) == list(news(theirs, expected))
        assert (reader.first_ns, reader.last_ns, reader.counts) == (whole.first_ns, whole.last_ns, whole.counts)
        assert reader.outcome == whole.outcome and reader.header == replace(
            header_at_60_hz(), part=Part("one run", 1, keyframe_ns=None)
        )
        for field in ("frame", "true_field", "route"):
            messages = list(reader.messages(field))
            assert [message.stamp_ns for message in messages] == [m.stamp_ns for m in whole.messages(field)]
        assert reader.files == files
    number = data.draw(st.integers(1, len(files)))
    with SessionReader(files[number - 1]) as part:
        ticks = list(part.ticks())
        assert (ticks[0].stamp_ns == part.keyframe_ns) == (number > 1)
        assert all(same(tick, replace(whole.tick_before(tick.stamp_ns), true_field=tick.true_field)) for tick in ticks)


@pytest.mark.slow("writes and reads a run of very many parts")
def test_a_run_of_very_many_parts_needs_few_open_files(tmp_path):
    import resource

    in_parts(tmp_path / "x.mcap", range(1, 60))
    limits = resource.getrlimit(resource.RLIMIT_NOFILE)
    reader = SessionReader(tmp_path / "x.mcap")
    resource.setrlimit(resource.RLIMIT_NOFILE, (len(list((tmp_path / "/proc/self/fd").iterdir())) + 12, limits[1]))
    try:
        together = [reader.ticks(tick.stamp_ns) for tick in TICKS[::20]]  # several iterations at a time
        firsts = [next(ticks) for ticks in together]
        assert [tick.stamp_ns for tick in firsts] == [tick.stamp_ns for tick in TICKS[::20]]
        assert [sum(1 for _ in ticks) for ticks in together] == [59, 39, 19]
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, limits)


def damage(run, what):
    first, second, third, last = (part_path(run, number) for number in (1, 2, 3, 4))
    other = run.with_name("y.mcap")
    if what == "no first":
        first.unlink()
    elif what == "gap":
        third.unlink()
    elif what == "no end":
        last.unlink()
    elif what == "exchanged":
        second.rename(run.with_name("z")), third.rename(second), run.with_name("z").rename(third)
    elif what == "another run":
        in_parts(other, [11, 12, 40])
        _rewritten(part_path(other, 2), second, lambda part: replace(part, run="another"))
    elif what == "other cuts":
        in_parts(other, [11, 30, 40])
        part_path(other, 3).replace(third)
    elif what == "another head":
        in_parts(
            other, [11, 12, 40], header=replace(header_at_60_hz(), config_toml=header_at_60_hz().config_toml + "\n")
        )
        part_path(other, 2).replace(second)
    elif what == "no part":
        with SessionWriter(second, header_at_60_hz(), WriterOptions(overwrite=True)) as writer:
            writer.write(TICKS[11])
    elif what == "carries too early":
        in_parts(other, [10, 11, 12, 40])
        _rewritten(part_path(other, 2), first, lambda part: replace(part, number=1))


def _rewritten(source, target, change):
    with SessionReader(source) as reader:
        header = replace(reader.header, part=change(reader.header.part))
        write_session(target, reader.ticks(), header, overwrite=True, outcome={"outcome": "continued"})


@pytest.mark.parametrize(
    ("what", "said"),
    [
        ("no first", r"x.part001.mcap: is missing"),
        ("gap", r"x.part003.mcap: is missing"),
        ("no end", r"x.part004.mcap: is missing, though x.part003.mcap says .*recover .*x.mcap"),
        ("exchanged", r"x.part002.mcap: is part 3 of a run by what it says, and 2 by its name"),
        ("another run", r"x.part002.mcap: is of another run than x.part001.mcap"),
        ("other cuts", r"x.part003.mcap: begins 0.300 s after the end of x.part002.mcap"),
        ("another head", r"x.part002.mcap: has another head than x.part001.mcap"),
        ("no part", r"x.part002.mcap: is named like a part of a run and is none"),
        ("carries too early", r"x.part001.mcap: is named as the first part and continues another one"),
    ],
)
def test_parts_that_make_no_run_are_refused_in_one_line_and_judged(run, what, said):
    damage(run, what)
    with pytest.raises(SessionError, match=said) as error:
        list(SessionReader(run).ticks())
    assert len(str(error.value).splitlines()) == 1
    verdict = check(run)
    assert verdict.exit_status == 1 and any(finding.about in ("parts", "end") for finding in verdict.findings)
    left = [path for path in run.parent.glob("x.part*.mcap") if what != "no part"]
    assert all(list(SessionReader(path).ticks()) for path in left)


def test_a_run_that_goes_on_or_was_killed_is_refused_as_such(run):
    last = part_path(run, 4)
    last.rename(partial_path(last))
    with pytest.raises(SessionError, match=r"was not finished .*x\.part004\.mcap\.partial.*recover .*x\.mcap`"):
        SessionReader(run)
    assert [(row.name, row.outcome, row.parts) for row in ls([run.parent])] == [("x.mcap", "unfinished", 4)]
    partial_path(last).unlink()
    with SessionWriter(last, header_at_60_hz()):
        with pytest.raises(SessionError, match="just now"):
            SessionReader(run)
        assert [row.outcome for row in ls([run.parent])] == ["recording"]


@pytest.mark.parametrize("left", ["all but the index", "half", "no message", "nothing", "no file"])
def test_recover_makes_a_run_whole_whatever_is_left_of_its_last_part(run, whole, left):
    last = part_path(run, 4)
    content = last.read_bytes()
    last.unlink()
    keep = {
        "all but the index": -100,
        "half": len(content) // 2,
        "no message": content.index(b"zstd") - 60,
        "nothing": 0,
    }
    if left != "no file":
        partial_path(last).write_bytes(content[: keep[left]])
    (done,) = recover_run(run)
    assert done.path == last and not partial_path(last).exists()
    reader = SessionReader(run)
    # Images may be on the disk before the rest of their ticks; a replay passes over these.
    ticks = [tick for tick in reader.ticks() if tick.applied.stamp_ns == tick.stamp_ns]
    assert all(map(same, ticks, whole.ticks()))
    assert SessionReader(last).part == Part("one run", 4, keyframe_ns=TICKS[39].stamp_ns)
    assert len(ticks) == 40 + done.ticks == int(reader.outcome["ticks"]) and done.complete == (len(ticks) == 60)
    assert reader.outcome["outcome"] == ("reached" if done.complete else "cut")
    assert check(run).word == ("good" if done.complete else "usable")
    assert [again.changed for again in recover_run(run)] == [False]


@pytest.fixture
def rrd_only_begun(monkeypatch):
    """What Rerun makes of a session is tested elsewhere, and takes its time."""
    monkeypatch.setattr("flowrec.exports.rrd.write_rrd", lambda *_, **__: None)


def test_the_verbs_take_the_run(run, whole, tmp_path, rrd_only_begun):
    verdict = check(run)
    assert (verdict.word, verdict.exit_status, len(verdict.parts)) == ("good", 0, 4), verdict.lines()
    assert verdict.facts["parts"] == "4, each begins where the part before ends"
    assert (
        verdict.topics == {BY_FIELD[field].path: count for field, count in whole.counts.items()} == Session(run).topics
    )
    assert info(run)["parts"] == 4
    assert "part 2 of the run x, goes on from 1.17 s" in info(part_path(run, 2))["piece"]
    (row,) = ls([run.parent])
    assert (row.name, row.outcome, row.parts) == ("x.mcap", "reached", 4)
    assert compare(run, whole.path).identical
    files = SessionReader(run).files
    joined = tmp_path / "joined"
    joined.write_bytes(b"".join(file.read_bytes() for file in files))
    assert session_sha256(files) == session_sha256([joined])


def test_a_part_that_repeats_something_else_is_odd(run):
    second = part_path(run, 3)
    with SessionReader(second) as reader:
        ticks = list(reader.ticks())
        ticks[0] = replace(ticks[0], estimate=replace(ticks[0].estimate, stamp_ns=5))
        write_session(second, ticks, reader.header, overwrite=True, outcome=reader.outcome)
    verdict = check(run)
    assert verdict.exit_status == 3
    (finding,) = verdict.findings
    assert "part 3" in finding.text and finding.text.endswith("/robot/estimate")


@pytest.mark.slow("replays a run and each of its parts")
def test_a_replay_of_the_run_and_of_each_part_alone_is_exact_wherever_it_was_cut(session, tmp_path):
    with SessionReader(session) as reader:
        ticks, header = list(reader.ticks()), reader.header
    path = tmp_path / "x.mcap"
    waits = [i for i, tick in enumerate(ticks) if tick.mission is not None and tick.mission.wanted]
    orders = [i for i in waits if ticks[i - 1].mission is None or ticks[i].mission is not ticks[i - 1].mission]
    files = in_parts(path, {order + 2 for order in orders}, ticks, header)  # in the middle of each order
    for file in (path, *files):
        done = verb.replay_session(file, Change(), verify=True)
        same_again, lines = done.same, done.lines()
        assert same_again and done.comparison.identical, lines
        assert (done.worker is not None and done.worker.lines) or file == files[0]
    # What is planned or refined anew from a part alone goes out from what the part knows.
    done = verb.replay_session(files[-1], Change(refine="assimilate"), out=tmp_path / "again.mcap")
    assert done.replayed.refined is not None
    assert SessionReader(tmp_path / "again.mcap").header.parent["sha256"] == session_sha256([files[-1]])


@pytest.mark.slow("flies a survey by information")
def test_a_stretch_of_a_survey_that_was_ordered_before_a_part_begins_is_taken_as_recorded(tmp_path):
    sets = [*SMALL, "survey.method=information", "survey.worth=0.03", "mission.phases=survey"]
    with SessionReader(record(load_config(None, sets), tmp_path / "survey.mcap").path) as reader:
        ticks, header = list(reader.ticks()), reader.header
    (cut,) = [
        i + 2
        for i, tick in enumerate(ticks)
        if tick.mission.wanted == "survey_route"
        and tick.mission.phase == "survey"
        and tick.mission.stamp_ns == tick.stamp_ns
    ][-1:]
    _, part = in_parts(tmp_path / "x.mcap", {cut}, ticks, header)
    done = verb.replay_session(part, Change(), verify=True)
    assert done.comparison.identical, done.lines()
    assert "/plan/route: ordered in the part before, taken as recorded" in done.lines()
    assert done.worker.computed == done.worker.adopted - 1


def test_recover_and_export_answer_in_json(run, rrd_only_begun):
    partial = partial_path(part_path(run, 4))
    part_path(run, 4).rename(partial)
    done = typed("recover", run, "--json")
    (told,) = json.loads(done.stdout)
    assert told["path"].endswith("x.part004.mcap") and told["ticks"] == 20 and done.exit_code == 0


@pytest.mark.parametrize("make", [lambda p: p, lambda p: part_path(p, 7), lambda p: snapshot_path(p, 1234)])
def test_the_run_of_a_file_is_known_from_its_name(make):
    run = Path("somewhere/a.part.of.it.mcap")
    assert run_path(make(run)) == run
    assert run_path(partial_path(make(run))) == run


def test_parts_are_in_order_of_their_number_and_nothing_else_is_among_them(tmp_path):
    run = tmp_path / "x.mcap"
    numbers = (2, 999, 1000, 1)
    others = (snapshot_path(run, 1), partial_path(part_path(run, 3)), part_path(tmp_path / "xy.mcap", 1))
    for path in (*(part_path(run, number) for number in numbers), *others):
        path.touch()
    assert parts(run) == [part_path(run, number) for number in sorted(numbers)]
    assert set(run_files(run)) == {part_path(run, number) for number in numbers} | set(others[:2])


def test_of_the_counts_of_parts_there_is_the_sum_and_of_what_is_told_of_the_last_alone_nothing():
    told = {"outcome": "continued", "ticks": "7", "dropped_frames": "2", "frames_windows": "5 of 7 images"}
    last = told | {"outcome": "reached", "ticks": "11", "note": "at the goal", "frames_missing_from_camera": "3"}
    names = [part_path(Path("x.mcap"), number) for number in (1, 2)]
    files = [RunFile(name, None, 0, 1, {}, outcome, 0, None) for name, outcome in zip(names, (told, last), strict=True)]
    both = {"outcome": "reached", "ticks": "18", "dropped_frames": "4", "note": "at the goal"}
    assert Run(Path("x.mcap"), files).outcome == both | {"frames_missing_from_camera": "3"}
    assert Run(names[1], files[1:]).outcome == last


def test_a_run_of_deep_images_without_its_last_part_is_given_an_end(tmp_path):
    deep = [
        replace(tick, frame=Frame(tick.stamp_ns, number, tick.frame.image.astype(np.uint16) << 3, 12))
        for number, tick in enumerate(ticks_of(60, shape=(16, 16)))
    ]
    write_session(tmp_path / "x.mcap", deep, files=Split(seconds=0.3), bits=12, outcome={"outcome": "reached"})
    *kept, last = parts(tmp_path / "x.mcap")
    last.unlink()
    assert len(kept) > 1 and recover_run(tmp_path / "x.mcap")[-1].lost == f"everything after {kept[-1].name}"
    whole = SessionReader(tmp_path / "x.mcap")
    assert whole.frame_bits == 12 and whole.outcome["outcome"] == "cut"
    assert all(same(one, other) for one, other in zip(whole.ticks(), deep, strict=False))
