"""PI-UNet (the paper): a U-Net fitted to one case by physics and observations, as a correction to an initial field.

What differs from the print, and why (science.md, section 2): true operators in dimensionless form; the loss is the
residual of the field minus that of the initial field, since a field from the solver obeys finer equations and its
residual on pixels is truncation error; near-wall pixels keep the initial profile but not its amplitude, because a
wrong inlet makes them wrong in proportion.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation

from flowrec.chip.chip import Chip
from flowrec.errors import FlowError
from flowrec.messages import FlowField
from flowrec.refine.sight import Floats, Sight
from flowrec.units import M_PER_UM, PA_S_PER_MPA_S

if TYPE_CHECKING:
    from torch import Tensor

CROSS = np.array([[0, 1, 0], [1, 1, 1], [0, 1, 0]], bool)
TAIL = 4.0  # Student-t noise, as in the assimilation
RELATIVE_NOISE = 0.03  # of the measured speed, beside its std: what the pixels can not represent
WINDOW = 5  # pixels over which near-wall pixels take their amplitude
HELD_OUT = 4  # every fourth observation judges whether an assimilated field gained anything
WORTH_TAKING = 0.9  # of the start's misfit on what was held out


@dataclass(frozen=True, slots=True)
class PiUnet:
    """Settings of the PI-UNet."""

    start: Literal["assimilate", "fvm"] = "assimilate"  # the initial field
    observations: Literal["soft", "hard"] = "soft"  # hard: the pixel takes the measured value, noise and all
    near_wall: Literal["scaled", "hard", "free"] = "scaled"  # hard: as printed, the initial values stay
    iterations: int = 80
    largest_work_mpx: float = 4.0  # iterations times pixels in millions: larger fields get fewer iterations
    patience: int = 25  # iterations without a better loss before it stops
    learning_rate: float = 3e-3
    observation_weight: float = 0.03  # of the mean log-likelihood against the mean squared residual
    base_channels: int = 16
    device: Literal["cpu", "cuda"] = "cpu"
    # More than one only on idle cores: torch spins at its barriers, and on two shared cores two are ten times slower.
    threads: int = 1
    seed: int = 0

    def fit(self, initial: FlowField, sight: Sight, chip: Chip) -> FlowField:
        """The corrected field, or `initial` with a note where a correction would not be an improvement.

        A start that has error bars has already used the observations: it is kept when they lie within their noise
        around it, or when a correction found without every fourth of them does not predict those better.

        Raises
        ------
        FlowError
            If the device is not there.
        """
        fastest = float(np.abs(initial.velocity_um_s).max())
        if fastest == 0.0:
            return self._kept(initial, "the initial field stands still")
        before = _misfit(initial.velocity_um_s, sight)
        used = np.ones(sight.count, bool)
        if initial.std_um_s is not None:
            if float(before.mean()) <= 2.0 + 4.0 / np.sqrt(sight.count):  # two standard deviations of chi2
                return self._kept(initial, f"the observations lie within their noise (chi2 {before.mean() / 2:.2f})")
            used = np.arange(sight.count) % HELD_OUT != HELD_OUT // 2
        case = _Case.of(initial, sight, chip)
        steps, velocity, pressure = self._descend(case, used)
        after = _misfit(velocity, sight)
        judges = before > -1.0 if used.all() else ~used
        if not np.isfinite(velocity).all() or _doubt(after[judges]) > WORTH_TAKING * _doubt(before[judges]):
            return self._kept(initial, "a correction did not predict the observations better")
        std = initial.std_um_s
        if std is not None:
            # Where the network moves the field, the start stays within the error bar.
            std = np.hypot(std, velocity - initial.velocity_um_s).astype(np.float32)
        return replace(
            initial,
            method="pi_unet",
            velocity_um_s=velocity.astype(np.float32),
            pressure_pa=pressure.astype(np.float32),
            std_um_s=std,
            note=f"corrected in {steps} iterations; misfit of the observations (chi2) {before.mean() / 2:.2f} to "
            f"{after.mean() / 2:.2f}" + (f"; start: {initial.note}" if initial.note else ""),
        )

    @staticmethod
    def _kept(initial: FlowField, why: str) -> FlowField:
        """The start as it is, and why."""
        return replace(initial, method="pi_unet", note=f"start kept, {why}; start: {initial.note or initial.method}")

    def _descend(self, case: _Case, used: NDArray[np.bool_]) -> tuple[int, Floats, Floats]:
        """Iterations done, velocity (h, w, 2) in um/s and pressure (h, w) in Pa of the lowest loss."""
        import torch

        from flowrec.refine.network import UNet

        if self.device == "cuda" and not torch.cuda.is_available():
            raise FlowError("refiner.pi_unet.device = 'cuda', but torch sees no GPU: set it to 'cpu'")
        steps = max(1, min(self.iterations, int(self.largest_work_mpx * 1e6 / case.pixels)))
        with _torch_state(torch, self.threads, self.seed):
            loss_of = _Loss(case, used, self)
            # Channels last: a fifth faster on a CPU.
            net = UNet(self.base_channels).to(self.device, memory_format=torch.channels_last)  # type: ignore[call-overload]
            seen = loss_of.seen.contiguous(memory_format=torch.channels_last)
            optimiser = torch.optim.Adam(net.parameters(), lr=self.learning_rate)
            # A short start, then half a cosine down to zero.
            schedule = torch.optim.lr_scheduler.LambdaLR(
                optimiser, lambda i: min(1.0, (i + 1) / (0.1 * steps)) * 0.5 * (1.0 + math.cos(math.pi * i / steps))
            )
            lowest, best, since, done = float("inf"), loss_of.start, 0, 0
            for _ in range(steps):
                loss, fields = loss_of(net(seen))
                value, since, done = float(loss.detach()), since + 1, done + 1
                if value < lowest:
                    since = since if value > 0.995 * lowest else 0
                    lowest, best = value, fields
                if since > self.patience:
                    break
                optimiser.zero_grad()
                loss.backward()  # type: ignore[no-untyped-call]
                optimiser.step()
                schedule.step()
            result = best.detach().cpu().numpy()[0].astype(np.float64)
        return done, case.whole(result[:2] * case.speed), case.whole(result[2:] * case.unit_pressure)[..., 0]


@contextlib.contextmanager
def _torch_state(torch: Any, threads: int, seed: int) -> Iterator[None]:
    """Seeded, deterministic, with a fixed number of threads; torch's global state is as before afterwards."""
    before = torch.get_num_threads()
    torch.set_num_threads(threads)
    try:
        with torch.random.fork_rng():
            torch.manual_seed(seed)
            yield
    finally:
        torch.set_num_threads(before)


