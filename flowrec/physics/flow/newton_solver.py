"""The discrete Navier-Stokes equations of one chip's geometry, factorised once, and Newton's method for them.

The equations are scaled so that viscosity, density, pixel size and boundary values do not enter the matrices: one
factorisation serves all of them.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Hashable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import scipy  # its sparse loads at first use, not at start-up

from flowrec.core import M_PER_UM, PA_S_PER_MPA_S, Floats
from flowrec.physics.chip.chip import Chip
from flowrec.physics.flow import grid as grids
from flowrec.physics.flow import momentum as momenta
from flowrec.physics.flow import streamfunction as streams
from flowrec.physics.flow.grid import Grid
from flowrec.physics.flow.level_set import LevelSet
from flowrec.physics.flow.linear_solver import Factors, array_key, compute_cached, factorise
from flowrec.physics.flow.momentum import Momentum
from flowrec.physics.flow.streamfunction import StreamBasis

# Factors are reused as long as each step is at most this fraction of the last one.
WORTH_KEEPING = 0.3

# When Newton's method has diverged.
RUNAWAY = 20.0  # step over the speed of the flow it started from
PATIENCE = 2  # number of steps that may be longer than the one before


class NotConvergedError(Exception):
    """Newton's method failed; carries the last relative step."""

    def __init__(self, step: float) -> None:
        super().__init__(step)
        self.step = step


# Of a flow to begin with, a parameter, iterations and a tolerance: the flow or None, iterations used, last step.
Solve = Callable[[Floats, float, int, float], tuple[Floats | None, int, float]]


@dataclass(frozen=True, slots=True)
class Continuation:
    """Continuation of a parameter from 0, where Newton's method does not converge at once."""

    intermediate_tolerance: float  # relative step that is enough for an intermediate flow
    smallest_stride: float  # of the end
    longer: float  # factor on the stride after a success
    shorter: float  # of a stride that failed

    def follow(self, solve: Solve, flux: Floats, end: float, max_iterations: int, tolerance: float) -> Floats:
        """Flow (faces,) of the parameter `end`, from that of 0.

        Raises NotConvergedError if there is no flow of `end` after all iterations.
        """
        left, reached, stride = max_iterations, 0.0, end
        while True:
            goal = min(reached + stride, end)
            near = tolerance if goal == end else max(tolerance, self.intermediate_tolerance)
            result, used, step = solve(flux, goal, left, near)
            left -= used
            if result is not None:
                if goal == end:
                    return result
                flux, reached, stride = result, goal, self.longer * stride
            else:
                stride = self.shorter * (goal - reached)
            if left <= 0 or stride < self.smallest_stride * end:
                raise NotConvergedError(step)


BY_INERTIA = Continuation(1e-3, 1e-3, longer=2.0, shorter=0.25)


@dataclass(frozen=True, slots=True, eq=False)
class Scales:
    """From the chip's units to those of the equations: velocities in m/s, pressures as p h / mu in m/s."""

    inertia: float  # rho h / mu, s/m; 0 for Stokes flow
    pressure: float  # mu / h, Pa per m/s
    drive_per_unit: Floats  # (openings,) m/s per um/s or per Pa
    drive: Floats  # (openings,) the chip's boundary values, m/s

    @classmethod
    def of(cls, chip: Chip, k: int, convection: bool) -> Scales:
        """Scales of a chip on k x k subcells a pixel."""
        h = chip.um_per_px * M_PER_UM / k
        mu = chip.viscosity_mpa_s * PA_S_PER_MPA_S
        per_unit = np.array([M_PER_UM if opening.kind == "inlet" else h / mu for opening in chip.openings])
        inertia = chip.density_kg_m3 * h / mu if convection else 0.0
        return cls(inertia, mu / h, per_unit, chip.boundary_values * per_unit)


def depth_friction(chip: Chip, k: int) -> float:
    """The factor f = 12 h^2 / H^2 of a shallow chip, else 0."""
    return 0.0 if chip.depth_um is None else 12.0 * (chip.um_per_px / k / chip.depth_um) ** 2


