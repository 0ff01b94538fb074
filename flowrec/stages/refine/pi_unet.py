"""PI-UNet (the paper): a U-Net corrects an initial field so that physics and observations hold.

Differences from the paper, and why: the operators are the true ones in dimensionless form. The loss is the residual of
the field minus that of the initial field, because a field from the solver satisfies finer equations and its residual on
pixels is truncation error. Pixels at walls keep the initial profile but not its amplitude, because a wrong inlet makes
them wrong in proportion. Where boundary values can not explain the observations, partly blocked channels are tried
first (obstacles.py). Weights trained on drawn vessels give a correction without iterations. The last step balances
physics, observations and boundary values directly (gauss_newton) and gives nearly all of the improvement: on 24 crops
of real vessels the mean relative RMSE falls from 0.198 to 0.063 in 2 s a case. On eight of them, with 0.169 before, the
trained network alone leaves 0.125 in 0.1 s, 80 iterations from random weights as in the paper 0.125 in 13 s, and
balancing 0.083 after the one and 0.084 after the other. With weights "none" and finish "none" it is the paper's method.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated, Literal

import numpy as np

from flowrec.core import Floats, FlowField, Range
from flowrec.stages.refine.case import Case
from flowrec.stages.refine.method import RefinementProblem
from flowrec.stages.refine.network_fit import FieldLoss, NetworkFit, NetworkSettings, fit_network, torch_run
from flowrec.stages.refine.observation_operator import student_t_loss
from flowrec.stages.refine.weights import SHIPPED, read_weights, sha256

HELD_OUT = 4  # every fourth observation tests whether a correction is an improvement
FEWEST = 8  # observations of which some can be held out
WORTH_TAKING = 0.9  # of the initial loss of the held-out observations, for a network's correction
# Fraction of a correction that is taken where chi2 is at most this many standard deviations above that of noise alone.
DAMPED = ((1.0, 0.5), (2.0, 0.75))
COLD_ITERATIONS = 80  # from random weights
TRAINED_RATE = 0.1  # learning rate from trained weights, of that from random ones


@dataclass(frozen=True, slots=True, eq=False)
class Correction:
    """Another field instead of the initial one."""

    words: str  # how it was found
    velocity_um_s: Floats  # (h, w, 2)
    pressure_pa: Floats  # (h, w)
    std_um_s: Floats | None = None  # (h, w, 2)


@dataclass(frozen=True, slots=True)
class PiUnet(NetworkSettings):
    """Settings of the PI-UNet."""

    start: Literal["assimilate", "fvm"] = "assimilate"  # initial field
    obstacles: bool = True  # channels may be partly blocked; of the start "assimilate" only
    # The next two apply to the start "fvm". What remains of an assimilated field's misfit is not explained by boundary
    # values, which is what the weights have learned and the balance assumes.
    weights: Literal["vessels", "none"] = "vessels"  # trained on drawn vessels, or random ones as in the paper
    # balance: with soft observations, physics, observations and boundary values are balanced directly, from the
    # network's field; none: the field is the network's
    finish: Literal["balance", "none"] = "balance"
    # pixels next to a wall: scaled with the flow around them; hard, as in the paper, their initial values stay; free
    near_wall: Literal["scaled", "hard", "free"] = "scaled"
    # iterations of the training; None: 80 with random weights, none with trained ones
    iterations: Annotated[int, Range(0, 1_000_000)] | None = None

    @property
    def weights_sha256(self) -> str:
        """Hash of the trained weights that are used, '' where they are random."""
        return sha256(SHIPPED[self.weights]) if self.weights != "none" and self.start == "fvm" else ""

    def fit(self, problem: RefinementProblem) -> FlowField:
        """The corrected field, or the initial one with a note where a correction would not be an improvement.

        A correction is first computed without every fourth observation and must predict those better than the initial
        field does; from the unrefined start it is then computed again with all. A start with error bars has used the
        observations already: it is kept when they lie within their noise around it, and a correction follows what the
        start does not explain by robot, registration or pump.

        Raises
        ------
        FlowError
            If the device is not available, or the weights can not be read.
        """
        initial, operator = problem.assumed, problem.operator
        if self.start == "assimilate":
            initial, operator = problem.assimilated(self.obstacles)
        assimilated = initial.std_um_s is not None
        if not initial.velocity_um_s.any():
            return _keep_initial(initial, "the initial field stands still")
        before = operator.misfit(initial.velocity_um_s)
        chi2 = float(before.mean()) / 2.0
        # Two standard deviations of chi2.
        if assimilated and float(before.mean()) <= 2.0 + 4.0 / np.sqrt(operator.count):
            return _keep_initial(
                initial, f"nothing to correct: the observations lie within their noise (chi2 {chi2:.2f})"
            )
        settings = replace(self, weights="none", finish="none") if assimilated else self
        case = Case.of(initial, operator, problem.chip)
        used = np.ones(operator.count, bool)
        if operator.count >= FEWEST:
            used[HELD_OUT // 2 :: HELD_OUT] = False
        test = used if used.all() else ~used
        before_loss = student_t_loss(before[test])
        found = settings.corrections(case.only(used))
        losses = [student_t_loss(operator.misfit(each.velocity_um_s)[test]) for each in found]
        # The balanced field must predict the held-out observations better, the network's alone clearly better.
        limits = [WORTH_TAKING * before_loss, (WORTH_TAKING if used.all() else 1.0) * before_loss]
        better = [index for index, loss in enumerate(losses) if loss < limits[index]]
        if not better:
            return _keep_initial(initial, "a correction did not predict the observations better")
        # An assimilated start has used all observations already; a second fit is not worth its time.
        chosen = (found if assimilated else settings.corrections(case))[better[-1]]
        words = chosen.words
        if not np.isfinite(chosen.velocity_um_s).all():
            return _keep_initial(initial, "a correction is not finite")
        # Where the start nearly explains the observations, much of what the correction follows is their noise.
        excess = (chi2 - 1.0) * np.sqrt(operator.count)
        fraction = 1.0 if assimilated else next((part for most, part in DAMPED if excess <= most), 1.0)
        change = chosen.velocity_um_s - initial.velocity_um_s
        velocity = initial.velocity_um_s + fraction * change
        pressure = initial.pressure_pa + fraction * (chosen.pressure_pa - initial.pressure_pa)
        std, error_share = initial.std_um_s, initial.error_share
        if std is not None:
            # Where the correction changes the field, the start stays within the error bar.
            std = np.hypot(std, velocity - initial.velocity_um_s).astype(np.float32)
        elif chosen.std_um_s is not None:
            std = np.hypot(fraction * chosen.std_um_s, (1.0 - fraction) * change).astype(np.float32)
        if std is not None:
            power = float((velocity.astype(np.float64) ** 2).sum())
            error_share = float(np.sqrt((std.astype(np.float64) ** 2).sum() / max(power, 1e-300)))
        after = float(operator.misfit(velocity).mean()) / 2.0
        words += "" if fraction == 1.0 else f", {fraction:.0%} of it"
        return replace(
            initial,
            method="pi_unet",
            velocity_um_s=velocity.astype(np.float32),
            pressure_pa=pressure.astype(np.float32),
            std_um_s=std,
            error_share=error_share,
            note=f"{words}; misfit of the observations (chi2) {chi2:.2f} to {after:.2f}; start: {_origin(initial)}",
        )

    def corrections(self, case: Case) -> list[Correction]:
        """The network's field, and the balanced one with its standard deviation.

        The second is left out where it is not requested, or the case is too large.
        """
        from flowrec.stages.refine.gauss_newton import LARGEST_PX, balance

        weights = f"weights {self.weights_sha256[:8]}" if self.weights_sha256 else "random weights"
        with torch_run(self.device, self.threads, self.seed, "refine.pi_unet.device"):
            fitted = self._fit_network(case)
            words = f"corrected by {weights}" + (f" in {fitted.iterations} iterations" if fitted.iterations else "")
            found = [Correction(words, *case.dimensional(fitted.velocity, fitted.pressure))]
            if self.finish == "balance" and self.observations == "soft" and int(case.fluid.sum()) <= LARGEST_PX:
                velocity, pressure, std = balance(case, fitted.velocity)
                field = case.dimensional(velocity, pressure)
                found.append(Correction(f"{words} and balanced", *field, case.dimensional(std, pressure)[0]))
        return found

    def _fit_network(self, case: Case) -> NetworkFit:
        import torch

        from flowrec.stages.refine.network import UNet, trained_network
        from flowrec.stages.refine.network_inputs import NetworkInputs

        inputs = NetworkInputs.of([case], self.device)
        loss_of = FieldLoss(inputs, case, self, lambda output: inputs.correct(output, self.near_wall))
        if self.weights == "vessels":
            net = trained_network()
            read_weights(SHIPPED["vessels"], net)
            rate = self.learning_rate * TRAINED_RATE
            return fit_network(net, inputs.with_observations(), loss_of, self.iterations or 0, rate)
        start = torch.cat([inputs.velocity, inputs.pressure], dim=1)
        steps = COLD_ITERATIONS if self.iterations is None else self.iterations
        return fit_network(UNet(self.base_channels), inputs.of_paper(), loss_of, steps, self.learning_rate, start)


def _keep_initial(initial: FlowField, why: str) -> FlowField:
    """The initial field as it is, and why."""
    return replace(initial, method="pi_unet", note=f"start kept, {why}; start: {_origin(initial)}")


def _origin(initial: FlowField) -> str:
    """Method and note of the initial field; the note of an assimilation names its method."""
    return initial.note if initial.method in initial.note else f"{initial.method}, {initial.note}".rstrip(", ")
