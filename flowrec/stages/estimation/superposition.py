"""Several pumps, one an inlet: the flow is the sum of what each inlet drives alone, by its own measured share.

Without inertia a Newtonian flow between outlets of one pressure is linear in the speeds at the inlets: u(x, t) = sum of
r_i(t) u_i(x), with r_i the measured value of inlet i over its nominal one and u_i the flow of that inlet alone. A map
u_0 of all, assumed or refined, is followed by r u_0 + sum of (r_i - r) u_i, r the mean over the inlets: exact for the
assumed map; of a refined one only what differs between the pumps is taken from the flow as assumed.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from flowrec.core import Floats, FlowField
from flowrec.physics import Chip, FlowSolver, sample


@functools.lru_cache(maxsize=2)
def at_share(flow: FlowField, share: float) -> FlowField:
    """A flow at a share of its speed everywhere."""
    share32 = np.float32(share)
    return replace(
        flow,
        velocity_um_s=flow.velocity_um_s * share32,
        pressure_pa=flow.pressure_pa * share32,
        std_um_s=None if flow.std_um_s is None else flow.std_um_s * share32,
    )


@dataclass(frozen=True, slots=True, eq=False)
class Superposition:
    """The flow of each inlet alone.

    Attributes
    ----------
    parts : assumed flow of each inlet at its nominal speed, the others closed.
    weights : (n,) nominal inflow of each over that of all.
    """

    parts: tuple[FlowField, ...]
    weights: Floats

    @classmethod
    def of(cls, chip: Chip, solver: FlowSolver) -> Self:
        """The parts of a chip's flow, in the order of its inlets."""
        inlets = [number for number, each in enumerate(chip.openings) if each.kind == "inlet"]
        parts = tuple(solver.solve(_alone(chip, number)) for number in inlets)
        inflow = np.array([abs(chip.openings[n].value) * chip.openings[n].width_px for n in inlets])
        return cls(parts, inflow / inflow.sum())

    def mean(self, shares: Floats) -> float:
        """The share of all, of shares (n,)."""
        return float(self.weights @ shares)

    def departure_um_s(self, points_um: Floats, shares: Floats) -> Floats:
        """Velocity (m, 2) at points (m, 2) by which shares (n,) differ from their mean."""
        away = shares - self.mean(shares)
        return sum(each * sample(part, points_um) for each, part in zip(away, self.parts, strict=True))

    def at_shares(self, flow: FlowField, shares: Floats) -> FlowField:
        """A map as the pumps drive it at shares (n,)."""
        return _at_shares(self, flow, tuple(shares.tolist()))


def _alone(chip: Chip, inlet: int) -> Chip:
    openings = [each if number == inlet else replace(each, value=0.0) for number, each in enumerate(chip.openings)]
    return replace(chip, openings=tuple(openings))


@functools.lru_cache(maxsize=2)
def _at_shares(inlets: Superposition, flow: FlowField, shares: tuple[float, ...]) -> FlowField:
    mean = inlets.mean(np.array(shares))
    found = at_share(flow, mean)
    velocity_um_s, pressure_pa = found.velocity_um_s, found.pressure_pa
    for share, part in zip(shares, inlets.parts, strict=True):
        away = np.float32(share - mean)
        velocity_um_s = velocity_um_s + away * part.velocity_um_s
        pressure_pa = pressure_pa + away * part.pressure_pa
    return replace(found, velocity_um_s=velocity_um_s, pressure_pa=pressure_pa)
