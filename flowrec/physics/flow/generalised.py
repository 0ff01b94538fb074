"""The discrete equations of a generalised Newtonian fluid in one chip's geometry, and Newton's method for them.

They are those of newton_solver with the viscous force of stress.py in place of A q + f V q. Viscosities are over the
chip's, so scales, drives and pressures are the same. In a shallow chip the fluid is also sheared across the depth, at
the rate c 6 V / H of its speed V (physics/chip/fluid.py: slit_factor), and

    gamma^2 = gamma_plane^2 + (c 6 V / H)^2.

The drag 12 mu(gamma) V / H^2 is exact for a power law where the depth dominates; near side walls, where both rates
matter, it is an assumption, as is the same viscosity at all depths.
"""

from __future__ import annotations

from collections.abc import Hashable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
import scipy  # its sparse loads at first use, not at start-up

from flowrec.core import M_PER_UM, Floats
from flowrec.physics.chip.chip import Chip
from flowrec.physics.chip.fluid import ViscosityLaw
from flowrec.physics.flow import stress as stresses
from flowrec.physics.flow.assembly import scaled_rows
from flowrec.physics.flow.level_set import LevelSet
from flowrec.physics.flow.linear_solver import Factors, compute_cached, factorise
from flowrec.physics.flow.newton_solver import (
    PATIENCE,
    RUNAWAY,
    Continuation,
    Equations,
    System,
    geometry_key,
    local_friction,
    newton_equations,
    system,
)
from flowrec.physics.flow.stress import Stress

# Least tolerance of the last relative step: at the slowest convergence with kept factors (KEEPING) it leaves an error
# of 4e-6, far below that of the grid. With a tenth of it a power law of 0.5 does not converge on one network in five:
# the viscosity at a point where the shear rate passes through zero chatters by about as much.
ENOUGH = 1e-6
# Newton's linearisation of the viscosity holds at a point whose gradient changes by less than this fraction of itself.
# Where the shear rate passes through zero, Newton's method for gamma^n never converges (n <= 1/2) or slowly; there the
# viscosity is kept, as in Picard's method.
TRUSTED = 0.5
# Trust in Newton's linearisation, 0 to 1, in the first step, which begins at the Newtonian flow.
FIRST = 0.5
# Factors are kept as long as each step is at most this fraction of the last one; a step with old factors costs a
# fifteenth of new ones. DEPTH: number of earlier steps in Anderson's acceleration.
KEEPING, DEPTH = 0.8, 4
SMALL = 1e-5  # change of an unknown of the law for the derivative of its slit factor
# Convection whose largest force is less than this fraction of the largest viscous one is left out of the matrix.
NEGLIGIBLE = 0.01
# Steps of the law's strength, from 0 (the Newtonian flow) to 1.
BY_STRENGTH = Continuation(1e-2, 0.02, longer=1.5, shorter=0.4)


@dataclass(frozen=True, slots=True, eq=False)
class _Viscosity:
    """Viscosities at the points of Stress for one flow."""

    value: Floats  # (m,) over that of the chip
    slope: Floats  # (m,) derivative with respect to gamma^2
    weighted: Floats  # (g,) gradients times the weights of their squares
    rate2: Floats  # (m,) gamma^2, 1/s^2


class _Mixing:
    """Anderson's acceleration of steps with the same factors (Walker and Ni 2011)."""

    def __init__(self) -> None:
        self.steps: list[Floats] = []  # as the factors give them
        self.moves: list[Floats] = []  # as they were taken

    def mix(self, step: Floats) -> Floats:
        """The accelerated step."""
        self.steps = [*self.steps, step][-DEPTH - 1 :]
        move = step
        if len(self.steps) > 1:
            changes = np.diff(np.stack(self.steps, axis=1), axis=1)
            moves = np.stack(self.moves[-changes.shape[1] :], axis=1)
            weights = np.linalg.lstsq(changes, step, rcond=None)[0]
            move = step - (moves + changes) @ weights
        self.moves = [*self.moves, move][-DEPTH:]
        return move


