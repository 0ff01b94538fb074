import numpy as np
import pytest
import scipy.sparse as sp

from flowrec.flow import FlowSolver, factors
from flowrec.flow import system as systems
from flowrec.flow.factors import factorise


@pytest.fixture
def wide_plate():
    """A 13-point biharmonic matrix with a skew part on 70 x 50 points, a hole, and one unknown tied to many."""
    h, w = 70, 50
    line = [sp.diags_array([np.ones(n - 1), -2.0 * np.ones(n), np.ones(n - 1)], offsets=[-1, 0, 1]) for n in (h, w)]
    laplace = sp.kron(line[0], sp.eye_array(w)) + sp.kron(sp.eye_array(h), line[1])
    drift = sp.kron(sp.diags_array([-np.ones(h - 1), np.ones(h - 1)], offsets=[-1, 1]), sp.eye_array(w))
    matrix = sp.lil_array(laplace @ laplace + 0.5 * drift + sp.eye_array(h * w))
    island = h * w // 2
    for other in range(0, h * w, 9):
        matrix[island, other] += -0.01
        matrix[other, island] += -0.02
    rows, columns = np.mgrid[:h, :w]
    places = np.stack([rows.ravel(), columns.ravel()], axis=1).astype(float)
    kept = np.flatnonzero(np.hypot(places[:, 0] - 20, places[:, 1] - 15) > 6)
    return sp.csc_array(matrix.tocsc()[kept][:, kept]), places[kept]


def test_both_engines_solve_the_same_unsymmetric_system(wide_plate, monkeypatch):
    matrix, places = wide_plate
    right = np.random.default_rng(3).standard_normal((matrix.shape[0], 3))
    small = factorise(matrix, places)
    monkeypatch.setattr(factors, "LARGE", 100)
    large = factorise(matrix, places)
    assert type(large) is not type(small)
    assert large.solve(right) == pytest.approx(small.solve(right), rel=1e-9, abs=1e-11)
    assert large.solve(right[:, 0]) == pytest.approx(large.solve(right)[:, 0], rel=1e-9, abs=1e-11)
    assert matrix @ large.solve(right) == pytest.approx(right, abs=1e-10)


def test_where_the_unknowns_lie_does_not_change_the_solution(wide_plate, monkeypatch):
    matrix, places = wide_plate
    right = np.ones(matrix.shape[0])
    monkeypatch.setattr(factors, "LARGE", 100)
    monkeypatch.setattr(factors, "FILLED", 0.0)
    at_home = factorise(matrix, places).solve(right)
    for wrong in (np.zeros_like(places), places[np.random.default_rng(4).permutation(len(places))]):
        assert factorise(matrix, wrong).solve(right) == pytest.approx(at_home, rel=1e-8)


def test_a_flow_is_the_same_from_both_engines(crossing, monkeypatch):
    chip = crossing.with_boundary([60000.0, 20000.0, 0.0, 5.0])
    first = FlowSolver(2).solve(chip)
    monkeypatch.setattr(factors, "LARGE", 100)
    systems._kept.clear()
    second = FlowSolver(2).solve(chip)
    systems._kept.clear()
    assert second.velocity_um_s == pytest.approx(first.velocity_um_s, rel=1e-6, abs=1e-2)
    assert second.pressure_pa == pytest.approx(first.pressure_pa, rel=1e-5, abs=1e-5)
