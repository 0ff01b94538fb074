import numpy as np
import pytest

from flowrec.core import bilinear
from flowrec.physics import ChipSettings, FlowSolver, clearance_um, load_chip, opening_point_um, sample
from tests.stages.planning.worlds import PX, channel, chip_of, downstream, field_of, length_um, loop, poiseuille, robot


def test_the_survey_goes_with_the_main_stream_and_stops_before_the_outlet():
    chip, field = loop()
    route = downstream(field, (60.0, 205.0), chip, robot(200.0), distance_um=1e5)
    assert route.reachable, route.reason
    assert route.waypoints_um[:, 1].max() < 300.0, "the fast branch"
    end_um = (chip.mask.shape[1] - 0.5) * PX - route.waypoints_um[-1, 0]
    assert 30.0 <= end_um < 60.0
    middle = route.waypoints_um[5:, 1]
    assert np.abs(middle - 200.0).max() < 15.0


def test_the_survey_is_as_long_as_asked_and_a_share_of_the_way_when_nothing_is_asked():
    chip, field = loop()
    start = (60.0, 205.0)
    assert length_um(downstream(field, start, chip, robot(200.0), distance_um=400.0)) == pytest.approx(400.0, abs=15.0)
    assert length_um(downstream(field, start, chip, robot(200.0), share=0.5)) == pytest.approx(650.0, abs=20.0)


@pytest.mark.parametrize("name", ["bifurcation", "vessels"])
def test_in_a_solved_flow_the_survey_runs_downstream_all_the_way_clear_of_walls(name):
    chip = load_chip(ChipSettings(name=name))
    field = FlowSolver().solve(chip)
    swimmer = robot(600.0, radius_um=2.4 * chip.um_per_px)
    start = opening_point_um(chip, "inlet", 5 * swimmer.radius_um)
    route = downstream(field, start, chip, swimmer, distance_um=1e6)
    assert route.reachable, route.reason
    points = route.waypoints_um[::4]
    with_flow = np.einsum("ij,ij->i", np.diff(points, axis=0), sample(field, 0.5 * (points[1:] + points[:-1])))
    assert (with_flow > 0).mean() > 0.97
    clearance = clearance_um(chip.mask, chip.um_per_px).astype(float)
    assert min(bilinear(clearance, *(p / chip.um_per_px)) for p in route.waypoints_um) >= swimmer.radius_um
    assert length_um(route) > 1.5 * chip.mask.shape[1] * chip.um_per_px / 2


def test_a_survey_from_within_a_channel_goes_with_the_flow_though_more_of_it_lies_upstream():
    mask = channel()
    route = downstream(poiseuille(mask, 60.0), (900.0, 195.0), chip_of(mask), robot(200.0), distance_um=1e5)
    assert route.reachable and (route.waypoints_um[1:, 0] > 900.0).all()


def test_a_start_at_the_very_end_and_still_fluid_have_nothing_downstream():
    mask = channel()
    start = (600.0, 195.0)
    assert "nothing lies downstream" in downstream(field_of(mask, 0.0), start, chip_of(mask), robot()).reason
    assert "in a wall" in downstream(field_of(mask, 9.0), (600.0, 20.0), chip_of(mask), robot()).reason
