"""A session in which every quantity has another number, on a chip that is not square: what leaves flowrec, checked.

A factor of a thousand, an exchanged axis, a wrong sign, or one quantity under the name of another gives another number.
Vectors are Pythagorean triples, so that their lengths are whole numbers, too.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from flowrec.core import (
    MCAP,
    Applied,
    CameraLosses,
    Currents,
    Demand,
    Estimate,
    Event,
    FlowField,
    Frame,
    Health,
    Mission,
    Observations,
    Output,
    Route,
    Tick,
    Timing,
    Track,
    Truth,
)
from flowrec.physics import Chip, ChipSettings, load_chip
from flowrec.stages import ResolvedConfig, load_config
from flowrec.stages.resolve import resolve
from flowrec.store.session_writer import session_writer

ROWS, COLUMNS, UM_PER_PX = 29, 61, 13.0  # of the mask
FIRST_ROW, LAST_ROW = 6, 22  # of the channel, which goes from left to right
WIDTH_PX, HEIGHT_PX, CAMERA_UM_PER_PX, BITS = 96, 56, 7.0, 12
RADIUS_UM = 19.0
FIRST_NS, STEP_NS, COUNT = 3_000_000_000, 100_000_000, 24  # 10 Hz

START_UM, VELOCITY_UM_S, SPEED_UM_S = np.array([103.0, 191.0]), np.array([40.0, 9.0]), 41.0
FLOW_UM_S, FLOW_SPEED_UM_S = np.array([20.0, 21.0]), 29.0  # by the observer
DEMAND_UM_S, DEMAND_SPEED_UM_S, ERROR_UM = np.array([60.0, 11.0]), 61.0, 31.0
ASSUMED_UM_S, ASSUMED_SPEED_UM_S = (33.0, 56.0), 65.0
REFINED_UM_S, REFINED_SPEED_UM_S = (48.0, 55.0), 73.0
TRUE_UM_S, TRUE_SPEED_UM_S = (39.0, 80.0), 89.0
STD_UM_S, STD_LENGTH_UM_S = (3.0, 4.0), 5.0  # left of KNOWN_COLUMNS; right of it ten times as much
KNOWN_COLUMNS = 37
FREQUENCY_HZ, HEADING_RAD, AMPLITUDE_MT, CURRENTS_A = 7.0, 0.11, 1.7, np.array([0.2, 0.3, 0.5])
APPLIED_HZ, APPLIED_RAD, APPLIED_MT, APPLIED_A = 5.3, 0.13, 1.9, np.array([0.7, 1.1, 1.3])
TURNS, NIS, HEALTH_NIS, CLEARANCE_UM = np.array([0.53, 0.59]), 2.3, 2.9, 67.0
GOAL_UM, WAY_UM = np.array([701.0, 197.0]), np.array([[103.0, 191.0], [401.0, 179.0], [701.0, 197.0]])
OBSERVED = Observations(
    FIRST_NS,
    np.array([[211.0, 163.0], [307.0, 181.0]]),
    np.array([[71.0, 73.0], [79.0, 83.0]]),
    np.array([2.1, 2.2]),
    np.array([[97.0, 101.0], [103.0, 107.0]]),
    np.array([3.7, 4.1]),
    RADIUS_UM,
)
DARK, BRIGHT = (211, 499), (1009, 3001)  # grey levels of the first and of the later images, from left to right


def mask() -> np.ndarray:
    """(ROWS, COLUMNS) fluid."""
    fluid = np.zeros((ROWS, COLUMNS), np.bool_)
    fluid[FIRST_ROW : LAST_ROW + 1] = True
    return fluid


def chip_and_config() -> tuple[Chip, ResolvedConfig]:
    chip = load_chip(ChipSettings(um_per_px=UM_PER_PX), mask())
    sets = [
        f"camera.width_px={WIDTH_PX}",
        f"camera.height_px={HEIGHT_PX}",
        f"camera.um_per_px={CAMERA_UM_PER_PX}",
        f"camera.bits={BITS}",
        "camera.rate_hz=10.0",
        f"robot.radius_um={RADIUS_UM}",
        "robot.max_speed_um_s=607.0",
        "robot.delay_s=0.02",
        "robot.step_out_hz=43.0",
        f"mission.start={START_UM.tolist()}",
        f"mission.goal={GOAL_UM.tolist()}",
        "recording.operator=Zoë",
        "recording.sample=prime",
    ]
    return chip, resolve(load_config(None, sets), chip)


def field(stamp_ns: int, method: str, velocity_um_s: tuple[float, float], *, std: bool = False) -> FlowField:
    """The velocity at the middle of column 30 and row 14; to the right and downwards each component grows."""
    row, column = np.mgrid[:ROWS, :COLUMNS].astype(np.float64)
    velocity = np.stack([velocity_um_s[0] + 0.1 * (column - 30), velocity_um_s[1] + 0.3 * (row - 14)], -1)
    fluid = mask()
    spread = np.where(column < KNOWN_COLUMNS, 1.0, 10.0)[..., None] * np.array(STD_UM_S) * fluid[..., None]
    return FlowField(
        stamp_ns, 1, method, UM_PER_PX, velocity * fluid[..., None], (7.0 * column + 0.5 * row) * fluid,
        spread if std else None, np.array([127.0, 0.0]), 1.31, 1009.0, "made up",
    )  # fmt: skip


def image(number: int) -> np.ndarray:
    """(HEIGHT_PX, WIDTH_PX) grey levels: a slope from left to right, and a mark in the lower right corner."""
    low, high = DARK if number == 0 else BRIGHT
    levels = np.tile(np.linspace(low, high, WIDTH_PX), (HEIGHT_PX, 1))
    levels[-5:, -3:] = high + number
    return levels.astype(np.uint16)


def position_um(number: int) -> np.ndarray:
    return START_UM + VELOCITY_UM_S * (1e-9 * STEP_NS * number)


def ticks() -> Iterator[Tick]:
    nowhere = np.zeros(0)
    assumed, true = field(FIRST_NS, "fvm", ASSUMED_UM_S), field(FIRST_NS, "truth", TRUE_UM_S)
    refined = field(FIRST_NS + STEP_NS, "assimilate", REFINED_UM_S, std=True)
    to_go = np.where(mask(), 0.25 * np.mgrid[:ROWS, :COLUMNS][1], np.inf)  # s, up to 15
    route = Route(FIRST_NS, 1, "time_field", True, "", WAY_UM, np.array([0.0, 4.3, 8.9]), to_go, goal_um=GOAL_UM)
    mission = Mission(FIRST_NS, "navigate", FIRST_NS, 1, "", 0, START_UM, GOAL_UM, False, "", "")
    event = Event(FIRST_NS, "info", "begun")
    for number in range(COUNT):
        now, here = FIRST_NS + number * STEP_NS, position_um(number)
        covariance = np.diag([1.21, 1.44, 2.25, 2.89])
        yield Tick(
            now,
            frame=Frame(now, number, image(number), BITS),
            applied=Applied(now, APPLIED_HZ, APPLIED_RAD, APPLIED_MT, APPLIED_A, TURNS, now),
            assumed=assumed,
            refined=refined if number else None,
            true_field=true,
            observations=OBSERVED,
            route=route,
            track=Track(now, True, here, 0.83, 0, 2.71, np.array([1.0, 2.0, 90.0, 50.0]), now),
            estimate=Estimate(now, here, FLOW_UM_S, covariance, NIS, here, True),
            health=Health(now, "", HEALTH_NIS, 0.01, 1.0, 0.0, 0.0, 0.0, nowhere, nowhere, nowhere, FLOW_UM_S, 0.0),
            mission=mission,
            demand=Demand(now, DEMAND_UM_S, here, 0.1 * number, ERROR_UM, False, np.zeros((1, 2))),
            currents=Currents(now, FREQUENCY_HZ, HEADING_RAD, AMPLITUDE_MT, 0.17, CURRENTS_A, False),
            event=event,
            timing=Timing(now, 1.1, 0.3, 0.5, 0.2, 4.7, 5.9, 0),
            truth=Truth(now, here + np.array([3.0, 4.0]), np.array(TRUE_UM_S), CLEARANCE_UM, 0),
            losses=CameraLosses(now, 967, 950, 2, 3, 5, 7, 0, 0),
        )


def write(path: Path) -> None:
    chip, config = chip_and_config()
    with session_writer(Output(path, MCAP), config, chip) as writer:
        for tick in ticks():
            writer.write(tick)
        writer.close({"outcome": "reached", "note": ""})
