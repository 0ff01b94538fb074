"""One tick: which stage is given what."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import flowrec
from flowrec.core.enums import Outcome, Phase
from flowrec.stages.pipeline import Inputs, assemble, step


def test_mission_and_controller_place_the_robot_by_the_registration_that_was_found_and_observations_keep_the_stated(
    session,
):
    recorded = flowrec.open(session)
    ticks = [tick for tick in recorded.ticks() if tick.mission and tick.mission.phase == Phase.NAVIGATE]
    last, now = ticks[3:5]
    pipeline = assemble(recorded.config, recorded.chip)

    def stepped(registration):
        refined = replace(last.field, registration=registration)
        return step(pipeline, replace(last, refined=refined), Inputs(now.stamp_ns, now.frame, now.applied))

    plain = stepped(None)
    assert not plain.mission.finished
    goal, seen = plain.mission.goal_um, plain.estimate.position_um
    quarter = np.array([[0.0, -1.0], [1.0, 0.0]])
    at_goal = stepped(np.column_stack((quarter, goal - quarter @ seen)))
    assert at_goal.mission.outcome == Outcome.REACHED
    for name in ("track", "estimate", "observations"):
        assert getattr(at_goal, name).same_as(getattr(plain, name)), name

    beside = np.array([0.0, 40.0])
    moved = stepped(np.column_stack((np.eye(2), beside)))
    assert moved.demand.error_um == pytest.approx(float(np.hypot(*(seen + beside - moved.demand.reference_um))))
    assert moved.demand.velocity_um_s[1] < plain.demand.velocity_um_s[1]  # back to the route
