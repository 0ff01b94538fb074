"""Cases as tensors: inputs of the networks, and the field for their output. One case, or a batch of one size.

A network that adds a free field would have to learn the profile of every channel. An initial field is mostly wrong in
the flow rate of each branch, so the trained network gives a gain of the initial velocity, which is smooth, and a free
part relative to the speed around. Pixels at walls keep the initial profile; their amplitude is that of the corrected
flow beside them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from flowrec.core import Floats
from flowrec.stages.refine.case import Case

INPUTS = 12  # channels of `NetworkInputs.with_observations`
GAIN, FREE, PRESSURE, LOG_STD = slice(0, 1), slice(1, 3), slice(3, 4), slice(4, 5)  # of a trained network's output
OUTPUTS = 5  # channels of a trained network, those of the line above
WINDOW = 5  # pixels around, for the amplitude of pixels at walls
LEAST_SPEED = 0.05  # of V: a branch without assumed flow can still be given a flow

SMOOTHINGS = 4  # passes of averaging over neighbours of double size
FARTHEST = 64  # pixels of double size along the channels to the nearest observation
LARGEST_GAIN = 1.5  # limits outliers: boundary values hardly cause a larger gain


@dataclass(frozen=True, slots=True, eq=False)
class NetworkInputs:
    """The images of n cases; units as in `Case`."""

    fluid: Tensor  # (n, 1, h, w)
    inside: Tensor  # (n, 1, h, w)
    walled: Tensor  # (n, 1, h, w)
    inflow: Tensor  # (n, 1, h, w)
    velocity: Tensor  # (n, 2, h, w) initial
    pressure: Tensor  # (n, 1, h, w) initial
    observed: Tensor  # (n, 1, h, w) 1 where there is an observation
    innovation: Tensor  # (n, 2, h, w) observed minus initial velocity
    geodesic: Tensor  # (n, 3, h, w) observations along the channels, as in `geodesic_features`
    reynolds: Tensor  # (n, 1, 1, 1)
    friction: Tensor  # (n, 1, 1, 1)

    @classmethod
    def of(cls, cases: Sequence[Case], device: str = "cpu") -> NetworkInputs:
        """Cases of one size."""

        def stack(arrays: list[NDArray[Any]]) -> Tensor:
            image = np.stack([np.asarray(a, np.float32).reshape(*a.shape[:2], -1) for a in arrays])
            return torch.from_numpy(np.ascontiguousarray(np.moveaxis(image, -1, 1))).to(device)

        def number(values: list[float]) -> Tensor:
            return torch.tensor(values, dtype=torch.float32, device=device)[:, None, None, None]

        innovations = [case.innovations() for case in cases]
        observed = stack(innovations)
        names = ("fluid", "inside", "walled", "inflow", "velocity", "pressure")
        return cls(
            **{name: stack([getattr(case, name) for case in cases]) for name in names},
            observed=observed[:, :1],
            innovation=observed[:, 1:3],
            geodesic=stack(
                [
                    geodesic_features(case.fluid, case.velocity, each)
                    for case, each in zip(cases, innovations, strict=True)
                ]
            ),
            reynolds=number([case.reynolds for case in cases]),
            friction=number([case.friction for case in cases]),
        )

    @property
    def largest(self) -> Tensor:
        """(n, 1, 1, 1) largest initial pressure: pressures reach hundreds of mu V / px."""
        return self.pressure.abs().amax(dim=(1, 2, 3), keepdim=True).clamp(min=1.0)

    @property
    def free(self) -> Tensor:
        """(n, 1, h, w) 1 on fluid pixels that are not at a wall."""
        return self.fluid * (1.0 - self.walled)

    @property
    def local_rms(self) -> Tensor:
        """(n, 1, h, w) root mean square of the initial speed around each pixel, without pixels at walls."""
        square = mean_around((self.velocity**2).sum(dim=1, keepdim=True) * self.free)
        return (square / mean_around(self.free).clamp(min=0.04)).sqrt()

    def of_paper(self) -> Tensor:
        """(n, 4, h, w) input of the paper's network: mask, vx, vy, p."""
        return torch.cat([self.fluid, self.velocity, self.pressure / self.largest], dim=1)

    def with_observations(self) -> Tensor:
        """(n, 12, h, w) input of a network that uses the observations at once.

        The paper's four, the logarithm of the speed, and the openings; where observations are, and the innovation
        there; the gain that the nearest observations along the channels imply, its precision, and their distance.
        """
        speed = torch.linalg.vector_norm(self.velocity, dim=1, keepdim=True)
        level = (1.0 + torch.log(speed + 1e-3) / 6.9) * self.fluid
        innovation = 3.0 * self.innovation.clamp(-1.0, 1.0)
        return torch.cat([self.of_paper(), level, self.inflow, self.observed, innovation, self.geodesic], dim=1)

    def correct(self, output: Tensor, near_wall: Literal["scaled", "hard", "free"] = "scaled") -> tuple[Tensor, Tensor]:
        """Velocity (n, 2, h, w) and pressure (n, 1, h, w) for a network's output (n, 3 or 5, h, w)."""
        if output.shape[1] == OUTPUTS:
            change = output[:, GAIN] * self.velocity + output[:, FREE] * (self.local_rms + LEAST_SPEED)
            pressure = output[:, PRESSURE]
        else:  # as in the paper: vx, vy, p
            change, pressure = output[:, :2], output[:, 2:]
        change = change * self.fluid
        if near_wall != "free":
            change = change * (1.0 - self.walled)
        if near_wall == "scaled":
            amplitude = mean_around((self.velocity**2).sum(dim=1, keepdim=True) * self.free) + 1e-6
            gain = mean_around((change * self.velocity).sum(dim=1, keepdim=True) * self.free) / amplitude
            change = change + self.walled * gain * self.velocity
        return self.velocity + change, self.pressure + pressure * self.largest * self.fluid


