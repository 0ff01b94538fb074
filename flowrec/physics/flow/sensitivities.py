"""Derivatives of a chip's flow with respect to boundary values and fluid, and the nonlinear remainder.

Without inertia a Newtonian flow is exactly linear in inlet speeds and in p_out / mu, so viscosity alone changes
nothing. With inertia or a law of viscosity the modes are the derivatives at the chip's own values, and a few steps with
the same factors lead from the linear prediction to the solution. All of it depends on the chip alone, never on earlier
calls.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from flowrec.core import UM_PER_M, Floats, Floats32
from flowrec.physics.flow.assembly import averages
from flowrec.physics.flow.generalised import GeneralisedSystem
from flowrec.physics.flow.grid import Grid, GridOpening, number_where
from flowrec.physics.flow.level_set import subcells
from flowrec.physics.flow.linear_solver import Factors
from flowrec.physics.flow.newton_solver import Scales, System


@dataclass(frozen=True, slots=True, eq=False)
class Remainder:
    """Difference of a nonlinear flow from its linear prediction.

    `flux` (faces,) is in m/s; `step` is the last step of its iteration over the fastest speed.
    """

    flux: Floats
    step: float


@dataclass(frozen=True, slots=True, eq=False)
class Sensitivities:
    """First-order expansion around a chip's own flow in P parameters, and iterations to the full solution.

    Parameters: one per opening (inlet: mean speed, um/s; outlet: pressure at the chip's own viscosity, Pa), ln nu with
    nu = mu / rho, then, where requested, ln of the depth friction, a skew and a flat part (um/s) per inlet, and the
    unknowns of the chip's law of viscosity (`law_unknowns`).
    Velocities are compact: (..., n, 2) um/s at the centres of the n fluid pixels of the mask in raster order.
    """

    equations: System | GeneralisedSystem
    factors: Factors  # of the equations linearised around `flux`
    scales: Scales
    with_friction: bool  # ln of the depth friction is a parameter
    flux: Floats  # (faces,) the chip's own flow, m/s
    flux_modes: Floats  # (faces, P) m/s per unit
    cell_average: Any  # (n, cells) cell values to pixels
    base: Floats  # (n, 2) the chip's own flow
    modes: Floats  # (P, n, 2) per unit
    law_unknowns: tuple[str, ...] = ()  # the last parameters

    @property
    def wall_px(self) -> Floats32:
        """Signed distance (h, w) of the pixel centres to the wall, as in FlowField."""
        return self.equations.grid.wall_px

    @property
    def openings(self) -> int:
        """Number of openings."""
        return len(self.scales.drive)

    def start(self) -> Remainder:
        """No remainder: the linear prediction."""
        return Remainder(np.zeros_like(self.flux), np.inf)

    def approach(self, offset: Floats, remainder: Remainder) -> Remainder:
        """One step with frozen factors towards the Navier-Stokes solution, for parameters `offset` (P,)."""
        newtonian = isinstance(self.equations, System)
        if newtonian and self.scales.inertia == 0.0 and not self._friction_change(offset):
            return Remainder(remainder.flux, 0.0)
        flux = self.flux + self.flux_modes @ offset + remainder.flux
        curl = self.equations.stream.curl
        step = curl @ self.factors.solve(-(curl.T @ self._load(offset, flux)))
        return Remainder(remainder.flux + step, float(np.abs(step).max() / max(np.abs(flux).max(), 1e-300)))

    def _friction_change(self, offset: Floats) -> float:
        """Relative change of the depth friction."""
        return float(np.expm1(offset[self.openings + 1])) if self.with_friction else 0.0

    def _load(self, offset: Floats, flux: Floats) -> Floats:
        """(faces,) residual that the inner pressure has to balance; m/s."""
        scales = self.scales
        drive = scales.drive + scales.drive_per_unit * offset[: self.openings]
        inertia = scales.inertia * float(np.exp(-offset[self.openings]))
        law = offset[len(offset) - len(self.law_unknowns) :]
        return self.equations.changed_residual(flux, drive, inertia, self._friction_change(offset), law)

    def pressure(self, offset: Floats, remainder: Remainder) -> Floats:
        """Pressure (n,) in Pa at the chip's own viscosity; at fixed parameters it is proportional to the viscosity."""
        load = self._load(offset, self.flux + self.flux_modes @ offset + remainder.flux)
        return np.asarray(self.cell_average @ self.equations.pressure(load)) * self.scales.pressure

    def pixels(self, flux: Floats) -> Floats:
        """Velocities (n, 2) at the pixel centres in um/s of fluxes (faces,) in m/s."""
        return self.equations.velocity(flux) * UM_PER_M


def sensitivities(
    equations: System | GeneralisedSystem, scales: Scales, flux: Floats, friction: bool, shapes: bool, law: bool = False
) -> Sensitivities:
    """Expansion around a flow `flux` (faces,).

    `friction` makes ln of the depth friction a parameter, `shapes` the shapes of the inlets' profiles, `law` the
    unknowns of the law of viscosity.
    """
    stream, momentum, grid = equations.stream, equations.momentum, equations.grid
    factors, operator = equations.tangent(flux, scales.inertia)
    # What each parameter prescribes (faces, P), and the force it adds (faces, P).
    none = np.zeros((grid.faces, 1))
    given = [stream.inflow * scales.drive_per_unit, none]
    # d/d ln nu at fixed drives: inertia is proportional to 1 / nu.
    push = [momentum.outlet * scales.drive_per_unit, scales.inertia * momentum.convection(flux)[:, None]]
    if friction:
        given.append(none)
        push.append(-equations.force_by_friction(flux)[:, None])
    if shapes:
        for opening in grid.openings:
            if opening.kind == "inlet":
                given += [_shape(grid, opening, skew)[:, None] / UM_PER_M for skew in (True, False)]
                push += [none, none]
    unknowns: tuple[str, ...] = ()
    if law and isinstance(equations, GeneralisedSystem):
        unknowns = equations.law.unknowns
        given += [none] * len(unknowns)
        push.append(-equations.force_by_unknowns(flux))
    prescribed = np.concatenate(given, axis=1)
    force = stream.curl.T @ (np.concatenate(push, axis=1) - operator @ prescribed)
    modes = stream.curl @ factors.solve(np.ascontiguousarray(force)) + prescribed
    return Sensitivities(
        equations,
        factors,
        scales,
        friction,
        flux,
        modes,
        _cell_average(grid),
        equations.velocity(flux) * UM_PER_M,
        np.ascontiguousarray((momentum.centre @ modes).T).reshape(modes.shape[1], -1, 2) * UM_PER_M,
        unknowns,
    )


def _cell_average(grid: Grid) -> Any:
    """The averages of Grid.pressure as a matrix (n, cells)."""
    number, count = number_where(grid.mask, 0)
    pixel = subcells(number, grid.k)
    inside = (pixel >= 0) & (grid.number_p >= 0)
    return averages(pixel[inside], grid.number_p[inside], (count, grid.cells))


def _shape(grid: Grid, opening: GridOpening, skew: bool) -> Floats:
    """(faces,) a profile without net flux at one inlet: odd (skew), or towards a flat profile; scaled as the parabola.

    It is given as a stream function on the corners of the opening, which changes the faces beside it too.
    """
    count = len(opening.faces)
    edge = np.linspace(-1.0, 1.0, count + 1)
    # Integrals from one wall: of y (1 - y^2), and of 1 - 3/2 (1 - y^2).
    potential = -0.25 * (1.0 - edge**2) ** 2 if skew else edge * (edge**2 - 1.0) / 3.0
    h, w = grid.fluid.shape
    psi = np.zeros((h + 1, w + 1))
    psi[opening.vertices] = opening.streamfunction_sign * 0.5 * count * 1.5 * potential
    return grid.on_faces(np.diff(psi, axis=0), -np.diff(psi, axis=1))
