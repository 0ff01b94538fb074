"""U-Net, a baseline of the paper: data-driven, without physics. Trained on other vessels, applied once.

The network and its inputs are those of the trained PI-UNet, including the observations and their continuation along
the channels, but it was trained on true fields alone and no equation enters. `python -m flowrec.bench.training DIR
FILE --network unet` makes the shipped weights. Without observations as input there is nothing to learn: wrong boundary
values have no sign that other vessels could show, and a network trained so keeps the error of the assumed field, 0.21.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from flowrec.core import FlowField, Threads
from flowrec.stages.refine.case import Case
from flowrec.stages.refine.method import RefinementProblem
from flowrec.stages.refine.network_fit import Device, torch_run
from flowrec.stages.refine.weights import SHIPPED, read_weights, sha256


@dataclass(frozen=True, slots=True)
class Unet:
    """Settings of the data-driven U-Net."""

    weights: str = ""  # path of a .safetensors file; '' for those that are shipped
    device: Device = "cpu"  # device that applies the network
    threads: Threads = 1  # threads of the processor that apply it

    @property
    def path(self) -> Path:
        """File of the weights."""
        return Path(self.weights) if self.weights else SHIPPED["unet"]

    @property
    def weights_sha256(self) -> str:
        """Hash of the weights, '' where there are none."""
        return sha256(self.path)

    def fit(self, problem: RefinementProblem) -> FlowField:
        """The corrected field.

        Raises
        ------
        FlowError
            If the weights are missing or damaged, or the device is not available.
        """
        initial, operator = problem.assumed, problem.operator
        if not initial.velocity_um_s.any():
            return replace(initial, method="unet", note="start kept: the initial field stands still")
        case = Case.of(initial, operator, problem.chip)
        with torch_run(self.device, self.threads, 0, "refine.unet.device"):
            import torch

            from flowrec.stages.refine.network import trained_network
            from flowrec.stages.refine.network_inputs import NetworkInputs

            network = trained_network()
            read_weights(self.path, network)
            network.to(self.device).eval()
            inputs = NetworkInputs.of([case], self.device)
            with torch.no_grad():
                fields = inputs.correct(network(inputs.with_observations()))
            image = np.moveaxis(torch.cat(fields, dim=1)[0].cpu().numpy().astype(np.float64), 0, -1)
        velocity, pressure = case.dimensional(image[..., :2], image[..., 2])
        return replace(
            initial,
            method="unet",
            velocity_um_s=velocity.astype(np.float32),
            pressure_pa=pressure.astype(np.float32),
            std_um_s=None,
            note=f"weights {self.weights_sha256[:8]}, from other vessels; {operator.count} observations",
        )
