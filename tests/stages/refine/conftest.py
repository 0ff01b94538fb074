"""Twins: a true flow, an assumed one with wrong parameters, and what a robot would have measured in between."""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import pytest

from flowrec.core.messages import FlowField, Observations
from flowrec.physics.chip.chip import Chip, Opening
from flowrec.physics.flow.sampling import sample
from flowrec.physics.flow.solver import FlowSolver
from flowrec.stages.outside_settings import with_row
from flowrec.stages.refine import REFINERS, Ni, Pinn, PiUnet, Refiner


@dataclass
class Twin:
    chip: Chip  # with the assumed parameters
    solver: FlowSolver
    true: FlowField
    assumed: FlowField
    observations: Observations

    def error(self, field):
        """Relative RMSE of v."""
        difference = field.velocity_um_s - self.true.velocity_um_s
        return float(np.sqrt((difference**2).sum() / (self.true.velocity_um_s**2).sum()))


@pytest.fixture
def twin():
    """A bifurcation around an island with a side outlet; the robot has been along the upper branch."""

    def make(noise=0.05, truth=(130.0, 0.0, 0.004), assumed=(100.0, 0.0, 0.0), seed=0, every=3, scale=1.0):
        mask = np.zeros((48, 80), bool)
        mask[20:28] = True
        mask[8:40, 20:60] = True
        mask[16:32, 28:52] = False
        mask[40:, 40:48] = True
        openings = tuple(
            Opening(side, first, first + 7, kind, scale * value)
            for side, first, kind, value in zip(
                ("left", "right", "bottom"), (20, 20, 40), ("inlet", "outlet", "outlet"), assumed, strict=True
            )
        )
        chip = Chip("twin", mask, 10.0, openings, 1.0, 1000.0, walls="pixel")
        solver = FlowSolver()
        true = solver.solve(chip.with_boundary(scale * np.array(truth)))
        # Up the stem, around the island above, out to the right.
        corners = np.array([[20, 240], [240, 240], [240, 120], [555, 120], [555, 240], [760, 240]], float)
        pieces = [np.linspace(a, b, int(np.abs(b - a).max() / 10), endpoint=False) for a, b in pairwise(corners)]
        points = np.concatenate(pieces)[::every]
        flow = sample(true, points)
        std = noise * np.sqrt((flow**2).sum(axis=1).mean())
        flow = flow + std * np.random.default_rng(seed).standard_normal(flow.shape)
        return Twin(chip, solver, true, solver.solve(chip), Observations(0, points, flow, np.full(len(points), std)))

    return make


# Settings with which a method of the table takes about a second; a method that is not named here has its own defaults.
QUICK = {
    "pi_unet": PiUnet(start="fvm"),
    "ni": Ni(iterations=6, base_channels=8),
    "pinn": Pinn(iterations=20, points=128, width=24, depth=3, features=24),
}


@pytest.fixture(params=REFINERS.usable())
def any_refiner(request):
    """Every method of the table, one after the other."""
    return with_row(Refiner(**QUICK), REFINERS, request.param)
