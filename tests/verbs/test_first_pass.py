"""A movie is looked through before it is imported: which body is the robot, does it shake; doubts go with a session."""

from __future__ import annotations

import json
import re
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

import flowrec
from flowrec.core import UsageError
from flowrec.physics import ORIENTATIONS, FlowSolver, chip_files
from flowrec.stages import Config, FieldLog, MovieSettings, load_config, to_toml
from flowrec.verbs import first_pass, misfit
from flowrec.verbs.first_pass import MovieTracks, radius_in_image
from flowrec.verbs.misfit import trembling as trembling_um
from flowrec.verbs.misfit import why_unexplained
from tests.conftest import run
from tests.movies import makers
from tests.stages.vision.shaky import ROBOT, UM_PER_PX, WIDTH, chip, image

COUNT = 24
ALONE = [[(40.0 + 1.5 * n, 80.0)] for n in range(COUNT)]
PAIR = [[(40.0 + 1.5 * n, 70.0), (60.0, 90.0)] for n in range(COUNT)]


@pytest.fixture(scope="module")
def known(tmp_path_factory: pytest.TempPathFactory) -> Config:
    """What a laboratory knows of the drawn chip."""
    folder = tmp_path_factory.mktemp("drawn")
    png, toml = chip_files(chip())
    (folder / "chip.png").write_bytes(png)
    (folder / "chip.toml").write_text(toml, encoding="utf-8")
    sets = [f"camera.um_per_px={UM_PER_PX}", f"chip.path={folder / 'chip.toml'}", f"robot.radius_um={ROBOT.radius_um}"]
    sets += ["movie.rate_hz=30", "refine.assimilate.doubt_depth=false", "recording.own_process=false"]
    return load_config(None, sets)


def movie(folder: Path, places: list[list[tuple[float, float]]], shake_px: float = 0.0) -> Path:
    pictures = []
    for n, at in enumerate(places):
        shift = shake_px * np.sin(0.63 * n + 0.5), 0.7 * shake_px * np.cos(0.63 * n)
        pictures.append(image(chip(), at, shift, seed=n))
    return makers.folder(folder / "movie", pictures)


def first_place_px(session: Path) -> np.ndarray:
    track = next(track for track in flowrec.open(session).messages("track") if track.seen)
    return np.asarray(flowrec.open(session).calibration.to_px(track.position_um))


