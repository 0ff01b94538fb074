"""U-Net, a baseline of the paper: data-driven, no physics. Trained on other vessels, applied once.

The network of the PI-UNet sees what that is said to see, [mask, vx, vy, p] of the initial field, and gives a
correction to it. No equation and no observation enters: it knows how assumed flows were wrong in other vessels, on
average, and nothing of how this one is. Where those errors have no sign in common there is nothing to learn: on the
lessons of `flowrec bench train --network unet --count 1800 --steps 1000`, which makes the shipped weights, its error
is that of the assumed field, 0.207.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from flowrec.chip.chip import Chip
from flowrec.errors import FlowError
from flowrec.messages import FlowField
from flowrec.refine.case import Case
from flowrec.refine.sight import Floats, Sight
from flowrec.refine.torch_run import Device, torch_run
from flowrec.refine.weights import SHIPPED, read_weights, sha256

SHIPPED_SHA256 = "15fe83d95346a7c436f910ecdf1b6d722a28f88dade8d0aa01e3106b2c952c32"


@dataclass(frozen=True, slots=True)
class Unet:
    """Settings of the data-driven U-Net."""

    weights: str = ""  # path of a .safetensors file; '' for those that are shipped
    device: Device = "cpu"
    threads: int = 1

    def fit(self, initial: FlowField, sight: Sight, chip: Chip) -> FlowField:
        """The corrected field. Observations are counted in the note, for a reader who expects them to matter.

        Raises
        ------
        FlowError
            If the weights are missing, damaged or not those that are shipped, or the device is not there.
        """
        if not initial.velocity_um_s.any():
            return replace(initial, method="unet", note="start kept: the initial field stands still")
        velocity, pressure, code = self._correct(Case.of(initial, sight, chip))
        return replace(
            initial,
            method="unet",
            velocity_um_s=velocity.astype(np.float32),
            pressure_pa=pressure.astype(np.float32),
            std_um_s=None,
            note=f"weights {code[:8]}, from other vessels; {sight.count} observations not used",
        )

    def _correct(self, case: Case) -> tuple[Floats, Floats, str]:
        """Velocity (h, w, 2) in um/s, pressure (h, w) in Pa, hash of the weights."""
        path = Path(self.weights) if self.weights else SHIPPED["unet"]
        code = sha256(path)
        if not self.weights and code and code != SHIPPED_SHA256:
            raise FlowError(f"{path}: not the weights that are shipped with this version; install flowrec anew")
        with torch_run(self.device, self.threads, 0, "refine.unet.device"):
            import torch

            from flowrec.refine.network import trained_network
            from flowrec.refine.scene import Scene

            network = trained_network("unet")
            read_weights(path, network)
            network.to(self.device).eval()
            scene = Scene.of([case], device=self.device)
            with torch.no_grad():
                fields = scene.correct(network(scene.printed()), near_wall="free")
            image = case.whole(torch.cat(fields, dim=1)[0].cpu().numpy().astype(np.float64))
        return image[..., :2] * case.speed, image[..., 2] * case.unit_pressure, code
