"""Beads of the simulated rig: the profile over the depth, lag, settling and sticking."""

from __future__ import annotations

import numpy as np
import pytest

from flowrec.physics import ChipSettings, FlowSolver, clearance_um, load_chip
from flowrec.rigs.simulated.beads import Beads, profile_exponent
from flowrec.rigs.simulated.world import true_pump
from flowrec.stages import Simulated

CHIP = load_chip(ChipSettings(name="straight"))
FIELD = FlowSolver().solve(CHIP)


def beads(depth_um: float | None, count: int = 400, **settings) -> Beads:
    simulated = Simulated(world="kind", seed=2, tracers=count, **settings)
    clearance = clearance_um(CHIP.mask, CHIP.um_per_px)
    return Beads(CHIP, simulated, 20.0, depth_um, FIELD, clearance, true_pump(simulated))


@pytest.mark.parametrize("shape", [0.1, 0.6, 1.5, 4.0])
def test_the_mean_of_the_profile_over_the_depth_is_the_flow(shape: float) -> None:
    n, s = profile_exponent(shape), np.linspace(-1.0, 1.0, 4001)
    assert np.trapezoid((1.0 + n) / n * (1.0 - np.abs(s) ** n), s) / 2.0 == pytest.approx(1.0, abs=1e-4)
    assert profile_exponent(0.1) == 2.0, "between plates it is the parabola"


def test_beads_go_with_a_part_of_the_flow_that_their_height_decides() -> None:
    every = beads(2000.0, 2000)
    floats = every.truth(0).stuck == 0.0
    share = every.speed_share()
    assert 0.0 < share[floats].min() < 0.2 and share.max() <= 1.5 and (share[~floats] == 0.0).all()
    assert share[floats].mean() == pytest.approx(1.0, abs=0.05), (
        "those that are spread evenly have the mean of the flow"
    )
    assert (~floats).mean() == pytest.approx(0.05, abs=0.02)
    flat = beads(None)
    assert set(flat.speed_share()) <= {0.0, 1.0}


def test_a_bead_that_touches_the_floor_lags_behind_the_flow_there_and_sticks_in_time() -> None:
    every = beads(200.0, tracer_excess_kg_m3=5000.0)
    n = every._exponent
    for _ in range(400):
        every.drift(0.05)
    truth = every.truth(0)
    low = truth.height_share < 1.2 * truth.radius_um / 200.0
    assert low.mean() > 0.5 and truth.stuck[low].mean() > 0.3
    moving = low & (truth.stuck == 0.0)
    here = (1.0 + n) / n * (1.0 - np.abs(2.0 * truth.height_share - 1.0) ** n)
    assert (every.speed_share()[moving] < 0.75 * here[moving]).all()


def test_a_bead_that_leaves_comes_in_as_another_one_where_the_flux_is() -> None:
    every = beads(200.0, 300, tracer_excess_kg_m3=0.0)
    before = every.truth(0).id
    for _ in range(600):
        every.drift(0.1)
    truth = every.truth(0)
    new = truth.id > before.max()
    assert new.any() and len(set(truth.id)) == 300
