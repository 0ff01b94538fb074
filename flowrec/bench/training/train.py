"""Trains the weights of the networks on random vessel networks; the truth comes from flowrec's own solver.

Both networks learn a correction of the assumed field from the observations. The loss of `pi_unet` also has the balance
of mass and the likelihood of its error bars; that of `unet`, the data-driven baseline, has the true fields only. The
same seed, lessons and machine give the same weights.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from flowrec.bench.training.lessons import Lesson, prepare, read_lesson
from flowrec.core import WEIGHTS, Output, UsageError
from flowrec.stages import Case, Device, torch_run

if TYPE_CHECKING:
    from torch import Tensor

    from flowrec.stages import NetworkInputs, UNet

SIDES = (4, 16)  # of the blocks in which mass must balance, px
VALIDATION_LESSONS = 64  # at most a fourth of all lessons


@dataclass(frozen=True, slots=True)
class Training:
    """Settings of the training of a network."""

    kind: Literal["pi_unet", "unet"] = "pi_unet"
    lessons: int = 1800
    steps: int = 4500
    batch: int = 4
    learning_rate: float = 2e-3
    weight_decay: float = 0.01
    average_decay: float = 0.998  # of the exponential moving average of the weights
    validate_every: int = 500
    device: Device = "cpu"
    seed: int = 0


def train(
    folder: Path,
    out: Path,
    training: Training = Training(),
    report: Callable[[str], None] = lambda _: None,
    *,
    overwrite: bool = False,
) -> dict[str, Any]:
    """Train on the lessons in `folder`, which are made if missing, and write the best weights to `out`.

    Returns the steps, training losses and validation errors (mean relative RMSE of the velocity), the error before the
    refinement (`before`), the least one (`best`) and the CPU time in s. `report` is called with a line of text at each
    validation.

    Raises
    ------
    UsageError
        If there are fewer than four lessons.
    OutputError
        If `out` may not be written; an existing file is replaced with `overwrite` only.
    """
    Output(out, WEIGHTS, overwrite=overwrite).check()
    if training.lessons < 4:
        raise UsageError(f"training: {training.lessons} lessons are too few; give at least 4")
    lessons = []
    for path in prepare(folder, training.lessons, training.seed):
        lessons.append(read_lesson(path))
        if len(lessons) % 100 == 0:
            report(f"{len(lessons)} of {training.lessons} lessons")
    first = len(lessons) - min(VALIDATION_LESSONS, len(lessons) // 4)
    with torch_run(training.device, 1, training.seed, "--device"):
        return _optimise(lessons[:first], lessons[first:], out, training, report)


def _optimise(
    lessons: list[Lesson], validation: list[Lesson], out: Path, training: Training, report: Callable[[str], None]
) -> dict[str, Any]:
    """AdamW with a cosine schedule; the moving average of the weights is validated and written."""
    import torch

    from flowrec.stages import trained_network, write_weights

    net, mean = (trained_network().to(training.device, memory_format=torch.channels_last) for _ in range(2))  # type: ignore[call-overload]
    mean.load_state_dict(net.state_dict())
    optimiser = torch.optim.AdamW(net.parameters(), lr=training.learning_rate, weight_decay=training.weight_decay)
    warm = max(1, min(300, training.steps // 10))
    schedule = torch.optim.lr_scheduler.LambdaLR(
        optimiser,
        lambda i: min(1.0, (i + 1) / warm) * (0.01 + 0.99 * 0.5 * (1.0 + math.cos(math.pi * i / training.steps))),
    )
    exam = list(_validation_batches(validation, training))
    figures: dict[str, Any] = {"loss": [], "error": [], "steps": [], "before": _validation_error(None, exam)}
    report(f"step 0: error {figures['before']:.4f}")
    best, losses, began = math.inf, [], time.process_time()
    batches = _training_batches(lessons, training)
    for step in range(1, training.steps + 1):
        loss = _loss(net, *next(batches), training)
        optimiser.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        torch.nn.utils.clip_grad_norm_(net.parameters(), 1.0)
        optimiser.step()
        schedule.step()
        with torch.no_grad():
            decay = min(training.average_decay, step / (step + 10.0))
            for slow, quick in zip(mean.parameters(), net.parameters(), strict=True):
                slow.lerp_(quick, 1.0 - decay)
        losses.append(float(loss.detach()))
        if step % training.validate_every == 0 or step == training.steps:
            error = _validation_error(mean, exam)
            for name, value in (("steps", step), ("loss", sum(losses) / len(losses)), ("error", error)):
                figures[name].append(value)
            report(f"step {step}: loss {figures['loss'][-1]:.4f}, error {error:.4f}")
            losses = []
            if error < best:
                best = error
                facts = {"kind": training.kind, "steps": str(step), "error": f"{error:.4f}", "seed": str(training.seed)}
                write_weights(out, mean, facts | {"lessons": str(training.lessons)})
    return figures | {"best": best, "cpu_s": time.process_time() - began}


def _batch(lessons: list[Lesson], rng: np.random.Generator, training: Training) -> tuple[NetworkInputs, Tensor]:
    """The inputs of some lessons, and their true velocity and pressure (n, 3, h, w) in the units of the inputs."""
    import torch

    from flowrec.stages import NetworkInputs

    cases, truths = [], []
    for lesson in lessons:
        seen = lesson.operator(rng)
        case = Case.of(lesson.assumed, seen, lesson.chip, cropped=False)
        cases.append(case)
        truth = [lesson.velocity_um_s / case.speed, lesson.pressure_pa[..., None] / case.unit_pressure]
        truths.append(np.moveaxis(case.crop.part(np.concatenate(truth, axis=2)), -1, 0).astype(np.float32))
    return NetworkInputs.of(cases, device=training.device), torch.from_numpy(np.stack(truths)).to(training.device)


def _training_batches(lessons: list[Lesson], training: Training) -> Iterator[tuple[NetworkInputs, Tensor]]:
    """Batches in random order and random orientation, without end."""
    import torch

    rng = np.random.default_rng([training.seed, 0xBA7C])
    order = np.arange(len(lessons))
    while True:
        rng.shuffle(order)
        for first in range(0, len(order), training.batch):
            inputs, truth = _batch([lessons[i] for i in order[first : first + training.batch]], rng, training)
            turned = int(rng.integers(4)), bool(rng.integers(2))  # quarter turns, mirrored
            truth = torch.cat([turn(truth[:, :2], *turned), turn(truth[:, 2:], *turned)], dim=1)
            yield turn_inputs(inputs, *turned), truth


def _validation_batches(lessons: list[Lesson], training: Training) -> Iterator[tuple[NetworkInputs, Tensor]]:
    """Each lesson once; the same observations whatever the seed of the training is."""
    rng = np.random.default_rng([0, 0xBA7C])
    for first in range(0, len(lessons), training.batch):
        yield _batch(lessons[first : first + training.batch], rng, training)


def _predict(net: UNet, inputs: NetworkInputs) -> tuple[Tensor, Tensor, Tensor]:
    """Velocity, pressure and the network's output."""
    output = net(inputs.with_observations())
    return *inputs.correct(output), output