def mean_around(image: Tensor) -> Tensor:
    """Mean over the window around each pixel."""
    return functional.avg_pool2d(image, WINDOW, stride=1, padding=WINDOW // 2)


def geodesic_features(fluid: NDArray[np.bool_], velocity: Floats, innovations: Floats) -> Floats:
    """(h, w, 3): relative gain of the nearest observations, the logarithm of its precision, their distance (0 to 1).

    Observations are carried along the channels and not through walls, as a convolution would.

    Parameters
    ----------
    fluid
        (h, w) with even sides.
    velocity
        (h, w, 2) initial.
    innovations
        (h, w, 4) as in `Case.innovations`.
    """
    h, w = fluid.shape[0] // 2, fluid.shape[1] // 2
    channels = np.asarray(fluid.reshape(h, 2, w, 2).any(axis=(1, 3)))  # pixels of double size
    # The 3 x 3 neighbours of each such pixel; the number after the last stands for solid.
    count = int(channels.sum())
    number = np.full((h + 2, w + 2), count)
    number[1:-1, 1:-1][channels] = np.arange(count)
    rows, columns = np.nonzero(channels)
    around = np.stack([number[rows + dy, columns + dx] for dy in range(3) for dx in range(3)], axis=1)

    def mean(values: Floats) -> Floats:
        """(pixels, c) sum of values (pixels, c) over the neighbours, over 9."""
        return np.asarray(np.concatenate([values, np.zeros((1, values.shape[1]))])[around].mean(axis=1))

    observed, noise = innovations[..., 0] > 0.0, np.maximum(innovations[..., 3], 1e-3)
    square = (velocity**2).sum(axis=-1)
    gain = (innovations[..., 1:3] * velocity).sum(axis=-1) / np.maximum(square, 1e-9)
    precision = np.where(observed, square / noise**2, 0.0)
    weighted = np.stack([np.clip(gain, -LARGEST_GAIN, LARGEST_GAIN) * precision, precision], axis=-1)
    values = weighted.reshape(h, 2, w, 2, 2).sum(axis=(1, 3))[channels]
    for _ in range(SMOOTHINGS):
        values = mean(values)
    known = values[:, 1] > 1e-12
    state = np.column_stack([values[:, 0] / np.maximum(values[:, 1], 1e-12), np.log1p(values[:, 1]) / 7.0, known])
    state[~known] = 0.0
    distance = np.where(known, 0.0, 1.0)
    for step in range(1, FARTHEST):
        total = mean(state)
        new = (state[:, 2] == 0.0) & (total[:, 2] > 0.0)
        if not new.any():
            break
        state[new] = total[new] / total[new, 2:]
        distance[new] = step / FARTHEST
    features = np.zeros((h, w, 3))
    features[channels] = np.column_stack([state[:, :2], distance])
    return np.asarray(np.repeat(np.repeat(features, 2, axis=0), 2, axis=1) * fluid[..., None])
