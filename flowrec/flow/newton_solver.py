"""The equations of one chip's geometry, factorised once, and Newton's method on them.

Everything here is free of viscosity, density, pixel size and boundary values, so one factorisation serves them all;
the cache is keyed by all that enters, so that it cannot change a result.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import scipy.sparse as sp

from flowrec.chip.chip import Chip
from flowrec.flow import grid as grids
from flowrec.flow import momentum as momenta
from flowrec.flow import streamfunction as streams
from flowrec.flow.cache import cells_of, kept
from flowrec.flow.grid import INLET, Floats, Grid
from flowrec.flow.level_set import Outline
from flowrec.flow.linear_solver import Factors, factorise
from flowrec.flow.momentum import Momentum
from flowrec.flow.streamfunction import Stream

# A frozen factorisation is used as long as each step leaves at most this share of the last one.
WORTH_KEEPING = 0.3

# When Newton's method has gone astray, and how continuation in inertia goes on.
RUNAWAY = 20.0  # step over the speed of the flow it started from
PATIENCE = 2  # steps that may be longer than the one before
NEARBY = 1e-3  # relative step that will do on the way
SMALLEST_STRIDE = 1e-3  # of the inertia


class NotConvergedError(Exception):
    """Newton's method gave up; carries the last relative step."""

    def __init__(self, step: float) -> None:
        super().__init__(step)
        self.step = step


