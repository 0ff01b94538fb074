"""The equations of one chip's geometry, factorised once, and Newton's method on them.

Everything here is free of viscosity, density, pixel size and boundary values, so one factorisation serves them all;
the cache is keyed by all that enters, so that it cannot change a result.
"""

from __future__ import annotations

import threading
from collections import OrderedDict
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import scipy.sparse as sp
from scipy.sparse.linalg import splu

from flowrec.chip.chip import Chip
from flowrec.flow import grid as grids
from flowrec.flow import momentum as momenta
from flowrec.flow import stream as streams
from flowrec.flow.grid import INLET, Floats, Grid
from flowrec.flow.momentum import Momentum
from flowrec.flow.outline import Outline
from flowrec.flow.stream import Stream

KEPT = 4  # geometries in memory; a session needs one or two

# A frozen factorisation is used as long as each step leaves at most this share of the last one.
WORTH_KEEPING = 0.3


def factorise(matrix: Any) -> Any:
    """LU factors of a matrix of symmetric pattern and dominant diagonal blocks."""
    if matrix.shape[0] == 0:  # a channel of one cell between inlets has no freedom left
        return _Nothing()
    return splu(
        sp.csc_matrix(matrix),
        permc_spec="MMD_AT_PLUS_A",
        diag_pivot_thresh=0.01,
        options={"SymmetricMode": True},
    )


class _Nothing:
    """Factors of the empty matrix."""

    @staticmethod
    def solve(right: Floats) -> Floats:
        """Solution (0, ...)."""
        return right


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
    stokes: Any  # factors of C' (A + f V) C
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
        given = self.momentum.outlet @ drive + push
        return np.asarray(self.resisting @ moving + inertia * self.momentum.convection(moving) - given)

    def steady(
        self, drive: Floats, inertia: float, max_iterations: int, tolerance: float, push: Floats | None = None
    ) -> Floats:
        """Navier-Stokes face velocities (faces,) for inertia = rho h / mu in s/m.

        `push` (faces,) is a further force in m/s, as of moving walls: momentum.sliding @ speeds (4,).

        Newton's method whose factors are renewed only when they stop paying: at the Reynolds numbers of a chip the
        Stokes factors mostly do.

        Raises
        ------
        NotConvergedError
            If the step is not below `tolerance` of the fastest velocity after `max_iterations`.
        """
        moving = self.linear(drive[:, None])[:, 0]
        if push is None:
            push = np.zeros(len(moving))
        else:
            moving = moving + self.stream.curl @ self.stokes.solve(np.ascontiguousarray(self.stream.curl.T @ push))
        speed = float(np.abs(moving).max())
        if inertia == 0.0 or speed == 0.0:
            return moving
        factors, last, step = self.stokes, np.inf, np.inf
        for _ in range(max_iterations):
            force = self.stream.curl.T @ self.residual(moving, drive, inertia, push)
            change = np.asarray(self.stream.curl @ factors.solve(np.ascontiguousarray(-force)))
            step = float(np.abs(change).max()) / speed
            if not np.isfinite(step) or step > 1e6:
                break
            if step > WORTH_KEEPING * last or step > 0.5:
                factors = self.tangent(moving, inertia)[0]
                change = np.asarray(self.stream.curl @ factors.solve(np.ascontiguousarray(-force)))
                step = float(np.abs(change).max()) / speed
            moving = moving + change
            last = step
            if step <= tolerance:
                return np.asarray(moving)
        raise NotConvergedError(step)

    def tangent(self, moving: Floats, inertia: float) -> tuple[Any, Any]:
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


_kept: OrderedDict[tuple[Any, ...], System] = OrderedDict()
_lock = threading.Lock()


def system(chip: Chip, k: int) -> System:
    """The factorised equations of a chip on k x k subcells a pixel; a few geometries are kept."""
    openings = tuple((o.side, o.first, o.last, o.kind) for o in chip.openings)
    mask = (chip.mask.shape, np.packbits(chip.mask).tobytes())
    key = (*mask, openings, chip.walls, k, _friction(chip, k))
    with _lock:
        if key in _kept:
            _kept.move_to_end(key)
            return _kept[key]
    made = assembled(chip, k)
    with _lock:
        _kept[key] = made
        while len(_kept) > KEPT:
            _kept.popitem(last=False)
    return made


def forget() -> None:
    """Drop the kept geometries, as in a process that has just started."""
    with _lock:
        _kept.clear()


def assembled(chip: Chip, k: int, drawn: Outline | None = None) -> System:
    """The same, not kept; with the walls of an outline in place of the mask's, where one is given."""
    grid = grids.build(chip, k, drawn)
    momentum = momenta.assemble(grid)
    stream = streams.assemble(grid)
    resisting = sp.csr_array(momentum.viscous + sp.diags_array(_friction(chip, k) * momentum.volume))
    return System(grid, momentum, stream, resisting, factorise(stream.curl.T @ resisting @ stream.curl))


def _friction(chip: Chip, k: int) -> float:
    """The factor 12 h^2 / H^2 of a shallow chip, else 0."""
    return 0.0 if chip.depth_um is None else 12.0 * (chip.um_per_px / k / chip.depth_um) ** 2
