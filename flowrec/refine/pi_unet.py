"""PI-UNet (the paper): a U-Net fitted to one case by physics and observations, as a correction to an initial field."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation

from flowrec.chip.chip import Chip
from flowrec.messages import FlowField
from flowrec.refine.sight import Floats, Sight
from flowrec.units import M_PER_UM, PA_S_PER_MPA_S

if TYPE_CHECKING:
    from torch import Tensor

_CROSS = np.array([[0, 1, 0], [1, 1, 1], [0, 1, 0]], bool)


@dataclass(frozen=True, slots=True)
class PiUnet:
    """Settings of the PI-UNet."""

    start: Literal["assimilate", "fvm"] = "assimilate"  # the initial field
    observations: Literal["soft", "hard"] = "soft"
    near_wall: Literal["scaled", "hard", "free"] = "scaled"
    iterations: int = 150
    largest_work_mpx: float = 6.0  # iterations times pixels; larger fields get fewer iterations
    learning_rate: float = 3e-3
    observation_weight: float = 0.03
    base_channels: int = 16
    device: str = "cpu"
    threads: int = 1
    seed: int = 0

    def fit(self, initial: FlowField, sight: Sight, chip: Chip, log=None) -> FlowField:
        import torch
        from flowrec.refine.network import MULTIPLE, UNet
        from flowrec.refine.physics import Physics
        from torch.nn import functional

        torch.set_num_threads(self.threads)
        torch.manual_seed(self.seed)
        rows, cols = np.nonzero(chip.mask)
        r0, r1, c0, c1 = rows.min(), rows.max() + 1, cols.min(), cols.max() + 1
        H = -(-(r1 - r0) // MULTIPLE) * MULTIPLE
        W = -(-(c1 - c0) // MULTIPLE) * MULTIPLE

        def crop(a):
            a = a[r0:r1, c0:c1]
            out = np.zeros((H, W, *a.shape[2:]), np.float32)
            out[: a.shape[0], : a.shape[1]] = a
            return out

        m = crop(chip.mask) > 0
        inside = np.zeros(chip.mask.shape, bool)
        inside[1:-1, 1:-1] = True
        inside = crop(inside) > 0
        v0 = crop(initial.velocity_um_s)
        p0 = crop(initial.pressure_pa)
        V = float(np.abs(v0).max())
        px = chip.um_per_px
        mu = initial.viscosity_mpa_s * 1e-3
        unit_p = mu * V / px
        P = max(float(np.abs(p0).max()), 1e-12)
        re = initial.density_kg_m3 * V * 1e-6 * px * 1e-6 / mu
        fr = 0.0 if chip.depth_um is None else 12 * (px / chip.depth_um) ** 2
        T = lambda a: torch.from_numpy(np.ascontiguousarray(a.astype(np.float32)))
        fluid = T(m)[None, None]
        ini = T(v0 / V).permute(2, 0, 1)[None]
        pin = T(p0 / P)[None, None]
        x = torch.cat([fluid, ini, pin], 1)
        phys = Physics.of(fluid, T(inside)[None, None], re, fr)
        solidnear = binary_dilation(~crop_true(chip.mask, r0, r1, c0, c1, H, W), _CROSS)
        near = m & solidnear
        inner = m & ~near
        near &= binary_dilation(inner, np.ones((3, 3), bool))
        nearT = T(near)[None, None]
        innerT = T(m & ~near)[None, None]
        box = lambda a: functional.avg_pool2d(a, 5, 1, 2)
        den = box((ini**2).sum(1, keepdim=True) * innerT) + 1e-6
        rowt = torch.from_numpy(sight.rows - r0)
        colt = torch.from_numpy(sight.columns - c0)
        wt = T(sight.weights)
        yo = T(sight.flow_um_s / V)
        so = T(np.sqrt(sight.std_um_s**2 + (0.03 * np.linalg.norm(sight.flow_um_s, axis=1)) ** 2) / V)[:, None]
        net = UNet(self.base_channels)
        opt = torch.optim.Adam(net.parameters(), lr=self.learning_rate)
        n = self.iterations
        sch = torch.optim.lr_scheduler.OneCycleLR(opt, self.learning_rate, total_steps=n, pct_start=0.1)
        count = phys.where.sum()
        with torch.no_grad():
            base = phys.residuals(ini * fluid, pin * (P / unit_p) * fluid)
            rms = ((ini**2).sum(1).sum() / fluid.sum()).sqrt()
        for it in range(n):
            c = net(x)
            cv = c[:, :2] * fluid
            if self.near_wall == "scaled":
                s = box((cv * ini).sum(1, keepdim=True) * innerT) / den
                cv = cv * (1 - nearT) + nearT * s * ini
            elif self.near_wall == "hard":
                cv = cv * (1 - nearT)
            v = ini + cv
            p = (pin + c[:, 2:]) * (P / unit_p) * fluid
            res = (phys.residuals(v, p) - base)
            physics = (res**2).sum() / count
            seen = (v[0][:, rowt, colt] * wt).sum(-1).T
            z2 = (((seen - yo) / so) ** 2).sum(1)
            ob = (6 * torch.log1p(z2 / 4)).mean()
            loss = physics / rms**2 + self.observation_weight * ob
            opt.zero_grad()
            loss.backward()
            opt.step()
            sch.step()
            if log and (it % 10 == 0 or it == n - 1):
                f = np.zeros_like(initial.velocity_um_s)
                f[r0:r1, c0:c1] = v[0].detach().permute(1, 2, 0).numpy()[: r1 - r0, : c1 - c0] * V
                log(it, float(physics / rms**2), float(ob), f)
        f = np.zeros_like(initial.velocity_um_s)
        f[r0:r1, c0:c1] = v[0].detach().permute(1, 2, 0).numpy()[: r1 - r0, : c1 - c0] * V
        return f


def crop_true(mask, r0, r1, c0, c1, H, W):
    out = np.ones((H, W), bool)
    out[: r1 - r0, : c1 - c0] = mask[r0:r1, c0:c1]
    # outside the crop: what the image says, or open
    return out
