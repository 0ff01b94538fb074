"""A movie and a log of a simulated run become a session of their own, which replays exactly and knows no truth."""

from __future__ import annotations

import csv
import hashlib
import json
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

import flowrec
from flowrec.core import FlowrecError, MovieError, UsageError
from flowrec.physics import chip_files, relative_rmse
from flowrec.stages import Config, load_config
from tests.conftest import run
from tests.movies import makers

SHORT = 75
HEADER = ("time_s", "frequency_hz", "heading_deg", "amplitude_mt")


@dataclass
class Laboratory:
    """What a laboratory has of a run, and the truth that it does not have."""

    folder: Path
    config: Config
    log: Path
    images: list[np.ndarray]
    stamps_ns: list[int]
    truth: flowrec.Session

    @property
    def rate_hz(self) -> float:
        return 1e9 * (len(self.stamps_ns) - 1) / (self.stamps_ns[-1] - self.stamps_ns[0])

    @property
    def seconds(self) -> np.ndarray:
        return np.array(self.stamps_ns) / 1e9

    def table(self, name: str, rows: list[tuple[object, ...]]) -> Path:
        with (self.folder / name).open("w", newline="") as file:
            csv.writer(file).writerows(rows)
        return self.folder / name

    def times(self, name: str = "frames.csv", seconds: np.ndarray | None = None) -> Path:
        seconds = self.seconds if seconds is None else seconds
        return self.table(name, [("frame", "time_s"), *((n, f"{t:.9f}") for n, t in enumerate(seconds))])

    def error(self, session: Path) -> float:
        """Of the refined flow."""
        found = flowrec.open(session).fields
        return relative_rmse(found["refined"], self.truth.fields["true"], self.truth.chip.mask).v


@pytest.fixture(scope="module")
def lab(session: Path, tmp_path_factory: pytest.TempPathFactory) -> Laboratory:
    folder, truth = tmp_path_factory.mktemp("lab"), flowrec.open(session)
    png, toml = chip_files(truth.chip)
    (folder / "chip.png").write_bytes(png)
    (folder / "chip.toml").write_text(toml, encoding="utf-8")
    ticks = list(truth.ticks())
    rows: list[tuple[object, ...]] = [HEADER]
    for tick in ticks:
        c = tick.currents
        rows.append((f"{tick.stamp_ns / 1e9:.4f}", c.frequency_hz, np.degrees(c.heading_rad), c.amplitude_mt))
    known = [f"robot.{key}={getattr(truth.config.robot, key)}" for key in ("radius_um", "um_per_rev", "delay_s")]
    known += [f"camera.um_per_px={truth.config.camera.um_per_px}", f"chip.path={folder / 'chip.toml'}"]
    known += ["refine.assimilate.doubt_depth=false", "recording.own_process=false"]  # as the run
    images, stamps = [tick.frame.image for tick in ticks], [tick.stamp_ns for tick in ticks]
    made = Laboratory(folder, load_config(None, known), folder, images, stamps, truth)
    made.log = made.table("log.csv", rows)
    makers.folder(folder / "pngs", images)
    makers.video(folder / "film.avi", "mjpeg", images, made.rate_hz)
    makers.video(folder / "short.avi", "mjpeg", images[:SHORT], made.rate_hz)  # where the flow is not looked at
    return made


@pytest.fixture(scope="module")
def imported(lab: Laboratory) -> Path:
    """Of images, times in a table and a log."""
    out = lab.folder / "pngs.mcap"
    done = flowrec.import_movie(lab.folder / "pngs", out, lab.config, coils=lab.log, times=lab.times())
    assert done.exit_status == 0 and done.report.outcome == "observe complete"
    return out


