"""How the flow of a chip answers to its boundary values and its fluid: linear modes, and the inertia on top of them.

Without inertia a flow is exactly linear in inlet speeds and in p_out / mu, so viscosity as such moves nothing. With
inertia the modes are the derivatives at the chip's own values, and a few steps with the same factors lead from their
prediction to the Navier-Stokes solution. Everything depends on the chip alone, never on what was asked before.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from flowrec.flow.grid import Floats, Grid, Mouth
from flowrec.flow.newton_solver import System
from flowrec.units import UM_PER_M

SHAPES = ("skew", "flat")  # what an inlet's profile may have besides the parabola


@dataclass(frozen=True, slots=True, eq=False)
class State:
    """A flow near the modes' own: (faces,) beside the linear prediction, and the last step over the fastest speed."""

    beyond: Floats
    step: float


@dataclass(frozen=True, slots=True, eq=False)
class FlowResponse:
    """First order around a chip's own flow in P parameters, and the way to the full solution.

    Parameters: one per opening (inlet: mean speed, um/s; outlet: pressure at the chip's own viscosity, Pa), ln nu
    with nu = mu / rho, and where they are asked for ln of the depth's friction, then a skew and a flat part (um/s) per
    inlet. Velocities are compact: (..., n, 2) um/s on the n fluid pixels of the mask in raster order.
    """

    equations: System
    factors: Any  # of the equations linearised around `moving`
    inertia: float  # rho h / mu, s/m, of the chip's own fluid
    friction: float  # f = 12 h^2 / H^2
    drive: Floats  # (openings,) the chip's own, m/s
    drive_per_unit: Floats  # (openings,) m/s per um/s or Pa
    pressure_scale: float  # mu / h, Pa per m/s
    given: Floats  # (faces, P) what each parameter prescribes, m/s per unit
    moving: Floats  # (faces,) the chip's own flow, m/s
    change: Floats  # (faces, P) m/s per unit
    average: Any  # (2 n, faces) face velocities to pixels, um/s per m/s
    average_cells: Any  # (n, cells) cell values to pixels
    base: Floats  # (n, 2)
    modes: Floats  # (P, n, 2) per unit

    @property
    def openings(self) -> int:
        """Number of openings."""
        return len(self.drive)

    def linear(self, offset: Floats) -> Floats:
        """Velocity (n, 2) for parameters that lie `offset` (P,) from the chip's own, to first order."""
        return np.asarray(self.base + np.tensordot(offset, self.modes, axes=1))

    def start(self) -> State:
        """On the linear prediction."""
        return State(np.zeros_like(self.moving), np.inf)

    def approach(self, offset: Floats, state: State) -> State:
        """One step nearer to the Navier-Stokes solution."""
        if self.inertia == 0.0 and not self.nonlinear_friction(offset):
            return State(state.beyond, 0.0)
        moving = self.predicted(offset) + state.beyond
        force = self.equations.stream.curl.T @ self.load(offset, moving)
        step = np.asarray(self.equations.stream.curl @ self.factors.solve(np.ascontiguousarray(-force)))
        return State(state.beyond + step, float(np.abs(step).max() / max(np.abs(moving).max(), 1e-300)))

    def nonlinear_friction(self, offset: Floats) -> bool:
        """Whether the friction of the depth is a parameter that was moved."""
        return self._has_friction and bool(offset[self.openings + 1])

    @property
    def _has_friction(self) -> bool:
        return bool((self.change.shape[1] - self.openings - 1) % 2 == 1)

    def predicted(self, offset: Floats) -> Floats:
        """Face velocities (faces,) to first order, m/s."""
        return np.asarray(self.moving + self.change @ offset)

    def load(self, offset: Floats, moving: Floats) -> Floats:
        """(faces,) what the pressure inside has to balance; m/s."""
        drive = self.drive + self.drive_per_unit * offset[: self.openings]
        inertia = self.inertia * float(np.exp(-offset[self.openings]))
        load = self.equations.residual(moving, drive, inertia)
        if self.nonlinear_friction(offset):
            load = load + float(np.expm1(offset[self.openings + 1])) * self.friction * (
                self.equations.momentum.volume * moving
            )
        return load

    def pressure(self, offset: Floats, state: State) -> Floats:
        """Pressure (n,) in Pa at the chip's own viscosity; it grows with the viscosity at fixed parameters."""
        load = self.load(offset, self.predicted(offset) + state.beyond)
        return np.asarray(self.average_cells @ self.equations.pressure(load[:, None])[:, 0]) * self.pressure_scale

    def seen(self, moving: Floats) -> Floats:
        """Face velocities (faces,) in m/s as the pixels (n, 2) in um/s see them."""
        return np.asarray((self.average @ moving).reshape(-1, 2))


