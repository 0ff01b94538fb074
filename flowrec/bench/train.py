"""`flowrec bench train`: weights for the networks, from vessels drawn at random and our own solver.

Both kinds learn a correction of the assumed field from the observations; `pi_unet` also that mass is conserved and how
sure it may be, `unet`, the data-driven baseline, from examples alone. The same seed, lessons and machine give the same
weights.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from flowrec.bench.lessons import Lesson, prepare, read_lessons
from flowrec.errors import UsageError
from flowrec.refine.case import Case
from flowrec.refine.observation_operator import sight
from flowrec.refine.torch_run import Device, torch_run
from flowrec.system.outputs import WEIGHTS, check_output
from flowrec.terminal import progress, table

if TYPE_CHECKING:
    from torch import Tensor

    from flowrec.refine.network import UNet
    from flowrec.refine.network_inputs import Scene

SIDES = (4, 16)  # of the blocks whose balance of mass counts, px
JUDGES = 64  # lessons kept apart, at most a fourth


@dataclass(frozen=True, slots=True)
class Training:
    """How a network is trained."""

    kind: Literal["pi_unet", "unet"] = "pi_unet"
    lessons: int = 3000
    steps: int = 12000
    batch: int = 4
    learning_rate: float = 2e-3
    weight_decay: float = 0.01
    averaged: float = 0.998  # the weights are a running mean of this memory
    judged_every: int = 500
    device: Device = "cpu"
    seed: int = 0


def train(
    folder: Path,
    out: Path,
    training: Training = Training(),
    say: Callable[[int, float, float], None] | None = None,
    *,
    overwrite: bool = False,
) -> dict[str, Any]:
    """Train on the lessons in `folder`, made where they are missing, and write the best weights to `out`.

    `say` is told the step, the loss and the error on the lessons kept apart. The figures returned hold them all.

    Raises
    ------
    UsageError
        If there are too few lessons to keep some apart.
    OutputError
        If `out` may not be written; what is there is replaced with `overwrite` only.
    """
    check_output(out, WEIGHTS, overwrite=overwrite)
    if training.lessons < 4:
        raise UsageError(f"bench train: {training.lessons} lessons are too few; give at least 4")
    paths = []
    with progress("making lessons", training.lessons) as done:
        for path in prepare(folder, training.lessons, training.seed):
            paths.append(path)
            done(len(paths))
    apart = min(JUDGES, training.lessons // 4)
    lessons, judges = read_lessons(paths[:-apart]), read_lessons(paths[-apart:])
    with torch_run(training.device, 1, training.seed, "--device"):
        return _descend(lessons, judges, out, training, say)


def _descend(
    lessons: list[Lesson],
    judges: list[Lesson],
    out: Path,
    training: Training,
    say: Callable[[int, float, float], None] | None,
) -> dict[str, Any]:
    """AdamW with a cosine, a running mean of the weights, judged now and then."""
    import torch

    from flowrec.refine.network import trained_network
    from flowrec.refine.weights import write_weights

    device = training.device
    net = trained_network().to(device, memory_format=torch.channels_last)  # type: ignore[call-overload]
    mean = trained_network().to(device, memory_format=torch.channels_last)  # type: ignore[call-overload]
    mean.load_state_dict(net.state_dict())
    optimiser = torch.optim.AdamW(net.parameters(), lr=training.learning_rate, weight_decay=training.weight_decay)
    warm = max(1, min(300, training.steps // 10))
    schedule = torch.optim.lr_scheduler.LambdaLR(
        optimiser,
        lambda i: min(1.0, (i + 1) / warm) * (0.01 + 0.99 * 0.5 * (1.0 + math.cos(math.pi * i / training.steps))),
    )
    exam = list(_batches(judges, Training(training.kind, batch=training.batch, device=device), examined=True))
    figures: dict[str, Any] = {"loss": [], "error": [], "steps": [], "before": _examine(None, exam)}
    best, total, since, began = math.inf, 0.0, 0, time.process_time()
    batches = _batches(lessons, training)
    for step in range(1, training.steps + 1):
        scene, velocity, pressure = next(batches)
        loss = _loss(net, scene, velocity, pressure, training)
        optimiser.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        torch.nn.utils.clip_grad_norm_(net.parameters(), 1.0)
        optimiser.step()
        schedule.step()
        with torch.no_grad():
            memory = min(training.averaged, step / (step + 10.0))
            for slow, quick in zip(mean.parameters(), net.parameters(), strict=True):
                slow.lerp_(quick, 1.0 - memory)
        total, since = total + float(loss.detach()), since + 1
        if step % training.judged_every == 0 or step == training.steps:
            error = _examine(mean, exam)
            for name, value in (("steps", step), ("loss", total / since), ("error", error)):
                figures[name].append(value)
            if say is not None:
                say(step, total / since, error)
            total, since = 0.0, 0
            if error < best:
                best = error
                facts = {"kind": training.kind, "steps": str(step), "error": f"{error:.4f}", "seed": str(training.seed)}
                write_weights(out, mean, facts | {"lessons": str(training.lessons)})
    return figures | {"best": best, "cpu_s": time.process_time() - began}


def show(figures: dict[str, Any]) -> None:
    """Print how the error fell on the lessons kept apart."""
    rows = [("0", "", f"{figures['before']:.4f}")]
    for step, loss, error in zip(figures["steps"], figures["loss"], figures["error"], strict=True):
        rows.append((str(step), f"{loss:.4f}", f"{error:.4f}"))
    table(f"Mean relative RMSE of v on lessons kept apart; {figures['cpu_s']:.0f} s", ("step", "loss", "error"), rows)


def _batches(
    lessons: list[Lesson], training: Training, examined: bool = False
) -> Iterator[tuple[Scene, Tensor, Tensor]]:
    """Scenes with true velocity and pressure in their units; `examined`, each lesson once, else forever, turned."""
    import torch

    from flowrec.refine.network_inputs import Scene, turn

    rng = np.random.default_rng([training.seed, 0xBA7C])
    order = np.arange(len(lessons))
    while True:
        if not examined:
            rng.shuffle(order)
        for first in range(0, len(order), training.batch):
            cases, true = [], []
            for index in order[first : first + training.batch]:
                lesson = lessons[index]
                chip = lesson.chip
                seen = sight(lesson.observe(rng), chip.mask, chip.um_per_px)
                case = Case.of(lesson.assumed, seen, chip, cropped=False)
                cases.append(case)
                units = [lesson.velocity_um_s / case.speed, lesson.pressure_pa[..., None] / case.unit_pressure]
                true.append(np.moveaxis(case.box.part(np.concatenate(units, axis=2)), -1, 0).astype(np.float32))
            scene, truth = Scene.of(cases, device=training.device), torch.from_numpy(np.stack(true)).to(training.device)
            velocity, pressure = truth[:, :2], truth[:, 2:]
            if not examined:
                quarters, mirrored = int(rng.integers(4)), bool(rng.integers(2))
                scene = scene.turned(quarters, mirrored)
                velocity, pressure = (turn(image, quarters, mirrored) for image in (velocity, pressure))
            yield scene, velocity, pressure
        if examined:
            return


def _predict(net: UNet, scene: Scene) -> tuple[Tensor, Tensor, Tensor]:
    """Velocity, pressure and the network's output."""
    output = net(scene.told())
    return *scene.correct(output), output


