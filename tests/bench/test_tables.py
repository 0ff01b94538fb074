"""Every bench has the rows of the tables of methods and a null model, so that a new method is measured by itself."""

import pytest

from flowrec.bench import flow, missions, observer, plan, track, worlds
from flowrec.bench.null_models import NULL_MODELS
from flowrec.stages.control.controller import CONTROLLERS
from flowrec.stages.estimation.observer import OBSERVERS
from flowrec.stages.planning import PLANNERS
from flowrec.stages.refine.refiner import REFINERS


def test_every_refiner_and_every_planner_has_a_row():
    assert set(REFINERS) <= set(flow.METHODS) and set(PLANNERS) <= set(plan.METHODS)
    assert all(flow.METHODS[name].method == name for name in REFINERS)
    assert all(plan.METHODS[name].method == name for name in PLANNERS)
    assert "fvm" in flow.METHODS and "astar_length" in plan.METHODS, "null models"
    assert "fvm" in worlds.METHODS and ("gain" in worlds.METHODS) == ("gain" in REFINERS), "null models"
    assert set(NULL_MODELS) <= set(worlds.METHODS) & set(flow.METHODS)


@pytest.mark.slow("a bench of every observer")
def test_every_observer_has_a_row_and_knowing_no_flow_is_the_worst_of_all():
    case = observer.CASES[0]
    run = observer.drive(case)
    found, _ = observer.estimates_of(case, run)
    assert set(OBSERVERS) <= set(found)
    errors = {name: observer.rmse(run, flow_um_s) for name, (flow_um_s, _) in found.items()}
    assert max(errors, key=errors.__getitem__) == "no observer"


def test_every_law_with_a_reference_and_every_observer_tracks_and_every_law_can_fly_missions():
    with_reference = {name for name, row in CONTROLLERS.items() if not row.needs}
    assert {law.method for law in track.LAWS.values()} == with_reference
    assert {law.observer for law in track.LAWS.values()} == set(OBSERVERS)
    assert track.LAWS["paper, without"].method == "ff_fb_no_flow", "null model"
    flown = {setting.removeprefix("control.method=") for sets in missions.POLICIES.values() for setting in sets}
    assert set(CONTROLLERS) <= flown and "plan.method=astar_length" in missions.POLICIES["plain"]
