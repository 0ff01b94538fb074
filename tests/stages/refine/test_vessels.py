"""Real vessel shapes with OpenFOAM's flow in them, where the environment says they are."""

import os
from pathlib import Path

import numpy as np
import pytest

from flowrec.core.messages import Observations
from flowrec.physics.chip.chip import Chip, Opening
from flowrec.physics.flow.solver import FlowSolver
from flowrec.stages.refine import PiUnet, Refiner

FOLDER = Path(os.environ.get("FLOWREC_REFERENCE_DATA", "/nonexistent")) / "vessels"
pytestmark = pytest.mark.skipif(not FOLDER.is_dir(), reason="FLOWREC_REFERENCE_DATA is not set")
SIDES = {"W": "left", "E": "right", "S": "top", "N": "bottom"}


def vessel(index, parameters):
    """Chip with the `true` or `assumed` parameters, true velocity in um/s, observations at 5 % noise."""
    with np.load(FOLDER / f"case_{index:02d}.npz") as data:
        speeds, pressures = data[f"op_u_{parameters}"] * 1e6, data[f"op_p_{parameters}"]
        openings = tuple(
            Opening(SIDES[side], int(a), int(b), str(kind), float(speed if kind == "inlet" else pressure))
            for side, a, b, kind, speed, pressure in zip(
                data["op_side"], data["op_a"], data["op_b"], data["op_type"], speeds, pressures, strict=True
            )
        )
        suffix = "" if parameters == "true" else "_assumed"
        um_per_px = float(data["px"]) * 1e6
        viscosity, density = float(data["mu" + suffix]) * 1e3, float(data["rho" + suffix])
        chip = Chip(f"case {index}", data["mask"], um_per_px, openings, viscosity, density, walls="pixel")
        seen = data["obs_idx_10"]
        positions = data["route_ij"][seen][:, ::-1] * um_per_px
        std = np.full(len(seen), float(data["route_v_sigma"][2]) * 1e6)
        halves, means = (np.stack([data[x], data[y]], axis=-1) for x, y in (("vx_c", "vy_c"), ("vx", "vy")))
        centres = halves + (halves - means) / 3.0  # means over half a pixel and over a pixel, to means over none
        # The noise was added to means over pixels; a robot measures at a point.
        measured = data["route_v_n05"] + (centres - means)[*data["route_ij"].T]
        return chip, centres * 1e6, Observations(0, positions, measured[seen] * 1e6, std)


def error(field, truth):
    return float(np.sqrt(((field.velocity_um_s - truth) ** 2).sum() / (truth**2).sum()))


def test_the_solver_agrees_with_openfoam_and_inertia_is_part_of_that():
    errors = []
    for index in range(10):
        chip, truth, _ = vessel(index, "true")
        errors.append(error(FlowSolver(2).solve(chip), truth))
    assert np.mean(errors) < 0.012 and max(errors) < 0.02
    chip, truth, _ = vessel(0, "true")  # Re 11
    assert error(FlowSolver(2, convection=False).solve(chip), truth) > 5 * errors[0]


def test_assimilation_brings_the_mean_error_from_fifteen_to_below_four_per_cent():
    before, after, covered = [], [], []
    for index in range(10):
        chip, truth, observations = vessel(index, "assumed")
        solver = FlowSolver(2)
        assumed = solver.solve(chip)
        refined = Refiner().refine(assumed, observations, chip, solver)
        before.append(error(assumed, truth))
        after.append(error(refined, truth))
        covered.append((np.abs(refined.velocity_um_s - truth) <= 2.0 * refined.std_um_s)[chip.mask].mean())
    assert np.mean(before) > 0.13
    assert np.mean(after) < 0.035 and max(after) < 0.06
    assert np.mean(covered) > 0.9


def test_pi_unet_halves_the_error_of_the_solver():
    before, after = [], []
    for index in (1, 7):  # the smallest
        chip, truth, observations = vessel(index, "assumed")
        solver = FlowSolver()
        assumed = solver.solve(chip)
        refiner = Refiner("pi_unet", pi_unet=PiUnet(start="fvm"))
        before.append(error(assumed, truth))
        after.append(error(refiner.refine(assumed, observations, chip, solver), truth))
    assert np.mean(after) < 0.5 * np.mean(before)
