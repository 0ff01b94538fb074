"""N/I, a baseline of the paper: PI-UNet without an initial prediction, relying on the observations alone.

Same network, same discrete equations, same likelihood of the observations. What is missing: the network sees
[mask, observed vx, observed vy, 0] instead of a solver's field, its output is the field and not a correction, and
pixels near a wall carry no predicted value: only the solid is at rest. Boundary values are not given either, so where
nothing was observed only the equations speak, and those are fulfilled by fluid at rest.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray

from flowrec.chip.chip import Chip
from flowrec.chip.clearance import median_width_um
from flowrec.messages import FlowField
from flowrec.ranges import Range, Seed, Threads, Weight
from flowrec.refine.case import MULTIPLE
from flowrec.refine.crop import Crop
from flowrec.refine.data_misfit import RELATIVE_NOISE, TAIL
from flowrec.refine.observation_operator import Floats, Sight
from flowrec.refine.torch_run import Device, torch_run
from flowrec.units import M_PER_UM, PA_S_PER_MPA_S

if TYPE_CHECKING:
    from torch import Tensor


@dataclass(frozen=True, slots=True)
class Ni:
    """Settings of N/I."""

    observations: Literal["soft", "hard"] = "soft"  # hard: as printed, the pixel takes the measured value
    iterations: Annotated[int, Range(1, 1_000_000)] = 150
    # iterations times pixels in millions: larger fields get fewer iterations
    largest_work_mpx: Annotated[float, Range(1e-3, 1e6)] = 6.0
    patience: Annotated[int, Range(1, 1_000_000)] = 30  # iterations without a better loss before it stops
    learning_rate: Annotated[float, Range(1e-8, 1.0)] = 3e-3
    observation_weight: Weight = 0.1  # of the mean log-likelihood against the mean squared residual
    base_channels: Annotated[int, Range(1, 512)] = 16
    device: Device = "cpu"
    threads: Threads = 1
    seed: Seed = 0

    def fit(self, assumed: FlowField, sight: Sight, chip: Chip) -> FlowField:
        """A field from observations and equations alone; of `assumed` only stamp and labels are used.

        Raises
        ------
        FlowError
            If the device is not there.
        """
        speed = float(np.sqrt((sight.flow_um_s**2).sum(axis=1).mean()))
        if speed == 0.0:
            return replace(assumed, method="ni", note="start kept: all observations say that the fluid stands still")
        with torch_run(self.device, self.threads, self.seed, "refine.ni.device"):
            steps, velocity, pressure, misfits = self._descend(_Scale.of(speed, chip), sight, chip)
        return replace(
            assumed,
            method="ni",
            velocity_um_s=velocity.astype(np.float32),
            pressure_pa=pressure.astype(np.float32),
            std_um_s=None,
            viscosity_mpa_s=chip.viscosity_mpa_s,
            density_kg_m3=chip.density_kg_m3,
            note=f"no initial prediction: {steps} iterations from {sight.count} observations; "
            f"their misfit (chi2) {misfits[0]:.2f} to {misfits[1]:.2f}",
        )

    def _descend(self, scale: _Scale, sight: Sight, chip: Chip) -> tuple[int, Floats, Floats, tuple[float, float]]:
        """Iterations done, velocity (h, w, 2) in um/s, pressure (h, w) in Pa, misfit before and after."""
        import torch

        from flowrec.refine.network import UNet
        from flowrec.refine.network_fit import lowest_of

        crop = Crop.around(chip.mask, MULTIPLE)
        loss_of = _Loss(scale, crop, sight, chip, self)
        steps = max(1, min(self.iterations, int(self.largest_work_mpx * 1e6 / loss_of.fluid.numel())))
        # Channels last: a fifth faster on a CPU.
        net = UNet(self.base_channels).to(self.device, memory_format=torch.channels_last)  # type: ignore[call-overload]
        seen = loss_of.seen.contiguous(memory_format=torch.channels_last)
        misfits: list[float] = []

        def noted(output: Tensor) -> tuple[Tensor, Tensor]:
            loss, misfit, field = loss_of(output)
            misfits.append(float(misfit.detach()) / 2.0)
            return loss, field

        done, kept, lowest = lowest_of(net, seen, noted, steps, self.learning_rate, self.patience)
        best = loss_of.seen[:, 1:] if lowest is None else lowest
        image = crop.whole(best.cpu().numpy()[0].astype(np.float64))
        return done, image[..., :2] * scale.speed, image[..., 2] * scale.pressure_pa, (misfits[0], misfits[kept])


@dataclass(frozen=True, slots=True)
class _Scale:
    """Units of the network: pixel, root mean square of the observed speed, mu V / px."""

    speed: float  # V, um/s
    pressure_pa: float  # mu V / px
    largest_pressure: float  # in that unit: the drop of a channel that crosses the image
    reynolds: float
    friction: float

    @classmethod
    def of(cls, speed: float, chip: Chip) -> _Scale:
        """Scales of a chip in which the robot felt this speed."""
        px_m, mu = chip.um_per_px * M_PER_UM, chip.viscosity_mpa_s * PA_S_PER_MPA_S
        width_px = median_width_um(chip) / chip.um_per_px
        return cls(
            speed,
            mu * speed * M_PER_UM / px_m,
            12.0 * max(chip.mask.shape) / width_px**2,
            chip.density_kg_m3 * speed * M_PER_UM * px_m / mu,
            0.0 if chip.depth_um is None else 12.0 * (chip.um_per_px / chip.depth_um) ** 2,
        )


class _Loss:
    """From the network's output to a field and its loss; all tensors of a case on the device."""

    def __init__(self, scale: _Scale, crop: Crop, sight: Sight, chip: Chip, settings: Ni) -> None:
        import torch

        from flowrec.refine.residuals import Physics

        def tensor(array: NDArray[Any]) -> Tensor:
            return torch.from_numpy(np.array(array, np.float32)).to(settings.device)

        self.settings = settings
        self.fluid = tensor(crop.part(chip.mask))[None, None]
        inside = np.zeros(chip.mask.shape, bool)
        inside[1:-1, 1:-1] = True
        self.physics = Physics.of(self.fluid, tensor(crop.part(inside))[None, None], scale.reynolds, scale.friction)
        self.scale = tensor(np.array([1.0, 1.0, scale.largest_pressure]))[None, :, None, None]
        flow = sight.flow_um_s / scale.speed
        size = np.linalg.norm(flow, axis=1)
        self.flow = tensor(flow)
        self.noise = tensor(np.hypot(sight.std_um_s / scale.speed, RELATIVE_NOISE * np.maximum(size, 0.1)))[:, None]
        rows, columns = sight.rows - crop.corner[0], sight.columns - crop.corner[1]
        # Beyond the box of the fluid there is none to see: a weight there falls on a solid pixel as well as on none.
        shape = self.fluid.shape[-2:]
        self.rows, self.columns = (
            torch.from_numpy(np.clip(index, 0, length - 1).astype(np.int64)).to(settings.device)
            for index, length in zip((rows, columns), shape, strict=True)
        )
        self.weights = tensor(sight.weights)
        nearest = sight.weights.argmax(axis=1)[:, None]
        row, column = (np.take_along_axis(at, nearest, axis=1)[:, 0] for at in (rows, columns))
        pinned, given = np.zeros(shape), np.zeros((2, *shape))
        pinned[row, column], given[:, row, column] = 1.0, flow.T
        self.pinned, self.given = tensor(pinned)[None, None], tensor(given)[None]
        self.seen = torch.cat([self.fluid, self.given, torch.zeros_like(self.fluid)], dim=1)

    def __call__(self, output: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Loss, misfit of the observations in variances, and the field (1, 3, h, w) for the network's output."""
        import torch

        field = output * self.scale * self.fluid
        velocity, pressure = field[:, :2], field[:, 2:]
        if self.settings.observations == "hard":
            velocity = velocity * (1.0 - self.pinned) + self.given * self.pinned
        residual = self.physics.residuals(velocity, pressure)
        loss = (residual**2).sum() / self.physics.where.sum().clamp(min=1.0)
        seen = velocity[0][:, self.rows, self.columns]  # (2, n, 4)
        misfit = ((((seen * self.weights).sum(dim=-1).T - self.flow) / self.noise) ** 2).sum(dim=1)
        likelihood = 0.5 * (TAIL + 2.0) * torch.log1p(misfit / TAIL).mean()
        total = loss + 2.0 * self.settings.observation_weight * likelihood
        return total, misfit.mean(), torch.cat([velocity, pressure], dim=1)
