import json

import pytest

from flowrec.bench.published_flows import cavity_case, cylinder_case
from flowrec.bench.solver import measure, show


def test_the_quick_bench_has_every_case_and_fits_into_json():
    figures = measure(quick=True)
    show(figures)
    assert {row["case"] for row in figures["rows"]} == {"channel", "oblique", "bend", "cavity", "cylinder", "speed"}
    assert json.loads(json.dumps(figures)) == figures
    assert figures["summary"]["channel_largest_error_percent"] < 0.01
    assert figures["summary"]["bend_order"] == pytest.approx(2.0, abs=0.4)
    assert figures["summary"]["mass_lost_in_a_cell"] < 1e-12


def test_the_cavity_agrees_with_the_table_also_where_plain_newton_fails():
    assert cavity_case(32, 100)["u_largest"] < 0.005
    assert cavity_case(32, 1000)["u_largest"] < 0.1


def test_the_drag_of_a_drawn_cylinder_is_within_three_per_cent():
    assert abs(cylinder_case(10, 1, "smooth")["drag_error_percent"]) < 3.0
