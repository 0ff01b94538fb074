import json

import numpy as np
import pytest

from flowrec.bench.complex_fluids import bend_drop, law_bend_case
from flowrec.bench.published_flows import cavity_case, cylinder_case
from flowrec.bench.solver import measure, show
from flowrec.physics.chip.fluid import PowerLaw


@pytest.mark.slow("a whole bench: ten flows on several grids")
def test_the_quick_bench_has_every_case_and_fits_into_json():
    figures = measure(quick=True)
    show(figures)
    laws = {"law channel", "law oblique", "law bend", "law speed"}
    cases = {"channel", "oblique", "bend", "cavity", "cylinder", "speed"} | laws
    assert {row["case"] for row in figures["rows"]} == cases
    assert json.loads(json.dumps(figures)) == figures
    assert figures["summary"]["channel_largest_error_percent"] < 0.01
    assert figures["summary"]["bend_order"] == pytest.approx(2.0, abs=0.4)
    assert figures["summary"]["law_channel_largest_error_percent_at_12_px"] < 0.5
    assert figures["summary"]["mass_lost_in_a_cell"] < 1e-12


def test_a_bend_of_a_constant_viscosity_has_the_closed_solution_and_laws_converge_to_theirs():
    # u = G / (2 mu) (r ln r + B r + C / r), as in bend_case, for mu = 1.
    inner, outer = 1.0, 2.0
    b, c = np.linalg.solve([[inner, 1 / inner], [outer, 1 / outer]], [-inner * np.log(inner), -outer * np.log(outer)])
    r = np.linspace(inner, outer, 20_001)
    flow = -float(np.trapezoid(0.5 * (r * np.log(r) + b * r + c / r), r))
    np.testing.assert_allclose(bend_drop(PowerLaw(1.0), inner, outer, flow), 1.0, rtol=1e-6)
    coarse, fine = (abs(law_bend_case("power law 0.5", k)["resistance_error_percent"]) for k in (1, 2))
    assert coarse < 3.0
    assert fine < 0.5 * coarse


def test_the_cavity_agrees_with_the_table_also_where_plain_newton_fails():
    assert cavity_case(32, 100)["u_largest"] < 0.005
    assert cavity_case(32, 1000)["u_largest"] < 0.1


def test_the_drag_of_a_drawn_cylinder_is_within_three_per_cent():
    assert abs(cylinder_case(10, 1, "smooth")["drag_error_percent"]) < 3.0