def _loss(net: UNet, scene: Scene, velocity: Tensor, pressure: Tensor, training: Training) -> Tensor:
    """Relative errors of velocity and pressure; for `pi_unet` also the unlikelihood of its error bars, and physics."""
    from flowrec.refine.residuals import Physics, balances

    v, p, output = _predict(net, scene)
    error = _error(v, velocity)
    loss = error.mean() + 0.1 * _error(p, pressure).mean()
    if training.kind == "unet":
        return loss
    std = scene.std(output).clamp(min=1e-5)
    # The network learns to doubt its velocity, not to move it where doubt is cheap.
    miss = ((v.detach() - velocity) ** 2).sum(dim=1, keepdim=True)
    unlikely = (2.0 * std.log() + 0.5 * miss / std**2) * scene.fluid
    physics = Physics.of(scene.fluid, scene.inside, scene.reynolds, scene.friction)
    surplus = physics.residuals(v, p)[:, :1] - physics.residuals(scene.velocity, scene.pressure)[:, :1]
    share = (balances(surplus, SIDES) / (velocity**2).sum(dim=(1, 2, 3)) + 1e-6).sqrt()
    return loss + 0.003 * unlikely.sum() / scene.fluid.sum() + 0.02 * share.mean()


def _error(field: Tensor, true: Tensor) -> Tensor:
    """(n,) relative RMSE."""
    miss, size = ((image**2).sum(dim=(1, 2, 3)) for image in (field - true, true))
    return (miss / size.clamp(min=1e-12) + 1e-6).sqrt()


def _examine(net: UNet | None, exam: list[tuple[Scene, Tensor, Tensor]]) -> float:
    """Mean relative RMSE of the velocity; of the assumed field without a network."""
    import torch

    with torch.no_grad():
        errors = [
            _error(scene.velocity if net is None else _predict(net, scene)[0], velocity) for scene, velocity, _ in exam
        ]
    return float(torch.cat(errors).mean())
