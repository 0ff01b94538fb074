"""A planner, a camera, a topic, an export and a verb for flowrec, from outside of it: replace them by your own."""

from __future__ import annotations

import json
import math
import time
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, ClassVar

import numpy as np
import typer

import flowrec
from flowrec.core import Message, OneOf, Range, RigError, Route, Source, Topic
from flowrec.rigs import CameraInfo, Grabbed, Wanted, bits_of
from flowrec.stages import Problem
from flowrec.store import Session


@dataclass(frozen=True, slots=True)
class FewestSteps:
    """the path with the fewest steps, by breadth-first search.

    The fields are the settings: section [plan.lab_plugin_steps] of a configuration.
    """

    neighbours: Annotated[int, OneOf(4, 8)] = 4  # pixels that a step can lead to

    def plan(self, problem: Problem) -> Route:
        """See flowrec.stages.planning.planner.PlanningMethod. Parents lead to the goal, where the search begins."""
        free, width = problem.space.free.ravel(), problem.space.width
        steps = [-1, 1, -width, width, -width - 1, -width + 1, width - 1, width + 1][: self.neighbours]
        parent = {problem.goal.node: -1}
        queue = deque(parent)
        while queue and problem.start.node not in parent:
            node = queue.popleft()
            for near in (node + step for step in steps):
                beside = abs(near % width - node % width) <= 1  # not across the border of the mask
                if 0 <= near < free.size and beside and free[near] and near not in parent:
                    parent[near] = node
                    queue.append(near)
        nodes = [problem.start.node]
        while parent[nodes[-1]] >= 0:
            nodes.append(parent[nodes[-1]])
        path = np.column_stack([np.array(nodes) % width, np.array(nodes) // width]).astype(np.float64)
        return problem.timed(problem.with_ends(path))


class DrawnCamera:
    """a drawn image of a disc, without any device."""

    @dataclass(frozen=True, slots=True)
    class Settings:
        """Section [lab.lab_plugin_disc] of a configuration."""

        radius_px: Annotated[float, Range(1.0, 1e3)] = 8.0
        background: Annotated[float, Range(1.0, 255.0)] = 170.0  # grey level around the disc

    def __init__(self, wanted: Wanted) -> None:
        self._wanted, self._count, self._due_s = wanted, 0, 0.0

    @classmethod
    def of(cls, wanted: Wanted) -> DrawnCamera:
        """See flowrec.rigs.lab.cameras.camera.Camera; `wanted.settings` are those above."""
        return cls(wanted)

    def open(self) -> CameraInfo:
        wanted, bits = self._wanted, bits_of(self._wanted.pixel_format)
        if bits != 8:
            raise RigError(f"camera.bits = {bits}: the drawn camera has 8; set that")
        self._count, self._due_s = 0, time.monotonic()
        return CameraInfo("Drawn", "1", wanted.width_px, wanted.height_px, bits, wanted.rate_hz, id_bits=32)

    def grab(self, timeout_s: float) -> Grabbed | None:
        wait_s = self._due_s - time.monotonic()
        time.sleep(min(max(wait_s, 0.0), timeout_s))
        if wait_s > timeout_s:
            return None
        self._due_s += 1.0 / self._wanted.rate_hz
        self._count += 1
        return Grabbed(self._image(), 8, self._count, None, time.monotonic_ns())

    def _image(self) -> np.ndarray:
        settings, size = self._wanted.settings, (self._wanted.height_px, self._wanted.width_px)
        rows, columns = np.ogrid[: size[0], : size[1]]
        middle = (0.5 * size[0], 0.5 * size[1] + 4.0 * np.sin(0.05 * self._count))
        disc = np.hypot(rows - middle[0], columns - middle[1]) < settings.radius_px
        noise = np.random.default_rng(self._count).normal(0.0, 1.0, size)
        return np.clip(np.where(disc, 40.0, settings.background) + noise, 0, 255).astype(np.uint8)

    def alive(self) -> bool:
        return True

    def discarded(self) -> int:
        return 0

    def trigger(self) -> None:
        raise RigError("the drawn camera knows no trigger")

    def close(self) -> None:
        pass


@dataclass(frozen=True, slots=True, eq=False)
class Pressure(Message):
    """Pressure of the pump."""

    stamp_ns: int
    pressure_pa: Annotated[float, "above that of the room"]


@dataclass(frozen=True, slots=True)
class PumpPressure:
    """pressure of a pump, drawn as a sine, without any device.

    The fields are the settings: section [lab_plugin_pressure] of a configuration.
    """

    every_s: Annotated[float, Range(1e-3, 60.0)] = 0.05
    topic: ClassVar[Topic] = Topic("/lab_plugin/pressure", Source.RIG, type=Pressure)

    def stream(self) -> Iterator[Pressure]:
        """See Streams of flowrec.run.stream_inputs; the loop stamps what it takes."""
        while True:
            yield Pressure(0, 2e4 + 500.0 * math.sin(time.monotonic()))
            time.sleep(self.every_s)


class PathExport:
    """where the robot was: a line of JSON a track."""

    suffixes = (".jsonl",)
    folder = False
    advice = "read it line by line:"

    def write(self, session: Session, part: Path, progress: Callable[[float], None]) -> None:
        """See flowrec.exports.formats.Exporter."""
        first_ns = session.run.first_ns
        with part.open("w", encoding="utf-8") as file:
            for track in session.messages("track"):
                time_s = 1e-9 * (track.stamp_ns - first_ns)
                file.write(json.dumps({"time_s": time_s, "position_um": track.position_um.tolist()}) + "\n")
                progress(time_s)


def routes(
    session: Annotated[Path, typer.Argument(help="Session (.mcap).")],
    as_json: Annotated[bool, typer.Option("--json", help="Print the result as JSON on stdout.")] = False,
) -> None:
    """Print the routes that a session has adopted."""
    with flowrec.open(session) as opened:
        found = [{"method": route.method, "points": len(route.waypoints_um)} for route in opened.messages("route")]
    for line in [json.dumps(found)] if as_json else [f"{each['method']}: {each['points']} points" for each in found]:
        typer.echo(line)