def _loss(net: UNet, inputs: NetworkInputs, truth: Tensor, training: Training) -> Tensor:
    """Relative errors of velocity and pressure; for `pi_unet` also negative log-likelihood and balance of mass."""
    from flowrec.stages import Physics

    velocity, pressure = truth[:, :2], truth[:, 2:]
    v, p, output = _predict(net, inputs)
    error = _error(v, velocity)
    loss = error.mean() + 0.1 * _error(p, pressure).mean()
    if training.kind == "unet":
        return loss
    std = output_std(inputs, output).clamp(min=1e-5)
    # Detached: the likelihood trains the error bars only, or it would move the velocity to where errors are likely.
    miss = ((v.detach() - velocity) ** 2).sum(dim=1, keepdim=True)
    unlikely = (2.0 * std.log() + 0.5 * miss / std**2) * inputs.fluid
    physics = Physics.of(inputs.fluid, inputs.inside, inputs.reynolds, inputs.friction)
    surplus = physics.residuals(v, p)[:, :1] - physics.residuals(inputs.velocity, inputs.pressure)[:, :1]
    imbalance = (balances(surplus, SIDES) / (velocity**2).sum(dim=(1, 2, 3)) + 1e-6).sqrt()
    return loss + 0.003 * unlikely.sum() / inputs.fluid.sum() + 0.02 * imbalance.mean()


def output_std(inputs: NetworkInputs, output: Tensor) -> Tensor:
    """(n, 1, h, w) standard deviation of each component, from a network's output (n, 5, h, w)."""
    from flowrec.stages import LEAST_SPEED, LOG_STD

    return (output[:, LOG_STD].clamp(-6.0, 2.0) - 2.0).exp() * (inputs.local_rms + LEAST_SPEED) * inputs.fluid


def turn_inputs(inputs: NetworkInputs, quarters: int, mirrored: bool) -> NetworkInputs:
    """Transform the cases by one of the eight symmetries of a square."""
    images = {f.name: turn(getattr(inputs, f.name), quarters, mirrored) for f in fields(inputs)}
    return replace(inputs, **images)


def turn(image: Tensor, quarters: int, mirrored: bool) -> Tensor:
    """(n, c, h, w) turned by quarters, then mirrored left to right; two channels are a vector (x, y)."""
    import torch

    if image.shape[-1] == 1:
        return image
    vector = image.shape[1] == 2
    for _ in range(quarters % 4):
        image = torch.rot90(image, 1, (2, 3))  # a vector to the right (x) now points up (-y)
        if vector:
            image = torch.stack([image[:, 1], -image[:, 0]], dim=1)
    if mirrored:
        image = image.flip(3)
        if vector:
            image = image * torch.tensor([-1.0, 1.0]).to(image)[None, :, None, None]
    return image


def balances(residual: Tensor, sides: Sequence[int]) -> Tensor:
    """(n,) sum of the squared sums of residuals (n, c, h, w) over blocks of several sides that overlap by half.

    The sum of the divergence over a block is the flux through its sides, so a branch that carries more than enters it
    counts the same wherever along it the surplus appears. On single pixels a slow change of the flux is hardly visible.
    """
    from torch.nn import functional

    total = (residual**2).sum(dim=(1, 2, 3))
    for side in sides:
        if side > max(residual.shape[-2:]):
            break
        blocks = functional.avg_pool2d(residual, side, max(side // 2, 1), side // 2) * float(side * side)
        total = total + (blocks**2).sum(dim=(1, 2, 3)) / 4.0  # each pixel is in four blocks
    return total


def _error(field: Tensor, true: Tensor) -> Tensor:
    """(n,) relative RMSE."""
    miss, size = ((image**2).sum(dim=(1, 2, 3)) for image in (field - true, true))
    return (miss / size.clamp(min=1e-12) + 1e-6).sqrt()


def _validation_error(net: UNet | None, exam: list[tuple[NetworkInputs, Tensor]]) -> float:
    """Mean relative RMSE of the velocity; of the assumed field if there is no network."""
    import torch

    with torch.no_grad():
        fields = [
            (inputs.velocity if net is None else _predict(net, inputs)[0], truth[:, :2]) for inputs, truth in exam
        ]
        return float(torch.cat([_error(*pair) for pair in fields]).mean())
