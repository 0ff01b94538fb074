"""The solver stage: a chip and its assumed boundary values to a flow field."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np

from flowrec.core import UM_PER_M, Floats, FlowError, FlowField, OneOf, Range
from flowrec.physics.chip.chip import Chip
from flowrec.physics.chip.fluid import law_text
from flowrec.physics.flow import grid as grids
from flowrec.physics.flow.generalised import GeneralisedSystem, generalised_system
from flowrec.physics.flow.linear_solver import chip_key, compute_cached
from flowrec.physics.flow.newton_solver import NotConvergedError, Scales, System, system
from flowrec.physics.flow.sampling import fluid_image
from flowrec.physics.flow.sensitivities import Sensitivities, sensitivities

ROUNDING = 1e-9  # smaller residuals are rounding errors: their digits differ between machines and are not shown


@dataclass(frozen=True, slots=True)
class FlowSolver:
    """Steady incompressible flow by finite volumes on a staggered grid, with Newton's method.

    The matrices of a Newtonian fluid do not depend on its viscosity; those of another fluid are made for each flow.
    """

    k: Annotated[int, OneOf(1, 2, 4)] = 1  # subcells per pixel side: 1, 2 or 4
    # largest number of iterations of Newton's method; a flow that has not converged by then is an error
    max_iterations: Annotated[int, Range(1, 10_000)] = 40
    tolerance: Annotated[float, Range(1e-14, 0.1)] = 1e-9  # largest last Newton step, over the fastest velocity
    convection: bool = True  # the fluid has inertia; False: Stokes flow

    def solve(self, chip: Chip) -> FlowField:
        """Flow on the pixels of the chip's mask for its boundary values; stamp and request are 0.

        Raises FlowError if the openings can not carry a flow, or convection does not converge.
        """
        self._check(chip)
        if chip.is_driven:
            equations, scales, flux = self._steady(chip)
            load = equations.residual(flux, scales.drive, scales.inertia)
            residual = equations.unbalanced_fraction(flux, load)
            grid, velocity = equations.grid, equations.velocity(flux)
            pressure = grid.pressure(equations.pressure(load)) * scales.pressure
        else:  # nothing drives the fluid: it stands still, and the matrices of a large dish would take seconds
            grid, residual = grids.build(chip, self.k), 0.0
            velocity, pressure = np.zeros((int(chip.mask.sum()), 2)), np.zeros(chip.mask.shape)
        return FlowField(
            stamp_ns=0,
            request=0,
            method="fvm",
            um_per_px=chip.um_per_px,
            velocity_um_s=fluid_image(chip.mask, velocity * UM_PER_M).astype(np.float32),
            pressure_pa=pressure.astype(np.float32),
            std_um_s=None,
            boundary_values=chip.boundary_values,
            viscosity_mpa_s=chip.viscosity_mpa_s,
            density_kg_m3=chip.density_kg_m3,
            note=f"residual {'below 1e-9' if residual < ROUNDING else f'{residual:.0e}'}",
            wall_px=grid.wall_px,
            viscosity_law=law_text(chip.law),
        )

    def sensitivities(
        self, chip: Chip, friction: bool = False, shapes: bool = False, law: bool = False
    ) -> Sensitivities:
        """Derivatives of the flow of `solve` with respect to boundary values and fluid, from the cache if possible.

        `friction` makes ln of the depth friction a parameter of a chip that has a depth, `shapes` the shapes of the
        inlets' profiles, `law` the unknowns of the chip's law of viscosity. Raises FlowError as `solve` does.
        """
        friction = friction and chip.depth_um is not None
        law = law and chip.law is not None

        def compute() -> Sensitivities:
            self._check(chip)
            return sensitivities(*self._steady(chip), friction, shapes, law)

        return compute_cached((self, chip_key(chip), friction, shapes, law), compute)

    def _steady(self, chip: Chip) -> tuple[System | GeneralisedSystem, Scales, Floats]:
        """Equations of a checked chip, its scales and its fluxes (faces,) in m/s."""
        scales = Scales.of(chip, self.k, self.convection)
        equations = system(chip, self.k) if chip.law is None else generalised_system(chip, chip.law, self.k)
        try:
            # In the cache, because an assimilation needs the assumed flow again.
            flux: Floats = compute_cached(
                (self, chip_key(chip)),
                lambda: equations.steady(scales.drive, scales.inertia, self.max_iterations, self.tolerance),
            )
        except NotConvergedError as failure:
            widest = max(opening.width_px for opening in chip.openings)
            fastest = float(np.abs(equations.linear(scales.drive)).max())
            reynolds = scales.inertia * self.k * widest * fastest
            law = "a law of viscosity nearer to the Newtonian one, " if chip.law is not None else ""
            raise FlowError(
                f"flow on chip '{chip.name}' did not converge (Re about {reynolds:.3g}, last step {failure.step:.1e} "
                f"after {self.max_iterations} iterations): try {law}a larger flow.k or flow.max_iterations, "
                "check units of speed and viscosity, or set flow.convection = false"
            ) from None
        return equations, scales, flux

    def _check(self, chip: Chip) -> None:
        """Raise FlowError for numbers that can not be solved."""
        if self.k not in (1, 2, 4):
            raise FlowError(f"flow.k = {self.k} on chip '{chip.name}': choose 1, 2 or 4 subcells per pixel side")
        _check(chip)


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