def test_an_imported_session_is_exact_good_and_refines_the_flow_as_the_run_itself_did(
    lab: Laboratory, imported: Path
) -> None:
    session = flowrec.open(imported)
    ticks = [tick for tick in session.ticks() if tick.frame is not None]
    frames = list(session.frames)
    assert [frame.stamp_ns for frame in frames] == lab.stamps_ns
    for frame, image in zip(frames, lab.images, strict=True):
        np.testing.assert_array_equal(frame.image, image)
    assert flowrec.replay(imported, verify=True).same
    assert flowrec.check(imported).word == "good"
    assert session.fields.keys() == {"assumed", "refined"}  # no truth
    assert (
        lab.error(imported)
        < 0.02
        < 0.1
        < relative_rmse(session.fields["assumed"], lab.truth.fields["true"], lab.truth.chip.mask).v
    )
    # The log is of commands; the turns of the rig's own field, which turns its plane, are those of the truth.
    turns = sum(tick.applied.turns for tick in ticks)
    true_turns = sum(tick.applied.turns for tick in lab.truth.ticks(with_frames=False))
    np.testing.assert_allclose(turns, true_turns, atol=0.3)


def test_the_head_of_the_session_says_what_it_was_made_of(lab: Laboratory, imported: Path) -> None:
    avi = lab.folder / "short.avi"
    out = lab.folder / "stated.mcap"
    flowrec.import_movie(avi, out, lab.config, coils=lab.log, align=False)
    facts = flowrec.info(out)
    assert facts["source_sha256"] == hashlib.sha256(avi.read_bytes()).hexdigest()
    assert facts["coil_log_sha256"] == hashlib.sha256(lab.log.read_bytes()).hexdigest()
    assert facts["source_bytes"] == avi.stat().st_size and facts["rig"] == "movie" and facts["phases"] == ["observe"]
    assert "mjpeg" in facts["source_codec"] and "lossy" in facts["source_codec"]
    assert "nominal rate" in facts["source_times"] and "PyAV" in facts["source_reader"]
    assert flowrec.info(imported)["times_file"] == "frames.csv" and "seed" not in facts


@pytest.mark.slow("replays a whole movie three times")
def test_a_session_that_was_imported_replays_with_other_settings(lab: Laboratory, imported: Path) -> None:
    out = lab.folder / "again.mcap"
    flowrec.replay(imported, flowrec.Change(observer="luenberger", sets=("robot.um_per_rev=20",)), out=out)
    again = flowrec.open(out)
    assert (again.config.observer.method, again.config.rig) == ("luenberger", "movie") and "refined" in again.fields
    assert lab.error(out) > 2.0 * lab.error(imported)  # a robot that rolls 20 um per revolution was another one


