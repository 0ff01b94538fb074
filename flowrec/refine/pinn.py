"""PINN, a baseline of the paper: velocity and pressure as a network of continuous coordinates (Raissi et al., 2019).

A fully connected tanh network is fitted to one case. Its loss is the mean square of the residuals of continuity and
momentum at random points of the fluid, of the velocity on the walls, of what differs from the assumed profiles of the
inlets and pressures of the outlets, and of what differs from the observations. Without dimensions (length L: the
median channel width, velocity V: root mean square of what was observed, pressure mu V / L) the equations are

    div v = 0,   Re (v . grad) v + grad p - lap v + f v = 0,   Re = rho V L / mu,   f = 12 L^2 / H^2,

and momentum is divided by 12, the pressure gradient of Poiseuille flow of mean V in a channel of width L.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Annotated

import numpy as np

from flowrec.chip.chip import Chip
from flowrec.chip.clearance import median_width_um
from flowrec.errors import FlowError
from flowrec.messages import FlowField
from flowrec.ranges import Range, Seed, Threads, Weight
from flowrec.refine.collocation import Collocation
from flowrec.refine.observation_operator import Floats, Sight
from flowrec.refine.torch_run import Device, torch_run
from flowrec.units import M_PER_UM, PA_S_PER_MPA_S

if TYPE_CHECKING:
    from torch import Tensor

    from flowrec.refine.coordinate_net import CoordinateNet

POISEUILLE = 12.0  # dp/dx of Poiseuille flow in units of mu V / L^2
BLOCK = 100  # iterations over which the noisy loss is averaged before it is judged


@dataclass(frozen=True, slots=True)
class Pinn:
    """Settings of the PINN."""

    iterations: Annotated[int, Range(1, 1_000_000)] = 1000
    # iterations without a loss that is lower by a hundredth before it stops
    patience: Annotated[int, Range(1, 1_000_000)] = 300
    # of the fluid, drawn anew for every iteration; half as many of the walls
    points: Annotated[int, Range(16, 1_000_000)] = 512
    width: Annotated[int, Range(1, 4_096)] = 64
    depth: Annotated[int, Range(1, 64)] = 4
    features: Annotated[int, Range(1, 4_096)] = 64  # sines and cosines of the coordinates that the first layer sees
    # of those, radians per median channel width, one standard deviation
    wavenumber: Annotated[float, Range(1e-3, 1e3)] = 0.5
    learning_rate: Annotated[float, Range(1e-8, 1.0)] = 3e-3
    momentum_weight: Weight = 0.1  # weights are those of mean squares
    continuity_weight: Weight = 30.0  # a leak is worse than a wrong force: it breaks the share of every branch beyond
    observation_weight: Weight = 10.0
    wall_weight: Weight = 10.0
    inlet_weight: Weight = 1.0
    outlet_weight: Weight = 1.0
    device: Device = "cpu"
    threads: Threads = 1
    seed: Seed = 0

    def fit(self, assumed: FlowField, sight: Sight, chip: Chip) -> FlowField:
        """The network's mean over each pixel; of `assumed` only stamp and labels are used.

        Raises
        ------
        FlowError
            If the device is not there, or the fit diverges.
        """
        speed = float(np.sqrt((sight.flow_um_s**2).sum(axis=1).mean()))
        if speed == 0.0:
            return replace(assumed, method="pinn", note="start kept: all observations say that the fluid stands still")
        case = _Case.of(speed, sight, chip)
        with torch_run(self.device, self.threads, self.seed, "refine.pinn.device"):
            steps, values, left = self._descend(case)
        if not np.isfinite(values).all():
            raise FlowError("the PINN diverged: lower refine.pinn.learning_rate")
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
            note=f"fitted to equations, openings and {sight.count} observations in {steps} iterations; "
            f"{left:.0%} of the observed speed left",
        )

    def _descend(self, case: _Case) -> tuple[int, Floats, float]:
        """Iterations done, dimensionless (vx, vy, p) (fluid pixels, 3), what is left of the observations."""
        import torch

        from flowrec.refine.coordinate_net import CoordinateNet

        rng = np.random.default_rng(self.seed)
        net = CoordinateNet(self.width, self.depth, self.features, self.wavenumber).to(self.device)
        loss_of = _Loss(case, self)
        optimiser = torch.optim.Adam(net.parameters(), lr=self.learning_rate)
        # A short start, then half a cosine down to a fiftieth.
        schedule = torch.optim.lr_scheduler.LambdaLR(
            optimiser,
            lambda i: min(1.0, (i + 1) / 50) * max(0.02, 0.5 + 0.5 * math.cos(math.pi * i / self.iterations)),
        )
        lowest, since, done, block = float("inf"), 0, 0, 0.0
        for _ in range(self.iterations):
            loss = loss_of(net, *case.points.draw(rng, self.points))
            optimiser.zero_grad()
            loss.backward()  # type: ignore[no-untyped-call]
            optimiser.step()
            schedule.step()
            block, done = block + float(loss.detach()), done + 1
            if done % BLOCK == 0:
                lowest, since = (block, 0) if block < 0.99 * lowest else (lowest, since + BLOCK)
                block = 0.0
                if since >= self.patience:
                    break
        with torch.no_grad():
            pixels = sum(loss_of.of(net, points) for points in case.points.subpixels) / len(case.points.subpixels)
            return done, pixels.cpu().numpy().astype(np.float64), loss_of.misfit(net)  # type: ignore[union-attr]


@dataclass(frozen=True, slots=True, eq=False)
class _Case:
    """One case without dimensions."""

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
    def of(cls, speed: float, sight: Sight, chip: Chip) -> _Case:
        """Scale a chip in which the robot felt this speed (um/s)."""
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
            np.stack([(at * sight.weights).sum(axis=1) for at in (sight.columns, sight.rows)], axis=1),
            sight.flow_um_s / speed,
            points.inlet_um_s / speed,
            points.outlet_pa / unit_pressure,
        )


class _Loss:
    """What a network leaves of equations, conditions and observations; tensors of a case on the device."""

    def __init__(self, case: _Case, settings: Pinn) -> None:
        self.case, self.settings = case, settings
        self.flow, self.inlet, self.outlet = (self._tensor(a) for a in (case.flow, case.inlet, case.outlet))
        self.scale = self._tensor(np.array([1.0, 1.0, case.largest_pressure]))
        self.seen, self.inlets, self.outlets = (
            self._place(points) for points in (case.seen, case.points.inlets, case.points.outlets)
        )

    def __call__(self, net: CoordinateNet, inside: Floats, walls: Floats) -> Tensor:
        """Weighted sum of mean squares at drawn points (n, 2), (m, 2) in px."""
        import torch

        case, settings = self.case, self.settings
        v, by_x, by_y, laplacian = net.jet(self._place(inside)) * self.scale
        loss: Tensor = settings.continuity_weight * (by_x[:, 0] + by_y[:, 1]).square().mean()
        for axis, slope in enumerate((by_x, by_y)):
            carried = v[:, 0] * by_x[:, axis] + v[:, 1] * by_y[:, axis]
            momentum = case.reynolds * carried + slope[:, 2] - laplacian[:, axis] + case.friction * v[:, axis]
            loss = loss + settings.momentum_weight * (momentum / POISEUILLE).square().mean()
        # One call for all points where the value alone counts.
        places = [self._place(walls), self.seen, self.inlets, self.outlets]
        wall, seen, inlet, outlet = (net(torch.cat(places)) * self.scale).split([len(place) for place in places])
        for weight, left in (
            (settings.wall_weight, wall[:, :2]),
            (settings.observation_weight, seen[:, :2] - self.flow),
            (settings.inlet_weight, inlet[:, :2] - self.inlet),
            (settings.outlet_weight, (outlet[:, 2:] - self.outlet[:, None]) / case.largest_pressure),
        ):
            if len(left):
                loss = loss + weight * left.square().sum(dim=1).mean()
        return loss

    def of(self, net: CoordinateNet, points: Floats) -> Tensor:
        """(n, 3) dimensionless vx, vy, p at points (n, 2) in px."""
        values: Tensor = net(self._place(points)) * self.scale
        return values

    def misfit(self, net: CoordinateNet) -> float:
        """Root mean square of what is left of the observations, in units of theirs."""
        import torch

        with torch.no_grad():
            left = (net(self.seen) * self.scale)[:, :2] - self.flow
            return float(left.square().sum(dim=1).mean().sqrt())

    def _place(self, points: Floats) -> Tensor:
        """Coordinates of the network of points in px."""
        return self._tensor((points - self.case.centre) / self.case.length_px)

    def _tensor(self, array: Floats) -> Tensor:
        import torch

        return torch.as_tensor(array, dtype=torch.float32, device=self.settings.device)
