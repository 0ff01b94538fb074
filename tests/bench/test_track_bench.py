"""The paper's tracking study, in part."""

from dataclasses import replace

import pytest

from flowrec.bench.track import ALL, FIRST, IDEAL, LAWS, PACES, flights, score
from tests.stages.control.plant import lemniscate


@pytest.mark.slow("a bench of tracking laws")
def test_the_papers_three_curves_come_in_its_order_and_vector_is_better_than_all():
    rows = {name: score(name, "", flights(LAWS[name], PACES["as planned"], IDEAL, 1)) for name in FIRST}
    compensated, without, observed = (rows[name] for name in FIRST)
    assert compensated["rmse_um"] < observed["rmse_um"] < without["rmse_um"]
    assert compensated["converged_s"] is not None and observed["converged_s"] is not None
    assert compensated["converged_s"] < observed["converged_s"] and without["converged_s"] is None
    name = "vector, kalman_map"
    assert score(name, "", flights(LAWS[name], PACES["as planned"], ALL, 1))["steady_um"] < 6.0


@pytest.mark.slow("a bench of tracking laws")
def test_where_step_out_binds_a_slowed_reference_is_followed_as_closely_as_ever():
    world, law = replace(ALL, step_out_um_s=500.0), LAWS["vector, kalman_map"]
    hasty, slowed = (score("", "", flights(law, PACES[pace], world, 1)) for pace in ("as planned", "limited speed"))
    assert slowed["steady_um"] < 7.0 < 100.0 < hasty["steady_um"]
    assert lemniscate().arrival_s[-1] == 80.0 and 0.8 < slowed["progress"] < 1.0