@dataclass(frozen=True, eq=False)
class GeneralisedSystem(Equations):
    """The equations of a fluid with a law of viscosity."""

    newtonian: System  # of the same geometry
    stress: Stress
    law: ViscosityLaw
    per_cell: float  # 1/s per m/s of difference between neighbouring cells
    drag: float = 1.0  # factor of the depth friction
    strength: float = 1.0  # power of the law: 0 is the Newtonian fluid

    def viscous_force(self, flux: Floats) -> Floats:
        return self._viscous(self._viscosity(flux).value, flux)

    def changed_residual(self, flux: Floats, drive: Floats, inertia: float, friction: float, law: Floats) -> Floats:
        """`residual` with the depth friction times 1 + `friction` and `law` (P,) added to the law's unknowns."""
        changed = self.law.with_offset(law) if len(law) else self.law
        return replace(self, law=changed, drag=self.drag * (1.0 + friction)).residual(flux, drive, inertia)

    def linear(self, drives: Floats, push: Floats | float = 0.0) -> Floats:
        """Newtonian Stokes fluxes."""
        return self.newtonian.linear(drives, push)

    def force_by_unknowns(self, flux: Floats) -> Floats:
        """(faces, P) derivatives of the viscous force with respect to the law's unknowns."""
        found = self._viscosity(flux)
        by_depth = found.slope * self._across_depth(found, flux)
        changes = np.eye(len(self.law.unknowns)) * SMALL
        factors = [
            (np.log(self.law.with_offset(change).slit_factor) - np.log(self.law.with_offset(-change).slit_factor))
            / SMALL
            for change in changes
        ]
        values = zip(self.law.by_unknowns(found.rate2), factors, strict=True)
        forces = [self._viscous(value + factor * by_depth, flux) for value, factor in values]
        return np.array(forces).reshape(len(forces), -1).T

    def force_by_friction(self, flux: Floats) -> Floats:
        """(faces,) derivative of the viscous force with respect to ln of the depth friction."""
        stress, found = self.stress, self._viscosity(flux)
        drag = (stress.at @ found.value) * (stress.strain @ flux)
        drag[: stress.viscous] = 0.0
        by_rate = self._viscous(found.slope * self._across_depth(found, flux), flux)
        return stress.gather @ self._apply_drag(drag) + by_rate

    def _across_depth(self, found: _Viscosity, flux: Floats) -> Floats:
        """(m,) the part of gamma^2 that the depth adds."""
        stress = self.stress
        squares = found.weighted * (stress.gradient @ flux)
        squares[: stress.planar] = 0.0
        return stress.square @ squares

    def steady(
        self, drive: Floats, inertia: float, max_iterations: int, tolerance: float, push: Floats | float = 0.0
    ) -> Floats:
        """Fluxes (faces,) of the steady flow for inertia = rho h / mu in s/m.

        Newton's method starts from the Newtonian Stokes flow. Where it fails, continuation follows flows of increasing
        strength of the law and increasing inertia. Raises NotConvergedError if the last step is not below `tolerance`,
        or ENOUGH, of the fastest velocity after `max_iterations`.
        """
        flux = self.linear(drive, push)
        if not flux.any():
            return flux
        return BY_STRENGTH.follow(
            lambda begin, goal, left, near: replace(self, strength=self.strength * goal).newton(
                begin, drive, push, goal * inertia, left, near
            ),
            *(flux, 1.0, max_iterations, max(tolerance, ENOUGH)),
        )

    def newton(
        self, flux: Floats, drive: Floats, push: Floats | float, inertia: float, max_iterations: int, tolerance: float
    ) -> tuple[Floats | None, int, float]:
        """Flux, or None where the iteration diverges or is slow; number of iterations; last relative step.

        Old factors are kept as long as they converge quickly. Where the steps grow, the iteration goes on from the flow
        of the smallest step with all viscosities kept, as in Picard's method.
        """
        curl = self.stream.curl
        speed = float(np.abs(flux).max())
        trust: Floats | float = FIRST
        factors: Factors | None = None
        mixing = _Mixing()
        last, step, grew = np.inf, np.inf, 0
        best, least, bold = flux, np.inf, 1.0  # bold: 1 for Newton's method, 0 for Picard's
        for number in range(1, max_iterations + 1):
            right = -(curl.T @ self.residual(flux, drive, inertia, push))
            if not np.isfinite(right).all():
                return None, number, step
            if factors is not None:
                change = mixing.mix(curl @ factors.solve(right))
                step = float(np.abs(change).max()) / speed
            if factors is None or not step <= KEEPING * last:
                factors = factorise(self._matrix(flux, inertia, trust))
                mixing = _Mixing()
                change = mixing.mix(curl @ factors.solve(right))
                step = float(np.abs(change).max()) / speed
            grew += step > last
            if not np.isfinite(step) or step > RUNAWAY or grew > PATIENCE:
                if not bold:
                    return None, number, step
                flux, factors, trust, bold, last, grew = best, None, 0.0, 0.0, np.inf, 0
                continue
            trust = bold * self._trust(flux, change)
            if step < least:
                best, least = flux, step
            flux = flux + change
            last = step
            if step <= tolerance:
                return flux, number, step
        return None, max_iterations, step

    def _trust(self, flux: Floats, change: Floats) -> Floats:
        """(m,) how far Newton's linearisation is trusted at each point, after a change of the flow."""
        stress = self.stress
        before, step = stress.gradient @ flux, stress.gradient @ change
        squares = np.stack([before**2, (before + step) ** 2, step**2], axis=1)
        squares = stress.square @ (self._weights[:, None] * squares)
        least = TRUSTED**2 * np.minimum(squares[:, 0], squares[:, 1])
        return least / np.maximum(least + squares[:, 2], 1e-300)

    @cached_property
    def _weights(self) -> Floats:
        """(g,) of the squared gradients in gamma^2, 1/s^2 per (m/s)^2."""
        stress = self.stress
        weights = np.full(stress.gradient.shape[0], self.per_cell**2)
        # The rate across the depth is proportional to the root of the friction.
        weights[stress.planar :] *= self.law.slit_factor**2 * self.drag
        return weights

    def _viscosity(self, flux: Floats) -> _Viscosity:
        stress = self.stress
        slopes = stress.gradient @ flux
        weighted = self._weights * slopes
        rate2 = stress.square @ (weighted * slopes)
        value, slope = self.law.relative(rate2)
        if self.strength != 1.0:
            slope = self.strength * value ** (self.strength - 1.0) * slope
            value = value**self.strength
        return _Viscosity(value, slope, weighted, rate2)

    def _viscous(self, viscosity: Floats, flux: Floats) -> Floats:
        """(faces,) viscous force and drag of viscosities (m,) on a flow."""
        stress = self.stress
        return stress.gather @ self._apply_drag((stress.at @ viscosity) * (stress.strain @ flux))

    def _apply_drag(self, stress: Floats) -> Floats:
        """Stresses (r,) with the drag of the depth times its factor."""
        if self.drag != 1.0:
            stress[self.stress.viscous :] *= self.drag
        return stress

    def _viscous_jacobian(self, flux: Floats, trust: Floats | float, gather: Any, strain: Any, gradient: Any) -> Any:
        """Derivative of the viscous force, between the spaces of `gather` and of `strain` and `gradient`."""
        stress, found = self.stress, self._viscosity(flux)
        by_velocity = gather @ scaled_rows(self._apply_drag(stress.at @ found.value), strain)
        by_viscosity = gather @ scaled_rows(self._apply_drag(stress.strain @ flux), stress.at)
        slopes = scaled_rows(2.0 * trust * found.slope, stress.square) @ scaled_rows(found.weighted, gradient)
        return by_velocity + by_viscosity @ slopes

    def _matrix(self, flux: Floats, inertia: float, trust: Floats | float) -> Any:
        """Matrix of the equations for stream functions, linearised around a flow."""
        curl = self.stream.curl
        matrix = self._viscous_jacobian(flux, trust, *self.stress.on_streams)
        convection = np.abs(inertia * self.momentum.convection(flux)).max()
        if convection > NEGLIGIBLE * np.abs(self.viscous_force(flux)).max():
            matrix = matrix + inertia * (curl.T @ self.momentum.convection_jacobian(flux) @ curl)
        return matrix

    def tangent(self, flux: Floats, inertia: float) -> tuple[Factors, Any]:
        """Factors and operator (faces, faces) of the equations linearised around a flow."""
        stress = self.stress
        operator = self._viscous_jacobian(flux, 1.0, stress.gather, stress.strain, stress.gradient)
        if inertia:
            operator = operator + inertia * self.momentum.convection_jacobian(flux)
        curl = self.stream.curl
        return factorise(curl.T @ operator @ curl), scipy.sparse.csr_array(operator)