def _misfit(velocity: NDArray[np.floating], sight: Sight) -> Floats:
    """(n,) squared distance of what a field (h, w, 2) predicts, in standard deviations; 2 on average if all is well."""
    return np.asarray((((sight.of(velocity) - sight.flow_um_s) / _noise(sight)[:, None]) ** 2).sum(axis=1))


def _noise(sight: Sight) -> Floats:
    """(n,) std of the observations with what pixels can not represent, um/s."""
    speed = np.linalg.norm(sight.flow_um_s, axis=1)
    return np.asarray(np.hypot(sight.std_um_s, RELATIVE_NOISE * np.maximum(speed, 0.1 * speed.max()) + 1e-9))


def _doubt(misfit: Floats) -> float:
    """Mean negative log-likelihood of Student-t noise: an outlier can not decide."""
    return float(0.5 * (TAIL + 2.0) * np.log1p(misfit / TAIL).mean()) if len(misfit) else float("inf")


@dataclass(frozen=True, slots=True, eq=False)
class _Case:
    """One case without dimensions, cropped to the fluid and padded to what the network can halve."""

    fluid: NDArray[np.bool_]  # (h, w)
    inside: NDArray[np.bool_]  # (h, w) not on the border of the image, where a residual would reach outside
    walled: NDArray[np.bool_]  # (h, w) a wall on one of the four sides, and a free pixel close by
    velocity: Floats  # (h, w, 2) in units of `speed`
    pressure: Floats  # (h, w) in units of `unit_pressure`
    rows: NDArray[np.intp]  # (n, 4) as in Sight
    columns: NDArray[np.intp]
    weights: Floats
    flow: Floats  # (n, 2) in units of `speed`
    noise: Floats  # (n,)
    speed: float  # V, um/s
    unit_pressure: float  # mu V / px, Pa
    reynolds: float
    friction: float
    corner: tuple[int, int]
    size: tuple[int, int]  # of the crop
    shape: tuple[int, int]  # of the image

    @classmethod
    def of(cls, initial: FlowField, sight: Sight, chip: Chip) -> _Case:
        """Crop and scale."""
        from flowrec.refine.network import MULTIPLE

        rows, columns = np.flatnonzero(chip.mask.any(axis=1)), np.flatnonzero(chip.mask.any(axis=0))
        top, left = int(rows[0]), int(columns[0])
        size = (int(rows[-1]) + 1 - top, int(columns[-1]) + 1 - left)
        padding = [(0, -length % MULTIPLE) for length in size]

        def crop(array: NDArray[Any]) -> NDArray[Any]:
            part = array[top : top + size[0], left : left + size[1]]
            return np.pad(part, padding + [(0, 0)] * (array.ndim - 2))

        inside = np.zeros(chip.mask.shape, bool)
        inside[1:-1, 1:-1] = True
        # Beyond the image is not a wall: openings keep their freedom.
        walled = chip.mask & binary_dilation(~chip.mask, CROSS)
        walled &= binary_dilation(chip.mask & ~walled, np.ones((3, 3), bool))
        px_m, mu = chip.um_per_px * M_PER_UM, initial.viscosity_mpa_s * PA_S_PER_MPA_S
        speed = float(np.abs(initial.velocity_um_s).max())
        unit_pressure = mu * speed * M_PER_UM / px_m
        return cls(
            crop(chip.mask),
            crop(inside),
            crop(walled),
            crop(initial.velocity_um_s.astype(np.float64) / speed),
            crop(initial.pressure_pa.astype(np.float64) / unit_pressure),
            sight.rows - top,
            sight.columns - left,
            sight.weights,
            sight.flow_um_s / speed,
            _noise(sight) / speed,
            speed,
            unit_pressure,
            initial.density_kg_m3 * speed * M_PER_UM * px_m / mu,
            0.0 if chip.depth_um is None else 12.0 * (chip.um_per_px / chip.depth_um) ** 2,
            (top, left),
            size,
            (chip.mask.shape[0], chip.mask.shape[1]),
        )

    @property
    def pixels(self) -> int:
        """Size of the network's input."""
        return self.fluid.size

    def whole(self, channels: Floats) -> Floats:
        """(h, w, c) on the image of channels (c, h, w) on the padded crop."""
        image = np.zeros((*self.shape, len(channels)))
        rows, columns = (slice(at, at + length) for at, length in zip(self.corner, self.size, strict=True))
        image[rows, columns] = np.moveaxis(channels[:, : self.size[0], : self.size[1]], 0, -1)
        return image


