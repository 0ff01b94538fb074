"""The network's part of a PI-UNet: from random weights it descends on physics and observations, trained ones know more.

The loss is the mean squared residual of the field minus that of the initial field, and the likelihood of the
observations.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from flowrec.refine.case import Case
from flowrec.refine.data_misfit import TAIL
from flowrec.refine.network import UNet, trained_network
from flowrec.refine.network_inputs import Scene
from flowrec.refine.observation_operator import Floats
from flowrec.refine.residuals import Physics
from flowrec.refine.weights import SHIPPED, read_weights

if TYPE_CHECKING:
    from flowrec.refine.pi_unet import PiUnet

COLD_ITERATIONS = 80
TRAINED_RATE = 0.1  # of the learning rate of random weights


def descend(case: Case, used: NDArray[np.bool_], settings: PiUnet) -> tuple[int, Floats, Floats]:
    """Iterations done, velocity (h, w, 2) and pressure (h, w) of the lowest loss, on the pixels of the case.

    Within `torch_run`, which seeds the random weights.

    Raises
    ------
    FlowError
        If the weights can not be read.
    """
    trained = settings.weights == "vessels"
    wanted = (0 if trained else COLD_ITERATIONS) if settings.iterations is None else settings.iterations
    steps = min(wanted, max(1, int(settings.largest_work_mpx * 1e6 / case.pixels)))
    loss_of = _Loss(case, used, settings)
    net = trained_network() if trained else UNet(settings.base_channels)
    if trained:
        read_weights(SHIPPED["vessels"], net)
    # Channels last: a fifth faster on a CPU.
    net = net.to(settings.device, memory_format=torch.channels_last)  # type: ignore[call-overload]
    seen = loss_of.scene.told() if trained else loss_of.scene.printed()
    seen = seen.contiguous(memory_format=torch.channels_last)
    with torch.no_grad():
        best = loss_of(net(seen))[1] if trained else loss_of.start
    rate = settings.learning_rate * (TRAINED_RATE if trained else 1.0)
    done, _, lowest = lowest_of(net, seen, loss_of, steps, rate, settings.patience)
    best = best if lowest is None else lowest
    result = np.moveaxis(best.cpu().numpy()[0].astype(np.float64), 0, -1)
    return done, result[..., :2], result[..., 2]


def lowest_of(
    net: UNet,
    seen: Tensor,
    loss_of: Callable[[Tensor], tuple[Tensor, Tensor]],
    steps: int,
    rate: float,
    patience: int,
) -> tuple[int, int, Tensor | None]:
    """Iterations done, the one of the lowest loss from 0, and the field of that; None where no loss was finite.

    `loss_of` gives loss and field for the network's output; after `patience` iterations without a better loss it ends.
    """
    optimiser = torch.optim.Adam(net.parameters(), lr=rate)
    # A short start, then half a cosine down to zero.
    schedule = torch.optim.lr_scheduler.LambdaLR(
        optimiser,
        lambda i: min(1.0, (i + 1) / (0.1 * steps + 1e-9)) * 0.5 * (1.0 + math.cos(math.pi * i / max(steps, 1))),
    )
    best: Tensor | None = None
    lowest, since, done, kept = float("inf"), 0, 0, 0
    for _ in range(steps):
        loss, field = loss_of(net(seen))
        value, since, done = float(loss.detach()), since + 1, done + 1
        if value < lowest:
            since = since if value > 0.995 * lowest else 0
            lowest, best, kept = value, field.detach(), done - 1
        if since > patience:
            break
        optimiser.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        optimiser.step()
        schedule.step()
    return done, kept, best


class _Loss:
    """From the network's output to a constrained field and its loss; all tensors of a case on the device."""

    def __init__(self, case: Case, used: NDArray[np.bool_], settings: PiUnet) -> None:
        def tensor(array: NDArray[np.generic]) -> Tensor:
            return torch.from_numpy(np.array(array, np.float32)).to(settings.device)

        self.settings = settings
        self.scene = Scene.of([case], used, settings.device)
        self.start = torch.cat([self.scene.velocity, self.scene.pressure], dim=1)
        self.physics = Physics.of(self.scene.fluid, self.scene.inside, case.reynolds, case.friction)
        self.truncation = self.physics.residuals(self.scene.velocity, self.scene.pressure)
        # Residuals are shares of the field's own size, so that weights mean the same in any case.
        size = float((self.scene.velocity**2).sum() / self.scene.fluid.sum())
        self.norm = size * float(self.physics.where.sum().clamp(min=1.0))
        self.rows, self.columns = (
            torch.from_numpy(np.array(index[used], np.int64)).to(settings.device) for index in (case.rows, case.columns)
        )
        self.weights, self.flow = tensor(case.weights[used]), tensor(case.flow[used])
        self.noise = tensor(case.noise[used])[:, None]
        if settings.observations == "hard":
            nearest = case.weights[used].argmax(axis=1)[:, None]
            row, column = (np.take_along_axis(at[used], nearest, axis=1)[:, 0] for at in (case.rows, case.columns))
            pinned, given = np.zeros(case.fluid.shape), np.zeros((2, *case.fluid.shape))
            pinned[row, column], given[:, row, column] = 1.0, case.flow[used].T
            self.pinned, self.given = tensor(pinned)[None, None], tensor(given)[None]

    def __call__(self, output: Tensor) -> tuple[Tensor, Tensor]:
        """Loss, and the field (1, 3, h, w) that it is of, for the network's output (1, 3, h, w)."""
        velocity, pressure = self.scene.correct(output, self.settings.near_wall)
        if self.settings.observations == "hard":
            velocity = velocity * (1.0 - self.pinned) + self.given * self.pinned
        residual = self.physics.residuals(velocity, pressure) - self.truncation
        loss = (residual**2).sum() / self.norm
        field = velocity[0][:, self.rows, self.columns]  # (2, n, 4)
        misfits = ((((field * self.weights).sum(dim=-1).T - self.flow) / self.noise) ** 2).sum(dim=1)
        likelihood = 0.5 * (TAIL + 2.0) * torch.log1p(misfits / TAIL).mean()
        return loss + 2.0 * self.settings.observation_weight * likelihood, torch.cat([velocity, pressure], dim=1)
