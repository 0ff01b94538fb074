"""Compilation ahead of need."""

from __future__ import annotations

import numpy as np

from flowrec.chip.chip import Chip, Opening
from flowrec.messages import FlowField
from flowrec.planning.planner import Planner
from flowrec.planning.survey import SurveyPlanner
from flowrec.robot import Robot


def warm_up() -> None:
    """Plan on a toy chip once, so that the first true order does not wait for the compiler."""
    mask = np.zeros((9, 24), np.bool_)
    mask[2:7] = True
    velocity = np.zeros((9, 24, 2), np.float32)
    velocity[2:7, :, 0] = 1.0
    openings = (Opening("left", 2, 6, "inlet", 1.0), Opening("right", 2, 6, "outlet", 0.0))
    chip = Chip("warm-up", mask, 1.0, openings, 1.0, 1000.0)
    field = FlowField(
        0, 0, "none", 1.0, velocity, np.zeros((9, 24), np.float32), None, chip.boundary_values, 1.0, 1000.0, ""
    )
    robot = Robot(radius_um=0.5, max_speed_um_s=5.0, step_out_hz=10.0)
    SurveyPlanner().plan(field, (2.0, 4.0), chip, robot)
    for planner in (Planner(), Planner(method="astar_time"), Planner(method="astar_paper")):
        planner.plan(field, (2.0, 4.0), (20.0, 4.0), chip, robot)