def local_friction(friction_per_um2: Floats, um_per_px: float, grid: Grid) -> Floats:
    """(faces,) the same of pixels (h, w): the mean of the two cells beside each face."""
    return grid.face_means(friction_per_um2) * (um_per_px / grid.k) ** 2


@dataclass(frozen=True, eq=False)
class Equations(ABC):
    """The discrete equations of one geometry and one kind of fluid.

    The unknowns are the fluxes of the faces (faces,) in m/s. A drive (openings,) holds inlet speeds in m/s and outlet
    pressures p h / mu in m/s. A push (faces,) is a further force on the right side, in m/s, such as a moving wall.
    """

    momentum: Momentum
    stream: StreamBasis

    @property
    def grid(self) -> Grid:
        """The grid."""
        return self.momentum.grid

    @abstractmethod
    def viscous_force(self, flux: Floats) -> Floats:
        """(faces,) viscous force and drag of the depth, with the sign of a resistance; m/s."""

    def residual(self, flux: Floats, drive: Floats, inertia: float, push: Floats | float = 0.0) -> Floats:
        """(faces,) residual of the momentum equations without the inner pressure, which has to balance it; m/s."""
        convection = inertia * self.momentum.convection(flux)
        return self.viscous_force(flux) + convection - (self.momentum.outlet @ drive + push)

    def unbalanced_fraction(self, flux: Floats, load: Floats) -> float:
        """Largest part of a load (faces,) that no pressure can balance, relative to the largest viscous term."""
        left = self.stream.curl.T @ load
        terms = abs(self.stream.curl).T @ np.abs(self.viscous_force(flux))
        return float(np.abs(left).max(initial=0.0) / max(float(terms.max(initial=0.0)), 1e-300))

    def velocity(self, flux: Floats) -> Floats:
        """Velocity (n, 2) at the centres of the fluid pixels in m/s, of fluxes (faces,)."""
        return (self.momentum.centre @ flux).reshape(-1, 2)

    def pressure(self, load: Floats) -> Floats:
        """Cell values p h / mu (cells,) whose gradient balances a load (faces,); the pressure at outlets is zero."""
        divergence, factors = self.momentum.poisson
        return factors.solve(divergence @ load)


