"""What every method of the control stage promises."""

from dataclasses import fields, replace

import numpy as np

from flowrec.core import Demand, Route
from flowrec.physics import clearance_um
from flowrec.stages import CONTROLLERS, Controller
from tests.stages.control.plant import ROBOT, field_of, fly, mission, straight, vortex

START_UM = (700.0, 2600.0)
WEAK = replace(ROBOT, max_speed_um_s=400.0, step_out_hz=16.0)


def route() -> Route:
    """Along the channel, with the time to go of still fluid."""
    y, x = np.mgrid[0:101, 0:101] * 50.0
    return replace(straight(), time_to_go_s=np.hypot(3500.0 - x, 2500.0 - y) / 300.0)


def test_from_any_recorded_demand_on_the_next_one_is_the_same(any_controller):
    field = field_of(vortex)
    run = fly(any_controller, route(), vortex, 3.0, START_UM, field, noise_um=5.0, robot=WEAK)
    for tick in (1, 30, len(run.demands) - 1):
        values = {each.name: getattr(run.demands[tick - 1], each.name) for each in fields(Demand)}
        recorded = Demand(**{name: np.array(v) if isinstance(v, np.ndarray) else v for name, v in values.items()})
        again = replace(any_controller).control(
            recorded, mission(), route(), run.estimates[tick], field, WEAK, None, 1.0
        )
        assert again.same_as(run.demands[tick])


def test_demands_are_finite_and_within_the_speed_limit(any_controller):
    run = fly(any_controller, route(), vortex, 4.0, START_UM, field_of(vortex), noise_um=10.0, robot=WEAK)
    for demand in run.demands:
        assert np.isfinite(demand.velocity_um_s).all() and np.isfinite(demand.reference_um).all()
        assert np.hypot(*demand.velocity_um_s) <= WEAK.speed_limit_um_s * (1.0 + 1e-9)


def test_a_robot_that_is_not_seen_is_a_value_and_soon_asked_for_nothing(any_controller):
    run = fly(any_controller, route(), lambda x, y: (0.0, 0.0), 4.0, START_UM, None, blind=(0.5, 9.0), robot=WEAK)
    assert not run.demands[-1].velocity_um_s.any()
    never = fly(any_controller, route(), lambda x, y: (0.0, 0.0), 0.2, START_UM, None, blind=(0.0, 9.0), robot=WEAK)
    assert not any(demand.velocity_um_s.any() for demand in never.demands)


def test_no_wall_is_touched_though_the_route_leads_into_it(any_controller):
    mask = np.zeros((101, 101), bool)
    mask[40:61] = True  # walls at y = 1975 and 3025 um
    time = np.linspace(0.0, 10.0, 101)
    waypoints = np.stack([500.0 + 200.0 * time, 2500.0 - 80.0 * time], -1)
    into_wall = replace(route(), waypoints_um=waypoints, arrival_s=time, time_to_go_s=None)
    walls = (clearance_um(mask, 50.0), 50.0)
    run = fly(any_controller, into_wall, lambda x, y: (0.0, -30.0), 10.0, (500.0, 2500.0), None, clearance=walls)
    assert run.position_um[:, 1].min() - 1975.0 > 0.8 * ROBOT.radius_um


def test_the_options_of_each_row_are_settings_of_the_stage():
    names = {each.name for each in fields(Controller)}
    assert {option for row in CONTROLLERS.values() for option in row.options} <= names
