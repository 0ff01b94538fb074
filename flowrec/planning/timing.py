"""The one judge of every planner: how long a robot takes along a polyline, by the model and nothing else."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from flowrec.flow import sample
from flowrec.messages import FlowField

Points = NDArray[np.float64]
_STEPS_PER_PX = 4.0


def ground_speed(
    field: FlowField, points_um: Points, directions: Points, speed_um_s: float, idle_um_s: float | None = None
) -> NDArray[np.float64]:
    """Speed over ground (n,) of a robot that keeps to directions (n, 2) of any length at points (n, 2), um/s.

    d.v + sqrt(V^2 - |v_perp|^2) (science.md, section 3); -inf where the flow carries it sideways. A robot that
    saves energy goes at sqrt(idle^2 + |v|^2), or as near to it as V allows (zermelo.step_energy).
    """
    velocity = sample(field, points_um)
    length = np.hypot(directions[:, 0], directions[:, 1])
    unit = directions / np.where(length > 0.0, length, 1.0)[:, None]
    along = unit[:, 0] * velocity[:, 0] + unit[:, 1] * velocity[:, 1]
    across = unit[:, 0] * velocity[:, 1] - unit[:, 1] * velocity[:, 0]
    spare = speed_um_s**2 - across**2
    root = np.sqrt(np.maximum(spare, 0.0))
    ground = along + root
    if idle_um_s is not None:
        ground = np.clip(np.sqrt(idle_um_s**2 + (velocity**2).sum(axis=1)), along - root, along + root)
    return np.where(spare >= 0.0, ground, -np.inf)


def travel_time(
    field: FlowField, waypoints_um: Points, speed_um_s: float, idle_um_s: float | None = None
) -> tuple[NDArray[np.float64], bool]:
    """When a robot that keeps to a polyline passes each of its points, and whether it can.

    The ground speed is taken in the middle of steps of at most a quarter of a pixel; nothing that a planner
    assumed enters.

    Parameters
    ----------
    waypoints_um : (n, 2) points of the polyline.
    speed_um_s : V, speed through the fluid.
    idle_um_s : for a robot that saves energy where it can, see `ground_speed`; None for one in a hurry.

    Returns
    -------
    arrival_s (n,) since the first point, inf behind the first place where the flow is too fast; and feasible.
    """
    points = np.asarray(waypoints_um, np.float64)
    arrival = np.zeros(len(points))
    if len(points) < 2:
        return arrival, True
    legs = np.diff(points, axis=0)
    lengths = np.hypot(legs[:, 0], legs[:, 1])
    steps = np.maximum(1, np.ceil(lengths * _STEPS_PER_PX / field.um_per_px)).astype(np.int64)
    first = np.cumsum(steps) - steps
    leg = np.repeat(np.arange(len(legs)), steps)
    share = (np.arange(steps.sum()) - first[leg] + 0.5) / steps[leg]
    ground = ground_speed(field, points[leg] + share[:, None] * legs[leg], legs[leg], speed_um_s, idle_um_s)
    way = (lengths / steps)[leg]
    possible = ground > 1e-9 * speed_um_s
    time = np.where(possible, way / np.where(possible, ground, 1.0), np.inf)
    time[way == 0.0] = 0.0  # wherever that is, nobody has to move
    arrival[1:] = np.cumsum(np.add.reduceat(time, first))
    return arrival, bool(np.isfinite(arrival[-1]))
