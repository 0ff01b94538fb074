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

from flowrec.chip.chip import Chip
from flowrec.errors import FlowError
from flowrec.messages import FlowField
from flowrec.refine.case import Case
from flowrec.refine.judge import TAIL, doubt, misfit
from flowrec.refine.sight import Floats, Sight

if TYPE_CHECKING:
    from torch import Tensor

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
        before = misfit(initial.velocity_um_s, sight)
        used = np.ones(sight.count, bool)
        if initial.std_um_s is not None:
            if float(before.mean()) <= 2.0 + 4.0 / np.sqrt(sight.count):  # two standard deviations of chi2
                return self._kept(initial, f"the observations lie within their noise (chi2 {before.mean() / 2:.2f})")
            used = np.arange(sight.count) % HELD_OUT != HELD_OUT // 2
        case = Case.of(initial, sight, chip)
        steps, velocity, pressure = self._descend(case, used)
        after = misfit(velocity, sight)
        judges = before > -1.0 if used.all() else ~used
        if not np.isfinite(velocity).all() or doubt(after[judges]) > WORTH_TAKING * doubt(before[judges]):
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

    def _descend(self, case: Case, used: NDArray[np.bool_]) -> tuple[int, Floats, Floats]:
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
            seen = loss_of.scene.printed().contiguous(memory_format=torch.channels_last)
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


class _Loss:
    """From the network's output to a constrained field and its loss; all tensors of a case on the device."""

    def __init__(self, case: Case, used: NDArray[np.bool_], settings: PiUnet) -> None:
        import torch

        from flowrec.refine.physics import Physics
        from flowrec.refine.scene import Scene

        def tensor(array: NDArray[Any]) -> Tensor:
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
        import torch

        velocity, pressure = self.scene.correct(output, self.settings.near_wall)
        if self.settings.observations == "hard":
            velocity = velocity * (1.0 - self.pinned) + self.given * self.pinned
        residual = self.physics.residuals(velocity, pressure) - self.truncation
        loss = (residual**2).sum() / self.norm
        field = velocity[0][:, self.rows, self.columns]  # (2, n, 4)
        misfits = ((((field * self.weights).sum(dim=-1).T - self.flow) / self.noise) ** 2).sum(dim=1)
        likelihood = 0.5 * (TAIL + 2.0) * torch.log1p(misfits / TAIL).mean()
        return loss + 2.0 * self.settings.observation_weight * likelihood, torch.cat([velocity, pressure], dim=1)
