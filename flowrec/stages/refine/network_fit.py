"""Fit of a U-Net to one case: physics and observations as its loss, Adam, and a reproducible run of torch.

The loss is the mean squared residual of the field minus that of the initial field, and the negative log-likelihood of
the observations under Student-t noise. torch is imported when a function runs.
"""

from __future__ import annotations

import contextlib
import math
import os
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray

from flowrec.core import Floats, FlowError, Range, Seed, Threads, Weight
from flowrec.stages.refine.case import Case
from flowrec.stages.refine.observation_operator import TAIL

if TYPE_CHECKING:
    from torch import Tensor, nn

    from flowrec.stages.refine.network_inputs import NetworkInputs

# On an H100, vessels of 128 x 128 pixels: each method gives the same bytes twice, in 40 to 130 MB. ni and the printed
# pi_unet take 0.3 to 0.4 of the time of one CPU core; pi_unet as shipped 0.9 to 1.0 (it is balanced on the CPU), unet
# 0.1 s on either, pinn 1.2 times it. Fields of two devices differ, by 1e-5 (unet) to a tenth (ni): verify on the same.
Device = Literal["cpu", "cuda"]
Iterations = Annotated[int, Range(1, 1_000_000)]


@contextlib.contextmanager
def torch_run(device: Device, threads: int, seed: int, setting: str) -> Iterator[None]:
    """Seeded, deterministic run of torch that restores torch's global state; `setting` names the device's setting.

    Raises
    ------
    FlowError
        If the device is not available.
    """
    import torch

    if device == "cuda":
        if not torch.cuda.is_available():
            raise FlowError(f"{setting} = 'cuda', but torch sees no GPU: set it to 'cpu'")
        # Without it cuBLAS refuses to be deterministic; cuBLAS reads it when it starts.
        os.environ.setdefault("CUBLAS_WORKSPACE_CONFIG", ":4096:8")
    before, strict = torch.get_num_threads(), torch.are_deterministic_algorithms_enabled()
    torch.set_num_threads(threads)
    try:
        with torch.random.fork_rng():
            torch.manual_seed(seed)
            torch.use_deterministic_algorithms(True)
            yield
    finally:
        torch.use_deterministic_algorithms(strict)
        torch.set_num_threads(before)


def adam(
    parameters: Iterator[nn.Parameter], rate: float, steps: int, warm_up: float, lowest: float = 0.0
) -> Callable[[Tensor], None]:
    """A step down a loss by Adam, whose rate rises over `warm_up` steps and falls as half a cosine to `lowest`."""
    import torch

    optimiser = torch.optim.Adam(parameters, lr=rate)
    schedule = torch.optim.lr_scheduler.LambdaLR(
        optimiser,
        lambda i: min(1.0, (i + 1) / warm_up) * max(lowest, 0.5 * (1.0 + math.cos(math.pi * i / max(steps, 1)))),
    )

    def step(loss: Tensor) -> None:
        optimiser.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        optimiser.step()
        schedule.step()

    return step


@dataclass(frozen=True, slots=True)
class NetworkSettings:
    """Settings of the fit of a U-Net to one case."""

    # how the loss takes observations: soft, by their likelihood; hard, as in the paper, the pixel takes the measured
    # value
    observations: Literal["soft", "hard"] = "soft"
    # iterations times pixels in millions: larger fields get fewer iterations
    largest_work_mpx: Annotated[float, Range(1e-3, 1e6)] = 4.0
    patience: Iterations = 25  # iterations without a better loss before it stops
    learning_rate: Annotated[float, Range(1e-8, 1.0)] = 3e-3  # learning rate of Adam
    observation_weight: Weight = 0.03  # weight of the mean log-likelihood against the mean squared residual
    # weights of the squared residuals of the equations in the sum that is minimised; 0 leaves one out, which a study of
    # the terms needs. The balance after the network is not changed by them.
    continuity_weight: Weight = 1.0
    momentum_weight: Weight = 1.0  # weight of the momentum equations in that sum
    base_channels: Annotated[int, Range(1, 512)] = 16  # channels of the first level of the network with random weights
    device: Device = "cpu"  # device that trains the network
    # More than one only on idle cores: torch's threads wait actively, and on two shared cores two are ten times slower.
    threads: Threads = 1
    seed: Seed = 0  # seed of the initial weights


