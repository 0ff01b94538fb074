"""PINN, a baseline of the paper: velocity and pressure as a network of continuous coordinates (Raissi et al., 2019).

A fully connected tanh network is fitted to one case. Its loss is the weighted sum of mean squares: residuals of
continuity and momentum at random points of the fluid, velocity on the walls, and deviations from the assumed profiles
of the inlets, the assumed pressures of the outlets, and the observations. Without dimensions (length L: the median
channel width, velocity V: root mean square of the observations, pressure mu V / L) the equations are

    div v = 0,   Re (v . grad) v + grad p - lap v + f v = 0,   Re = rho V L / mu,   f = 12 L^2 / H^2,

and momentum is divided by 12, the pressure gradient of Poiseuille flow of mean V in a channel of width L.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Annotated

import numpy as np

from flowrec.core import (
    M_PER_UM,
    PA_S_PER_MPA_S,
    Floats,
    FlowError,
    FlowField,
    NotFiniteError,
    Range,
    Seed,
    Threads,
    Weight,
)
from flowrec.physics import Chip, border, median_width_um
from flowrec.stages.refine.method import RefinementProblem
from flowrec.stages.refine.network_fit import Device, Iterations, adam, torch_run
from flowrec.stages.refine.observation_operator import ObservationOperator

if TYPE_CHECKING:
    from torch import Tensor

    from flowrec.stages.refine.network import CoordinateNet

BLOCK = 100  # iterations over which the noisy loss is averaged before it is compared
WARM_UP = 50  # iterations of a rising learning rate
LOWEST_RATE = 0.02  # of the learning rate, at the end
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


@dataclass(frozen=True, slots=True)
class Pinn:
    """Settings of the PINN."""

    iterations: Iterations = 1000  # iterations of the training
    # iterations without a loss that is lower by a hundredth before it stops
    patience: Iterations = 300
    # points in the fluid, drawn anew for every iteration; half as many on the walls
    points: Annotated[int, Range(16, 1_000_000)] = 512
    width: Annotated[int, Range(1, 4_096)] = 64  # neurons of a hidden layer
    depth: Annotated[int, Range(1, 64)] = 4  # hidden layers
    features: Annotated[int, Range(1, 4_096)] = 64  # sines and cosines of the coordinates that the first layer sees
    # one standard deviation of their wavenumbers, in radians per median channel width
    wavenumber: Annotated[float, Range(1e-3, 1e3)] = 0.5
    learning_rate: Annotated[float, Range(1e-8, 1.0)] = 3e-3  # learning rate of Adam
    momentum_weight: Weight = 0.1  # weights are those of mean squares
    continuity_weight: Weight = (
        30.0  # a leak is worse than a wrong force: it changes the flow of every branch behind it
    )
    observation_weight: Weight = 10.0  # weight of the misfit of the observations in the loss
    wall_weight: Weight = 10.0  # weight of the velocity at the walls in the loss
    inlet_weight: Weight = 1.0  # weight of the misfit of the stated inflow in the loss
    outlet_weight: Weight = 1.0  # weight of the misfit of the stated pressure at outlets in the loss
    device: Device = "cpu"  # device that trains the network
    threads: Threads = 1  # threads of the processor that train it
    seed: Seed = 0  # seed of the initial weights

    def fit(self, problem: RefinementProblem) -> FlowField:
        """The network's values at pixel centres; of the assumed field only stamp and labels are used.

        Raises
        ------
        FlowError
            If the device is not available, or the viscosity depends on the shear rate.
        NotFiniteError
            If the fit diverges.
        """
        assumed, operator, chip = problem.assumed, problem.operator, problem.chip
        if chip.law is not None:
            raise FlowError(
                "the PINN knows constant viscosities only: use refine.method pi_unet or assimilate, or set "
                "chip.viscosity.law = newtonian"
            )
        speed = operator.rms_um_s
        if speed == 0.0:
            return replace(assumed, method="pinn", note="start kept: all observations say that the fluid stands still")
        case = PinnCase.of(speed, operator, chip)
        with torch_run(self.device, self.threads, self.seed, "refine.pinn.device"):
            iterations, values, residual = self._fit_network(case)
        if not np.isfinite(values).all():
            raise NotFiniteError("the PINN diverged: lower refine.pinn.learning_rate")
        velocity, pressure = np.zeros((*chip.mask.shape, 2), np.float32), np.zeros(chip.mask.shape, np.float32)
        velocity[chip.mask], pressure[chip.mask] = values[:, :2] * speed, values[:, 2] * case.unit_pressure
        return replace(
            assumed,
            method="pinn",
            velocity_um_s=velocity,
            pressure_pa=pressure,
            std_um_s=None,
            boundary_values=chip.boundary_values,
            viscosity_mpa_s=chip.viscosity_mpa_s,
            density_kg_m3=chip.density_kg_m3,
            note=f"fitted to equations, openings and {operator.count} observations in {iterations} iterations; "
            f"{residual:.0%} of the observed speed left",
        )

    def _fit_network(self, case: PinnCase) -> tuple[int, Floats, float]:
        """Number of iterations, dimensionless (vx, vy, p) (fluid pixels, 3), and residual of the observations."""
        import torch

        from flowrec.stages.refine.network import CoordinateNet

        rng = np.random.default_rng(self.seed)
        net = CoordinateNet(self.width, self.depth, self.features, self.wavenumber).to(self.device)
        loss_of = _Loss(case, self, net)
        descend = adam(net.parameters(), self.learning_rate, self.iterations, WARM_UP, LOWEST_RATE)
        lowest, since, done, block = float("inf"), 0, 0, 0.0
        for _ in range(self.iterations):
            loss = loss_of(*case.points.draw(rng, self.points))
            descend(loss)
            block, done = block + float(loss.detach()), done + 1
            if done % BLOCK == 0:
                lowest, since = (block, 0) if block < 0.99 * lowest else (lowest, since + BLOCK)
                block = 0.0
                if since >= self.patience:
                    break
        with torch.no_grad():
            return done, loss_of.pixels(), loss_of.residual_speed()


class _Loss:
    """Residuals of equations, conditions and observations; holds the tensors of one case on the device."""

    def __init__(self, case: PinnCase, settings: Pinn, net: CoordinateNet) -> None:
        self.case, self.settings, self.net = case, settings, net
        self.flow, self.inlet, self.outlet = (self._tensor(a) for a in (case.flow, case.inlet, case.outlet))
        self.scale = self._tensor(np.array([1.0, 1.0, case.largest_pressure]))
        self.seen, self.inlets, self.outlets = (
            self._place(points) for points in (case.seen, case.points.inlets, case.points.outlets)
        )

    def __call__(self, inside: Floats, walls: Floats) -> Tensor:
        """Weighted sum of mean squares at drawn points (n, 2), (m, 2) in px."""
        import torch

        case, settings = self.case, self.settings
        v, by_x, by_y, laplacian = self.net.jet(self._place(inside)) * self.scale
        loss: Tensor = settings.continuity_weight * (by_x[:, 0] + by_y[:, 1]).square().mean()
        for axis, slope in enumerate((by_x, by_y)):
            convection = v[:, 0] * by_x[:, axis] + v[:, 1] * by_y[:, axis]
            momentum = case.reynolds * convection + slope[:, 2] - laplacian[:, axis] + case.friction * v[:, axis]
            loss = loss + settings.momentum_weight * (momentum / POISEUILLE).square().mean()
        # One call for all points where only the value counts.
        places = [self._place(walls), self.seen, self.inlets, self.outlets]
        wall, seen, inlet, outlet = torch.split(self._values(torch.cat(places)), [len(place) for place in places])
        for weight, residual in (
            (settings.wall_weight, wall[:, :2]),
            (settings.observation_weight, seen[:, :2] - self.flow),
            (settings.inlet_weight, inlet[:, :2] - self.inlet),
            (settings.outlet_weight, (outlet[:, 2:] - self.outlet[:, None]) / case.largest_pressure),
        ):
            if len(residual):
                loss = loss + weight * residual.square().sum(dim=1).mean()
        return loss

    def pixels(self) -> Floats:
        """(fluid pixels, 3) dimensionless vx, vy, p at the centre of each pixel."""
        return np.asarray(self._values(self._place(self.case.points.fluid)).cpu().numpy(), np.float64)

    def residual_speed(self) -> float:
        """Root mean square residual of the observations, in units of their speed."""
        residual = self._values(self.seen)[:, :2] - self.flow
        return float(residual.square().sum(dim=1).mean().sqrt())

    def _values(self, places: Tensor) -> Tensor:
        values: Tensor = self.net(places) * self.scale
        return values

    def _place(self, points: Floats) -> Tensor:
        """Coordinates of the network of points in px."""
        return self._tensor((points - self.case.centre) / self.case.length_px)

    def _tensor(self, array: Floats) -> Tensor:
        import torch

        return torch.as_tensor(array, dtype=torch.float32, device=self.settings.device)
