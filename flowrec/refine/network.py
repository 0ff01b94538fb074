"""The network of the paper: a four-level U-Net whose bottleneck alone is a Transformer. Imported by pi_unet only."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn
from torch.nn import functional

LEVELS = 4
MULTIPLE = 2**LEVELS  # sides of the input must divide by this


class Block(nn.Module):
    """Two 3 x 3 convolutions with group norm and GELU: (1, a, h, w) to (1, b, h, w)."""

    def __init__(self, channels_in: int, channels_out: int) -> None:
        super().__init__()
        layers: list[nn.Module] = []
        for channels in (channels_in, channels_out):
            layers += [nn.Conv2d(channels, channels_out, 3, padding=1), nn.GroupNorm(4, channels_out), nn.GELU()]
        self.layers = nn.Sequential(*layers)

    def forward(self, x: Tensor) -> Tensor:
        """Apply."""
        return self.layers(x)  # type: ignore[no-any-return]


class UNet(nn.Module):
    """(1, 4, h, w) of [mask, vx, vy, p] to (1, 3, h, w), zero before training; skips by concatenation."""

    def __init__(self, base_channels: int) -> None:
        super().__init__()
        widths = [base_channels * 2**level for level in range(LEVELS)]
        deep = 2 * widths[-1]
        self.down = nn.ModuleList(Block(a, b) for a, b in zip([4, *widths[:-1]], widths, strict=True))
        self.middle = Block(widths[-1], deep)
        self.attend = nn.TransformerEncoderLayer(deep, 4, 2 * deep, dropout=0.0, batch_first=True, norm_first=True)
        self.lift = nn.ModuleList(nn.ConvTranspose2d(2 * b, b, 2, 2) for b in widths[::-1])
        self.up = nn.ModuleList(Block(2 * b, b) for b in widths[::-1])
        self.last = nn.Conv2d(base_channels, 3, 1)
        # Start exactly at the initial field: the network predicts what is to be added to it.
        nn.init.zeros_(self.last.weight)
        assert self.last.bias is not None
        nn.init.zeros_(self.last.bias)

    def forward(self, x: Tensor) -> Tensor:
        """Apply."""
        skips = []
        for block in self.down:
            x = block(x)
            skips.append(x)
            x = functional.max_pool2d(x, 2)
        x = self.middle(x)
        _, channels, h, w = x.shape
        tokens = x.flatten(2).transpose(1, 2) + positions(h, w, channels).to(x)
        x = self.attend(tokens).transpose(1, 2).reshape(1, channels, h, w)
        for lift, block, skip in zip(self.lift, self.up, skips[::-1], strict=True):
            x = block(torch.cat([lift(x), skip], dim=1))
        return self.last(x)  # type: ignore[no-any-return]


def positions(h: int, w: int, channels: int) -> Tensor:
    """(1, h w, channels) sines and cosines of row and column: attention alone does not know where a token is."""
    quarter = channels // 4
    rate = torch.exp(-math.log(1000.0) * torch.arange(quarter) / quarter)
    row, column = torch.meshgrid(torch.arange(h), torch.arange(w), indexing="ij")
    angles = [place.reshape(-1, 1) * rate for place in (row, column)]
    return torch.cat([wave(angle) for angle in angles for wave in (torch.sin, torch.cos)], dim=1)[None]
