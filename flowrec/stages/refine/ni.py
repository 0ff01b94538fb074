"""N/I, a baseline of the paper: PI-UNet without an initial prediction, from the observations alone.

Network, discrete equations and likelihood of the observations are the same. The differences: the input is [mask,
observed vx, observed vy, 0] instead of a solver's field, the output is the field and not a correction, and pixels at
walls have no predicted value: only the solid is at rest. Boundary values are not given either. Where nothing was
observed only the equations count, and fluid at rest satisfies them.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Annotated

import numpy as np

from flowrec.core import FlowField, Range, Weight
from flowrec.physics import median_width_um
from flowrec.stages.refine.case import Case
from flowrec.stages.refine.method import RefinementProblem
from flowrec.stages.refine.network_fit import FieldLoss, Iterations, NetworkSettings, fit_network, torch_run
from flowrec.stages.refine.observation_operator import RELATIVE_NOISE

if TYPE_CHECKING:
    from torch import Tensor


@dataclass(frozen=True, slots=True)
class Ni(NetworkSettings):
    """Settings of N/I."""

    iterations: Iterations = 150  # iterations of the training
    largest_work_mpx: Annotated[float, Range(1e-3, 1e6)] = 6.0
    patience: Iterations = 30
    observation_weight: Weight = 0.1

    def fit(self, problem: RefinementProblem) -> FlowField:
        """A field from observations and equations; of the assumed field only stamp and labels are used.

        Raises
        ------
        FlowError
            If the device is not available.
        """
        assumed, operator, chip = problem.assumed, problem.operator, problem.chip
        speed = operator.rms_um_s
        if speed == 0.0:
            return replace(assumed, method="ni", note="start kept: all observations say that the fluid stands still")
        at_rest = replace(
            assumed,
            method="ni",
            velocity_um_s=np.zeros_like(assumed.velocity_um_s),
            pressure_pa=np.zeros_like(assumed.pressure_pa),
            std_um_s=None,
            viscosity_mpa_s=chip.viscosity_mpa_s,
            density_kg_m3=chip.density_kg_m3,
        )
        case = Case.of(at_rest, operator, chip, speed=speed)
        noise = RELATIVE_NOISE * np.maximum(np.linalg.norm(case.flow, axis=1), 0.1)
        case = replace(case, noise=np.hypot(operator.std_um_s / speed, noise))
        # The pressure drop of a channel across the image, in units of mu V / px.
        largest_pressure = 12.0 * max(chip.mask.shape) / (median_width_um(chip) / chip.um_per_px) ** 2
        with torch_run(self.device, self.threads, self.seed, "refine.ni.device"):
            import torch

            from flowrec.stages.refine.network import UNet
            from flowrec.stages.refine.network_inputs import NetworkInputs

            inputs = NetworkInputs.of([case], self.device)

            def correct(output: Tensor) -> tuple[Tensor, Tensor]:
                velocity, pressure = output[:, :2] * inputs.fluid, output[:, 2:] * largest_pressure * inputs.fluid
                return velocity, pressure

            loss_of = FieldLoss(inputs, case, self, correct)
            start = torch.cat([loss_of.measured, torch.zeros_like(inputs.fluid)], dim=1)
            image = torch.cat([inputs.fluid, start], dim=1)
            fitted = fit_network(UNet(self.base_channels), image, loss_of, self.iterations, self.learning_rate, start)
        velocity, pressure = case.dimensional(fitted.velocity, fitted.pressure)
        return replace(
            at_rest,
            velocity_um_s=velocity.astype(np.float32),
            pressure_pa=pressure.astype(np.float32),
            note=f"no initial prediction: {fitted.iterations} iterations from {operator.count} observations; "
            f"their misfit (chi2) {fitted.first_misfit:.2f} to {fitted.misfit:.2f}",
        )
