"""The error of the map that planning, control and estimation count on."""

from dataclasses import replace

import numpy as np
import pytest

from flowrec.physics import FlowUncertainty, Robot
from flowrec.physics.flow import map_error
from flowrec.physics.flow.map_error import MapError
from flowrec.stages import Controller, Kalman, Planner, SurveyPlanner
from flowrec.stages.estimation.consistency_monitor import StepOut
from tests.stages.planning import worlds

USES = [value for value in vars(map_error).values() if isinstance(value, MapError)]
ROBOT = Robot(radius_um=40.0, max_speed_um_s=600.0, step_out_hz=30.0)


@pytest.mark.parametrize("use", USES)
def test_the_error_of_a_map_is_what_the_field_states_within_bounds_and_a_setting_overrides_it(use: MapError) -> None:
    field = worlds.field_of(worlds.channel(), 100.0)
    between = 0.5 * (use.least + use.most)
    assert use.of(None, None) == use.of(field, None) == use.most
    assert use.of(replace(field, error_share=0.0), None) == use.least
    assert use.of(replace(field, error_share=9.0), None) == use.most
    assert use.of(replace(field, error_share=between / use.deviations), None) == pytest.approx(between)
    assert use.of(replace(field, error_share=0.0), 0.7) == 0.7


def test_by_default_every_use_of_a_map_takes_its_error_from_the_field() -> None:
    stated = (
        *(Controller().map_error, Kalman().map_share, StepOut().map_error),
        *(Planner().flow_error_share, Planner().swift.map_error, SurveyPlanner().swift.map_error),
    )
    assert stated == (None,) * 6


def test_a_map_that_states_a_small_error_needs_less_room_in_a_fast_flow() -> None:
    swift = replace(Planner().swift, heading_error_rad=0.0, frame_s=0.03, latency_s=0.04)
    field = worlds.field_of(worlds.open_water(), 400.0)
    off_um = [swift.course_error(ROBOT, 0.0, replace(field, error_share=share)).um(field) for share in (0.05, 0.1)]
    straight_um = swift.course_error(ROBOT, 0.0, field).um(field) - 0.07 * 0.2 * 400.0
    assert np.allclose([off_um[0] - straight_um, off_um[1] - straight_um], [[[2.8]], [[5.6]]], atol=1e-6)


def test_the_standard_deviation_of_a_flow_is_that_of_draws_from_its_modes_and_of_what_no_mode_explains():
    rng = np.random.default_rng(0)
    root = rng.normal(size=(4, 4))
    columns, mean, left = rng.normal(size=(3, 5, 2)), 10.0 + rng.normal(size=(5, 2)), rng.uniform(0.5, 2.0, 5)
    flow = FlowUncertainty(mean, columns, np.ones((1, 5)), root @ root.T, left)
    z = (rng.normal(size=(40_000, 4)) @ root.T)[:, :3]  # the last unknown is of the robot
    drawn = np.tensordot(z, columns, axes=1) + left[:, None] * rng.normal(size=(40_000, 5, 2))
    np.testing.assert_allclose(flow.std_um_s, drawn.std(axis=0), rtol=0.03)
    assert flow.error_share == pytest.approx(np.sqrt((drawn**2).sum(axis=(1, 2)).mean() / (mean**2).sum()), rel=0.03)
