"""Small chips whose flow is known, or known well enough."""

import numpy as np
import pytest

from flowrec.chip.chip import Chip, Opening


@pytest.fixture
def straight():
    """A straight channel from left to right of a width in pixels."""

    def make(width=8, length=24, speed=100.0, margin=2, **fluid):
        mask = np.zeros((width + 2 * margin, length), bool)
        mask[margin : margin + width] = True
        openings = (
            Opening("left", margin, margin + width - 1, "inlet", speed),
            Opening("right", margin, margin + width - 1, "outlet", 0.0),
        )
        settings = {"viscosity_mpa_s": 1.0, "density_kg_m3": 1000.0, "walls": "pixel"} | fluid
        return Chip("straight", mask, 10.0, openings, **settings)

    return make


@pytest.fixture
def crossing():
    """Two inlets, two outlets on four sides, an island and a pond that no opening reaches."""
    mask = np.zeros((40, 48), bool)
    mask[14:26] = True
    mask[:, 18:30] = True
    mask[17:23, 21:27] = False
    mask[3:8, 4:9] = True
    openings = (
        Opening("left", 14, 25, "inlet", 150.0),
        Opening("top", 18, 29, "inlet", 60.0),
        Opening("right", 14, 25, "outlet", 0.0),
        Opening("bottom", 18, 29, "outlet", 0.02),
    )
    return Chip("crossing", mask, 10.0, openings, 1.0, 1000.0, walls="pixel")
