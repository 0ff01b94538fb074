"""Small chips whose flow is known, or known well enough."""

import numpy as np
import pytest

from flowrec.physics import Chip, Opening, Scales, from_distance, generalised_equations


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


def crossing_chip(bottom_pa=0.02):
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
        Opening("bottom", 18, 29, "outlet", bottom_pa),
    )
    return Chip("crossing", mask, 10.0, openings, 1.0, 1000.0, walls="pixel")


@pytest.fixture
def crossing():
    return crossing_chip()


@pytest.fixture
def oblique_error():
    """Relative error of the velocity of a power law in a channel at an angle whose walls are exact lines, no mask."""

    def error(width_px, angle_deg, k, law):
        angle, length = np.radians(angle_deg), 64
        rows = int(length * np.tan(angle)) + 24
        size = np.array([length - 1.0, rows - 1.0]) / 2.0 + [-0.13, -0.27]  # not symmetric to the pixels

        def across(x, y):
            return (y - size[1]) * np.cos(angle) - (x - size[0]) * np.sin(angle)

        y, x = np.mgrid[:rows, :length].astype(float)
        mask = np.abs(across(x, y)) < width_px / 2.0
        ends = [np.flatnonzero(mask[:, column]) for column in (0, -1)]
        openings = (
            Opening("left", int(ends[0][0]), int(ends[0][-1]), "inlet", 100.0 * width_px / len(ends[0])),
            Opening("right", int(ends[1][0]), int(ends[1][-1]), "outlet", 0.0),
        )
        chip = Chip("oblique", mask, 10.0, openings, 1.0, 1000.0, law=law)
        walls = from_distance(lambda x, y: width_px / 2.0 - np.abs(across(x, y)), mask.shape, k)
        equations = generalised_equations(chip, law, k, walls)
        drive = Scales.of(chip, k, False).drive
        found = np.zeros((*mask.shape, 2))
        found[mask] = equations.velocity(equations.steady(drive, 0.0, 60, 1e-9))
        n = law.exponent
        speed = np.maximum(1.0 - np.abs(2.0 * across(x, y) / width_px) ** (1.0 + 1.0 / n), 0.0)
        exact = (1e-4 * (2 * n + 1) / (n + 1) * speed)[..., None] * [np.cos(angle), np.sin(angle)]
        along = (x - size[0]) * np.cos(angle) + (y - size[1]) * np.sin(angle)
        core = mask & (np.abs(along) < 10.0)
        return float(np.linalg.norm((found - exact)[core]) / np.linalg.norm(exact[core]))

    return error
