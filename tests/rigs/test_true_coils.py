"""Coils whose calibration is off: the direction and the strength that follow are those of the turning field itself."""

import math
from dataclasses import replace

import numpy as np
import pytest

from flowrec.rigs.simulated.world import TrueCoils
from flowrec.stages import Coils
from tests.rigs.test_simulated import EXACT, command, fly, rig_with

WRONG = replace(EXACT, seed=4, coil_error=0.05)


@pytest.mark.parametrize(
    "kinds", [{}, {"surface": "ceiling"}, {"mode": "helix"}, {"mode": "helix", "handedness": "left"}]
)
def test_a_robot_turns_about_the_axis_of_the_field_that_is_truly_made(kinds):
    coils = Coils(**kinds)
    wrong = TrueCoils.of(coils, WRONG)
    phase = np.linspace(0.0, 2.0 * math.pi, 400, endpoint=False)
    for heading in (0.3, 2.0, -2.5):
        asked = coils.field_mt(phase, heading, 1.0)
        made = asked @ wrong.made.T
        # Twice the area that the tip of the field sweeps, as a vector: the axis about which it turns.
        axes = [np.cross(field, np.roll(field, -1, axis=0)).sum(axis=0) for field in (asked, made)]
        turned = math.atan2(*axes[1][1::-1]) - math.atan2(*axes[0][1::-1])
        direction, strength = wrong.motion(heading)
        assert math.remainder(direction - heading - turned, 2.0 * math.pi) == pytest.approx(0.0, abs=1e-9)
        assert 1e-4 < abs(turned) < 0.15
        assert strength == pytest.approx(min(np.linalg.norm(made, axis=1).min(), 1.0), rel=1e-3)
        reverse, same = wrong.motion(heading + math.pi)
        assert math.remainder(reverse - direction - math.pi, 2.0 * math.pi) == pytest.approx(0.0, abs=1e-9)
        assert same == pytest.approx(strength)


def test_the_simulated_robot_goes_there_and_the_readback_states_what_was_commanded():
    commands = {0: replace(command(10.0, 0.4, 4.0), limit_hz=20.0)}
    right, wrong = (fly(rig_with(simulated=s, coils=Coils(ramp_s=0.0)), commands) for s in (EXACT, WRONG))
    assert TrueCoils.of(Coils(), EXACT) is None
    assert TrueCoils.of(None, WRONG) is None
    assert [i.applied.turns.tolist() for i in right] == [i.applied.turns.tolist() for i in wrong]
    ways = [seen[-1].truth.position_um - seen[0].truth.position_um for seen in (right, wrong)]
    assert math.atan2(*ways[0][::-1]) == pytest.approx(0.4)
    assert math.atan2(*ways[1][::-1]) == pytest.approx(TrueCoils.of(Coils(), WRONG).motion(0.4)[0])
    assert math.hypot(*ways[1]) == pytest.approx(math.hypot(*ways[0]))
