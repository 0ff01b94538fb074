"""What every method of the table promises, and the choice of the method."""

import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
import scipy

from flowrec.core.errors import FlowError, FlowrecError, UsageError
from flowrec.core.messages import Observations
from flowrec.physics.flow.linear_solver import clear_cache
from flowrec.stages.config import load_config
from flowrec.stages.refine import REFINERS, Refiner


def refine(refiner, case):
    return refiner.refine(case.assumed, case.observations, case.chip, case.solver)


@pytest.fixture(scope="module")
def refined():
    """What a method makes of a twin with the stamp 77 and the request 5, computed once."""
    fields = {}

    def refined_once(refiner, case):
        case.assumed = replace(case.assumed, stamp_ns=77, request=5, note="")
        if refiner.method not in fields:
            fields[refiner.method] = refine(refiner, case)
        return fields[refiner.method]

    return refined_once


def test_every_method_gives_a_finite_field_that_is_zero_in_solid(any_refiner, twin, refined):
    case = twin()
    field = refined(any_refiner, case)
    solid = ~case.chip.mask
    assert field.velocity_um_s.shape == case.assumed.velocity_um_s.shape
    assert field.pressure_pa.shape == case.assumed.pressure_pa.shape
    assert np.isfinite(field.velocity_um_s).all() and np.isfinite(field.pressure_pa).all()
    assert not field.velocity_um_s[solid].any() and not field.pressure_pa[solid].any()
    assert field.velocity_um_s[case.chip.mask].any()


def test_every_method_states_a_note_and_either_no_error_bars_or_sound_ones(any_refiner, twin, refined):
    case = twin()
    field = refined(any_refiner, case)
    assert field.note and "\n" not in field.note
    assert (field.stamp_ns, field.request) == (77, 5)
    if field.std_um_s is not None:
        assert field.std_um_s.shape == field.velocity_um_s.shape
        assert (field.std_um_s[case.chip.mask] > 0.0).all() and not field.std_um_s[~case.chip.mask].any()


def test_every_method_makes_the_same_bytes_of_the_same_inputs_whatever_the_truth_and_leaves_them_unchanged(
    any_refiner, twin, refined
):
    # Two true flows with the same observations.
    one, other, same = twin(), twin(truth=(160.0, 0.0, 0.001)), twin()
    known = refined(any_refiner, one)
    other.observations, other.assumed = one.observations, replace(other.assumed, stamp_ns=77, request=5, note="")
    assert known.same_as(refine(any_refiner, other))
    assert replace(other.assumed, stamp_ns=0, request=0, note="").same_as(replace(same.assumed, note=""))
    for name in ("position_um", "flow_um_s", "std_um_s"):
        assert np.array_equal(getattr(one.observations, name), getattr(same.observations, name))


def test_every_method_refuses_a_field_of_another_chip(any_refiner, twin):
    case = twin()
    smaller = replace(
        case.assumed, velocity_um_s=case.assumed.velocity_um_s[1:], pressure_pa=case.assumed.pressure_pa[1:]
    )
    with pytest.raises(FlowError, match=r"47, 80.*48, 80"):
        any_refiner.refine(smaller, case.observations, case.chip, case.solver)


def test_every_method_returns_the_assumed_field_without_observations(any_refiner, twin):
    case = twin()
    nothing = Observations(0, np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0))
    field = any_refiner.refine(case.assumed, nothing, case.chip, case.solver)
    assert np.array_equal(field.velocity_um_s, case.assumed.velocity_um_s)
    assert field.note.startswith("not refined")


def test_every_method_bears_an_observation_beside_a_wall_at_the_edge_of_the_fluid(any_refiner, twin):
    # The rows of the fluid are 8 to 39, a multiple of 16: a network's crop of the image has no row 40 below them.
    case = twin()
    mask = case.chip.mask.copy()
    mask[40:] = False
    chip = replace(case.chip, mask=mask, openings=case.chip.openings[:2])
    points = np.array([[400.0, 393.0], [592.0, 350.0], [240.0, 240.0]])
    observed = Observations(0, points, np.tile([5.0, 1.0], (3, 1)), np.full(3, 2.0))
    field = any_refiner.refine(case.solver.solve(chip), observed, chip, case.solver)
    assert np.isfinite(field.velocity_um_s).all()


def test_what_depends_on_the_chip_alone_can_be_prepared_and_changes_no_result(twin, monkeypatch):
    """Prepared, a survey order compares depths and mask offsets without a flow of its own, and says the same."""
    factorised = []
    splu = scipy.sparse.linalg.splu
    monkeypatch.setattr(
        scipy.sparse.linalg, "splu", lambda *given, **named: factorised.append(1) or splu(*given, **named)
    )
    world, refiner = twin(truth=(130.0, 0.0, 0.0)), Refiner()

    def order():
        found = refiner.uncertainty(world.assumed, world.observations, world.chip, world.solver)
        return found.mean_um_s.tobytes(), found.covariance.tobytes()

    clear_cache()
    usual, in_order = order(), len(factorised)
    clear_cache()
    for part in refiner.preparations(world.chip, world.solver):
        part()
    before = len(factorised)
    assert order() == usual
    left = len(factorised) - before
    assert in_order > 20 and left <= 2, "only the walls that the observations ask for have a flow yet to compute"


@pytest.mark.parametrize("times", [12.0, -12.0])
def test_the_next_stretch_of_a_survey_counts_with_a_flow_many_times_as_fast_as_the_assumed_one(twin, times):
    case = twin()
    faster = replace(case.observations, flow_um_s=times * case.observations.flow_um_s)
    found = Refiner().uncertainty(case.assumed, faster, case.chip, case.solver)
    true_um_s = times * case.true.velocity_um_s[case.chip.mask]
    assert np.linalg.norm(found.mean_um_s - true_um_s) < 0.05 * np.linalg.norm(true_um_s)


def test_an_unknown_method_is_an_error_that_names_the_nearest(twin):
    for use in (lambda: refine(Refiner("kalman"), twin()), lambda: Refiner("kalman").weights_sha256):
        with pytest.raises(UsageError, match=r"refine\.method = 'kalman': .* assimilate, "):
            use()
    with pytest.raises(FlowrecError, match=r"refine\.method"):
        load_config(None, ["refine.method=kalman"])


def test_every_row_of_the_table_has_a_summary_and_settings_that_the_stage_has():
    for row in REFINERS.values():
        assert row.summary and hasattr(row.load(), "fit")
        assert all(hasattr(Refiner(), name) for name in row.options)


def test_torch_is_not_imported_before_a_method_that_needs_it_runs():
    loaded = "[method.load() for method in refine.REFINERS.values()]"
    code = f"import sys; from flowrec.stages import refine; {loaded}; sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