@pytest.mark.slow("imports a movie and refines by it")
def test_without_a_log_the_movie_is_still_a_session_that_says_what_it_does_not_know(
    lab: Laboratory, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = lab.folder / "watched.mcap"
    done = flowrec.import_movie(lab.folder / "short.avi", out, lab.config)
    # Nothing that was asked for is missing, so the status is 0; nothing is called refined that was not.
    assert done.exit_status == 0 and not done.doubts and "refined_method" not in done.facts
    assert str(done.facts["not_refined"]).startswith("because there is no log of the coils")
    assert flowrec.info(out)["not_refined"] == done.facts["not_refined"]
    assert flowrec.replay(out, verify=True).same
    said = capsys.readouterr().err
    assert "without --coils LOG the robot is tracked, and the flow is not refined" in said
    assert not any("no log of the coils" in line for line in done.lines()), "an event of the run has said it"
    assert "observes_flow" not in said
    assert flowrec.info(out)["coil_log_file"].startswith("none")
    session = flowrec.open(out)
    assert not any(tick.applied.turns.any() for tick in session.ticks(with_frames=False))
    moved = np.linalg.norm([each.flow_um_s for each in session.messages("estimate")], axis=1)
    assert np.median(moved) > 30.0  # what carried the robot, the coils' part included
    said = [event.text for event in session.events if "refined flow" in event.text]
    assert len(said) == 1
    assert said[0].startswith("refined flow refused, the map in use stays: there is no log of the coils")
    maps = session.fields
    assert maps["refined"].refused and "movie.drifts=true" in maps["refined"].refused
    np.testing.assert_array_equal(maps["refined"].velocity_um_s, maps["assumed"].velocity_um_s)
    flowrec.replay(out, out=tmp_path / "replayed.mcap", refine="gain")  # by no other method either
    assert flowrec.open(tmp_path / "replayed.mcap").fields["refined"].refused


@pytest.mark.slow("imports a whole movie")
def test_a_body_that_only_drifts_shows_the_flow_without_a_log(
    lab: Laboratory, capsys: pytest.CaptureFixture[str]
) -> None:
    drifting = replace(lab.config, movie=replace(lab.config.movie, drifts=True))
    out = lab.folder / "drifting.mcap"
    assert flowrec.import_movie(lab.folder / "short.avi", out, drifting).exit_status == 0
    assert "not refined" not in capsys.readouterr().err
    maps = flowrec.open(out).fields
    assert not maps["refined"].refused and maps["refined"].method == "assimilate"
    assert flowrec.info(out)["coil_log_file"] == "none: movie.drifts: the motion is that of the flow"
    with pytest.raises(UsageError, match=r"movie.drifts = true says that nothing drove the body, and .*log.csv is a"):
        flowrec.import_movie(lab.folder / "short.avi", out, drifting, coils=lab.log, overwrite=True)


@pytest.mark.slow("imports a whole movie twice")
def test_a_robot_acts_on_the_log_its_delay_later(lab: Laboratory) -> None:
    rows = [HEADER, (0, 0, 0, 4), (1.0, 12, 90, 4), (1.5, 0, 90, 4)]
    log = lab.table("step.csv", rows)
    out = lab.folder / "step.mcap"
    flowrec.import_movie(lab.folder / "short.avi", out, lab.config, coils=log, align=False)
    ticks = [tick.applied for tick in flowrec.open(out).ticks(with_frames=False)]
    np.testing.assert_allclose(sum(applied.turns for applied in ticks), [0.0, 6.0], atol=1e-6)
    delay_s = lab.config.robot.delay_s
    turning = [applied.stamp_ns / 1e9 for applied in ticks if applied.frequency_hz == 12.0]
    first, last = turning[0], turning[-1]
    frame_s = 1.0 / lab.rate_hz
    assert 0.0 <= first - 1.0 - delay_s < frame_s + 1e-6 and -frame_s - 1e-6 < last - 1.5 - delay_s < 0.0


@pytest.mark.slow("imports a movie for each setting")
def test_clock_and_heading_of_the_log_are_set_by_four_settings(lab: Laboratory) -> None:
    """A log with another zero and rate, and a mirrored heading, gives the turns of the right one."""
    rate, offset = 1.2, 7.25  # the movie says 1 s where 1.2 s of the log pass
    rows = list(csv.reader(lab.log.read_text().splitlines()))
    other = [rows[0], *((offset + float(t), f, 25.0 - float(h), a) for t, f, h, a in rows[1:])]
    log = lab.table("other.csv", [tuple(row) for row in other])
    keys = {"clock_rate": rate, "clock_offset_s": offset, "heading_offset_deg": 25.0, "heading_mirrored": "true"}
    outs = []
    for name, fps, path, sets in (
        ("right", lab.rate_hz, lab.log, []),
        ("set", lab.rate_hz * rate, log, [f"movie.{key}={value}" for key, value in keys.items()]),
    ):
        config = flowrec.stages.config.with_sets(lab.config, sets)
        outs.append(lab.folder / f"{name}.mcap")
        flowrec.import_movie(lab.folder / "short.avi", outs[-1], config, coils=path, fps=fps, align=False)
    right, other_turns = (
        np.array([tick.applied.turns for tick in flowrec.open(out).ticks(with_frames=False)]) for out in outs
    )
    np.testing.assert_allclose(right, other_turns, atol=1e-6)


def test_what_no_file_tells_is_asked_for_in_one_line(lab: Laboratory, tmp_path: Path) -> None:
    with pytest.raises(UsageError) as refused:
        flowrec.import_movie(lab.folder / "film.avi", tmp_path / "a.mcap", coils=lab.log)
    text = str(refused.value)
    assert "it does not tell camera.um_per_px, robot.radius_um, chip.path" in text and "\n" not in text
    assert "[camera] um_per_px" in text and "320 x 256 pixels of 8 bit" in text
    assert not list(tmp_path.iterdir())


BAD = {
    "no times": (lambda lab: {"movie": "pngs"}, "does not tell when its images were taken; give the times"),
    "too few times": (
        lambda lab: {"movie": "pngs", "times": lab.times("few.csv", lab.seconds[:-3])},
        r"few.csv: has \d+ rows, and .*pngs \d+ images",
    ),
    "too many times": (
        lambda lab: {"movie": "short.avi", "times": lab.times("many.csv", lab.seconds[: SHORT + 1])},
        r"many.csv: has \d+ rows, and .*short.avi \d+ images",
    ),
    "times that go back": (
        lambda lab: {"movie": "pngs", "times": lab.times("back.csv", lab.seconds[::-1])},
        "back.csv: the time of image 1 is .*, not after that of the one before",
    ),
    "two kinds of times": (
        lambda lab: {"movie": "pngs", "times": lab.times(), "fps": 30.0},
        "give one of --times and --fps",
    ),
    "log of another day": (
        lambda lab: {"coils": lab.table("late.csv", [HEADER, (1e6, 1, 0, 4), (1e6 + 9, 1, 0, 4)])},
        "does not overlap the movie",
    ),
    "field that never turns": (
        lambda lab: {"coils": lab.table("still.csv", [HEADER, (0, 9, 0, 0)])},
        "the field never turns",
    ),
    "NaN": (
        lambda lab: {"coils": lab.table("nan.csv", [HEADER, (0, "nan", 0, 4)])},
        "line 2: frequency_hz is nan",
    ),
    "no log": (lambda lab: {"coils": lab.folder / "absent.csv"}, "absent.csv: no such file"),
    "truncated": (lambda lab: {"movie": "cut.avi"}, r"breaks off: .* --partial takes the \d+ images before it"),
    "no movie": (lambda lab: {"movie": "chip.toml"}, "no movie that can be read"),
    "damaged": (lambda lab: {"movie": "damaged", "fps": 30.0}, r"img_40.png: .* or --partial takes the 40 images"),
}  # fmt: skip


@pytest.mark.parametrize("kind", BAD)
def test_bad_input_is_one_line_and_leaves_what_was_there(kind: str, lab: Laboratory, tmp_path: Path) -> None:
    if not (lab.folder / "cut.avi").exists():
        data = (lab.folder / "film.avi").read_bytes()
        (lab.folder / "cut.avi").write_bytes(data[: len(data) // 2])
        makers.folder(lab.folder / "damaged", lab.images)
        whole = (lab.folder / "damaged" / "img_40.png").read_bytes()
        (lab.folder / "damaged" / "img_40.png").write_bytes(whole[: len(whole) // 3])
    make, why = BAD[kind]
    given = {"movie": "film.avi", "coils": lab.log} | make(lab)
    movie = lab.folder / str(given.pop("movie"))
    with pytest.raises(FlowrecError, match=why) as refused:
        flowrec.import_movie(movie, tmp_path / "a.mcap", lab.config, align=False, **given)
    assert "\n" not in str(refused.value) and not list(tmp_path.iterdir())
    (tmp_path / "a.mcap").write_bytes(b"what was there")
    with pytest.raises(FlowrecError, match=why):
        flowrec.import_movie(movie, tmp_path / "a.mcap", lab.config, overwrite=True, align=False, **given)
    assert [each.name for each in tmp_path.iterdir()] == ["a.mcap"]
    assert (tmp_path / "a.mcap").read_bytes() == b"what was there"


@pytest.mark.slow("imports a whole movie twice")
def test_a_movie_that_breaks_off_is_taken_as_far_as_it_goes_if_that_is_said(
    lab: Laboratory, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    data = (lab.folder / "film.avi").read_bytes()
    (tmp_path / "cut.avi").write_bytes(data[: len(data) // 2])
    toml = tmp_path / "my.toml"
    toml.write_text(flowrec.stages.config.to_toml(lab.config), encoding="utf-8")
    words = ["import", tmp_path / "cut.avi", toml, "-o", tmp_path / "cut.mcap", "--coils", lab.log, "--no-align"]
    assert run(words) == 2
    refused = capsys.readouterr().err.strip().splitlines()
    assert len(refused) == 1 and "breaks off" in refused[0]
    assert run([*words, "--partial", "--json"]) == 3  # so short a motion does not confirm the log's axes
    found = json.loads(capsys.readouterr().out)
    assert found["outcome"] == "observe complete" and "the axes of the log are not confirmed" in found["doubts"]
    frames = list(flowrec.open(tmp_path / "cut.mcap").frames)
    assert 30 < len(frames) < len(lab.images)
    assert f"only the first {len(frames)} images were taken" in flowrec.info(tmp_path / "cut.mcap")["source_remarks"]


def test_a_session_never_replaces_what_it_is_made_of(lab: Laboratory, tmp_path: Path) -> None:
    movie = makers.video(tmp_path / "film.avi", "mjpeg", lab.images[:10], 30.0).rename(tmp_path / "film.mcap")
    with pytest.raises(FlowrecError, match="film"):
        flowrec.import_movie(movie, movie, lab.config, overwrite=True)
    assert movie.exists()


@pytest.mark.slow("imports a movie twice")
def test_walls_that_are_not_where_the_registration_says_are_told_before_the_import_and_in_the_file(
    lab: Laboratory, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    makers.folder(tmp_path / "few", lab.images[:40:4])
    for angle_deg, told in ((0.0, False), (2.0, True)):
        config = replace(lab.config, camera=replace(lab.config.camera, angle_deg=angle_deg))
        flowrec.import_movie(tmp_path / "few", tmp_path / f"{angle_deg}.mcap", config, fps=10.0)
        assert ("px from where the registration puts it" in capsys.readouterr().err) == told
        assert ("px from where" in flowrec.info(tmp_path / f"{angle_deg}.mcap")["source_walls"]) == told


@pytest.mark.parametrize(
    ("share", "way"),
    [
        pytest.param(-0.05, "small", marks=pytest.mark.slow("imports a movie; what is measured: the walls' own test")),
        pytest.param(0.0, "", marks=pytest.mark.slow("imports a movie of the right scale")),
        pytest.param(0.05, "large", marks=pytest.mark.slow("imports a movie, to the other side")),
    ],
)
def test_a_scale_that_the_walls_contradict_makes_the_import_doubtful_with_the_setting_to_paste(
    share: float, way: str, lab: Laboratory, tmp_path: Path
) -> None:
    right_um = lab.config.camera.um_per_px
    makers.folder(tmp_path / "few", lab.images[:40:4])
    stated = replace(lab.config, camera=replace(lab.config.camera, um_per_px=right_um * (1.0 + share)))
    done = flowrec.import_movie(tmp_path / "few", tmp_path / "a.mcap", stated, fps=10.0)
    told = [doubt for doubt in done.doubts if f"5.0 % too {way or '.'} for the walls" in doubt]
    assert len(told) == bool(share) and (not share or done.exit_status == 3)
    if share:
        set_to = float(told[0].partition("set camera.um_per_px = ")[2].partition(",")[0])
        assert set_to == pytest.approx(right_um, rel=2e-3)
        assert told[0] in flowrec.info(tmp_path / "a.mcap")["doubts"]
        assert any(told[0] in finding.text for finding in flowrec.check(tmp_path / "a.mcap").findings)


@pytest.mark.slow("imports a turned movie")
def test_a_movie_that_shows_the_chip_turned_is_refused_with_the_setting_to_paste(
    lab: Laboratory, tmp_path: Path
) -> None:
    makers.folder(tmp_path / "few", [np.ascontiguousarray(image[::-1, ::-1]) for image in lab.images[:12:4]])
    with pytest.raises(UsageError, match=r"camera\.mirror = false, camera\.angle_deg = 180"):
        flowrec.import_movie(tmp_path / "few", tmp_path / "a.mcap", lab.config, fps=10.0)
    assert not (tmp_path / "a.mcap").exists()
    right = flowrec.stages.config.with_sets(lab.config, ["camera.mirror=false", "camera.angle_deg=180"])
    flowrec.import_movie(tmp_path / "few", tmp_path / "a.mcap", right, fps=10.0)


def test_a_log_that_the_motion_does_not_confirm_makes_the_session_doubtful(lab: Laboratory, tmp_path: Path) -> None:
    """Of less than a second on the clock of the log, or aligned by hand, which is decided by the motion alone."""
    makers.folder(tmp_path / "few", lab.images[:25])
    sets = {"coils": lab.log, "fps": lab.rate_hz, "align": False}
    done = flowrec.import_movie(tmp_path / "few", tmp_path / "few.mcap", lab.config, **sets)
    assert done.exit_status == 3 and "the axes of the log are not confirmed" in done.doubts[0]
    unchecked = flowrec.stages.config.with_sets(lab.config, ["mission.check_axes=false"])
    assert not flowrec.import_movie(tmp_path / "few", tmp_path / "off.mcap", unchecked, **sets).doubts


def test_one_image_makes_a_session(lab: Laboratory, tmp_path: Path) -> None:
    makers.folder(tmp_path / "one", lab.images[:1])
    flowrec.import_movie(tmp_path / "one", tmp_path / "one.mcap", lab.config, fps=30.0)
    assert len(list(flowrec.open(tmp_path / "one.mcap").frames)) == 1
    assert flowrec.replay(tmp_path / "one.mcap", verify=True).same


@pytest.mark.slow("imports a movie with gaps")
def test_gaps_in_the_cameras_numbers_are_counted_as_losses(lab: Laboratory, tmp_path: Path) -> None:
    makers.folder(tmp_path / "few", [lab.images[n] for n in (0, 1, 4, 5)])
    big = 10**9
    rows = [("frame", "time_s"), *((big + n, f"{n / 30:.4f}") for n in (0, 1, 4, 5))]
    flowrec.import_movie(tmp_path / "few", tmp_path / "few.mcap", lab.config, times=lab.table("few.csv", rows))
    assert [frame.index - big for frame in flowrec.open(tmp_path / "few.mcap").frames] == [0, 1, 4, 5]


def test_a_rig_that_plays_a_movie_is_paced_by_its_stamps(lab: Laboratory, tmp_path: Path) -> None:
    """The sleeps between images add up to the stamps; no clock is asserted."""
    from flowrec.rigs.movie import rig as module
    from flowrec.stages import RIGS
    from flowrec.verbs import prepare

    asked = flowrec.stages.config.with_sets(
        lab.config, ["rig=movie", f"movie.path={lab.folder / 'film.avi'}", f"movie.coils={lab.log}"]
    )
    config, _, pipeline, *_ = prepare(asked)
    slept: list[float] = []
    clock = type("Clock", (), {"sleep": slept.append, "monotonic": staticmethod(lambda: sum(slept))})
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, "time", clock)
        with RIGS["movie"].load().of(pipeline, config, 1.0, True) as rig:
            stamps = [inputs.stamp_ns for inputs in rig.inputs()]
    assert stamps[-1] <= 10**9 < stamps[-1] + 4e7
    np.testing.assert_allclose(sum(slept), stamps[-1] / 1e9, rtol=1e-9)


@pytest.mark.slow("imports a movie and fails halfway")
def test_a_failure_while_the_file_grows_leaves_nothing(lab: Laboratory, tmp_path: Path, monkeypatch) -> None:
    """Whatever stage fails: the partial file has the name of no session, and goes."""
    from flowrec.stages.estimation import Sampler

    seen: list[list[str]] = []
    real = Sampler.collect

    def failing(self: Sampler, previous: object, before: object, estimate: object, robot: object) -> object:
        if estimate.stamp_ns > 0.7e9:
            seen.append([each.name for each in tmp_path.iterdir()])
            raise MovieError("planted")
        return real(self, previous, before, estimate, robot)

    monkeypatch.setattr(Sampler, "collect", failing)
    with pytest.raises(MovieError, match="planted"):
        flowrec.import_movie(lab.folder / "short.avi", tmp_path / "a.mcap", lab.config, coils=lab.log, align=False)
    assert seen == [["a.mcap.partial"]] and not list(tmp_path.iterdir())
