"""A laboratory in which one thing is not as stated: what its camera and its robot make of a flow that is known.

Everything follows from geometry and kinematics; nothing of the refinement is used. The robot is at X on the chip, the
stated registration puts it at x, and the flow that an observer states is the velocity of x less the robot's own motion
as the stated um per revolution has it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation, binary_erosion, distance_transform_edt

from flowrec.core.messages import FlowField, Observations
from flowrec.physics.chip.chip import Chip, Opening
from flowrec.physics.flow.sampling import sample
from flowrec.physics.flow.solver import FlowSolver

Floats = NDArray[np.float64]

SOLVER = FlowSolver()
UM_PER_PX, WIDTH_UM, RADIUS_UM = 10.0, 80.0, 12.0
FLOOR_DRAG = 2.9  # of a roller, times Stokes'
_CORNERS_UM = np.array([[20, 240], [240, 240], [240, 120], [555, 120], [555, 240], [760, 240]], float)


def chip(values: tuple[float, ...] = (100.0, 0.0, 0.0), **changes: Any) -> Chip:
    """An island in a channel that is 8 px wide everywhere, with a second outlet below; inlet in um/s, outlets in Pa."""
    mask = np.zeros((48, 80), bool)
    mask[20:28] = True
    mask[8:40, 20:60] = True
    mask[16:32, 28:52] = False
    mask[40:, 40:48] = True
    sides = ("left", "right", "bottom"), (20, 20, 40), ("inlet", "outlet", "outlet")
    openings = tuple(
        Opening(side, first, first + 7, kind, value) for side, first, kind, value in zip(*sides, values, strict=True)
    )
    return Chip("laboratory", mask, UM_PER_PX, openings, 1.0, 1000.0, walls="pixel", **changes)


def wider_everywhere(drawn: Chip, pixels: int) -> Chip:
    """The chip with each wall a pixel farther out (1) or in (-1)."""
    mask = binary_dilation(drawn.mask) if pixels > 0 else binary_erosion(drawn.mask, border_value=1)
    openings = tuple(replace(one, first=one.first - pixels, last=one.last + pixels) for one in drawn.openings)
    return replace(drawn, mask=mask, openings=openings)


def wider_in_places(drawn: Chip, stem: int, branch: int, outlet: int) -> Chip:
    """The chip with the walls of three of its channels each a pixel farther out (1) or in (-1), at the same flow."""
    mask = drawn.mask.copy()
    for first, last, columns, inner, out in (
        (20, 27, slice(0, 20), slice(0, 20), stem),
        (8, 15, slice(20, 60), slice(28, 52), branch),
        (20, 27, slice(60, 80), slice(60, 80), outlet),
    ):
        mask[first - 1 if out > 0 else first, columns] = out > 0
        mask[last + 1 if out > 0 else last, inner] = out > 0
    inlet, right, bottom = drawn.openings
    inlet = replace(inlet, first=20 - stem, last=27 + stem, value=inlet.value * 8.0 / (8.0 + 2.0 * stem))
    return replace(drawn, mask=mask, openings=(inlet, replace(right, first=20 - outlet, last=27 + outlet), bottom))


@dataclass(frozen=True)
class Laboratory:
    """What is true where it is not as stated. Angles in degrees, clockwise as the chip is drawn: x right, y down."""

    um_per_px: float = UM_PER_PX  # of the camera; UM_PER_PX is stated
    chip_moved_um: tuple[float, float] = (0.0, 0.0)  # where the chip lies, from where the registration puts it
    chip_turned_deg: float = 0.0  # likewise, around the middle of the survey
    um_per_rev: float = 1.0  # true over stated
    off_heading_deg: float = 0.0  # of the robot's course from the heading of the field
    held_by_walls: float = 0.0  # 1: side walls hold a roller back as Faxen's formula says; -1: they help as much
    pump: float = 0.0  # amplitude of its line, of the flow
    pump_hz: float = 0.7
    wander: float = 0.0  # of the flow, one sigma, correlated over 4 s
    shake_um_s: tuple[float, float] = (0.0, 0.0)
    shake_hz: float = 1.3
    noise_um_s: float = 2.0  # stated and, unless `noisier` than that, true
    noisier: float = 1.0
    across_um: float = 25.0  # how far from the middle of the channels the robot goes
    step_s: float = 0.35
    radius_um: float | None = RADIUS_UM  # None: not stated

    def survey(self, true: FlowField, seed: int = 0, count: int = 56) -> Observations:
        """Observations along the upper branch, with headings that vary."""
        rng = np.random.default_rng(seed)
        way = [np.linspace(a, b, int(np.abs(b - a).max() / 5), endpoint=False) for a, b in pairwise(_CORNERS_UM)]
        places = np.concatenate(way)
        places = places[np.linspace(0, len(places) - 1, count).astype(int)]
        places = places + self.across_um * rng.uniform(-1.0, 1.0, places.shape)
        time_s = self.step_s * np.arange(count)
        flow = sample(true, places) * self.pump_factor(time_s, seed)[:, None]
        angle = rng.uniform(0.0, 2.0 * np.pi, count)
        stated_own = 150.0 * np.stack([np.cos(angle), np.sin(angle)], axis=1)
        held = self.held_by_walls * held_share(true, places)
        own = (self.um_per_rev * (1.0 - held))[:, None] * stated_own @ _turn(self.off_heading_deg).T
        # Camera and coils are one frame. The chip lies in it moved and turned; a scale that is stated too large makes
        # it, and every motion on it, look too large.
        larger, chip_turn, middle = UM_PER_PX / self.um_per_px, _turn(self.chip_turned_deg), places.mean(axis=0)
        seen = middle + larger * (places - middle) @ chip_turn.T + np.array(self.chip_moved_um)
        velocity = larger * (flow @ chip_turn.T + own)
        velocity = velocity + np.outer(np.cos(2.0 * np.pi * self.shake_hz * time_s + 0.4), self.shake_um_s)
        noise = self.noisier * self.noise_um_s * rng.standard_normal(places.shape)
        std = np.full(count, self.noise_um_s)
        return Observations(0, seen, velocity - stated_own + noise, std, stated_own, time_s, self.radius_um)

    def pump_factor(self, time_s: Floats, seed: int) -> Floats:
        """(n,) the flow over the steady one."""
        kernel = np.exp(-np.abs(time_s[:, None] - time_s) / 4.0) + 1e-9 * np.eye(len(time_s))
        wander = np.linalg.cholesky(kernel) @ np.random.default_rng([seed, 1]).standard_normal(len(time_s))
        return np.asarray(1.0 + self.pump * np.sin(2.0 * np.pi * self.pump_hz * time_s + 1.0) + self.wander * wander)


def held_share(field: FlowField, places: Floats) -> Floats:
    """(n,) of its own motion that a roller loses to the two side walls.

    Faxen's drag along a wall, 1 / (1 - 9/16 s + s^3/8 - 45/256 s^4 - s^5/16) of Stokes' with s = radius / distance: the
    excess of both walls is added to the drag of the floor.
    """
    column, row = np.round(places / field.um_per_px).astype(int).T
    near = field.um_per_px * (distance_transform_edt(field.velocity_um_s.any(axis=-1)) - 0.5)[row, column]
    s = RADIUS_UM / np.stack([near, np.maximum(WIDTH_UM - near, near)])
    excess = (1.0 / (1.0 - 9.0 / 16.0 * s + s**3 / 8.0 - 45.0 / 256.0 * s**4 - s**5 / 16.0) - 1.0).sum(axis=0)
    return np.asarray(excess / (FLOOR_DRAG + excess))


def _turn(degrees: float) -> Floats:
    """(2, 2) turns a vector clockwise: from +x, to the right, to +y, down."""
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    return np.array([[c, -s], [s, c]])
