"""Collocation points of the PINN in the fluid, on its walls and in its openings, and its case without dimensions."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from flowrec.core import M_PER_UM, PA_S_PER_MPA_S
from flowrec.physics import Chip, border, median_width_um
from flowrec.stages.refine.observation_operator import Floats, ObservationOperator

POISEUILLE = 12.0  # dp/dx of Poiseuille flow in units of mu V / L^2

_INWARD = {"left": (1.0, 0.0), "right": (-1.0, 0.0), "top": (0.0, 1.0), "bottom": (0.0, -1.0)}


@dataclass(frozen=True, slots=True, eq=False)
class Collocation:
    """Points (n, 2) as (x, y) in pixels; pixel centres are integers, walls and openings lie on pixel edges."""

    fluid: Floats  # (n, 2) centres of the fluid pixels, in raster order
    walls: Floats  # (m, 2) midpoints of the edges between fluid and solid
    along: Floats  # (m, 2) unit vector along each of them
    inlets: Floats  # (a, 2)
    inlet_um_s: Floats  # (a, 2) parabolic profile of the assumed mean speed
    outlets: Floats  # (b, 2)
    outlet_pa: Floats  # (b,)

    @classmethod
    def of(cls, chip: Chip) -> Collocation:
        """Points of a chip. The border of the image is a wall where there is no opening."""
        h, w = chip.mask.shape
        beyond = np.pad(chip.mask, 1)  # fluid, and openings in the margin
        inlets, inlet_um_s, outlets, outlet_pa = [np.zeros((0, 2))], [np.zeros((0, 2))], [np.zeros((0, 2))], []
        for o in chip.openings:
            border(beyond, o.side)[o.first + 1 : o.last + 2] = True
            across = np.arange(o.first - 0.25, o.last + 0.5, 0.5)
            edge = {"left": -0.5, "right": w - 0.5, "top": -0.5, "bottom": h - 0.5}[o.side]
            fixed = np.full_like(across, edge)
            points = np.stack([fixed, across] if o.side in ("left", "right") else [across, fixed], axis=1)
            if o.kind == "inlet":
                fraction = (across - o.first + 0.5) / o.width_px
                inlets.append(points)
                inlet_um_s.append(6.0 * o.value * (fraction * (1.0 - fraction))[:, None] * np.array(_INWARD[o.side]))
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
        """Random points in the fluid (count, 2) and on its walls (count / 2, 2), anywhere in a pixel or on an edge."""
        pixel = rng.integers(len(self.fluid), size=count)
        inside = self.fluid[pixel] + rng.uniform(-0.5, 0.5, (count, 2))
        edge = rng.integers(len(self.walls), size=count // 2) if len(self.walls) else np.zeros(0, np.intp)
        return inside, self.walls[edge] + rng.uniform(-0.5, 0.5, (len(edge), 1)) * self.along[edge]


@dataclass(frozen=True, slots=True, eq=False)
class PinnCase:
    """One case without dimensions, with length L (median channel width), speed V and pressure mu V / L."""

    points: Collocation
    centre: Floats  # (2,) px
    length_px: float  # L
    reynolds: float
    friction: float
    largest_pressure: float  # in units of mu V / L: half the drop of a channel that crosses the image
    unit_pressure: float  # mu V / L, Pa
    seen: Floats  # (n, 2) px
    flow: Floats  # (n, 2) in units of V
    inlet: Floats  # (a, 2) in units of V
    outlet: Floats  # (b,) in units of mu V / L

    @classmethod
    def of(cls, speed: float, operator: ObservationOperator, chip: Chip) -> PinnCase:
        """Case of a chip in which observations have this root mean square speed (um/s)."""
        points = Collocation.of(chip)
        length_px = median_width_um(chip) / chip.um_per_px
        length_um = length_px * chip.um_per_px
        mu = chip.viscosity_mpa_s * PA_S_PER_MPA_S
        unit_pressure = mu * speed / length_um
        return cls(
            points,
            points.fluid.mean(axis=0),
            length_px,
            chip.density_kg_m3 * speed * M_PER_UM * length_um * M_PER_UM / mu,
            0.0 if chip.depth_um is None else 12.0 * (length_um / chip.depth_um) ** 2,
            0.5 * POISEUILLE * float(np.ptp(points.fluid, axis=0).max() + 1.0) / length_px,
            unit_pressure,
            operator.points,
            operator.flow_um_s / speed,
            points.inlet_um_s / speed,
            points.outlet_pa / unit_pressure,
        )
