"""One case without dimensions, on the pixels that the networks and Gauss-Newton work on.

The image is cropped to the fluid and padded to sides that a U-Net can halve. Lengths are in pixels, velocities in
units of a speed V, pressures in units of mu V / px; mu is the viscosity at the shear rate V / px.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import scipy  # its ndimage loads at first use, not at start-up
from numpy.typing import NDArray

from flowrec.core import M_PER_UM, PA_S_PER_MPA_S, Floats, FlowField
from flowrec.physics import Chip, Opening, border
from flowrec.stages.refine.local_viscosity import LocalViscosity, viscosity_scale
from flowrec.stages.refine.observation_operator import ObservationOperator

CROSS = np.array([[0, 1, 0], [1, 1, 1], [0, 1, 0]], bool)
MULTIPLE = 16  # a U-Net of four levels needs sides that are multiples of this


@dataclass(frozen=True, slots=True)
class Crop:
    """A box of an image of `shape`, padded at the right and bottom to multiples of MULTIPLE."""

    rows: slice
    columns: slice
    shape: tuple[int, int]

    @classmethod
    def around(cls, mask: NDArray[np.bool_]) -> Crop:
        """The box around the fluid of a mask (h, w); all of a mask without fluid."""
        lines = [np.flatnonzero(mask.any(axis=axis)) for axis in (1, 0)]
        rows, columns = (
            slice(int(line[0]), int(line[-1]) + 1) if len(line) else slice(0, size)
            for line, size in zip(lines, mask.shape, strict=True)
        )
        return cls(rows, columns, (mask.shape[0], mask.shape[1]))

    @property
    def size(self) -> tuple[int, int]:
        """Rows and columns of the box without padding."""
        return self.rows.stop - self.rows.start, self.columns.stop - self.columns.start

    def part(self, image: NDArray[Any]) -> NDArray[Any]:
        """The padded part of an image (h, w, ...); zeros beyond the box."""
        padding = [(0, -length % MULTIPLE) for length in self.size]
        return np.pad(image[self.rows, self.columns], padding + [(0, 0)] * (image.ndim - 2))

    def whole(self, part: NDArray[Any]) -> Floats:
        """An image (h, w, ...) from the padded part (rows, columns, ...); zeros beyond the box."""
        image = np.zeros((*self.shape, *part.shape[2:]))
        image[self.rows, self.columns] = part[: self.size[0], : self.size[1]]
        return image

    def operator(self, operator: ObservationOperator) -> ObservationOperator:
        """An observation operator of the image on the padded part."""
        number = np.full(self.shape, -1, np.intp)
        h, w = self.size
        number[self.rows, self.columns] = np.add.outer(np.arange(h) * (w + -w % MULTIPLE), np.arange(w))
        return operator.renumber(number)


@dataclass(frozen=True, slots=True, eq=False)
class Case:
    """An initial field and observations, on the (h, w) pixels of the padded crop."""

    fluid: NDArray[np.bool_]  # (h, w)
    inside: NDArray[np.bool_]  # (h, w) not on the border of the image, where a residual would need pixels outside
    walled: NDArray[np.bool_]  # (h, w) a wall on one of the four sides, and a pixel without walls next to it
    inflow: Floats  # (h, w) 1 on the border pixels of inlets, -1 on those of outlets
    opening: NDArray[np.intp]  # (h, w) number of the opening that a border pixel belongs to, from 1; 0 elsewhere
    openings: tuple[Opening, ...]
    velocity: Floats  # (h, w, 2) initial, in units of `speed`
    pressure: Floats  # (h, w) initial, in units of `unit_pressure`
    pixels: NDArray[np.intp]  # (n, m) as in ObservationOperator
    weights: Floats  # (n, m)
    flow: Floats  # (n, 2) observed, in units of `speed`
    noise: Floats  # (n,) its standard deviation, in units of `speed`
    speed: float  # V, um/s
    unit_pressure: float  # mu V / px, Pa
    reynolds: float  # rho V px / mu
    friction: float  # 12 px^2 / H^2, 0 without a depth
    crop: Crop
    viscosity: LocalViscosity | None = None  # None: constant

    @classmethod
    def of(
        cls,
        initial: FlowField,
        operator: ObservationOperator,
        chip: Chip,
        cropped: bool = True,
        speed: float | None = None,
    ) -> Case:
        """Case of an initial field. V is `speed`, or else the largest component of its velocity.

        A batch of cases needs one size: it is not cropped.
        """
        crop = Crop.around(chip.mask if cropped else np.ones_like(chip.mask))
        part, shape = crop.part, chip.mask.shape
        inside = np.zeros(shape, bool)
        inside[1:-1, 1:-1] = True
        # The border of the image is not a wall, so openings keep their freedom.
        walled = chip.mask & scipy.ndimage.binary_dilation(~chip.mask, CROSS)
        walled &= scipy.ndimage.binary_dilation(chip.mask & ~walled, np.ones((3, 3), bool))
        inflow, number = np.zeros(shape), np.zeros(shape, np.intp)
        for index, opening in enumerate(chip.openings):
            along = slice(opening.first, opening.last + 1)
            border(inflow, opening.side)[along] = 1.0 if opening.kind == "inlet" else -1.0
            border(number, opening.side)[along] = index + 1
        speed = float(np.abs(initial.velocity_um_s).max()) if speed is None else speed
        viscosity = LocalViscosity.of(chip, speed, chip.um_per_px)
        px_m = chip.um_per_px * M_PER_UM
        mu = initial.viscosity_mpa_s * PA_S_PER_MPA_S * viscosity_scale(viscosity)
        unit_pressure = mu * speed * M_PER_UM / px_m
        observed = crop.operator(operator)
        return cls(
            part(chip.mask),
            part(inside),
            part(walled),
            part(inflow),
            part(number),
            chip.openings,
            part(initial.velocity_um_s.astype(np.float64) / speed),
            part(initial.pressure_pa.astype(np.float64) / unit_pressure),
            observed.pixels,
            observed.weights,
            observed.flow_um_s / speed,
            observed.noise_um_s / speed,
            speed,
            unit_pressure,
            initial.density_kg_m3 * speed * M_PER_UM * px_m / mu,
            0.0 if chip.depth_um is None else 12.0 * (chip.um_per_px / chip.depth_um) ** 2,
            crop,
            viscosity,
        )

    def only(self, used: NDArray[np.bool_]) -> Case:
        """The case with some of the observations, `used` (n,)."""
        names = ("pixels", "weights", "flow", "noise")
        return replace(self, **{name: getattr(self, name)[used] for name in names})

    def at_nearest(self, values: Floats) -> Floats:
        """(h, w, c) values (n, c) on the pixel nearest to each observation, 0 elsewhere; of two the later counts."""
        image = np.zeros((self.fluid.size, values.shape[1]))
        image[self.pixels[:, 0]] = values
        return image.reshape(*self.fluid.shape, -1)

    def innovations(self) -> Floats:
        """(h, w, 4) on the pixel nearest to each observation: 1, observed minus initial velocity, std; 0 elsewhere."""
        initial = (self.velocity.reshape(-1, 2)[self.pixels] * self.weights[..., None]).sum(axis=1)
        return self.at_nearest(np.column_stack([np.ones(len(self.flow)), self.flow - initial, self.noise]))

    def dimensional(self, velocity: Floats, pressure: Floats) -> tuple[Floats, Floats]:
        """Velocity (h, w, 2) in um/s and pressure (h, w) in Pa on the image, from those of the case."""
        return self.crop.whole(velocity) * self.speed, self.crop.whole(pressure) * self.unit_pressure
