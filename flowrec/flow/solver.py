"""The solver stage: a chip and its assumed boundary values to a flow field."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np

from flowrec.chip.chip import Chip
from flowrec.errors import FlowError
from flowrec.flow.cache import cells_of, chip_key, kept
from flowrec.flow.grid import Floats
from flowrec.flow.modes import FlowModes
from flowrec.flow.newton_solver import NotConvergedError, System, depth_friction, system
from flowrec.flow.sensitivities import FlowResponse, respond
from flowrec.messages import FlowField
from flowrec.ranges import OneOf, Range
from flowrec.units import M_PER_UM, PA_S_PER_MPA_S, UM_PER_M

CLOSE = 1e-9  # residuals below are rounding, which differs from machine to machine: the digits would be noise


@dataclass(frozen=True, slots=True)
class FlowSolver:
    """Steady incompressible flow by finite volumes on a staggered grid (science.md, section 1)."""

    k: Annotated[int, OneOf(1, 2, 4)] = 1  # subcells per pixel side: 1, 2 or 4
    max_iterations: Annotated[int, Range(1, 10_000)] = 40
    tolerance: Annotated[float, Range(1e-14, 0.1)] = 1e-9  # last Newton step over the fastest velocity
    convection: bool = True  # False: Stokes flow

    def solve(self, chip: Chip) -> FlowField:
        """Flow on the pixels of the chip's mask for its boundary values; stamp and request are 0.

        Raises
        ------
        FlowError
            If the openings can not carry a flow, or convection does not converge.
        """
        equations, scales = self._equations(chip)
        moving = self._steady(chip, equations, scales)
        return self._field(chip, equations, scales, moving)

    def modes(self, chip: Chip) -> FlowModes:
        """Stokes flow and its exact linear dependence on the boundary values."""
        return FlowSolver(self.k, self.max_iterations, self.tolerance, convection=False).linearised(chip)

    def linearised(self, chip: Chip) -> FlowModes:
        """The flow of `solve` and its first derivatives with respect to boundary values and viscosity."""
        equations, scales = self._equations(chip)
        moving = self._steady(chip, equations, scales)
        change, load = equations.responses(moving, scales.drive(chip), scales.inertia)
        pressure = equations.pressure(load)
        velocity_um_s = equations.grid.velocity(change.T) * UM_PER_M
        pressure_pa = equations.grid.pressure(pressure.T) * scales.pressure
        base = self._field(chip, equations, scales, moving)
        per_unit = scales.drive_per_unit
        return FlowModes(
            base,
            velocity_um_s[:-1] * per_unit[:, None, None, None],
            pressure_pa[:-1] * per_unit[:, None, None],
            velocity_um_s[-1],
            # p = p^ mu / h: the scale itself grows with ln mu.
            pressure_pa[-1] + base.pressure_pa,
        )

    def response(self, chip: Chip, friction: bool = False, shapes: bool = False) -> FlowResponse:
        """How the flow of `solve` answers to boundary values and fluid: made once for a chip, then kept.

        Parameters are also ln of the depth's friction, and the shapes of the inlets' profiles, where they are asked.
        """
        extras = (friction and chip.depth_um is not None, shapes)

        def make() -> FlowResponse:
            equations, scales = self._equations(chip)
            moving = self._steady(chip, equations, scales)
            drive, per_unit, resists = scales.drive(chip), scales.drive_per_unit, depth_friction(chip, self.k)
            return respond(equations, drive, per_unit, scales.inertia, resists, scales.pressure, moving, extras)

        made: FlowResponse = kept((self, chip_key(chip), extras), cells_of(chip, self.k), make)
        return made

    def _equations(self, chip: Chip) -> tuple[System, _Scales]:
        if self.k not in (1, 2, 4):
            raise FlowError(f"flow.k = {self.k} on chip '{chip.name}': choose 1, 2 or 4 subcells per pixel side")
        _check(chip)
        return system(chip, self.k), _Scales.of(chip, self.k, self.convection)

    def _steady(self, chip: Chip, equations: System, scales: _Scales) -> Floats:
        drive = scales.drive(chip)
        try:
            # Kept, because an assimilation asks for the flow again that was assumed.
            moving: Floats = kept(
                (self, chip_key(chip)),
                cells_of(chip, self.k) // 50,  # a vector, not a matrix
                lambda: equations.steady(drive, scales.inertia, self.max_iterations, self.tolerance),
            )
            return moving
        except NotConvergedError as failure:
            widest = max(opening.width_px for opening in chip.openings)
            fastest = float(np.abs(equations.linear(drive[:, None])).max())
            reynolds = scales.inertia * self.k * widest * fastest
            raise FlowError(
                f"flow on chip '{chip.name}' did not converge (Re about {reynolds:.3g}, last step {failure.step:.1e} "
                f"after {self.max_iterations} iterations): try a larger flow.k or flow.max_iterations, "
                "check units of speed and viscosity, or set flow.convection = false"
            ) from None

    def _field(self, chip: Chip, equations: System, scales: _Scales, moving: Floats) -> FlowField:
        load = equations.residual(moving, scales.drive(chip), scales.inertia)
        pressure = equations.pressure(load[:, None])[:, 0]
        residual = equations.unbalanced(moving, load)
        return FlowField(
            stamp_ns=0,
            request=0,
            method="fvm",
            um_per_px=chip.um_per_px,
            velocity_um_s=(equations.grid.velocity(moving) * UM_PER_M).astype(np.float32),
            pressure_pa=(equations.grid.pressure(pressure) * scales.pressure).astype(np.float32),
            std_um_s=None,
            boundary_values=chip.boundary_values,
            viscosity_mpa_s=chip.viscosity_mpa_s,
            density_kg_m3=chip.density_kg_m3,
            note=f"residual {'below 1e-9' if residual < CLOSE else f'{residual:.0e}'}",
        )


def _check(chip: Chip) -> None:
    """Raise FlowError for numbers and openings that can not carry a flow."""
    where = f"chip '{chip.name}'"
    for key in ("um_per_px", "viscosity_mpa_s", "depth_um"):
        value = getattr(chip, key)
        if value is not None and not (np.isfinite(value) and value > 0):
            raise FlowError(f"{where}: {key} = {value:g}; it must be more than zero")
    if not (np.isfinite(chip.density_kg_m3) and chip.density_kg_m3 >= 0):
        raise FlowError(f"{where}: density_kg_m3 = {chip.density_kg_m3:g}; it must not be negative")
    for index, opening in enumerate(chip.openings):
        what = f"opening {index} ({opening.side} {opening.first}..{opening.last})"
        if not np.isfinite(opening.value):
            raise FlowError(
                f"{where}: {what} has the value {opening.value:g}; give a speed in um/s or a pressure in Pa"
            )
        for other in chip.openings[:index]:
            if other.side == opening.side and other.first <= opening.last and opening.first <= other.last:
                raise FlowError(f"{where}: {what} overlaps another on the same side; remove one")
    if not any(opening.kind == "outlet" for opening in chip.openings):
        raise FlowError(f"{where} has no outlet: make one of its openings an outlet")


@dataclass(frozen=True, slots=True, eq=False)
class _Scales:
    """From the chip's units to those of the equations: velocities in m/s, pressures as p h / mu in m/s."""

    inertia: float  # rho h / mu, s/m; 0 for Stokes flow
    pressure: float  # mu / h, Pa per m/s
    drive_per_unit: Floats  # (openings,) m/s per um/s or per Pa

    @classmethod
    def of(cls, chip: Chip, k: int, convection: bool) -> _Scales:
        """Scales of a chip on k x k subcells."""
        h = chip.um_per_px * M_PER_UM / k
        mu = chip.viscosity_mpa_s * PA_S_PER_MPA_S
        return cls(
            chip.density_kg_m3 * h / mu if convection else 0.0,
            mu / h,
            np.array([M_PER_UM if opening.kind == "inlet" else h / mu for opening in chip.openings]),
        )

    def drive(self, chip: Chip) -> Floats:
        """(openings,) the chip's boundary values in m/s."""
        return chip.boundary_values * self.drive_per_unit
