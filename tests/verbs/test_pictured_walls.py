"""A run takes walls and registration from its first image; file and replay have them, the simulated world not."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from flowrec.physics import load_chip
from flowrec.stages import load_config
from flowrec.store import Session
from flowrec.verbs import replay_session
from flowrec.verbs.record import record
from tests.short_missions import SMALL

WALLS = (
    *SMALL,
    "camera.um_per_px=20.0",
    "mission.phases=observe",
    "duration_s=1.0",
    "simulated.wall_error_px=1.0",
    "simulated.um_per_px=20.3",
    "simulated.centre_um=[3230.0, 2560.0]",
)


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("walls") / "s.mcap"
    record(load_config(None, WALLS), path)
    return path


def test_a_session_has_the_walls_and_the_registration_of_its_first_image(recorded: Path) -> None:
    session = Session(recorded)
    drawn = load_chip(load_config(None, WALLS).chip)
    assert session.chip.walls == "grey"
    assert 50 < np.count_nonzero(session.chip.mask != drawn.mask) < 0.1 * drawn.mask.sum()
    assert session.config.camera.um_per_px == pytest.approx(20.3, rel=2e-3)
    x_um, y_um = session.config.camera.centre_um or (0.0, 0.0)
    assert np.hypot(x_um - 3230.0, y_um - 2560.0) < 10.0
    assert "taken from the image" in session.provenance["source_walls"]


def test_a_replay_finds_the_same_in_the_recorded_walls(recorded: Path) -> None:
    assert replay_session(recorded, verify=True).identical


def test_a_session_without_the_setting_keeps_registration_and_mask(tmp_path: Path) -> None:
    path = tmp_path / "s.mcap"
    record(load_config(None, [*WALLS, "camera.trace_walls=false", "duration_s=0.2"]), path)
    session = Session(path)
    assert session.chip.walls == "smooth"
    assert session.config.camera.um_per_px == 20.0
    assert "source_walls" not in session.provenance
