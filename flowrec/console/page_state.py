"""Content of the console's page: numbers and words of a run, the camera's image, and the drawing over it.

All that is drawn lies where the image shows it, also where a refinement has found another registration than stated.
Pixels are those of the camera's image, counted from the corner of the first one, as a browser counts them.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import cv2
import numpy as np

from flowrec.core import WALLS, Estimate, Floats, Phase, RobotWalls, Tick, printable, seconds, shift_px, with_micro
from flowrec.stages import estimates_of_others
from flowrec.view import Batch, Scene, encode_jpeg, goal_of, of_robot, state_text, way_of

# What the page shows depends on these fields of a tick.
SHOWN = (
    *("frame", "shift", "refined", "route", "estimate", "mission", "demand"),
    *("currents", "event", "timing", "losses", "extra"),
)
_QUALITY = 80  # of the JPEG
_EDGE_PX = 3  # by which the mask goes on beyond its border, so that its openings are not drawn as walls
_SMOOTHING_PX = 0.7  # of the walls, in pixels of the mask

Drawing = dict[str, Any]


class PageState:
    """The ticks so far of one run."""

    def __init__(self, scene: Scene) -> None:
        self.tick = Tick()
        self.remarks: dict[str, Any] = {}
        self._scene = scene
        self._walls_um = _outlines(scene)
        self._step = 1

    def take(self, batch: Batch) -> list[dict[str, Any]]:
        """Take over what has happened; the events for people among it."""
        events = []
        for changes in batch.changes:
            self.tick = replace(self.tick, **changes)
            event = changes.get("event")
            if event is not None:
                events.append(
                    {"s": round(seconds(event.stamp_ns), 2), "level": event.level, "text": with_micro(event.text)}
                )
        self._step, self.remarks = batch.step, batch.remarks
        return events

    def chip_um(self, x_px: float, y_px: float) -> tuple[float, float]:
        """The place on the chip that the image shows there."""
        x, y = self._scene.from_plane(self._scene.image_to_plane(self.tick) @ (x_px, y_px, 1.0)).tolist()
        return x, y

    def chip_share(self, x: float, y: float) -> tuple[float, float]:
        """A share of the speed limit along x and y of the chip, for one of the same length along those of the image."""
        across = np.subtract(self.chip_um(x, y), self.chip_um(0.0, 0.0))
        length = math.hypot(*across)
        x, y = (across * (math.hypot(x, y) / length if length > 0.0 else 0.0)).tolist()
        return x, y

    def drawing(self) -> Drawing:
        """Content that changes rarely: walls, route, goal; and the sizes."""
        left, top, right, bottom = self._scene.image_bounds()
        goal = goal_of(self.tick.mission)
        return {
            "width": round(right - left),
            "height": round(bottom - top),
            "um_per_px": self._scene.calibration.um_per_px,
            "radius": round(self._scene.length_px(self._scene.robot.radius_um), 2),
            "top_speed": self._scene.robot.max_speed_um_s,
            "walls": [self._pixels(line) for line in self._walls_um],
            "route": self._pixels(way_of(self.tick.route)),
            "goal": None if goal is None else self._pixels(goal[None])[0],
            "goal_um": None if goal is None else [round(each) for each in goal.tolist()],
        }

    def state(self) -> dict[str, Any]:
        """Content that changes with each tick."""
        tick, mission, estimate = self.tick, self.tick.mission, self.tick.estimate
        field = tick.currents
        at = None if estimate is None else self._place(estimate)
        error_um = tick.demand.error_um if tick.demand is not None else math.nan
        by_hand = mission is not None and mission.by_hand
        return {
            "time_s": round(seconds(max(tick.stamp_ns, 0)), 2),
            "state": state_text(mission, estimate) or Phase.START.value,
            "waits_for": mission.wanted.replace("_", " ") if mission is not None else "",
            "held": mission is not None and mission.held_since_ns is not None,
            "observing": mission is not None and mission.phase == Phase.OBSERVE,
            "robot": at,
            "seen": estimate is not None and estimate.seen,
            "others": self._others(),
            "error_um": round(error_um) if math.isfinite(error_um) and not by_hand else None,
            "field": "off"
            if field is None or field.amplitude_mt == 0.0
            else f"{field.amplitude_mt:.1f} mT, {field.frequency_hz:.1f} Hz",
            "speed_limit_um_s": mission.speed_limit_um_s if mission is not None else None,
            "losses": self._losses(),
            **self.remarks,
        }

    def picture(self) -> bytes | None:
        """The last image as JPEG, each `step`-th pixel of it; None without one."""
        frame = self.tick.frame
        if frame is None or not frame.image.size:
            return None
        return bytes([min(self._step, 255)]) + encode_jpeg(frame.image, frame.bits, _QUALITY)

    def _place(self, estimate: Estimate) -> list[float] | None:
        """The pixel of a robot; None where it is not known."""
        at = (self._scene.to_plane(estimate.position_um) + shift_px(self.tick.shift)).tolist()
        return [round(each, 1) for each in at] if np.isfinite(at).all() else None

    def _others(self) -> list[dict[str, Any]]:
        """The robots beside the mission's one: number, pixel, colour, whether it is seen, and near a wall."""
        walls = self.tick.extra.get(WALLS)
        near = walls.near.tolist() if isinstance(walls, RobotWalls) else []
        return [
            {
                "number": number,
                "at": self._place(estimate),
                "colour": f"rgb{of_robot(number)}",
                "seen": estimate.seen,
                "near": number <= len(near) and bool(near[number - 1]),
            }
            for number, estimate in enumerate(estimates_of_others(self.tick), start=1)
        ]

    def _losses(self) -> list[str]:
        timing, losses = self.tick.timing, self.tick.losses
        counts = {"not written": 0 if timing is None else timing.dropped_frames}
        if losses is not None:
            counts |= {"link": losses.link, "incomplete": losses.incomplete}
            counts |= {"driver": losses.driver, "too late": losses.backlog}
        return [printable(f"{count} {what}") for what, count in counts.items() if count]

    def _pixels(self, points_um: Floats) -> list[list[float]]:
        to_image = self._scene.plane_to_image(self.tick)
        pixels = self._scene.to_plane(points_um) @ to_image[:, :2].T + to_image[:, 2]
        return np.round(pixels, 1).tolist()


def _outlines(scene: Scene) -> list[Floats]:
    """The walls (n, 2) in um: outlines of the fluid, which go on beyond the mask at its openings."""
    padded = np.pad(scene.chip.mask.astype(np.uint8), _EDGE_PX, mode="edge")
    found, _ = cv2.findContours(padded, cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
    lines = [cv2.approxPolyDP(line, _SMOOTHING_PX, closed=True)[:, 0] for line in found]
    return [(line.astype(np.float64) - _EDGE_PX) * scene.chip.um_per_px for line in lines if len(line) > 2]
