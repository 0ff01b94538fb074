"""Cases as tensors: what the networks see of them, and how their output becomes a field. One case or a batch of a size.

A free part of the output would have to learn the profile of every channel. What is wrong with an initial field is
mostly the amount that flows in each branch, so the trained network gives a gain of the initial velocity, which is
smooth, and a free part relative to the speed around. Near-wall pixels keep the initial profile; their amplitude is that
of the corrected flow beside them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from flowrec.refine.case import Case
from flowrec.refine.geodesic_features import spread

PRINTED = 4  # channels of `Scene.printed`
TOLD = 12  # channels of `Scene.told`
GAIN, FREE, PRESSURE, DOUBT = 0, slice(1, 3), slice(3, 4), slice(4, 5)  # of a trained network's output
OUTPUTS = 5
WINDOW = 5  # pixels over which near-wall pixels take their amplitude
LEAST = 0.05  # of V: a branch where nothing was assumed to flow may still be given a flow


@dataclass(frozen=True, slots=True, eq=False)
class Scene:
    """The images of n cases; units as in `Case`."""

    fluid: Tensor  # (n, 1, h, w)
    inside: Tensor  # (n, 1, h, w)
    walled: Tensor  # (n, 1, h, w)
    openings: Tensor  # (n, 1, h, w)
    velocity: Tensor  # (n, 2, h, w) initial
    pressure: Tensor  # (n, 1, h, w) initial
    observed: Tensor  # (n, 1, h, w) 1 where there is an observation
    gap: Tensor  # (n, 2, h, w) observed minus initial velocity
    near: Tensor  # (n, 3, h, w) what observations say along the channels, as in `spread`
    reynolds: Tensor  # (n, 1, 1, 1)
    friction: Tensor  # (n, 1, 1, 1)

    @classmethod
    def of(cls, cases: Sequence[Case], used: NDArray[np.bool_] | None = None, device: str = "cpu") -> Scene:
        """Cases of one size; `used` (observations,) leaves out some of an only case."""

        def stack(arrays: list[NDArray[Any]]) -> Tensor:
            image = np.stack([np.asarray(a, np.float32).reshape(*a.shape[:2], -1) for a in arrays])
            return torch.from_numpy(np.ascontiguousarray(np.moveaxis(image, -1, 1))).to(device)

        told = [case.gaps(used) for case in cases]
        gaps = stack(told)
        near = stack([spread(case.fluid, case.velocity, each) for case, each in zip(cases, told, strict=True)])

        def number(values: list[float]) -> Tensor:
            return torch.tensor(values, dtype=torch.float32, device=device)[:, None, None, None]

        names = ("fluid", "inside", "walled", "openings", "velocity", "pressure")
        images = {name: stack([getattr(case, name) for case in cases]) for name in names}
        return cls(
            **images,
            observed=gaps[:, :1],
            gap=gaps[:, 1:3],
            near=near,
            reynolds=number([c.reynolds for c in cases]),
            friction=number([c.friction for c in cases]),
        )

    def turned(self, quarters: int, mirrored: bool) -> Scene:
        """The same cases seen from another of the eight sides of a square."""
        return Scene(**{f.name: turn(getattr(self, f.name), quarters, mirrored) for f in fields(self)})

    @property
    def largest(self) -> Tensor:
        """(n, 1, 1, 1) largest initial pressure: they reach hundreds of mu V / px."""
        return self.pressure.abs().amax(dim=(1, 2, 3), keepdim=True).clamp(min=1.0)

    @property
    def around(self) -> Tensor:
        """(n, 1, h, w) root mean square of the initial speed around each pixel, off the walls."""
        free = self.fluid * (1.0 - self.walled)
        square = mean_around((self.velocity**2).sum(dim=1, keepdim=True) * free)
        return (square / mean_around(free).clamp(min=0.04)).sqrt()

    def printed(self) -> Tensor:
        """(n, 4, h, w) input of the paper's network: mask, vx, vy, p."""
        return torch.cat([self.fluid, self.velocity, self.pressure / self.largest], dim=1)

    def told(self) -> Tensor:
        """(n, 12, h, w) input of a network that uses observations at once.

        The printed four, the logarithm of the speed, openings; where was observed, what differs there; the gain that
        the nearest observations along the channels speak for, how surely, and how far they are.
        """
        speed = torch.linalg.vector_norm(self.velocity, dim=1, keepdim=True)
        level = (1.0 + torch.log(speed + 1e-3) / 6.9) * self.fluid
        gap = 3.0 * self.gap.clamp(-1.0, 1.0)
        return torch.cat([self.printed(), level, self.openings, self.observed, gap, self.near], dim=1)

    def correct(self, output: Tensor, near_wall: Literal["scaled", "hard", "free"] = "scaled") -> tuple[Tensor, Tensor]:
        """Velocity (n, 2, h, w) and pressure (n, 1, h, w) for a network's output (n, 3 or 5, h, w)."""
        if output.shape[1] == OUTPUTS:
            moved = output[:, GAIN : GAIN + 1] * self.velocity + output[:, FREE] * (self.around + LEAST)
            pushed = output[:, PRESSURE]
        else:  # as printed: vx, vy, p
            moved, pushed = output[:, :2], output[:, 2:]
        moved = moved * self.fluid
        if near_wall != "free":
            moved = moved * (1.0 - self.walled)
        if near_wall == "scaled":
            free = self.fluid * (1.0 - self.walled)
            amplitude = mean_around((self.velocity**2).sum(dim=1, keepdim=True) * free) + 1e-6
            gain = mean_around((moved * self.velocity).sum(dim=1, keepdim=True) * free) / amplitude
            moved = moved + self.walled * gain * self.velocity
        return self.velocity + moved, self.pressure + pushed * self.largest * self.fluid

    def std(self, output: Tensor) -> Tensor:
        """(n, 1, h, w) standard deviation of a component that a trained network's output (n, 5, h, w) admits."""
        return (output[:, DOUBT].clamp(-6.0, 2.0) - 2.0).exp() * (self.around + LEAST) * self.fluid


def mean_around(image: Tensor) -> Tensor:
    """Mean over the window around each pixel."""
    return functional.avg_pool2d(image, WINDOW, stride=1, padding=WINDOW // 2)


def turn(image: Tensor, quarters: int, mirrored: bool) -> Tensor:
    """(n, c, h, w) turned by quarters, then mirrored left to right; two channels are a vector (x, y)."""
    if image.shape[-1] == 1:
        return image
    vector = image.shape[1] == 2
    for _ in range(quarters % 4):
        image = torch.rot90(image, 1, (2, 3))  # what pointed right (x) now points up (-y)
        if vector:
            image = torch.stack([image[:, 1], -image[:, 0]], dim=1)
    if mirrored:
        image = image.flip(3)
        if vector:
            image = image * torch.tensor([-1.0, 1.0]).to(image)[None, :, None, None]
    return image
