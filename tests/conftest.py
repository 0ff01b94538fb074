"""Missions that several tests look at, flown once."""

from __future__ import annotations

from pathlib import Path

import pytest

from flowrec.config import load_config
from flowrec.record import Recorded, record

SMALL = ["camera.width_px=320", "camera.height_px=256", "simulated.seed=1"]


@pytest.fixture(scope="session")
def mission(tmp_path_factory: pytest.TempPathFactory) -> Recorded:
    """A whole mission on the bifurcation, seen by a small camera."""
    path = tmp_path_factory.mktemp("mission") / "mission.mcap"
    return record(load_config(None, SMALL), path)


@pytest.fixture(scope="session")
def session(mission: Recorded) -> Path:
    return mission.path
