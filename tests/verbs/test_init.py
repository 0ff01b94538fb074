"""`flowrec init`: from a movie and the answers of a person to a configuration by which the movie is imported."""

from __future__ import annotations

import io
import re
import shlex
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

import flowrec
from flowrec.core import ChipError, OutputError, RigError, UsageError
from flowrec.movies import open_movie
from flowrec.physics import load_chip
from flowrec.rigs import first_camera
from flowrec.stages import CameraSettings, Config, Lab, columns_by_unit, load_config, with_sets
from flowrec.stages.resolve import resolve
from flowrec.verbs.doctor import doctor
from flowrec.verbs.init import LAB as LAB_WORD
from flowrec.verbs.init import StartedConfig, _try_amplifier, init
from tests.extras import why
from tests.twins.coils import device
from tests.twins.emulator import emulated, showing

LAB = Path(__file__).parents[2] / "sessions" / "movie"
MOVIE, LOG = LAB / "robot.mp4", LAB / "coils.csv"
KNOWN: dict[str, Any] = {"um_per_px": 13.0, "radius_um": 50.0, "inlet": ["left:0"], "inlet_speed_um_s": 180.0}


def test_what_a_movie_does_not_tell_is_listed_at_once_beside_a_picture_that_names_the_openings(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "flowrec.toml"
    with pytest.raises(UsageError, match=r": --radius, --inlet, --inlet-speed$"):
        init(MOVIE, um_per_px=13.0, out=out)
    assert re.search("--inlet .*: left:0, right:0, bottom:0", capsys.readouterr().err)
    assert [each.name for each in tmp_path.iterdir()] == ["robot_openings.png"]


@pytest.mark.slow("imports a movie")
def test_a_movie_is_imported_by_what_init_has_written(tmp_path: Path) -> None:
    done = init(MOVIE, **KNOWN, coils=LOG, um_per_rev=25.0, out=tmp_path / "flowrec.toml")
    assert len(done.path.read_text(encoding="utf-8").splitlines()) < 40
    config = load_config(done.path)
    assert (config.robot.radius_um, config.robot.um_per_rev, config.camera.um_per_px) == (50.0, 25.0, 13.0)
    assert config.movie.columns.heading_deg == "phi (deg)"
    imported = flowrec.import_movie(MOVIE, tmp_path / "a.mcap", done.path, coils=LOG)
    assert imported.exit_status == 0 and imported.report.last.refined is not None
    # The lab's own configuration has a mask that was drawn, not found.
    usual = flowrec.import_movie(MOVIE, tmp_path / "b.mcap", LAB / "lab.toml", coils=LOG)
    speeds = [
        np.nanquantile(np.hypot(*np.moveaxis(each.report.last.refined.velocity_um_s, -1, 0)), 0.99)
        for each in (imported, usual)
        if each.report.last.refined is not None
    ]
    assert speeds[0] == pytest.approx(speeds[1], rel=0.15)
    with pytest.raises(OutputError, match=r"flowrec\.toml: exists already"):
        init(MOVIE, **KNOWN, out=done.path)


@pytest.mark.slow("looks for a channel")
def test_a_person_at_a_terminal_is_asked_again_after_an_answer_that_can_not_be_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Terminal(io.StringIO):
        def isatty(self) -> bool:
            return True

    monkeypatch.setattr("sys.stdin", Terminal("fifty\n50\nleft:0\n180\n"))
    monkeypatch.setattr("sys.stderr", Terminal())
    done = init(MOVIE, um_per_px=13.0, out=tmp_path / "mine.toml")
    assert load_config(done.path).robot.radius_um == 50.0
    chip = flowrec.stages.config.load_config(done.path).chip
    assert Path(chip.path) == tmp_path / "mine_chip.toml"
    assert 'kind = "inlet"\nspeed_um_s = 180.0' in (tmp_path / "mine_chip.toml").read_text(encoding="utf-8")


@pytest.mark.slow("imports a movie")
def test_a_movie_without_a_channel_is_tracked(tmp_path: Path) -> None:
    """A dark bead that goes along a line of 2 px an image."""
    folder = tmp_path / "dish"
    folder.mkdir()
    centres = [(40.0 + 2.0 * number, 60.0) for number in range(12)]
    y, x = np.mgrid[:120, :160]
    for number, (cx, cy) in enumerate(centres):
        bead = 160.0 * np.clip(7.0 - np.hypot(x - cx, y - cy), 0.0, 1.0)
        cv2.imwrite(str(folder / f"{number:03d}.png"), np.asarray(200.0 - bead, np.uint8))
    with pytest.raises(UsageError, match=r"nobody to ask: --um-per-px, --radius$"):
        init(folder, no_chip=True, out=tmp_path / "flowrec.toml")
    done = init(folder, no_chip=True, um_per_px=2.0, radius_um=14.0, out=tmp_path / "flowrec.toml")
    assert done.lines()[1] == f"next: flowrec import {folder} {done.path} --fps F -o dish.mcap"
    imported = flowrec.import_movie(folder, tmp_path / "a.mcap", done.path, fps=10.0)
    track = flowrec.open(imported.path).table("track").to_pandas()
    places_um = track[["position_x_um", "position_y_um"]].to_numpy()
    assert track["seen"][: len(centres)].all()
    assert np.allclose(places_um[: len(centres)], 2.0 * np.array(centres), atol=0.4)
    with pytest.raises(UsageError, match=r"--no-chip: chip\.path"):
        init(folder, no_chip=True, sets={"chip.path": "mine.png"}, out=tmp_path / "b.toml")


@pytest.mark.parametrize(
    ("um_per_px", "why"), [(2.85, r"0\.18 px .* camera\.um_per_px is 0\.3509"), (1e-3, "larger than the")]
)
def test_a_scale_at_which_no_image_can_show_the_robot_is_refused(tmp_path: Path, um_per_px: float, why: str) -> None:
    with pytest.raises(UsageError, match=why):
        init(MOVIE, **{**KNOWN, "um_per_px": um_per_px, "radius_um": 0.5}, no_chip=True, out=tmp_path / "flowrec.toml")
    assert not [*tmp_path.iterdir()]


def test_what_is_wrong_is_named_by_its_option_and_leaves_no_file(tmp_path: Path) -> None:
    out = tmp_path / "flowrec.toml"
    with pytest.raises(UsageError, match=r"^--radius: robot\.radius_um = -5"):
        init(MOVIE, **{**KNOWN, "radius_um": -5.0}, out=out)
    log = tmp_path / "log.csv"
    log.write_text("one,two\n1,2\n2,3\n")
    with pytest.raises(UsageError, match=r"log\.csv: .*column"):
        init(MOVIE, **KNOWN, coils=log, out=out)
    assert [each.name for each in tmp_path.iterdir()] == ["log.csv"]
    cv2.imwrite(str(tmp_path / "dish.png"), np.full((120, 160), 128, np.uint8))
    with pytest.raises(ChipError, match="--no-chip"):
        init(tmp_path / "dish.png", **KNOWN, out=out)


@pytest.mark.slow("watches a camera, and looks for a channel")
def test_the_configuration_of_a_lab_holds_what_its_camera_says_and_a_chip_of_its_image(tmp_path: Path) -> None:
    sets = {"lab.camera": "opencv", "lab.device": str(MOVIE), "mission.phases": "observe"}
    done = init(LAB_WORD, **KNOWN, sets=sets, out=tmp_path / "lab.toml")
    config = load_config(done.path)
    camera = config.camera
    assert (config.rig, config.lab.camera, camera.width_px, camera.height_px) == ("lab", "opencv", 384, 308)
    assert resolve(config, load_chip(config.chip)).mission.observes
    made = sorted(each.name for each in tmp_path.iterdir())
    assert made == ["lab.png", "lab.toml", "lab_chip.png", "lab_chip.toml", "lab_chip_overlay.png"]


@pytest.mark.slow("watches a camera")
def test_a_lab_that_drives_is_asked_for_every_limit_of_robot_and_coils(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A current that the coils do not bear must be nobody's default."""
    sets = {"lab.camera": "opencv", "lab.device": str(MOVIE), "chip.path": "drawn.png"}
    with pytest.raises(UsageError) as refused:
        init(LAB_WORD, um_per_px=13.0, radius_um=50.0, sets=sets, out=tmp_path / "lab.toml")
    wanted = ("robot.max_speed_um_s", "robot.step_out_hz", "robot.delay_s", "lab.serial.port", "coils.max_current_a")
    assert str(refused.value).endswith(": " + ", ".join(f"--set {key}=..." for key in wanted))
    assert "largest current of a coil, number from 0.001 to 1000 A" in capsys.readouterr().err
    assert not [*tmp_path.iterdir()], "nor a picture of the camera for each attempt"


@pytest.mark.slow("compiles the firmware's twin, and opens a camera")
def test_init_finds_camera_and_amplifier_of_a_lab_and_leaves_its_coils_without_a_current(tmp_path: Path) -> None:
    """By pylon's emulator and the serial firmware."""
    pytest.importorskip("pypylon", reason=why("pypylon"))
    (tmp_path / "seen").mkdir()
    with open_movie(MOVIE) as movie:
        features = showing(tmp_path / "seen", [np.asarray(movie.median_image(), np.uint8)])
    sets = {"lab.camera": "pylon", "lab.device_config": str(features), "coils.max_current_a": 1.5}
    sets |= {"robot.max_speed_um_s": 600.0, "robot.step_out_hz": 28.0, "robot.delay_s": 0.05}
    out = tmp_path / "lab.toml"
    with emulated(), device("serial", tmp_path) as coils:
        init(LAB_WORD, **KNOWN, sets=sets | {"lab.serial.port": coils.address}, out=out)
        assert not coils.energised()
        looked = doctor(out)
        assert any("amplifier" in line for line in looked.lines())
        assert "camera" not in {finding.what for finding in looked.findings if finding.level == "failure"}
    config = load_config(out)
    assert (config.camera.width_px, config.camera.height_px) == (4096, 4096), "the whole sensor"
    assert config.camera.exposure_s == pytest.approx(0.01), "that of the emulator, not flowrec's default"
    assert config.lab.device == "0815-0000" and config.coils.max_current_a == 1.5


def test_an_amplifier_that_is_not_there_yet_is_told_of_and_refuses_nothing(capsys: pytest.CaptureFixture[str]) -> None:
    _try_amplifier(with_sets(Config(), ("rig=lab", "lab.serial.port=/dev/none", "coils.max_current_a=1.0")))
    told = capsys.readouterr().err
    assert "the amplifier was not tried" in told
    assert "/dev/none" in told
    assert "flowrec doctor" in told


def test_one_image_with_a_channel_leads_to_a_simulated_mission_and_a_movie_to_its_import() -> None:
    movie = StartedConfig(Path("a.png"), Path("flowrec.toml"), Path("a_chip.toml"), None, True, Path("a.png"), False)
    assert movie.lines()[1].startswith("next: flowrec import a.png")
    assert movie._replace(still=True).lines()[1].startswith("next: flowrec record ")


def test_the_next_command_works_for_a_movie_whose_name_has_blanks() -> None:
    movie, log = Path("day 1/robot (2).mp4"), Path("coils 2.csv")
    done = StartedConfig(movie, Path("my lab.toml"), Path("a.toml"), log, True, movie, False)
    suggested = shlex.split(done.lines()[1].removeprefix("next: "))
    assert suggested == ["flowrec", "import", str(movie), "my lab.toml", "--coils", str(log), "-o", "robot (2).mcap"]


def test_a_lab_without_a_camera_is_told_what_to_do_once_and_no_driver_speaks_for_itself(
    capfd: pytest.CaptureFixture[str],
) -> None:
    with pytest.raises(RigError, match=r"^no .*notebooks/08_lab\.ipynb") as refused:
        first_camera(CameraSettings(rate_hz=30.0), Lab(), ["mmcore", "opencv"])
    assert "device_config" not in str(refused.value)
    assert "pymmcore" not in capfd.readouterr().err


def test_columns_of_a_log_are_found_by_the_units_in_their_names_unless_two_have_the_same() -> None:
    assert columns_by_unit(["time [s]", "f (Hz)", "Theta (\u00b0)", "B (mT)", "note"]) == {
        "time_s": "time [s]",
        "frequency_hz": "f (Hz)",
        "heading_deg": "Theta (\u00b0)",
        "amplitude_mt": "B (mT)",
    }
    assert columns_by_unit(["time_s", "t (s)", "Bx (mT)", "By (mT)"]) == {}