@pytest.mark.slow("imports a movie four times")
def test_two_bodies_alike_are_refused_with_a_picture_and_each_way_to_name_one_takes_it(
    known: Config, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    made, toml = movie(tmp_path, PAIR), tmp_path / "my.toml"
    toml.write_text(to_toml(known), encoding="utf-8")
    words = ["import", made, toml, "-o", tmp_path / "a.mcap", "--overwrite"]
    (tmp_path / "movie_robots.png").write_bytes(b"of somebody else")
    assert run(words) == 2
    said = capsys.readouterr().err.strip().splitlines()[-1]
    assert "2 bodies in image 0 look like the robot" in said and "movie_robots_2.png" in said and "--robot N" in said
    assert (tmp_path / "movie_robots.png").read_bytes() == b"of somebody else"
    picture = cv2.imread(str(tmp_path / "movie_robots_2.png"))
    amber = np.argwhere(abs(picture.astype(int) - (38, 140, 255)).sum(axis=2) < 30)
    factor = picture.shape[1] / WIDTH
    for at in PAIR[0]:  # a circle and a number beside each
        near = np.hypot(*(amber[:, ::-1] / factor - at).T)
        assert (near < 16.0).sum() > 40
    assert not (tmp_path / "a.mcap").exists()
    assert run(words) == 2 and not (tmp_path / "movie_robots_3.png").exists()  # the same picture
    um = UM_PER_PX * np.array(PAIR[0][1])
    for which, place in (("1", 0), ("2", 1), ("60,90px", 1), (f"{um[0]:g},{um[1]:g}", 1)):
        assert run([*words, "--robot", which]) == 0
        assert np.hypot(*(first_place_px(tmp_path / "a.mcap") - PAIR[0][place])) < 1.0
    capsys.readouterr()
    for which, said in (
        ("3", "there are 2"),
        ("a,b", "neither a number"),
        ("900,90px", "outside of the image"),
        ("90,20px", "nothing differs from the background"),
    ):
        assert run([*words, "--robot", which]) == 2
        assert said in capsys.readouterr().err


@pytest.mark.slow("imports a movie")
def test_a_body_that_is_alone_needs_no_one_to_name_it(known: Config, tmp_path: Path) -> None:
    done = flowrec.import_movie(movie(tmp_path, ALONE), tmp_path / "a.mcap", known)
    assert done.exit_status == 0 and not done.doubts
    assert flowrec.open(tmp_path / "a.mcap").config.tracker.click_px is None


@pytest.mark.slow("imports two movies and replays one")
def test_a_shaking_movie_gives_the_track_of_a_still_one_and_replays_exactly(known: Config, tmp_path: Path) -> None:
    for name, shake_px in (("still", 0.0), ("shaken", 2.0)):
        (tmp_path / name).mkdir()
        flowrec.import_movie(movie(tmp_path / name, ALONE, shake_px), tmp_path / f"{name}.mcap", known)
    still, shaken = (
        np.array([track.position_um for track in flowrec.open(tmp_path / f"{name}.mcap").messages("track")])
        for name in ("still", "shaken")
    )
    off_px = (shaken - still) / UM_PER_PX
    assert np.sqrt(((off_px - off_px.mean(axis=0)) ** 2).mean()) < 0.12  # without stabilisation it is 1.2
    assert np.abs(off_px.mean(axis=0)).max() < 0.35  # the first image lies 1.4 px off
    shifts = np.array([shift.shift_px for shift in flowrec.open(tmp_path / "shaken.mcap").messages("shift")])
    assert np.ptp(shifts[:, 0]) > 3.5
    assert flowrec.replay(tmp_path / "shaken.mcap", verify=True).same
    assert flowrec.replay(tmp_path / "shaken.mcap", verify=True, from_s=0.4).same
    assert "1.7" in flowrec.info(tmp_path / "shaken.mcap")["source_shake"]
    assert not any(shift.shift_px.any() for shift in flowrec.open(tmp_path / "still.mcap").messages("shift"))


@pytest.mark.slow("imports and replays a movie")
def test_a_doubtful_track_makes_the_session_doubtful_wherever_it_is_shown(
    known: Config, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    jumps = [[(40.0 + 1.5 * n + 60.0 * (n >= 12), 80.0)] for n in range(COUNT)]
    made, toml, out = movie(tmp_path, jumps), tmp_path / "my.toml", tmp_path / "a.mcap"
    toml.write_text(to_toml(known), encoding="utf-8")
    assert run(["import", made, toml, "-o", out]) == 3
    assert "doubtful: the track jumps once" in capsys.readouterr().err
    assert "jumps once" in flowrec.info(out)["doubts"]
    assert run(["ls", tmp_path]) == 0
    assert "observe complete, doubtful" in " ".join(capsys.readouterr().out.replace("│", " ").split())
    verdict = flowrec.check(out)
    assert verdict.exit_status == 3
    assert [each.text for each in verdict.findings if each.about == "doubts"] == [
        f"doubtful: {flowrec.info(out)['doubts']}"  # judged again of the messages: the same words, and told once
    ]
    monkeypatch.setattr("flowrec.exports.report.style.as_svg", lambda *_: b"<svg/>")  # drawn, but not rendered
    page = flowrec.report(out).read_text(encoding="utf-8")
    assert 'class="outcome doubtful"' in page and "the track jumps once" in page
    again = tmp_path / "again.mcap"
    assert run(["replay", out, "--out", again, "--json"]) == 3
    assert "jumps once" in json.loads(capsys.readouterr().out)["doubts"] and flowrec.info(again)["doubts"]


def test_the_reason_why_a_log_does_not_explain_a_track_is_the_one_that_holds() -> None:
    on = chip()
    flow = FlowSolver().solve(on)
    time_s = np.arange(0.0, 4.0, 1.0 / 30.0)
    stamps_ns = np.rint(1e9 * time_s).astype(np.int64)
    log = FieldLog([0, 4_000_000_000], [10.0, 10.0], [0.0, 0.0], [4.0, 4.0])
    rng = np.random.default_rng(0)

    def why(places_um: np.ndarray, **seen: object) -> str:
        given = {"shake_px": 0.0, "stabilised": True, "um_per_px": UM_PER_PX, "doubts": ()} | seen
        return why_unexplained(MovieTracks(stamps_ns, places_um, log, **given), flow, 25.0)  # type: ignore[arg-type]

    angle = np.repeat(rng.uniform(-3.0, 3.0, 8), 15)
    driven = np.array([400.0, 320.0]) + np.cumsum(
        np.column_stack([np.cos(angle), np.sin(angle)]) * 250.0 / 30.0, axis=0
    )
    still = np.array([400.0, 320.0]) + rng.normal(0.0, 0.3, (len(time_s), 2))
    carried = np.column_stack([60.0 + 140.0 * time_s, np.full(len(time_s), 320.0)])
    assert "does not move by itself" in why(still)
    assert "it is the log of another run" in why(driven)
    assert "the assumed flow carries it" in why(carried)
    assert "the track is doubtful: it jumps" in why(driven, doubts=("it jumps",))
    assert "the image shakes by 1.7 px" in why(driven, shake_px=1.7, stabilised=False)
    assert "shakes" not in why(driven, shake_px=1.7)
    assert trembling_um(rng.normal(0.0, 2.0, (2000, 2))) == pytest.approx(2.0, rel=0.1)
    trembling = driven + UM_PER_PX * rng.normal(0.0, 2.0, driven.shape)
    assert "the track trembles" in why(trembling, shake_px=None)
    assert "shakes" not in why(driven, shake_px=None)


@pytest.mark.slow("imports a movie")
def test_an_image_without_walls_says_that_shake_can_not_be_seen(known: Config, tmp_path: Path) -> None:
    pictures = [image(None, at, seed=n) for n, at in enumerate(ALONE[:6])]
    flowrec.import_movie(makers.folder(tmp_path / "bare", pictures), tmp_path / "a.mcap", known, fps=5.0)
    # Nobody states a speed: a radius an image, or what the flow of 100 um/s on average reaches; not the usual 600.
    assert flowrec.open(tmp_path / "a.mcap").config.robot.max_speed_um_s < 250.0
    assert flowrec.info(tmp_path / "a.mcap")["source_shake"].startswith("not known: the image shows no walls")


def test_stabilisation_and_images_of_the_robot_alone_exclude_each_other(known: Config) -> None:
    with pytest.raises(UsageError, match=r"stabilise\.on reads the walls in every image"):
        load_config(None, ["stabilise.on=true", "recording.region=robot"])


@pytest.mark.parametrize(("about_px", "ring"), [(4.0, False), (10.0, False), (25.0, False), (10.0, True), (25.0, True)])
def test_the_size_of_a_body_is_that_of_its_outline_whatever_was_stated(about_px: float, *, ring: bool) -> None:
    y, x = np.mgrid[:240, :320]
    distance = np.hypot(x - 160.0, y - 120.0)
    body = np.clip(10.5 - distance, 0.0, 1.0) * (np.clip(distance - 6.0, 0.0, 1.0) if ring else 1.0)
    image = np.clip(np.random.default_rng(0).normal(180.0, 3.0, body.shape) - 120.0 * body, 0.0, 255.0)
    place = np.array([160.4, 119.7])
    assert radius_in_image(image.astype(np.uint8), place, about_px) == pytest.approx(10.0, abs=0.7)


def test_a_body_without_an_outline_in_view_has_no_size() -> None:
    grey = np.full((100, 100), 180, np.uint8)
    grey[:, :50] = 60
    assert radius_in_image(grey, np.array([20.0, 50.0]), 5.0) == 0.0


def test_the_first_image_of_a_shaking_movie_is_so_far_from_the_mean_place_of_all_that_they_lie_about_that() -> None:
    shifts_px = np.random.default_rng(4).normal((7.0, -3.0), (2.0, 1.0), (200, 2))
    shifts_px -= shifts_px[0]  # each is measured from the first image
    config, facts = first_pass._with_mean_shift(Config(), shifts_px)
    np.testing.assert_allclose((shifts_px + config.stabilise.first_px).mean(axis=0), 0.0, atol=1e-3)
    rms_px, most_px = map(float, re.findall(r"[\d.]+", facts["source_shake"]))
    assert rms_px == pytest.approx(np.sqrt(shifts_px.var(axis=0).sum()), abs=0.006) and most_px > 2.0 * rms_px
    still, _ = first_pass._with_mean_shift(Config(), shifts_px / 100.0)
    assert not any(still.stabilise.first_px), "what is less than a tenth of a pixel is no shake"


def test_a_track_is_compared_with_what_the_log_drove_its_delay_before(monkeypatch: pytest.MonkeyPatch) -> None:
    log = FieldLog()
    for number in range(20):
        log.append(number * 10**8, 5.0, 0.4 * number, 4.0, np.zeros(3))
    stamps_ns = np.arange(5, 19) * 10**8
    driven_um = 30.0 * log.turns_until((stamps_ns - 7 * 10**7).astype(np.float64))  # 70 ms before
    compared: list[np.ndarray] = []
    monkeypatch.setattr(misfit, "own_gain", lambda _time_s, seen_um, own_um: compared.append(own_um - seen_um) or ())
    monkeypatch.setattr(misfit, "orientation_by_motion", lambda *_: None)
    seen = MovieTracks(stamps_ns, driven_um, log, None, False, UM_PER_PX, ())
    config = SimpleNamespace(robot=SimpleNamespace(delay_s=0.07, um_per_rev=30.0, radius_um=1.0))
    misfit.motion_by_log(seen, config)  # type: ignore[arg-type]
    np.testing.assert_allclose(compared, 0.0, atol=1e-9)


@pytest.mark.parametrize(("offset_deg", "mirrored"), [(0.0, False), (25.0, False), (-140.0, True)])
def test_the_settings_for_a_log_in_other_axes_turn_its_headings_to_where_the_robot_moves(
    offset_deg: float, mirrored: bool
) -> None:
    logged_rad = np.radians([0.0, 20.0, 130.0, -75.0])

    def directions(offset_deg: float, mirrored: bool) -> np.ndarray:
        heading_rad = np.radians(offset_deg) + (-logged_rad if mirrored else logged_rad)
        return np.stack([np.cos(heading_rad), np.sin(heading_rad)])

    for orientation in ORIENTATIONS:
        stated = MovieSettings(heading_offset_deg=offset_deg, heading_mirrored=mirrored)
        text = misfit._log_settings(orientation, stated)
        settings = load_config(None, [each.replace(" ", "") for each in text.split(", ")]).movie
        assert -180.0 < settings.heading_offset_deg <= 180.0
        found = directions(settings.heading_offset_deg, settings.heading_mirrored)
        np.testing.assert_allclose(found, orientation.matrix @ directions(offset_deg, mirrored), atol=1e-9)
