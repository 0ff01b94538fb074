"""Assimilation: the boundary values that explain the observations best, and how sure that makes the field.

The parameters are the boundary values and ln mu, with a Gaussian prior around the assumed ones. The field is linear
in them (Stokes) or nearly so, so Gauss-Newton around the Navier-Stokes solution finds the most probable ones, and the
curvature there is their posterior covariance (science.md, section 2).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import uniform_filter

from flowrec.chip.chip import Chip
from flowrec.errors import FlowError
from flowrec.flow import FlowModes, FlowSolver
from flowrec.messages import FlowField
from flowrec.refine.sight import Floats, Sight

FLOOR = 0.01  # of the fastest speed: nothing is known better than that share times model_error_share
UNSEEN = 0.9  # share of the prior std above which an opening counts as not seen


@dataclass(frozen=True, slots=True)
class Assimilate:
    """Settings of the assimilation. Prior widths are one standard deviation."""

    inlet_std_share: float = 0.25  # of the assumed inlet speed
    outlet_std_share: float = 0.10  # of the largest assumed |pressure|
    viscosity_std_share: float = 0.20  # of the assumed viscosity
    model_error_share: float = 0.03  # of the flow speed: what a perfect set of parameters would leave
    tail: float = 4.0  # degrees of freedom of the Student-t noise: small doubts outliers more
    max_iterations: int = 6  # linearisations
    tolerance: float = 1e-2  # largest last step, in prior standard deviations

    def fit(self, assumed: FlowField, sight: Sight, chip: Chip, solver: FlowSolver) -> FlowField:
        """Posterior mean field with its standard deviation, boundary values and viscosity.

        Raises
        ------
        FlowError
            If the flow of the fitted parameters can not be computed.
        """
        prior = self._prior_std(assumed, chip)
        mean = np.append(chip.boundary_values, 0.0)
        theta = mean.copy()
        for _ in range(self.max_iterations):
            modes = solver.linearised(_with(chip, theta))
            jacobian = _jacobian(modes)
            target, covariance = self._posterior(modes.base, jacobian, sight, theta, mean, prior)
            step = target - theta
            theta = theta + step
            if float(np.abs(step / prior).max()) <= self.tolerance:
                break
        field = solver.solve(_with(chip, theta))
        spread = np.linalg.cholesky(covariance + 1e-18 * np.diag(prior**2))
        by_draw = np.tensordot(spread.T, jacobian, axes=1)
        model = self.model_error_share * _speed_around(field, chip)
        std = np.sqrt((by_draw**2).sum(axis=0) + model[..., None] ** 2) * chip.mask[..., None]
        return replace(
            field,
            stamp_ns=assumed.stamp_ns,
            request=assumed.request,
            method="assimilate",
            std_um_s=std,
            note=_note(chip, sight, np.sqrt(np.diag(covariance)), prior),
        )

    def _prior_std(self, assumed: FlowField, chip: Chip) -> Floats:
        """(openings + 1,) in um/s, Pa, and of ln mu."""
        speeds = [abs(opening.value) for opening in chip.openings if opening.kind == "inlet"]
        fastest = max(speeds, default=0.0)
        pressure = float(np.abs(assumed.pressure_pa).max())
        std = [
            # A closed inlet is no more certain than an open one.
            self.inlet_std_share * (abs(opening.value) or fastest)
            if opening.kind == "inlet"
            else self.outlet_std_share * pressure
            for opening in chip.openings
        ]
        if min(std) <= 0.0:
            raise FlowError(
                f"chip '{chip.name}' is assumed to stand still, so nothing says how wrong that may be: "
                "give an inlet speed or an outlet pressure of the right size"
            )
        return np.array([*std, self.viscosity_std_share])

    def _posterior(
        self, base: FlowField, jacobian: Floats, sight: Sight, theta: Floats, mean: Floats, prior: Floats
    ) -> tuple[Floats, Floats]:
        """Most probable parameters and their covariance for a field that is linear around theta.

        Student-t noise by iterated weights: an observation far outside its std counts less.
        """
        predicted = sight.of(base.velocity_um_s)
        design = sight.of(jacobian) * prior[:, None, None]  # (parameters, n, 2), in prior stds
        unfitted = sight.flow_um_s - predicted
        speed = np.linalg.norm(predicted, axis=-1)
        # The floor keeps an observation of std 0 in stagnant fluid from ruling alone.
        speed = np.maximum(speed, FLOOR * speed.max() + 1e-9)
        variance = sight.std_um_s**2 + (self.model_error_share * speed) ** 2
        flat = design.reshape(len(prior), -1)
        start, step = (theta - mean) / prior, np.zeros(len(prior))
        for _ in range(50):
            left = unfitted - np.tensordot(step, design, axes=1)
            trust = (self.tail + 2.0) / (self.tail + (left**2).sum(axis=-1) / variance)
            weight = np.repeat(trust / variance, 2)
            precision = np.eye(len(prior)) + (flat * weight) @ flat.T
            new = np.linalg.solve(precision, (flat * weight) @ unfitted.ravel() - start)
            settled = float(np.abs(new - step).max()) < 1e-6
            step = new
            if settled:
                break
        return theta + prior * step, prior[:, None] * np.linalg.inv(precision) * prior


def _with(chip: Chip, theta: Floats) -> Chip:
    """The chip with parameters (openings + 1,): boundary values and ln of the viscosity's factor."""
    return chip.with_boundary(theta[:-1], chip.viscosity_mpa_s * float(np.exp(theta[-1])))


def _jacobian(modes: FlowModes) -> Floats:
    """(openings + 1, h, w, 2) change of velocity per unit of each parameter."""
    return np.concatenate([modes.velocity, modes.viscosity_velocity[None]])


def _speed_around(field: FlowField, chip: Chip) -> Floats:
    """(h, w) root mean square speed in the 5 x 5 pixels around each pixel.

    Beside a wall the flow is slow, but what the grid gets wrong there goes with the speed in the channel.
    """
    square = (np.asarray(field.velocity_um_s, np.float64) ** 2).sum(axis=-1)
    share = uniform_filter(chip.mask.astype(np.float64), 5, mode="nearest")
    mean = uniform_filter(square, 5, mode="nearest") / np.maximum(share, 0.04)
    return np.asarray(np.sqrt(np.maximum(mean, FLOOR**2 * square.max())))


def _note(chip: Chip, sight: Sight, std: Floats, prior: Floats) -> str:
    """What was used, and which openings the robot could not see."""
    # The pressure of an only outlet moves nothing: there is nothing to see.
    alone = sum(opening.kind == "outlet" for opening in chip.openings) == 1
    unseen = [
        f"{opening.kind} {index} ({opening.side})"
        for index, opening in enumerate(chip.openings)
        if std[index] > UNSEEN * prior[index] and not (alone and opening.kind == "outlet")
    ]
    text = f"assimilated {sight.count} observations"
    return f"{text}; they say nothing about {', '.join(unseen)}" if unseen else text
