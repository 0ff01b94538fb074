"""The network of the paper: a four-level U-Net whose bottleneck alone is a Transformer."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn
from torch.nn import functional

LEVELS = 4


class Block(nn.Module):
    """Two 3 x 3 convolutions with group norm and GELU: (n, a, h, w) to (n, b, h, w)."""

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
    """(n, in, h, w) to (n, out, h, w), zero before training; skips by concatenation; h and w multiples of 16.

    As printed it sees [mask, vx, vy, p] and has four levels of convolutions. `folded`, the finest level is 2 x 2
    pixels folded into channels, without convolutions of its own: a fifth of the time, for corrections that are smooth.
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
        self.down = nn.ModuleList(Block(a, b) for a, b in zip([channels_in, *widths[:-1]], widths, strict=True))
        self.middle = Block(widths[-1], deep)
        self.attend = nn.Sequential(
            *(
                nn.TransformerEncoderLayer(deep, 4, 2 * deep, dropout=0.0, batch_first=True, norm_first=True)
                for _ in range(depth)
            )
        )
        self.lift = nn.ModuleList(nn.ConvTranspose2d(2 * b, b, 2, 2) for b in widths[::-1])
        self.up = nn.ModuleList(Block(2 * b, b) for b in widths[::-1])
        self.last = nn.Conv2d(base_channels, channels_out, 1)
        # Start exactly at the initial field: the network predicts what is to be added to it.
        nn.init.zeros_(self.last.weight)
        assert self.last.bias is not None
        nn.init.zeros_(self.last.bias)

    def forward(self, x: Tensor) -> Tensor:
        """Apply."""
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
    """(1, h w, channels) sines and cosines of row and column: attention alone does not know where a token is."""
    quarter = channels // 4
    rate = torch.exp(-math.log(1000.0) * torch.arange(quarter) / quarter)
    row, column = torch.meshgrid(torch.arange(h), torch.arange(w), indexing="ij")
    angles = [place.reshape(-1, 1) * rate for place in (row, column)]
    return torch.cat([wave(angle) for angle in angles for wave in (torch.sin, torch.cos)], dim=1)[None]


def trained_network() -> UNet:
    """The network that shipped weights fit: it sees and gives what a `Scene` says."""
    from flowrec.refine.network_inputs import OUTPUTS, TOLD

    return UNet(16, TOLD, OUTPUTS, folded=True, depth=3)