@dataclass(frozen=True, slots=True, eq=False)
class System:
    """Operators of one geometry. Drives (openings,) are inlet speeds in m/s and outlet p h / mu in m/s."""

    grid: Grid
    momentum: Momentum
    stream: Stream
    resisting: Any  # A + f V (faces, faces)
    stokes: Factors  # factors of C' (A + f V) C
    _poisson: list[Any] = field(default_factory=list)  # factors for the pressure, once they are needed

    def linear(self, drives: Floats) -> Floats:
        """Stokes face velocities (faces, n) of drives (openings, n)."""
        return self._response(self.stokes, self.resisting, drives)

    def _response(self, factors: Any, operator: Any, drives: Floats) -> Floats:
        given = self.stream.inflow @ drives
        force = self.stream.curl.T @ (self.momentum.outlet @ drives - operator @ given)
        return np.asarray(self.stream.curl @ factors.solve(np.ascontiguousarray(force)) + given)

    def residual(self, moving: Floats, drive: Floats, inertia: float, push: Floats | float = 0.0) -> Floats:
        """(faces,) what the pressure inside has to balance; m/s. `push` as in `steady`."""
        return self._load(moving, self.momentum.outlet @ drive + push, inertia)

    def _load(self, moving: Floats, force: Floats, inertia: float) -> Floats:
        return np.asarray(self.resisting @ moving + inertia * self.momentum.convection(moving) - force)

    def unbalanced(self, moving: Floats, load: Floats) -> float:
        """What the pressure can not balance of a load (faces,), over the largest term of its balance."""
        left = self.stream.curl.T @ load
        terms = abs(self.stream.curl).T @ np.abs(self.resisting @ moving)
        return float(np.abs(left).max(initial=0.0) / max(float(terms.max(initial=0.0)), 1e-300))

    def steady(
        self, drive: Floats, inertia: float, max_iterations: int, tolerance: float, push: Floats | None = None
    ) -> Floats:
        """Navier-Stokes face velocities (faces,) for inertia = rho h / mu in s/m.

        Newton's method from Stokes flow, then, where that fails, along flows of growing inertia. `push` (faces,) is a
        further force on the right, in m/s: a wall that moves, for one.

        Raises
        ------
        NotConvergedError
            If the step is not below `tolerance` of the fastest velocity after `max_iterations`, continuation included.
        """
        force = self.momentum.outlet @ drive + (0.0 if push is None else push)
        moving = self._stokes(drive, force)
        if inertia == 0.0 or not moving.any():
            return moving
        left = max_iterations
        reached, stride = 0.0, inertia
        while True:
            goal = min(reached + stride, inertia)
            # Far from the goal a thousandth will do: the flow is only where the next one starts from.
            near = tolerance if goal == inertia else max(tolerance, NEARBY)
            result, used, step = self._newton(moving, force, goal, left, near)
            left -= used
            if result is not None:
                if goal == inertia:
                    return result
                moving, reached, stride = result, goal, 2.0 * stride
            else:
                stride = 0.25 * (goal - reached)
            if left <= 0 or stride < SMALLEST_STRIDE * inertia:
                raise NotConvergedError(step)

    def _stokes(self, drive: Floats, force: Floats) -> Floats:
        """Stokes flow (faces,) of drives (openings,) and forces (faces,)."""
        given = self.stream.inflow @ drive
        right = self.stream.curl.T @ (force - self.resisting @ given)
        return np.asarray(self.stream.curl @ self.stokes.solve(right) + given)

    def _newton(
        self, moving: Floats, force: Floats, inertia: float, max_iterations: int, tolerance: float
    ) -> tuple[Floats | None, int, float]:
        """Flow or None where it runs away or is slow, iterations and last relative step.

        The factors are renewed only when they stop paying: at the Reynolds numbers of a chip those of Stokes flow
        mostly do.
        """
        speed = float(np.abs(moving).max())
        factors, last, step, grew = self.stokes, np.inf, np.inf, 0
        for number in range(1, max_iterations + 1):
            right = -(self.stream.curl.T @ self._load(moving, force, inertia))
            change = np.asarray(self.stream.curl @ factors.solve(right))
            step = float(np.abs(change).max()) / speed
            if not np.isfinite(step) or step > WORTH_KEEPING * last or step > 0.5:
                factors = self.tangent(moving, inertia)[0]
                change = np.asarray(self.stream.curl @ factors.solve(right))
                step = float(np.abs(change).max()) / speed
            grew += step > last
            if not np.isfinite(step) or step > RUNAWAY or grew > PATIENCE:
                return None, number, step
            moving = moving + change
            last = step
            if step <= tolerance:
                return np.asarray(moving), number, step
        return None, max_iterations, step

    def tangent(self, moving: Floats, inertia: float) -> tuple[Factors, Any]:
        """Factors and operator (faces, faces) of the equations linearised around a flow."""
        if inertia == 0.0:
            return self.stokes, self.resisting
        operator = self.resisting + inertia * self.momentum.convection_jacobian(moving)
        return factorise(self.stream.curl.T @ operator @ self.stream.curl), operator

    def responses(self, moving: Floats, drive: Floats, inertia: float) -> tuple[Floats, Floats]:
        """Change of velocity (faces, openings + 1) and of the pressure's load around a flow.

        One column per unit of each drive, and last per unit of ln mu at fixed inlet speeds and outlet pressures.
        """
        factors, operator = self.tangent(moving, inertia)
        unit = np.eye(len(drive))
        by_drive = self._response(factors, operator, unit)
        # d/d ln mu: both inertia and the drive of the outlets fall as 1 / mu.
        push = inertia * self.momentum.convection(moving) - self.momentum.outlet @ drive
        by_viscosity = self.stream.curl @ factors.solve(np.ascontiguousarray(self.stream.curl.T @ push))
        change = np.column_stack([by_drive, by_viscosity])
        load = operator @ change - np.column_stack([self.momentum.outlet @ unit, push])
        return change, np.asarray(load)

    def pressure(self, load: Floats) -> Floats:
        """Cell values p h / mu (cells, n) whose gradient balances loads (faces, n); outlets hang at zero."""
        if not self._poisson:
            kinds = np.concatenate([self.grid.kind_u.ravel(), self.grid.kind_v.ravel()])
            numbers = np.concatenate([self.grid.number_u.ravel(), self.grid.number_v.ravel()])
            free = np.ones(self.grid.faces)
            free[numbers[kinds == INLET]] = 0.0
            gradient = sp.diags_array(free) @ self.momentum.gradient
            laplacian = gradient.T @ gradient
            if not any(mouth.kind == "outlet" for mouth in self.grid.mouths):
                # In a closed box the level of the pressure is free: the first cell's is 0.
                laplacian = laplacian + sp.coo_array(([1.0], ([0], [0])), shape=laplacian.shape)
            self._poisson[:] = [gradient.T.tocsr(), factorise(laplacian)]
        transposed, factors = self._poisson
        return np.asarray(factors.solve(np.ascontiguousarray(transposed @ load)))


def system(chip: Chip, k: int) -> System:
    """The factorised equations of a chip on k x k subcells a pixel; a few geometries are kept."""
    openings = tuple((o.side, o.first, o.last, o.kind) for o in chip.openings)
    mask = (chip.mask.shape, np.packbits(chip.mask).tobytes())
    key = ("system", *mask, openings, chip.walls, k, depth_friction(chip, k))
    made: System = kept(key, cells_of(chip, k), lambda: assembled(chip, k))
    return made


def assembled(chip: Chip, k: int, drawn: Outline | None = None) -> System:
    """The same, not kept; with the walls of an outline in place of the mask's, where one is given."""
    grid = grids.build(chip, k, drawn)
    momentum = momenta.assemble(grid)
    stream = streams.assemble(grid)
    resisting = sp.csr_array(momentum.viscous + sp.diags_array(depth_friction(chip, k) * momentum.volume))
    return System(grid, momentum, stream, resisting, factorise(stream.curl.T @ resisting @ stream.curl))


def depth_friction(chip: Chip, k: int) -> float:
    """The factor f = 12 h^2 / H^2 of a shallow chip, else 0."""
    return 0.0 if chip.depth_um is None else 12.0 * (chip.um_per_px / k / chip.depth_um) ** 2