def respond(
    equations: System,
    drive: Floats,
    drive_per_unit: Floats,
    inertia: float,
    friction: float,
    pressure_scale: float,
    moving: Floats,
    extras: tuple[bool, bool],
) -> FlowResponse:
    """The modes around a flow `moving`; `extras`: ln friction, and the inlets' shapes, are parameters too."""
    stream, momentum, grid = equations.stream, equations.momentum, equations.grid
    factors, operator = equations.tangent(moving, inertia)
    # What is prescribed, and what pushes besides.
    given = [stream.inflow * drive_per_unit]
    push = [momentum.outlet * drive_per_unit]
    none = np.zeros((grid.faces, 1))
    # d/d ln nu at fixed drives: inertia falls as 1 / nu.
    given.append(none)
    push.append(inertia * momentum.convection(moving)[:, None])
    if extras[0]:
        given.append(none)
        push.append(-friction * (momentum.volume * moving)[:, None])
    if extras[1]:
        for mouth in grid.mouths:
            if mouth.kind == "inlet":
                shapes = np.column_stack([_shape(grid, mouth, name) for name in SHAPES]) / UM_PER_M
                given.append(shapes)
                push.append(np.zeros_like(shapes))
    prescribed = np.concatenate(given, axis=1)
    force = stream.curl.T @ (np.concatenate(push, axis=1) - operator @ prescribed)
    change = np.asarray(stream.curl @ factors.solve(np.ascontiguousarray(force)) + prescribed)
    average = _averages(grid) * UM_PER_M
    pixels = average.shape[0] // 2
    return FlowResponse(
        equations,
        factors,
        inertia,
        friction,
        drive,
        drive_per_unit,
        pressure_scale,
        prescribed,
        moving,
        change,
        average,
        _cell_averages(grid),
        np.asarray(average @ moving).reshape(pixels, 2),
        np.ascontiguousarray((average @ change).T.reshape(-1, pixels, 2)),
    )


def _cell_averages(grid: Grid) -> Any:
    """(n, cells) mean over the fluid subcells of each fluid pixel, as Grid.pressure."""
    number = np.full(grid.mask.shape, -1, np.int64)
    number[grid.mask] = np.arange(np.count_nonzero(grid.mask))
    pixel = np.repeat(np.repeat(number, grid.k, axis=0), grid.k, axis=1)
    there = (pixel >= 0) & (grid.number_p >= 0)
    count = np.bincount(pixel[there], minlength=int(number.max()) + 1)
    return sp.csr_array(
        sp.coo_array((1.0 / count[pixel[there]], (pixel[there], grid.number_p[there])), shape=(len(count), grid.cells))
    )


def _averages(grid: Grid) -> Any:
    """(2 n, faces) mean over the k x k subcells of each fluid pixel, x and y in turn, as Grid.velocity."""
    k = grid.k
    where = np.flatnonzero(grid.mask)
    number = np.full(grid.mask.shape, -1, np.int64)
    number[grid.mask] = np.arange(len(where))
    pixel = np.repeat(np.repeat(number, k, axis=0), k, axis=1)
    rows, columns = [], []
    for axis, faces in enumerate((grid.number_u, grid.number_v)):
        for side in (faces[:, :-1], faces[:, 1:]) if axis == 0 else (faces[:-1], faces[1:]):
            there = (pixel >= 0) & (side >= 0)
            rows.append(2 * pixel[there] + axis)
            columns.append(side[there])
    row, column = np.concatenate(rows), np.concatenate(columns)
    return sp.csr_array(
        sp.coo_array((np.full(len(row), 0.5 / k**2), (row, column)), shape=(2 * len(where), grid.faces))
    )


def _shape(grid: Grid, mouth: Mouth, name: str) -> Floats:
    """(faces,) a profile without flux at one inlet: odd (skew), or towards a flat one; of the parabola's size.

    As a stream function on the corners of the mouth, which the faces beside it feel too.
    """
    count = len(mouth.faces)
    edge = np.linspace(-1.0, 1.0, count + 1)
    # Integrals from the one wall: of y (1 - y^2), and of 1 - 3/2 (1 - y^2).
    potential = -0.25 * (1.0 - edge**2) ** 2 if name == "skew" else edge * (edge**2 - 1.0) / 3.0
    sign = mouth.inward * (1.0 if mouth.side in ("left", "right") else -1.0)
    h, w = grid.fluid.shape
    psi = np.zeros((h + 1, w + 1))
    psi[mouth.vertices] = sign * 0.5 * count * 1.5 * potential
    face = np.zeros(grid.faces)
    for numbers, difference in ((grid.number_u, psi[1:] - psi[:-1]), (grid.number_v, psi[:, :-1] - psi[:, 1:])):
        there = numbers >= 0
        face[numbers[there]] = difference[there]
    return face


def fluid_image(mask: NDArray[np.bool_], values: NDArray[Any]) -> NDArray[Any]:
    """Compact values (n, ...) as an image (h, w, ...) that is 0 in solid."""
    image = np.zeros((*mask.shape, *values.shape[1:]), values.dtype)
    image[mask] = values
    return image