@dataclass(frozen=True, eq=False)
class System(Equations):
    """The equations of a Newtonian fluid."""

    friction: float  # f = 12 h^2 / H^2 of a shallow chip, else 0
    resistance: Any  # A + f V (faces, faces), with the friction of single pixels
    stokes: Factors  # of C' (A + f V) C

    def viscous_force(self, flux: Floats) -> Floats:
        return self.resistance @ flux

    def force_by_friction(self, flux: Floats) -> Floats:
        """(faces,) derivative of the viscous force with respect to ln of the depth friction."""
        return self.friction * (self.momentum.volume * flux)

    def changed_residual(self, flux: Floats, drive: Floats, inertia: float, friction: float, law: Floats) -> Floats:
        """(faces,) `residual` with the depth friction times 1 + `friction`; the fluid has no law."""
        load = self.residual(flux, drive, inertia)
        return load + friction * self.friction * (self.momentum.volume * flux) if friction else load

    def linear(self, drives: Floats, push: Floats | float = 0.0) -> Floats:
        """Stokes fluxes (faces,) or (faces, n) for drives (openings,) or (openings, n)."""
        given = self.stream.inflow @ drives
        force = self.stream.curl.T @ (self.momentum.outlet @ drives + push - self.resistance @ given)
        return self.stream.curl @ self.stokes.solve(np.ascontiguousarray(force)) + given

    def steady(
        self, drive: Floats, inertia: float, max_iterations: int, tolerance: float, push: Floats | float = 0.0
    ) -> Floats:
        """Navier-Stokes fluxes (faces,) for inertia = rho h / mu in s/m.

        Newton's method starts from Stokes flow. Where it fails, continuation follows flows of increasing inertia.
        Raises NotConvergedError if the step is not below `tolerance` of the fastest velocity after `max_iterations`,
        continuation included.
        """
        flux = self.linear(drive, push)
        if inertia == 0.0 or not flux.any():
            return flux
        return BY_INERTIA.follow(
            lambda begin, goal, left, near: self._newton(begin, drive, push, goal, left, near),
            *(flux, inertia, max_iterations, tolerance),
        )

    def _newton(
        self, flux: Floats, drive: Floats, push: Floats | float, inertia: float, max_iterations: int, tolerance: float
    ) -> tuple[Floats | None, int, float]:
        """Flux, or None where the iteration diverges or is slow; number of iterations; last relative step.

        The matrix is factorised again only when the old factors converge slowly: at the Reynolds numbers of a chip
        those of Stokes flow are mostly enough.
        """
        speed = float(np.abs(flux).max())
        factors, last, step, grew = self.stokes, np.inf, np.inf, 0
        for number in range(1, max_iterations + 1):
            right = -(self.stream.curl.T @ self.residual(flux, drive, inertia, push))
            change = self.stream.curl @ factors.solve(right)
            step = float(np.abs(change).max()) / speed
            if not np.isfinite(step) or step > WORTH_KEEPING * last or step > 0.5:
                factors = self.tangent(flux, inertia)[0]
                change = self.stream.curl @ factors.solve(right)
                step = float(np.abs(change).max()) / speed
            grew += step > last
            if not np.isfinite(step) or step > RUNAWAY or grew > PATIENCE:
                return None, number, step
            flux = flux + change
            last = step
            if step <= tolerance:
                return flux, number, step
        return None, max_iterations, step

    def tangent(self, flux: Floats, inertia: float) -> tuple[Factors, Any]:
        """Factors and operator (faces, faces) of the equations linearised around a flow."""
        if inertia == 0.0:
            return self.stokes, self.resistance
        operator = self.resistance + inertia * self.momentum.convection_jacobian(flux)
        return factorise(self.stream.curl.T @ operator @ self.stream.curl), operator


def system(chip: Chip, k: int) -> System:
    """The factorised equations of a chip on k x k subcells a pixel, from the cache if they are there."""

    def compute() -> System:
        # Friction of single pixels changes only the resistance of a chip without it.
        if chip.friction_per_um2 is None:
            return newton_equations(chip, k)
        return with_friction(system(replace(chip, friction_per_um2=None), k), chip.friction_per_um2, chip.um_per_px)

    return compute_cached(("system", *geometry_key(chip, k)), compute)


def geometry_key(chip: Chip, k: int) -> tuple[Hashable, ...]:
    """All of a chip that the matrices depend on, as part of a cache key."""
    openings = tuple((o.side, o.first, o.last, o.kind) for o in chip.openings)
    mask = (chip.mask.shape, np.packbits(chip.mask).tobytes())
    walls = (chip.walls, array_key(chip.drawn), chip.wall_offset_px, array_key(chip.level_px))
    return (*mask, openings, *walls, k, depth_friction(chip, k), array_key(chip.friction_per_um2))


def with_friction(bare: System, friction_per_um2: Floats, um_per_px: float) -> System:
    """The equations of a chip whose pixels (h, w) have more friction than those of `bare`."""
    friction = local_friction(friction_per_um2, um_per_px, bare.grid)
    resistance = scipy.sparse.csr_array(bare.resistance + scipy.sparse.diags_array(friction * bare.momentum.volume))
    return replace(bare, resistance=resistance, stokes=factorise(bare.stream.curl.T @ resistance @ bare.stream.curl))


def newton_equations(chip: Chip, k: int, walls: LevelSet | None = None) -> System:
    """Assemble the equations without the cache. `walls` replaces the walls of the mask."""
    momentum = momenta.assemble(grids.build(chip, k, walls))
    stream, friction = streams.assemble(momentum.grid), depth_friction(chip, k)
    resistance = scipy.sparse.csr_array(momentum.viscous + scipy.sparse.diags_array(friction * momentum.volume))
    stokes = factorise(stream.curl.T @ resistance @ stream.curl)
    return System(momentum, stream, friction, resistance, stokes)
