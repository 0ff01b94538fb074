"""A pump that pulses, and one that drifts."""

from __future__ import annotations

import numpy as np
import pytest

from flowrec.core import FlowField
from flowrec.physics import Robot
from flowrec.rigs.simulated.bodies import Swimmer
from flowrec.rigs.simulated.pump import Pump, PumpSensor
from flowrec.stages import Simulated


def drifter(share: float) -> Swimmer:
    robot = Robot(radius_um=50.0, max_speed_um_s=600.0, step_out_hz=30.0)
    velocity = np.zeros((40, 200, 2), np.float32)
    velocity[..., 0] = 100.0
    quiet = Simulated(world="kind", pulsation_share=share, pulsation_hz=2.0, position_noise_um=0.0)
    field = FlowField(0, 0, "made up", 20.0, velocity, np.zeros((40, 200)), None, np.zeros(0), 1.0, 1000.0, "")
    return Swimmer((400.0, 400.0), robot, quiet, field, np.full((40, 200), 500.0, np.float32), 20.0)


def test_a_pulsating_flow_swings_about_the_steady_one_and_carries_as_far() -> None:
    steady, pulsating = drifter(0.0), drifter(0.5)
    speeds = []
    for _ in range(30):
        steady.advance(1 / 30, 0.0, 0.0, 0.0)
        pulsating.advance(1 / 30, 0.0, 0.0, 0.0)
        speeds.append(pulsating.flow_um_s[0])
    assert max(speeds) == pytest.approx(150.0, rel=0.02)
    assert min(speeds) == pytest.approx(50.0, rel=0.02)
    np.testing.assert_allclose(pulsating.position_um, steady.position_um, atol=0.2)


def test_the_flow_of_a_drifting_pump_is_on_average_that_of_the_map_it_is_judged_by() -> None:
    pump = Pump(0.0, 1.0, 0.0, 0.1, 20.0, np.random.default_rng(4))
    strengths = [pump.strength(0.5 * step) for step in range(60)]
    assert np.std(strengths) > 0.02
    assert pump.mean_drift(30.0) == pytest.approx(np.mean(strengths), abs=1e-12)


def test_a_sensor_at_the_pump_shows_a_step_its_delay_after_it() -> None:
    pump = Pump(0.0, 0.0, 0.0, 0.0, 1.0, np.random.default_rng(0), step_share=0.5, step_s=2.0)
    sensor = PumpSensor(pump, 100.0, 0.0, 0.3, 0, lambda: 5 * 10**9)
    chunk = sensor.read(0.0)
    assert chunk is not None and len(chunk.times_ns) == 501
    assert chunk.times_ns[chunk.values[:, 0] < 0.75][0] == pytest.approx(2.3e9, abs=1.1e7)
