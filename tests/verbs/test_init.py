"""`flowrec init`: from a movie and the answers of a person to a configuration by which the movie is imported."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import flowrec
from flowrec.core.errors import UsageError
from flowrec.core.system.outputs import OutputError
from flowrec.stages.config import load_config
from flowrec.stages.control.coil_log import columns_by_unit
from flowrec.verbs.init import init

LAB = Path(__file__).parents[2] / "sessions" / "movie"
MOVIE, LOG = LAB / "robot.mp4", LAB / "coils.csv"
KNOWN: dict[str, Any] = {"um_per_px": 13.0, "radius_um": 50.0, "inlet": ["left:0"], "inlet_speed_um_s": 180.0}


def test_what_a_movie_does_not_tell_is_listed_at_once_beside_a_picture_that_names_the_openings(tmp_path: Path) -> None:
    out = tmp_path / "flowrec.toml"
    with pytest.raises(UsageError, match=r"missing: --radius .*; --inlet \(.*left:0, right:0, bottom:0\); --inlet-sp"):
        init(MOVIE, um_per_px=13.0, out=out)
    assert [each.name for each in tmp_path.iterdir()] == ["robot_openings.png"]
    with pytest.raises(UsageError, match="missing: --inlet-speed"):
        init(MOVIE, **{**KNOWN, "inlet_speed_um_s": None}, out=out)


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


@pytest.mark.slow("looks for a channel twice")
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
    assert Path(chip.path) == tmp_path / "robot_chip.toml"
    assert 'kind = "inlet"\nspeed_um_s = 180.0' in (tmp_path / "robot_chip.toml").read_text(encoding="utf-8")


def test_columns_of_a_log_are_found_by_the_units_in_their_names_unless_two_have_the_same() -> None:
    assert columns_by_unit(["time [s]", "f (Hz)", "Theta (\u00b0)", "B (mT)", "note"]) == {
        "time_s": "time [s]",
        "frequency_hz": "f (Hz)",
        "heading_deg": "Theta (\u00b0)",
        "amplitude_mt": "B (mT)",
    }
    assert columns_by_unit(["time_s", "t (s)", "Bx (mT)", "By (mT)"]) == {}
