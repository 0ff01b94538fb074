"""One case without dimensions: what the PI-UNet works on, cropped to the fluid and padded to what it can halve.

Lengths are in pixels, velocities in units of the fastest initial component V, pressures in mu V / px.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation

from flowrec.chip.chip import Chip, Opening
from flowrec.chip.openings import border
from flowrec.messages import FlowField
from flowrec.refine.crop import Crop
from flowrec.refine.data_misfit import noise_of
from flowrec.refine.observation_operator import Floats, Sight
from flowrec.units import M_PER_UM, PA_S_PER_MPA_S

CROSS = np.array([[0, 1, 0], [1, 1, 1], [0, 1, 0]], bool)
MULTIPLE = 16  # sides of what the network sees must divide by this


@dataclass(frozen=True, slots=True, eq=False)
class Case:
    """An initial field and what was observed, on (h, w) pixels of the padded crop."""

    fluid: NDArray[np.bool_]  # (h, w)
    inside: NDArray[np.bool_]  # (h, w) not on the border of the image, where a residual would reach outside
    walled: NDArray[np.bool_]  # (h, w) a wall on one of the four sides, and a free pixel close by
    openings: Floats  # (h, w) 1 on the border pixels of inlets, -1 on those of outlets
    door: NDArray[np.intp]  # (h, w) number of the opening that a border pixel belongs to, from 1; 0 elsewhere
    doors: tuple[Opening, ...]
    velocity: Floats  # (h, w, 2) in units of `speed`
    pressure: Floats  # (h, w) in units of `unit_pressure`
    rows: NDArray[np.intp]  # (n, 4) as in Sight
    columns: NDArray[np.intp]
    weights: Floats
    flow: Floats  # (n, 2) in units of `speed`
    noise: Floats  # (n,)
    speed: float  # V, um/s
    unit_pressure: float  # mu V / px, Pa
    reynolds: float
    friction: float
    box: Crop

    @classmethod
    def of(cls, initial: FlowField, sight: Sight, chip: Chip, cropped: bool = True) -> Case:
        """Scale, and crop unless a batch needs all cases of one size."""
        box = Crop.around(chip.mask if cropped else np.ones_like(chip.mask), MULTIPLE)
        crop = box.part
        inside = np.zeros(chip.mask.shape, bool)
        inside[1:-1, 1:-1] = True
        # Beyond the image is not a wall: openings keep their freedom.
        walled = chip.mask & binary_dilation(~chip.mask, CROSS)
        walled &= binary_dilation(chip.mask & ~walled, np.ones((3, 3), bool))
        openings, door = np.zeros(chip.mask.shape), np.zeros(chip.mask.shape, np.intp)
        for number, opening in enumerate(chip.openings):
            along = slice(opening.first, opening.last + 1)
            sign = 1.0 if opening.kind == "inlet" else -1.0
            border(openings, opening.side)[along] = sign
            border(door, opening.side)[along] = number + 1
        px_m, mu = chip.um_per_px * M_PER_UM, initial.viscosity_mpa_s * PA_S_PER_MPA_S
        speed = float(np.abs(initial.velocity_um_s).max())
        unit_pressure = mu * speed * M_PER_UM / px_m
        return cls(
            crop(chip.mask),
            crop(inside),
            crop(walled),
            crop(openings),
            crop(door),
            chip.openings,
            crop(initial.velocity_um_s.astype(np.float64) / speed),
            crop(initial.pressure_pa.astype(np.float64) / unit_pressure),
            sight.rows - box.corner[0],
            sight.columns - box.corner[1],
            sight.weights,
            sight.flow_um_s / speed,
            noise_of(sight) / speed,
            speed,
            unit_pressure,
            initial.density_kg_m3 * speed * M_PER_UM * px_m / mu,
            0.0 if chip.depth_um is None else 12.0 * (chip.um_per_px / chip.depth_um) ** 2,
            box,
        )

    def gaps(self, used: NDArray[np.bool_] | None = None) -> Floats:
        """(h, w, 4) on the pixel nearest to each observation: 1, observed minus initial velocity, std; 0 elsewhere.

        Of two observations on one pixel the later one counts. `used` (n,) leaves some out.
        """
        nearest = self.weights.argmax(axis=1)
        each = np.arange(len(nearest))
        row, column = self.rows[each, nearest], self.columns[each, nearest]
        initial = (self.velocity[self.rows, self.columns] * self.weights[..., None]).sum(axis=1)
        told = np.column_stack([np.ones(len(each)), self.flow - initial, self.noise])
        made = np.zeros((*self.fluid.shape, 4))
        chosen = each if used is None else each[used]
        made[row[chosen], column[chosen]] = told[chosen]
        return made

    @property
    def pixels(self) -> int:
        """Size of the network's input."""
        return self.fluid.size

    def whole(self, channels: Floats) -> Floats:
        """(h, w, c) on the image of channels (c, h, w) on the padded crop."""
        return self.box.whole(channels)
