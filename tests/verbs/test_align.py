"""A movie and a log on another clock are imported on one clock, and the session itself tells the same of the robot."""

from __future__ import annotations

import csv
import io
import json
import tomllib
from contextlib import redirect_stdout
from pathlib import Path

import av
import numpy as np
import pytest

import flowrec
from flowrec.core import UsageError
from flowrec.measure.calibrate_motion import calibrate_motion
from flowrec.stages import load_config
from tests.conftest import run
from tests.movies import makers

MOVIE = Path(__file__).parents[2] / "sessions" / "movie"
CLOCK_OFFSET_S = 12.4  # of its log, see lab.toml
HIDDEN = [*range(60, 75), *range(130, 145), *range(200, 215)]  # images without the robot
SETTINGS = ["camera.um_per_px=13.0", "robot.radius_um=50.0", "robot.delay_s=0.04", "robot.um_per_rev=30.0"]


def late_log(path: Path, by_s: float, heading: float = 1.0, every: int = 1) -> Path:
    """The log of the movie with its times late, and its headings times a factor; or only some of its rows."""
    header, *rows = csv.reader((MOVIE / "coils.csv").read_text(encoding="utf-8").splitlines())
    with path.open("w", newline="") as file:
        csv.writer(file).writerows(
            [header, *((f"{float(t) + by_s:.4f}", f, heading * float(phi), b) for t, f, phi, b in rows[::every])]
        )
    return path


@pytest.fixture(scope="module")
def imported(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The robot is hidden in some images, the log is 100 ms late, and robot.um_per_rev is stated 20 % too large."""
    folder = tmp_path_factory.mktemp("align")
    with av.open(str(MOVIE / "robot.mp4")) as source:
        stream = source.streams.video[0]
        rate_hz = float(stream.average_rate or 0.0)
        images = [frame.to_ndarray(format="gray8") for frame in source.decode(stream)]
    empty = np.median(images[::10], axis=0).astype(np.uint8)
    makers.folder(folder / "images", [empty if n in HIDDEN else image for n, image in enumerate(images)])
    config = load_config(MOVIE / "lab.toml", SETTINGS)
    log, out = late_log(folder / "late.csv", 0.1), folder / "a.mcap"
    printed = io.StringIO()
    with redirect_stdout(printed):
        done = flowrec.import_movie(folder / "images", out, config, coils=log, fps=rate_hz)
    assert printed.getvalue() == "", "stdout is for --json"
    assert json.loads(done.source["alignment"])["frames"] > 200
    return out


@pytest.mark.slow("tracks and aligns a whole movie")
def test_a_log_that_is_100_ms_late_is_found_though_the_robot_is_not_always_seen(imported: Path) -> None:
    session = flowrec.open(imported)
    found = json.loads(session.provenance["alignment"])
    assert session.config.movie.clock_offset_s == pytest.approx(CLOCK_OFFSET_S + 0.1, abs=4e-3)
    assert session.config.movie.clock_rate == 1.0
    seen = sum(track.seen for track in session.messages("track"))
    assert seen <= len(list(session.messages("track"))) - len(HIDDEN)
    assert found["frames"] + found["frames_left_out"] == seen


@pytest.mark.slow("tracks and aligns a whole movie")
def test_um_per_revolution_that_the_motion_refutes_are_replaced_and_both_are_recorded(imported: Path) -> None:
    session = flowrec.open(imported)
    found = json.loads(session.provenance["alignment"])
    assert session.config.robot.um_per_rev == pytest.approx(25.0, rel=0.05)
    assert (found["um_per_rev_stated"], found["um_per_rev_used"]) == (30.0, session.config.robot.um_per_rev)


@pytest.mark.slow("aligns a whole movie by its motion")
def test_calibrate_motion_finds_an_imported_session_aligned(imported: Path) -> None:
    motion = calibrate_motion(imported)
    seen = sum(track.seen for track in flowrec.open(imported).messages("track"))
    assert motion.fit.frames + motion.fit.left_out == seen
    assert motion.fit.offset_s == pytest.approx(0.0, abs=4e-3)
    assert "movie.clock_offset_s" not in motion.sets and not motion.shared_clock
    assert motion.sets["robot.um_per_rev"] == pytest.approx(25.0, rel=0.05)


@pytest.mark.slow("aligns a whole movie by its motion")
def test_calibrate_motion_at_the_command_line_takes_another_log_on_another_clock(
    imported: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    log, out = late_log(tmp_path / "later.csv", 700.0), tmp_path / "motion.toml"
    assert run(["calibrate", "motion", imported, "--coils", log, "--out", out, "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    delay_s = flowrec.open(imported).config.robot.delay_s
    assert found["offset_s"] == pytest.approx(CLOCK_OFFSET_S + 700.0 - delay_s, abs=4e-3)
    assert f"robot.um_per_rev={tomllib.loads(out.read_text())['robot']['um_per_rev']}" in found["set"]
    foreign = late_log(tmp_path / "foreign.csv", 0.0, heading=3.0)
    assert run(["calibrate", "motion", imported, "--coils", foreign, "--out", tmp_path / "b.toml"]) == 2
    refused = capsys.readouterr().err
    assert "the log explains" in refused and refused.count("\n") == 1 and not (tmp_path / "b.toml").exists()


@pytest.mark.slow("imports a whole movie")
def test_a_log_at_a_third_of_the_images_rate_is_aligned_as_samples_of_the_field(tmp_path: Path) -> None:
    log, out = late_log(tmp_path / "slow.csv", 0.1, every=3), tmp_path / "a.mcap"
    done = flowrec.import_movie(MOVIE / "robot.mp4", out, load_config(MOVIE / "lab.toml"), coils=log)
    assert done.exit_status == 3 and "the log has a row every 0.1 s only" in done.doubts[0]
    session = flowrec.open(out)
    movie, found = session.config.movie, json.loads(session.provenance["alignment"])
    assert movie.between_rows == "linear" and movie.clock_rate == 1.0
    assert abs(movie.clock_offset_s - CLOCK_OFFSET_S - 0.1) < 0.05  # the rows are 0.1 s apart
    assert found["um_per_rev"] == pytest.approx(25.0, rel=0.05) and not session.fields["refined"].refused


@pytest.mark.slow("looks through a whole movie")
def test_a_slow_log_of_another_run_is_refused_with_its_rate_and_that_of_the_field(tmp_path: Path) -> None:
    foreign = late_log(tmp_path / "foreign.csv", 0.0, heading=3.0, every=3)
    why = r"sampled too slowly, at 10 Hz where the movie has 30 and the field turns at up to [\d.]+ Hz"
    with pytest.raises(UsageError, match=why):
        flowrec.import_movie(MOVIE / "robot.mp4", tmp_path / "a.mcap", load_config(MOVIE / "lab.toml"), coils=foreign)
    assert not list(tmp_path.glob("*.mcap"))
