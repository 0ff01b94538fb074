"""U-Net, a baseline of the paper: data-driven, no physics. Trained on other vessels, applied once.

The network and inputs are those of the trained PI-UNet, observations and their spread along the channels included. It
learns from true fields only, no equation enters; `python -m flowrec.refine.training DIR FILE --network unet` makes the
shipped weights. Without observations there is nothing to learn: the sign of an error of the boundary values can not be
known from other vessels, and a network trained so keeps the error of the assumed field, 0.21.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from flowrec.chip.chip import Chip
from flowrec.messages import FlowField
from flowrec.ranges import Threads
from flowrec.refine.case import Case
from flowrec.refine.observation_operator import Floats, Sight
from flowrec.refine.torch_run import Device, torch_run
from flowrec.refine.weights import SHIPPED, read_weights, sha256


@dataclass(frozen=True, slots=True)
class Unet:
    """Settings of the data-driven U-Net."""

    weights: str = ""  # path of a .safetensors file; '' for those that are shipped
    device: Device = "cpu"
    threads: Threads = 1

    @property
    def path(self) -> Path:
        """Of the weights."""
        return Path(self.weights) if self.weights else SHIPPED["unet"]

    @property
    def weights_sha256(self) -> str:
        """Hash of the weights, '' where there are none."""
        return sha256(self.path)

    def fit(self, initial: FlowField, sight: Sight, chip: Chip) -> FlowField:
        """The corrected field.

        Raises
        ------
        FlowError
            If the weights are missing or damaged, or the device is not there.
        """
        if not initial.velocity_um_s.any():
            return replace(initial, method="unet", note="start kept: the initial field stands still")
        velocity, pressure = self._correct(Case.of(initial, sight, chip))
        return replace(
            initial,
            method="unet",
            velocity_um_s=velocity.astype(np.float32),
            pressure_pa=pressure.astype(np.float32),
            std_um_s=None,
            note=f"weights {self.weights_sha256[:8]}, from other vessels; {sight.count} observations",
        )

    def _correct(self, case: Case) -> tuple[Floats, Floats]:
        """Velocity (h, w, 2) in um/s, pressure (h, w) in Pa."""
        with torch_run(self.device, self.threads, 0, "refine.unet.device"):
            import torch

            from flowrec.refine.network import trained_network
            from flowrec.refine.network_inputs import Scene

            network = trained_network()
            read_weights(self.path, network)
            network.to(self.device).eval()
            scene = Scene.of([case], device=self.device)
            with torch.no_grad():
                fields = scene.correct(network(scene.told()))
            image = case.whole(torch.cat(fields, dim=1)[0].cpu().numpy().astype(np.float64))
        return image[..., :2] * case.speed, image[..., 2] * case.unit_pressure
