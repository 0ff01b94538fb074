"""Where a continuous method is asked: points of the fluid, of its walls and of its openings, in pixels."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from flowrec.chip.chip import Chip
from flowrec.refine.observation_operator import Floats

_SUBPIXELS = np.array([[x, y] for x in (-0.25, 0.25) for y in (-0.25, 0.25)])
_INWARD = {"left": (1.0, 0.0), "right": (-1.0, 0.0), "top": (0.0, 1.0), "bottom": (0.0, -1.0)}


@dataclass(frozen=True, slots=True, eq=False)
class Collocation:
    """Points (n, 2) as (x, y) in pixels; pixel centres are whole numbers, walls and openings lie on pixel edges."""

    fluid: Floats  # (n, 2) centres of the fluid pixels, in the order of mask
    walls: Floats  # (m, 2) middles of the edges between fluid and solid
    along: Floats  # (m, 2) unit vector along each of them
    inlets: Floats  # (a, 2)
    inlet_um_s: Floats  # (a, 2) parabolic profile of the assumed mean speed
    outlets: Floats  # (b, 2)
    outlet_pa: Floats  # (b,)

    @classmethod
    def of(cls, chip: Chip) -> Collocation:
        """Points of a chip. The border of the image is a wall where there is no opening."""
        h, w = chip.mask.shape
        beyond = np.pad(chip.mask, 1)
        inlets, inlet_um_s, outlets, outlet_pa = [np.zeros((0, 2))], [np.zeros((0, 2))], [np.zeros((0, 2))], []
        for o in chip.openings:
            there = slice(o.first + 1, o.last + 2)
            at: tuple[int | slice, int | slice] = {
                "left": (there, 0),
                "right": (there, w + 1),
                "top": (0, there),
                "bottom": (h + 1, there),
            }[o.side]
            beyond[at] = True
            across = np.arange(o.first - 0.25, o.last + 0.5, 0.5)
            edge = {"left": -0.5, "right": w - 0.5, "top": -0.5, "bottom": h - 0.5}[o.side]
            fixed = np.full_like(across, edge)
            points = np.stack([fixed, across] if o.side in ("left", "right") else [across, fixed], axis=1)
            if o.kind == "inlet":
                share = (across - o.first + 0.5) / o.width_px
                inlets.append(points)
                inlet_um_s.append(6.0 * o.value * (share * (1.0 - share))[:, None] * np.array(_INWARD[o.side]))
            else:
                outlets.append(points)
                outlet_pa.append(np.full(len(across), o.value))
        rows, columns = np.nonzero(chip.mask)
        walls, along = [], []
        for down, right in ((0, 1), (0, -1), (1, 0), (-1, 0)):
            solid = ~beyond[rows + 1 + down, columns + 1 + right]
            walls.append(np.stack([columns[solid] + 0.5 * right, rows[solid] + 0.5 * down], axis=1))
            along.append(np.tile([float(abs(down)), float(abs(right))], (int(solid.sum()), 1)))
        return cls(
            np.stack([columns, rows], axis=1).astype(np.float64),
            np.concatenate(walls),
            np.concatenate(along),
            np.concatenate(inlets),
            np.concatenate(inlet_um_s),
            np.concatenate(outlets),
            np.concatenate([np.zeros(0), *outlet_pa]),
        )

    def draw(self, rng: np.random.Generator, count: int) -> tuple[Floats, Floats]:
        """Random points of the fluid (count, 2) and of its walls (count / 2, 2), anywhere in a pixel or on an edge."""
        pixel = rng.integers(len(self.fluid), size=count)
        inside = self.fluid[pixel] + rng.uniform(-0.5, 0.5, (count, 2))
        edge = rng.integers(len(self.walls), size=count // 2) if len(self.walls) else np.zeros(0, np.intp)
        return inside, self.walls[edge] + rng.uniform(-0.5, 0.5, (len(edge), 1)) * self.along[edge]

    @property
    def subpixels(self) -> Floats:
        """(4, n, 2) points whose mean over the first axis is the mean over each fluid pixel."""
        return np.asarray(self.fluid + _SUBPIXELS[:, None])