class _Loss:
    """From the network's output to a constrained field and its loss; all tensors of a case on the device."""

    def __init__(self, case: _Case, used: NDArray[np.bool_], settings: PiUnet) -> None:
        import torch

        from flowrec.refine.physics import Physics

        def tensor(array: NDArray[Any]) -> Tensor:
            return torch.from_numpy(np.array(array, np.float32)).to(settings.device)

        self.settings = settings
        self.fluid, inside, self.walled = (tensor(m)[None, None] for m in (case.fluid, case.inside, case.walled))
        self.free = self.fluid * (1.0 - self.walled)
        velocity, pressure = tensor(np.moveaxis(case.velocity, -1, 0))[None], tensor(case.pressure)[None, None]
        self.velocity = velocity
        self.start = torch.cat([velocity, pressure], dim=1)
        # Pressures reach hundreds of mu V / px; the network sees and gives them as shares of the largest.
        largest = max(float(np.abs(case.pressure).max()), 1.0)
        self.scale = torch.tensor([1.0, 1.0, largest], device=settings.device)[None, :, None, None]
        self.seen = torch.cat([self.fluid, self.start / self.scale], dim=1)
        self.physics = Physics.of(self.fluid, inside, case.reynolds, case.friction)
        self.truncation = self.physics.residuals(velocity, pressure)
        self.amplitude = self._around((velocity**2).sum(dim=1, keepdim=True) * self.free) + 1e-6
        # Residuals are shares of the field's own size, so that weights mean the same in any case.
        self.norm = float((velocity**2).sum() / self.fluid.sum()) * float(self.physics.where.sum().clamp(min=1.0))
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
        import torch

        change = output * self.scale * self.fluid
        moved = change[:, :2]
        if self.settings.near_wall != "free":
            moved = moved * (1.0 - self.walled)
        if self.settings.near_wall == "scaled":
            # The profile at the wall stays, its amplitude is that of the corrected flow beside it.
            gain = self._around((moved * self.velocity).sum(dim=1, keepdim=True) * self.free) / self.amplitude
            moved = moved + self.walled * gain * self.velocity
        velocity = self.velocity + moved
        if self.settings.observations == "hard":
            velocity = velocity * (1.0 - self.pinned) + self.given * self.pinned
        pressure = self.start[:, 2:] + change[:, 2:]
        residual = self.physics.residuals(velocity, pressure) - self.truncation
        loss = (residual**2).sum() / self.norm
        field = velocity[0][:, self.rows, self.columns]  # (2, n, 4)
        misfit = ((((field * self.weights).sum(dim=-1).T - self.flow) / self.noise) ** 2).sum(dim=1)
        likelihood = 0.5 * (TAIL + 2.0) * torch.log1p(misfit / TAIL).mean()
        return loss + 2.0 * self.settings.observation_weight * likelihood, torch.cat([velocity, pressure], dim=1)

    @staticmethod
    def _around(image: Tensor) -> Tensor:
        """Mean over the window around each pixel."""
        from torch.nn import functional

        return functional.avg_pool2d(image, WINDOW, stride=1, padding=WINDOW // 2)
