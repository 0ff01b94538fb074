"""`python -m tests.perf.robots [--robots 4, --seeds N, --world W, --set key=value]`: several robots in one field.

Of each short mission: how often a track went over to another robot, the share of images in which each robot in view was
tracked, the wall contacts of the other robots with and without a limit of speed, and the time of an image.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Annotated, Any

import numpy as np
import typer

from flowrec.core import FlowrecError, Tick, Truth
from flowrec.physics import load_chip
from flowrec.rigs import SimulatedRig
from flowrec.run import LockstepWorker, run
from flowrec.stages import assemble, load_config, resolve, robot_topic
from flowrec.stages.robot_topics import track_of

_NEAR = 1.0  # radii between a track and the robot that it follows


class Score:
    """What became of each robot; a sink of ticks."""

    def __init__(self, count: int, radius_um: float, size_um: tuple[float, float]) -> None:
        self.count, self.radius_um, self.size_um = count, radius_um, size_um
        self.follows: dict[int, int] = {}  # number of the true robot by that of the track
        self.switches = 0
        self.right, self.in_view = np.zeros(count), np.zeros(count)
        self.contacts = np.zeros(count)
        self.encounters, self._meet = 0, np.zeros((count, count), np.bool_)
        self.ms: list[float] = []

    def write(self, tick: Tick) -> None:
        truths = [tick.truth, *(tick.extra.get(robot_topic("/truth/robot", k)) for k in range(1, self.count))]
        places = np.array([truth.position_um for truth in truths if isinstance(truth, Truth)])
        if len(places) < self.count:
            return
        clear_um = np.array([truth.clearance_um for truth in truths if isinstance(truth, Truth)])
        edge_um = np.minimum(places, np.array(self.size_um) - places).min(axis=1)
        inside = np.isfinite(clear_um) & (edge_um > self.radius_um)  # of the chip, which the image shows
        self.contacts = np.array([truth.contacts for truth in truths if isinstance(truth, Truth)])
        self.in_view += inside
        apart = np.hypot(*(places[:, None] - places).transpose(2, 0, 1)) + np.where(inside, 0.0, np.inf)
        meet = np.triu((apart < 2.0 * self.radius_um) & inside[:, None], 1)
        self.encounters += int((meet & ~self._meet).sum())
        self._meet = meet
        if tick.timing is not None:
            self.ms.append(tick.timing.track_ms + tick.timing.observe_ms)
        for number in range(self.count):
            track = track_of(tick, number)
            if track is None or not track.seen:
                continue
            away = np.hypot(*(places - track.position_um).T) / self.radius_um
            nearest = int(np.where(inside, away, np.inf).argmin())
            own = self.follows.get(number)
            if own is None:
                if away[nearest] < _NEAR and nearest not in self.follows.values():
                    self.follows[number] = nearest
                continue
            if away[own] < _NEAR:
                self.right[own] += inside[own]
            elif away[nearest] < 0.5 * _NEAR:
                self.switches += 1
                other = next((k for k, each in self.follows.items() if each == nearest), None)
                if other is not None:
                    self.follows[other] = own
                self.follows[number] = nearest


def fly(seed: int, robots: int, duration_s: float, world: str, sets: Sequence[str]) -> dict[str, Any]:
    """Scores of a mission of a seed; FlowrecError where it can not be flown."""
    every = [f"simulated.robots={robots}", f"tracker.robots={robots}", f"simulated.seed={seed}"]
    config = load_config(None, [*every, f"simulated.world={world}", "mission.check_axes=false", *sets])
    chip = load_chip(config.chip)
    resolved = resolve(config, chip)
    pipeline = assemble(resolved, chip)
    score = Score(robots, resolved.robot.radius_um, chip.size_um)
    rig = SimulatedRig.of(pipeline, resolved, duration_s=duration_s)
    report = run(pipeline, rig, LockstepWorker(pipeline, resolved.worker.adopt_after_s), [score])
    tracked = [float(a / b) for a, b in zip(score.right, score.in_view, strict=True) if b]
    return {
        "seed": seed,
        "outcome": report.outcome,
        "seconds": report.duration_s,
        "switches": score.switches,
        "encounters": score.encounters,
        "tracked": tracked,
        "contacts": score.contacts.tolist(),
        "ms": float(np.median(score.ms)) if score.ms else math.nan,
    }


def measure(
    robots: int = 4,
    seeds: int = 10,
    first: int = 100,
    duration_s: float = 20.0,
    world: str = "kind",
    sets: Annotated[list[str] | None, typer.Option("--set")] = None,
) -> None:
    """Fly a mission a seed and print a line each, and the sums."""
    rows = []
    for seed in range(first, first + seeds):
        try:
            row = fly(seed, robots, duration_s, world, sets or [])
        except FlowrecError as error:
            print(f"seed {seed}: {error}", flush=True)
            continue
        rows.append(row)
        shares = " ".join(f"{share:.2f}" for share in row["tracked"])
        print(
            f"seed {seed}: {row['outcome']} after {row['seconds']:.1f} s, {row['switches']} switches in "
            f"{row['encounters']} encounters, tracked {shares}, "
            f"contacts {row['contacts']}, {row['ms']:.2f} ms an image",
            flush=True,
        )
    shares = [share for row in rows for share in row["tracked"][1:]]
    contacts = [sum(row["contacts"][1:]) for row in rows]
    print(
        f"{len(rows)} missions, {sum(row['seconds'] for row in rows):.0f} s: {sum(row['switches'] for row in rows)} "
        f"switches in {sum(row['encounters'] for row in rows)} encounters; the first tracked "
        f"{np.mean([row['tracked'][0] for row in rows]):.3f}, "
        f"the others {np.mean(shares) if shares else math.nan:.3f}; contacts of the first "
        f"{sum(row['contacts'][0] for row in rows)}, of the others {sum(contacts)}; "
        f"{np.median([row['ms'] for row in rows]):.2f} ms an image"
    )


if __name__ == "__main__":
    typer.run(measure)
