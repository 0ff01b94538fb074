"""PI-UNet (the paper): a U-Net corrects an initial field so that physics and observations hold.

What differs from the print, and why (science.md, section 2): true operators in dimensionless form; the loss is the
residual of the field minus that of the initial field, since a field from the solver obeys finer equations and its
residual on pixels is truncation error; near-wall pixels keep the initial profile but not its amplitude, because a
wrong inlet makes them wrong in proportion. Weights trained on drawn vessels give a correction without iterations.
The last step balances physics, observations and boundary values directly (`balance`) and brings nearly all of the
gain: on 24 crops of real vessels the mean relative RMSE falls from 0.198 to 0.063 in 2 s a case. On eight of them, of
0.169, the trained network alone leaves 0.125 in 0.1 s, 80 iterations from random weights as printed 0.125 in 13 s, and
balancing 0.083 after the one and 0.084 after the other. With weights "none" and finish "none" it is the paper's.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray

from flowrec.chip.chip import Chip
from flowrec.messages import FlowField
from flowrec.ranges import Range, Seed, Threads, Weight
from flowrec.refine.case import Case
from flowrec.refine.data_misfit import doubt, misfit
from flowrec.refine.observation_operator import Floats, Sight
from flowrec.refine.torch_run import Device, torch_run
from flowrec.refine.weights import SHIPPED, sha256

HELD_OUT = 4  # every fourth observation judges whether a correction gained anything
FEWEST = 8  # observations of which some can be held out
WORTH_TAKING = 0.9  # of the start's misfit on what was held out, for a network's correction
# Share of a correction that is taken, up to so many standard deviations of chi2 above what noise alone gives.
TAKEN = ((1.0, 0.5), (2.0, 0.75))


@dataclass(frozen=True, slots=True)
class PiUnet:
    """Settings of the PI-UNet."""

    start: Literal["assimilate", "fvm"] = "assimilate"  # the initial field
    # Both of the next two are for the start "fvm": what remains of an assimilated field's misfit is no matter of
    # boundary values, which is what the weights have learned and the balance assumes.
    weights: Literal["vessels", "none"] = "vessels"  # trained on drawn vessels, or random ones as printed
    finish: Literal["balance", "none"] = "balance"  # with soft observations
    observations: Literal["soft", "hard"] = "soft"  # hard: the pixel takes the measured value, noise and all
    near_wall: Literal["scaled", "hard", "free"] = "scaled"  # hard: as printed, the initial values stay
    # None: 80 with random weights, none with trained ones
    iterations: Annotated[int, Range(0, 1_000_000)] | None = None
    # iterations times pixels in millions: larger fields get fewer iterations
    largest_work_mpx: Annotated[float, Range(1e-3, 1e6)] = 4.0
    patience: Annotated[int, Range(1, 1_000_000)] = 25  # iterations without a better loss before it stops
    learning_rate: Annotated[float, Range(1e-8, 1.0)] = 3e-3
    observation_weight: Weight = 0.03  # of the mean log-likelihood against the mean squared residual
    base_channels: Annotated[int, Range(1, 512)] = 16  # of the network with random weights
    device: Device = "cpu"
    # More than one only on idle cores: torch spins at its barriers, and on two shared cores two are ten times slower.
    threads: Threads = 1
    seed: Seed = 0

    @property
    def weights_sha256(self) -> str:
        """Hash of the trained weights that are used, '' where they are random."""
        return sha256(SHIPPED[self.weights]) if self.weights != "none" and self.start == "fvm" else ""

    def fit(self, initial: FlowField, sight: Sight, chip: Chip) -> FlowField:
        """The corrected field, or `initial` with a note where a correction would not be an improvement.

        A correction is found without every fourth observation first and must predict those better than `initial`;
        from the unrefined start it is then found anew with all. A start that has error bars has already used the
        observations: it is kept when they lie within their noise around it.

        Raises
        ------
        FlowError
            If the device is not there, or the weights can not be read.
        """
        assimilated = initial.std_um_s is not None
        if assimilated and (self.weights, self.finish) != ("none", "none"):
            # What remains of its misfit is no matter of boundary values.
            return replace(self, weights="none", finish="none").fit(initial, sight, chip)
        fastest = float(np.abs(initial.velocity_um_s).max())
        if fastest == 0.0:
            return self._kept(initial, "the initial field stands still")
        before = misfit(initial.velocity_um_s, sight)
        if assimilated and float(before.mean()) <= 2.0 + 4.0 / np.sqrt(sight.count):  # two standard deviations of chi2
            return self._kept(initial, f"the observations lie within their noise (chi2 {before.mean() / 2:.2f})")
        case = Case.of(initial, sight, chip)
        every = np.ones(sight.count, bool)
        used = np.arange(sight.count) % HELD_OUT != HELD_OUT // 2 if sight.count >= FEWEST else every
        judges = every if used.all() else ~used
        start = doubt(before[judges])
        found = self._corrections(case, used)
        scores = [doubt(misfit(velocity, sight)[judges]) for _, velocity, _ in found]
        # The balanced field where it predicts what it has not seen; the network's alone must do so clearly.
        bars = [WORTH_TAKING * start] + [(WORTH_TAKING if used.all() else 1.0) * start] * (len(scores) - 1)
        best = max((i for i in range(len(scores)) if scores[i] < bars[i]), default=-1)
        if best < 0:
            return self._kept(initial, "a correction did not predict the observations better")
        # An assimilated start has used all observations already; descending once more is not worth its time.
        said, velocity, pressure = (found if assimilated else self._corrections(case, every))[best]
        if not np.isfinite(velocity).all():
            return self._kept(initial, "a correction is not finite")
        std = initial.std_um_s
        # Where the start nearly explains the observations, much of what they ask for is their noise.
        over = (0.5 * float(before.mean()) - 1.0) * np.sqrt(sight.count)
        share = 1.0 if assimilated else next((part for most, part in TAKEN if over <= most), 1.0)
        velocity = initial.velocity_um_s + share * (velocity - initial.velocity_um_s)
        pressure = initial.pressure_pa + share * (pressure - initial.pressure_pa)
        if std is not None:
            # Where the correction moves the field, the start stays within the error bar.
            std = np.hypot(std, velocity - initial.velocity_um_s).astype(np.float32)
        after = misfit(velocity, sight)
        said += "" if share == 1.0 else f", {share:.0%} of it"
        return replace(
            initial,
            method="pi_unet",
            velocity_um_s=velocity.astype(np.float32),
            pressure_pa=pressure.astype(np.float32),
            std_um_s=std,
            note=f"{said}; misfit of the observations (chi2) {before.mean() / 2:.2f} to "
            f"{after.mean() / 2:.2f}" + f"; start: {_said(initial)}",
        )

    @staticmethod
    def _kept(initial: FlowField, why: str) -> FlowField:
        """The start as it is, and why."""
        return replace(initial, method="pi_unet", note=f"start kept, {why}; start: {_said(initial)}")

    def _corrections(self, case: Case, used: NDArray[np.bool_]) -> list[tuple[str, Floats, Floats]]:
        """What was done, velocity (h, w, 2) in um/s and pressure (h, w) in Pa: the network's field, and its finish."""
        from flowrec.refine.gauss_newton import LARGEST_PX, balance
        from flowrec.refine.network_fit import descend

        weights = f"weights {self.weights_sha256[:8]}" if self.weights_sha256 else "random weights"
        with torch_run(self.device, self.threads, self.seed, "refine.pi_unet.device"):
            steps, velocity, pressure = descend(case, used, self)
            said = f"corrected by {weights}" + (f" in {steps} iterations" if steps else "")
            found = [(said, velocity, pressure)]
            if self.finish == "balance" and self.observations == "soft" and int(case.fluid.sum()) <= LARGEST_PX:
                found.append((f"{said} and balanced", *balance(case, used, velocity)))
        return [
            (
                said,
                case.whole(np.moveaxis(velocity, -1, 0) * case.speed),
                case.whole(pressure[None] * case.unit_pressure)[..., 0],
            )
            for said, velocity, pressure in found
        ]


def _said(initial: FlowField) -> str:
    """What is known of the initial field; an assimilation says itself what it is."""
    return initial.note if initial.method in initial.note else f"{initial.method}, {initial.note}".rstrip(", ")
