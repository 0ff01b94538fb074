"""Trips through random vessels, and the least time that they can take: the reference for planners."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.ndimage import label

from flowrec.bench.vessels import draw_mask
from flowrec.core import Floats, FlowField, FlowrecError
from flowrec.physics import Chip, FlowSolver, Robot, find_openings, read_vessel_case
from flowrec.stages import SPACING_PX, descend, open_space, refine_path, time_field, travel_time

SPEED_UM_S = 1000.0  # the robot's; flows are scaled to it
UM_PER_PX = 20.0
FINER = 8  # pixels of the reference per pixel side; time_field uses at most four
_EIGHT = np.ones((3, 3), np.int64)
Points = Floats


@dataclass(frozen=True, slots=True, eq=False)
class TripCase:
    """A chip, its flow scaled to a peak of 1 um/s, and a robot of SPEED_UM_S that fits through."""

    name: str
    chip: Chip
    flow: FlowField
    robot: Robot

    def field(self, ratio: float) -> FlowField:
        """The flow with a peak of `ratio` times the robot's speed."""
        return replace(self.flow, velocity_um_s=self.flow.velocity_um_s * np.float32(ratio * SPEED_UM_S))


@dataclass(frozen=True, slots=True, eq=False)
class Trip:
    """Two points: downstream is from the upper to the lower one, by pressure."""

    upper_um: Points
    lower_um: Points

    def ends(self, direction: str) -> tuple[Points, Points]:
        """Start and goal, `down` or `up`."""
        return (self.upper_um, self.lower_um) if direction == "down" else (self.lower_um, self.upper_um)


def worlds(side_px: int, seed: int = 0) -> Iterator[TripCase]:
    """Random vessel networks without end, except those in which the flow can not be computed."""
    while True:
        rng = np.random.default_rng([seed, side_px, 0x7219])
        seed += 1
        mask = draw_mask(rng, side_px)
        parts, count = label(mask)
        if count > 1:
            mask = parts == 1 + int(np.argmax(np.bincount(parts.ravel())[1:]))
        openings = list(find_openings(mask))
        if len(openings) < 2:
            continue
        inlet = int(np.argmax([opening.width_px for opening in openings]))
        openings = [replace(opening, kind="outlet", value=0.0) for opening in openings]
        openings[inlet] = replace(openings[inlet], kind="inlet", value=100.0)
        chip = Chip(f"vessels {seed - 1}", mask, UM_PER_PX, tuple(openings), 1.0, 1000.0)
        made = world_of(chip, k=1 if side_px > 128 else 2)
        if made is not None:
            yield made


def worlds_of(folder: Path) -> Iterator[TripCase]:
    """The vessel cases of a folder with their assumed boundary values."""
    for path in sorted(folder.glob("*.npz")):
        made = world_of(replace(read_vessel_case(path), name=path.stem), k=2)
        if made is not None:
            yield made


def world_of(chip: Chip, k: int) -> TripCase | None:
    """The world of a chip; None if its flow can not be computed."""
    try:
        field = FlowSolver(k).solve(chip)
    except FlowrecError:
        return None
    peak = float(np.hypot(field.velocity_um_s[..., 0], field.velocity_um_s[..., 1]).max())
    flow = replace(field, velocity_um_s=field.velocity_um_s / np.float32(peak))
    robot = Robot(radius_um=chip.um_per_px, max_speed_um_s=SPEED_UM_S, step_out_hz=1e6, step_out_margin=1.0)
    return TripCase(chip.name, chip, flow, robot)


def draw_trip(world: TripCase, rng: np.random.Generator) -> Trip | None:
    """Two points with room for the robot, connected, 0.4 of the chip's size apart or more; None if there are none."""
    space = open_space(world.chip, world.flow, world.robot.radius_um, 0.5 * world.robot.radius_um)
    parts = label(space.free, _EIGHT)[0]
    rows, columns = np.nonzero(space.free)
    for _ in range(400 if len(rows) else 0):
        a, b = (int(k) for k in rng.integers(len(rows), size=2))
        apart = np.hypot(rows[a] - rows[b], columns[a] - columns[b])
        if parts[rows[a], columns[a]] != parts[rows[b], columns[b]] or apart < 0.4 * max(space.free.shape):
            continue
        pressure = world.flow.pressure_pa
        if pressure[rows[a], columns[a]] < pressure[rows[b], columns[b]]:
            a, b = b, a
        ends = np.array([[columns[a], rows[a]], [columns[b], rows[b]]], np.float64) * space.um_per_px
        return Trip(ends[0], ends[1])
    return None


def best_time(
    world: TripCase, field: FlowField, start_um: Points, goal_um: Points, speed_um_s: float, finer: int = FINER
) -> tuple[float, float]:
    """Travel time of the best path on a finer grid, and the time to go on that grid: both are close to the optimum.

    Flow and clearance are interpolated bilinearly. inf if there is no route.
    """
    space = open_space(world.chip, field, world.robot.radius_um, 0.5 * world.robot.radius_um)
    px = space.um_per_px
    rasters = space.cost_rasters(speed_um_s / px)
    fine = rasters.finer(finer)
    px = px / finer
    start, goal = np.rint(start_um / px), np.rint(goal_um / px)
    times = time_field(fine, goal)
    least = float(times[int(start[1]), int(start[0])])
    if not np.isfinite(least):
        return np.inf, np.inf
    path = descend(fine, times, start, goal)
    if path is None:
        return least, least
    ways = (refine_path(path / finer, rasters, spacing=SPACING_PX / finer) * space.um_per_px, path * px)
    return min(float(travel_time(field, points, speed_um_s)[0][-1]) for points in ways), least