class FieldLoss:
    """From a network's output to a constrained field and its loss; holds all tensors of one case on the device."""

    def __init__(
        self,
        inputs: NetworkInputs,
        case: Case,
        settings: NetworkSettings,
        correct: Callable[[Tensor], tuple[Tensor, Tensor]],
    ) -> None:
        """`correct` gives velocity (1, 2, h, w) and pressure (1, 1, h, w) for an output (1, 3 or 5, h, w)."""
        import torch

        from flowrec.stages.refine.residuals import Physics

        def tensor(array: NDArray[Any]) -> Tensor:
            return torch.from_numpy(np.array(array, np.float32)).to(settings.device)

        self.correct, self.settings = correct, settings
        self.physics = Physics.of(inputs.fluid, inputs.inside, case.reynolds, case.friction, case.viscosity)
        self.truncation = self.physics.residuals(inputs.velocity, inputs.pressure)
        # Residuals are relative to the square of the initial field, so that weights mean the same in any case.
        size = float((inputs.velocity**2).sum() / inputs.fluid.sum()) or 1.0
        self.norm = size * float(self.physics.where.sum().clamp(min=1.0))
        terms = (settings.continuity_weight, settings.momentum_weight, settings.momentum_weight)
        self.terms = tensor(np.array(terms))[None, :, None, None]
        self.pixels = torch.from_numpy(case.pixels.astype(np.int64)).to(settings.device)
        self.weights, self.flow, self.noise = tensor(case.weights), tensor(case.flow), tensor(case.noise)[:, None]
        self.observed = inputs.observed
        self.measured = tensor(np.moveaxis(case.at_nearest(case.flow), -1, 0))[None]

    def __call__(self, output: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Loss, mean squared misfit of the observations in variances, and the field (1, 3, h, w)."""
        import torch

        velocity, pressure = self.correct(output)
        if self.settings.observations == "hard":
            velocity = velocity * (1.0 - self.observed) + self.measured * self.observed
        residual = self.physics.residuals(velocity, pressure) - self.truncation
        loss = (self.terms * residual**2).sum() / self.norm
        predicted = (velocity[0].flatten(1)[:, self.pixels] * self.weights).sum(dim=-1).T
        misfit = (((predicted - self.flow) / self.noise) ** 2).sum(dim=1)
        likelihood = 0.5 * (TAIL + 2.0) * torch.log1p(misfit / TAIL).mean()
        total = loss + 2.0 * self.settings.observation_weight * likelihood
        return total, misfit.mean(), torch.cat([velocity, pressure], dim=1)


@dataclass(frozen=True, slots=True, eq=False)
class NetworkFit:
    """The field of the lowest loss, on the pixels of the case and in its units."""

    iterations: int
    velocity: Floats  # (h, w, 2)
    pressure: Floats  # (h, w)
    first_misfit: float  # chi squared per component of the observations in the first iteration
    misfit: float  # in the iteration of the lowest loss


def fit_network(
    net: nn.Module,
    image: Tensor,
    loss_of: FieldLoss,
    iterations: int,
    rate: float,
    start: Tensor | None = None,
) -> NetworkFit:
    """Minimise the loss over the parameters of a network for its input image (1, c, h, w). Runs within `torch_run`.

    Large images get fewer iterations. Without an iteration with a finite loss the field is `start` (1, 3, h, w), or
    that of the network as it is.
    """
    import torch

    settings = loss_of.settings
    steps = min(iterations, max(1, int(settings.largest_work_mpx * 1e6 / image[0, 0].numel())))
    # Channels last: a fifth faster on a CPU.
    net = net.to(settings.device, memory_format=torch.channels_last)  # type: ignore[call-overload]
    image = image.contiguous(memory_format=torch.channels_last)
    if start is None:
        with torch.no_grad():
            start = loss_of(net(image))[2]
    descend = adam(net.parameters(), rate, steps, 0.1 * steps + 1e-9)
    best, lowest, since = start, float("inf"), 0
    misfits: list[float] = []
    lowest_misfit = float("nan")
    for _ in range(steps):
        loss, misfit, field = loss_of(net(image))
        misfits.append(float(misfit.detach()) / 2.0)
        value, since = float(loss.detach()), since + 1
        if value < lowest:
            since = since if value > 0.995 * lowest else 0
            lowest, best, lowest_misfit = value, field.detach(), misfits[-1]
        if since > settings.patience:
            break
        descend(loss)
    image_of = np.moveaxis(best.cpu().numpy()[0].astype(np.float64), 0, -1)
    first = misfits[0] if misfits else float("nan")
    return NetworkFit(len(misfits), image_of[..., :2], image_of[..., 2], first, lowest_misfit)
