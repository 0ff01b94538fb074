"""A lap of the paper's lemniscate in its swirling flow, for observers: what is measured and what is true."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from flowrec.core import Applied, Estimate, FlowField, Track
from flowrec.physics import Robot
from flowrec.stages import Observer

ROBOT = Robot(radius_um=50.0, max_speed_um_s=600.0, step_out_hz=30.0, um_per_rev=25.0)
RATE_HZ = 30.0
LAP_S = 40.0
MIDDLE = np.array([2200.0, 1200.0])  # of the vortex, um
SPIN_PER_S = 0.2

Floats = NDArray[np.float64]


def lemniscate(time_s: float | Floats) -> Floats:
    """(..., 2) the reference of the paper's tracking study, once around in 40 s."""
    sine, cosine = np.sin(2 * np.pi * time_s / LAP_S), np.cos(2 * np.pi * time_s / LAP_S)
    return MIDDLE + np.stack([1800.0 * cosine, 1500.0 * sine * cosine], -1) / np.asarray(1.0 + sine**2)[..., None]


def across(position: Floats) -> Floats:
    """(..., 2) the vortex of strength 1/s."""
    x, y = position[..., 0] - MIDDLE[0], position[..., 1] - MIDDLE[1]
    return np.stack((-y, x), -1)


def vortex(share: float = 1.0, spacing_um: float = 20.0) -> FlowField:
    """The swirling flow as a map, `share` of its strength; the chip's origin is (0, 0) as ever."""
    y, x = np.mgrid[0:120, 0:220] * spacing_um
    velocity = share * SPIN_PER_S * across(np.stack([x, y], -1))
    return FlowField(
        0, 0, "map", spacing_um, velocity, np.zeros(velocity.shape[:2]), None, np.zeros(0), 1.0, 1000.0, ""
    )


@dataclass
class Lap:
    tracks: list[Track]
    applied: list[Applied]
    flow_um_s: Floats  # (n, 2)

    def observed(self, observer: Observer, field: FlowField | None = None) -> list[Estimate]:
        """The estimate after every frame."""
        estimates: list[Estimate] = []
        for track, done in zip(self.tracks, self.applied, strict=True):
            estimates.append(observer.estimate(estimates[-1] if estimates else None, track, done, ROBOT, field))
        return estimates

    def rmse(self, flow_um_s: list[Floats] | Floats) -> float:
        """Of the vector over the second half, um/s."""
        miss = np.asarray(flow_um_s) - self.flow_um_s
        return float(np.sqrt(np.square(miss)[len(miss) // 2 :].sum(axis=1).mean()))


def driven(noise_um: float, *, pulsation: float = 0.0, pulsation_hz: float = 1.0, gain: float = 1.0) -> Lap:
    """A robot driven along it exactly: its own displacement is what the flow (Simpson's rule) leaves of the way.

    `gain` is its true um per revolution over the nominal.
    """
    rng = np.random.default_rng(0)
    time = np.arange(round(LAP_S * RATE_HZ)) / RATE_HZ

    def flow(at: Floats) -> Floats:
        pulse = 1.0 + pulsation * np.sin(2 * np.pi * pulsation_hz * at)
        return SPIN_PER_S * pulse[:, None] * across(lemniscate(at))

    place, true = lemniscate(time), flow(time)
    carried = (true[:-1] + 4.0 * flow(time[:-1] + 0.5 / RATE_HZ) + true[1:]) / (6.0 * RATE_HZ)
    moved = np.concatenate([np.zeros((1, 2)), np.diff(place, axis=0) - carried])
    measured = place + noise_um * rng.standard_normal(place.shape)
    turns = moved / (gain * ROBOT.um_per_rev)
    stamps = [round(at * 1e9) for at in time]
    tracks = [Track(stamp, True, at, 0.9, 0, 5.0, np.zeros(4)) for stamp, at in zip(stamps, measured, strict=True)]
    applied = [Applied(stamp, 0.0, 0.0, 0.0, np.zeros(3), turn) for stamp, turn in zip(stamps, turns, strict=True)]
    return Lap(tracks, applied, true)