def generalised_system(chip: Chip, law: ViscosityLaw, k: int) -> GeneralisedSystem:
    """The equations of a law on a chip's geometry, whose operators come from the cache if they are there."""
    equations = system(chip, k)
    key: Hashable = ("stress", *geometry_key(chip, k))
    return _with_law(equations, compute_cached(key, lambda: _stress(equations, chip)), chip, law)


def generalised_equations(chip: Chip, law: ViscosityLaw, k: int, walls: LevelSet | None = None) -> GeneralisedSystem:
    """Assemble the equations without the cache. `walls` replaces the walls of the mask."""
    equations = newton_equations(chip, k, walls)
    return _with_law(equations, _stress(equations, chip), chip, law)


def _with_law(equations: System, stress: Stress, chip: Chip, law: ViscosityLaw) -> GeneralisedSystem:
    per_cell = equations.grid.k / (chip.um_per_px * M_PER_UM)
    return GeneralisedSystem(equations.momentum, equations.stream, equations, stress, law, per_cell)


def _stress(equations: System, chip: Chip) -> Stress:
    friction = None
    if chip.depth_um is not None or chip.friction_per_um2 is not None:
        friction = np.full(equations.grid.faces, equations.friction)
        if chip.friction_per_um2 is not None:
            friction += local_friction(chip.friction_per_um2, chip.um_per_px, equations.grid)
    return stresses.assemble(equations.momentum, equations.stream.curl, friction)
