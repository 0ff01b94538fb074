"""The networks: the paper's U-Net with a Transformer in its bottleneck, and the PINN's network of coordinates.

The U-Net has four levels of convolutions, group norm and GELU, with resolutions halved by max pooling; its skip
connections are concatenated.
"""

from __future__ import annotations

import math
from itertools import pairwise

import torch
from torch import Tensor, nn
from torch.nn import functional

from flowrec.stages.refine.network_inputs import INPUTS, OUTPUTS

LEVELS = 4  # of the U-Net, each half as fine as the one before


class ConvBlock(nn.Module):
    """Two 3 x 3 convolutions with group norm and GELU: (n, a, h, w) to (n, b, h, w)."""

    def __init__(self, channels_in: int, channels_out: int) -> None:
        super().__init__()
        layers: list[nn.Module] = []
        for channels in (channels_in, channels_out):
            layers += [nn.Conv2d(channels, channels_out, 3, padding=1), nn.GroupNorm(4, channels_out), nn.GELU()]
        self.layers = nn.Sequential(*layers)

    def forward(self, x: Tensor) -> Tensor:
        """(n, b, h, w) of x (n, a, h, w)."""
        return self.layers(x)


class UNet(nn.Module):
    """(n, in, h, w) to (n, out, h, w), zero before training; h and w are multiples of 16.

    As in the paper the input is [mask, vx, vy, p] and all four levels have convolutions. With `folded`, 2 x 2 pixels
    are folded into channels in place of the finest level: a fifth of the time, for corrections that are smooth.
    """

    def __init__(
        self, base_channels: int, channels_in: int = 4, channels_out: int = 3, folded: bool = False, depth: int = 1
    ) -> None:
        super().__init__()
        self.folded = folded
        if folded:
            channels_in, channels_out = 4 * channels_in, 4 * channels_out
        widths = [base_channels * 2**level for level in range(LEVELS - folded)]
        deep = 2 * widths[-1]
        self.down = nn.ModuleList(ConvBlock(a, b) for a, b in zip([channels_in, *widths[:-1]], widths, strict=True))
        self.middle = ConvBlock(widths[-1], deep)
        self.attend = nn.Sequential(
            *(
                nn.TransformerEncoderLayer(deep, 4, 2 * deep, dropout=0.0, batch_first=True, norm_first=True)
                for _ in range(depth)
            )
        )
        self.lift = nn.ModuleList(nn.ConvTranspose2d(2 * b, b, 2, 2) for b in widths[::-1])
        self.up = nn.ModuleList(ConvBlock(2 * b, b) for b in widths[::-1])
        self.last = nn.Conv2d(base_channels, channels_out, 1)
        # The output is a correction: without training it is zero.
        nn.init.zeros_(self.last.weight)
        assert self.last.bias is not None
        nn.init.zeros_(self.last.bias)

    def forward(self, x: Tensor) -> Tensor:
        """(n, out, h, w) of x (n, in, h, w)."""
        if self.folded:
            x = functional.pixel_unshuffle(x, 2)
        skips = []
        for block in self.down:
            x = block(x)
            skips.append(x)
            x = functional.max_pool2d(x, 2)
        x = self.middle(x)
        count, channels, h, w = x.shape
        tokens = x.flatten(2).transpose(1, 2) + positions(h, w, channels).to(x)
        x = self.attend(tokens).transpose(1, 2).reshape(count, channels, h, w)
        for lift, block, skip in zip(self.lift, self.up, skips[::-1], strict=True):
            x = block(torch.cat([lift(x), skip], dim=1))
        x = self.last(x)
        return functional.pixel_shuffle(x, 2) if self.folded else x


def positions(h: int, w: int, channels: int) -> Tensor:
    """(1, h w, channels) position encoding by sines and cosines of row and column, for the attention."""
    quarter = channels // 4
    rate = torch.exp(-math.log(1000.0) * torch.arange(quarter) / quarter)
    row, column = torch.meshgrid(torch.arange(h), torch.arange(w), indexing="ij")
    angles = [place.reshape(-1, 1) * rate for place in (row, column)]
    return torch.cat([wave(angle) for angle in angles for wave in (torch.sin, torch.cos)], dim=1)[None]


def trained_network() -> UNet:
    """The network of the shipped weights, from `NetworkInputs.with_observations` to `NetworkInputs.correct`."""
    return UNet(16, INPUTS, OUTPUTS, folded=True, depth=3)


class CoordinateNet(nn.Module):
    """Points (n, 2) to (n, 3); tanh layers after Fourier features of the coordinates (Tancik et al., 2020).

    `jet` computes derivatives in forward mode: value, both slopes and the Laplacian go through the layers together.
    For h = tanh(z)

        h_x = (1 - h^2) z_x,   lap h = (1 - h^2) lap z - 2 h (1 - h^2) |grad z|^2,

    and a linear layer acts on all four alike. The result is that of differentiating twice, in a third of the time.
    """

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
        """Value (n, 3) of points (n, 2)."""
        phase = points @ self.waves
        h = math.sqrt(2.0) * torch.cat([phase.sin(), phase.cos()], dim=1)
        *hidden, (weight, bias) = zip(self.weights, self.biases, strict=True)
        for w, b in hidden:
            h = torch.tanh(h @ w.T + b)
        return h @ weight.T + bias

    def jet(self, points: Tensor) -> Tensor:
        """(4, n, 3) of points (n, 2): value, slope along x, slope along y, Laplacian."""
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
