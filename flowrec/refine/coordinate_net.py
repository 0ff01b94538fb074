"""A fully connected network of the coordinates, with its derivatives carried forward. Imported by pinn only.

Value, both slopes and the Laplacian go through the layers together: for h = tanh(z)

    h_x = (1 - h^2) z_x,   lap h = (1 - h^2) lap z - 2 h (1 - h^2) |grad z|^2,

and a linear layer acts on all four alike. That is what differentiating twice gives, at a third of the time.
"""

from __future__ import annotations

import math
from itertools import pairwise

import torch
from torch import Tensor, nn


class CoordinateNet(nn.Module):
    """Points (n, 2) to (n, 3); tanh layers behind Fourier features of the coordinates (Tancik et al., 2020)."""

    def __init__(self, width: int, depth: int, features: int, wavenumber: float) -> None:
        super().__init__()
        self.waves: Tensor
        self.register_buffer("waves", wavenumber * torch.randn(2, features))
        sizes = [2 * features, *[width] * depth, 3]
        self.weights = nn.ParameterList(torch.empty(b, a) for a, b in pairwise(sizes))
        self.biases = nn.ParameterList(torch.zeros(b) for b in sizes[1:])
        for weight in self.weights:
            nn.init.xavier_normal_(weight)

    def forward(self, points: Tensor) -> Tensor:
        """Value (n, 3) alone."""
        phase = points @ self.waves
        h = math.sqrt(2.0) * torch.cat([phase.sin(), phase.cos()], dim=1)
        *hidden, (weight, bias) = zip(self.weights, self.biases, strict=True)
        for w, b in hidden:
            h = torch.tanh(h @ w.T + b)
        return h @ weight.T + bias  # type: ignore[no-any-return]

    def jet(self, points: Tensor) -> Tensor:
        """(4, n, 3): value, slope along x, slope along y, Laplacian."""
        phase = points @ self.waves
        sine, cosine = math.sqrt(2.0) * phase.sin(), math.sqrt(2.0) * phase.cos()
        square = (self.waves**2).sum(dim=0)
        h = torch.stack(
            [
                torch.cat([sine, cosine], dim=1),
                torch.cat([cosine * self.waves[0], -sine * self.waves[0]], dim=1),
                torch.cat([cosine * self.waves[1], -sine * self.waves[1]], dim=1),
                torch.cat([-sine * square, -cosine * square], dim=1),
            ]
        )
        *hidden, (weight, bias) = zip(self.weights, self.biases, strict=True)
        for w, b in hidden:
            z = h @ w.T
            t = torch.tanh(z[0] + b)
            slope = 1.0 - t**2
            bend = slope * (z[3] - 2.0 * t * (z[1] ** 2 + z[2] ** 2))
            h = torch.stack([t, slope * z[1], slope * z[2], bend])
        z = h @ weight.T
        return torch.cat([z[:1] + bias, z[1:]])
