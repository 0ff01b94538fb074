"""Null models of a refinement: short standard methods that share no code with it and model no cause of an error.

modes : the sensitivities of the solver to its boundary values, the gain of the robot's own motion and an offset of the
    image, with Gaussian priors.
network : the channels as a network of resistors on the pixels, conductance by the square of the local width; the
    assumed flow is scaled by the ratio of the fitted and the assumed local flow rate (hydraulic-electric analogy).
gp : a divergence-free Gaussian process (Narcowich and Ward 1994) for what one factor of the assumed flow leaves;
    length, size and share of the own motion by the largest evidence on a grid (Rasmussen and Williams 2006, 5.4.1).

The first two are fitted by iteratively reweighted least squares with Huber's weights (1964); the noise is widened until
the median residual is that of noise. What the model can not represent is a fixed share of the speed, LEFT_SHARE.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import scipy  # its linalg, ndimage and sparse load at first use
from numpy.typing import NDArray

from flowrec.core import STD_PER_MAD, Floats, FlowError, FlowField, Observations
from flowrec.physics import Chip, FlowSolver, border, fluid_image, sample

INLET_SHARE, OUTLET_SHARE = 0.25, 0.1  # prior std of inlet speeds, and of outlet pressures over the pressure drop
GAIN, OFFSET_PX = 0.1, 0.3  # prior std of the robot's own motion per revolution, and of the image's offset
LEFT_SHARE = {"modes": 0.03, "network": 0.05}  # of the speed: what the model can not represent
HUBER, ITERATIONS = 2.0, 6  # limit of a residual in standard deviations, and rounds of reweighting
LENGTHS_PX, SIZES, GAINS = (3.0, 6.0, 12.0, 24.0, 48.0), (0.03, 0.1, 0.2, 0.4), (0.0, 0.1)  # of the grid of gp


@dataclass(frozen=True, slots=True)
class NullModel:
    """A null model by name, with the call of a refiner."""

    method: str

    def refine(self, assumed: FlowField, observations: Observations, chip: Chip, solver: FlowSolver) -> FlowField:
        """The field that fits, and its standard deviation.

        Raises FlowError if nothing was observed, or the sensitivities can not be computed.
        """
        if not len(observations.std_um_s):
            raise FlowError(f"{self.method}: there are no observations")
        flow, variance = NULL_MODELS[self.method](assumed, observations, chip, solver)
        power = float((flow**2).sum())
        return replace(
            assumed,
            method=self.method,
            velocity_um_s=fluid_image(chip.mask, flow.astype(np.float32)),
            std_um_s=fluid_image(chip.mask, np.sqrt(np.maximum(variance, 1e-12)).astype(np.float32)),
            error_share=float(np.sqrt(variance.sum() / max(power + float(variance.sum()), 1e-300))),
            note=f"null model {self.method}",
        )


def _modes(assumed: FlowField, seen: Observations, chip: Chip, solver: FlowSolver) -> tuple[Floats, Floats]:
    expansion = solver.sensitivities(chip)
    count = len(chip.openings)
    std = _prior_std(chip, float(np.ptp(assumed.pressure_pa[chip.mask])))
    modes = np.asarray(expansion.modes[:count] * std[:, None, None])
    at = np.stack([_at(fluid_image(chip.mask, mode), assumed, seen) for mode in modes])
    z, covariance, noise = _robust_fit("modes", assumed, seen, at, chip.um_per_px)
    flow = assumed.velocity_um_s[chip.mask] + np.tensordot(z[:count], modes, axes=1)
    spread = np.einsum("inc,ij,jnc->nc", modes, covariance[:count, :count], modes)
    return flow, noise**2 * spread + (LEFT_SHARE["modes"] * flow) ** 2


def _network(assumed: FlowField, seen: Observations, chip: Chip, _solver: FlowSolver) -> tuple[Floats, Floats]:
    base, modes, drop = _resistor_flows(chip)
    speed = np.linalg.norm(base, axis=1)
    speed = np.maximum(speed, 0.02 * speed.max())
    # Relative change of the local flow rate along its direction, per prior standard deviation.
    relative = np.einsum("inc,nc->in", modes, base) / speed**2 * _prior_std(chip, drop)[:, None]
    flow = assumed.velocity_um_s[chip.mask].astype(np.float64)
    columns = relative[:, :, None] * flow
    at = np.stack([_at(fluid_image(chip.mask, column), assumed, seen) for column in columns])
    z, covariance, noise = _robust_fit("network", assumed, seen, at, chip.um_per_px)
    count = len(relative)
    spread = np.einsum("in,ij,jn->n", relative, covariance[:count, :count], relative)
    share = noise**2 * spread + LEFT_SHARE["network"] ** 2
    return flow * (1.0 + z[:count] @ relative)[:, None], share[:, None] * flow**2


def _gp(assumed: FlowField, seen: Observations, chip: Chip, _solver: FlowSolver) -> tuple[Floats, Floats]:
    flow = assumed.velocity_um_s[chip.mask].astype(np.float64)
    there, places, px = _at(assumed.velocity_um_s, assumed, seen), seen.position_um, chip.um_per_px
    factor = float((there * seen.flow_um_s).sum() / max(float((there**2).sum()), 1e-9))
    left = (seen.flow_um_s - factor * there).T.ravel()
    noise = np.tile(np.maximum(seen.std_um_s, 1.0), 2) ** 2
    own = np.zeros_like(left) if seen.rolled_um_s is None else seen.rolled_um_s.T.ravel()
    rms = float(np.sqrt((flow**2).sum(axis=1).mean()))
    best = (-np.inf, 0.0, 0.0, np.zeros(0), (np.zeros((0, 0)), True))
    for length in (px * length_px for length_px in LENGTHS_PX):
        kernel = _divergence_free(places, places, length)
        for size in (rms * share for share in SIZES):
            for gain in GAINS:
                factors = scipy.linalg.cho_factor(
                    size**2 * kernel + np.diag(noise) + gain**2 * np.outer(own, own), True
                )
                solved = scipy.linalg.cho_solve(factors, left)
                evidence = -0.5 * float(left @ solved) - float(np.log(np.diag(factors[0])).sum())
                if evidence > best[0]:
                    best = (evidence, length, size, solved, factors)
    _, length, size, solved, factors = best
    rows, columns = np.nonzero(chip.mask)
    pixels = px * np.column_stack([columns, rows]).astype(np.float64)
    cross = size**2 * _divergence_free(pixels, places, length)
    half = scipy.linalg.solve_triangular(factors[0], cross.T, lower=True)
    change, variance = (cross @ solved).reshape(2, -1).T, (size**2 - (half**2).sum(axis=0)).reshape(2, -1).T
    return factor * flow + change, np.maximum(variance, 0.0)


NULL_MODELS: dict[str, Callable[[FlowField, Observations, Chip, FlowSolver], tuple[Floats, Floats]]] = {
    "modes": _modes,
    "network": _network,
    "gp": _gp,
}


def _at(image: NDArray[np.floating], assumed: FlowField, seen: Observations) -> Floats:
    """A flow (h, w, 2) at the places of the observations, (n, 2)."""
    return sample(replace(assumed, velocity_um_s=image.astype(np.float32)), seen.position_um).astype(np.float64)


def _prior_std(chip: Chip, drop_pa: float) -> Floats:
    """Prior standard deviation of the value of each opening: um/s of an inlet, Pa of an outlet."""
    return np.array([INLET_SHARE * o.value if o.kind == "inlet" else OUTLET_SHARE * drop_pa for o in chip.openings])


def _robust_fit(
    method: str, assumed: FlowField, seen: Observations, columns: Floats, um_per_px: float
) -> tuple[Floats, Floats, float]:
    """Unknowns in prior std, their covariance at the stated noise, and the factor by which the noise exceeds it.

    `columns` (p, n, 2): effect of each unknown of the flow on the observations; those of gain and offset are appended.
    """
    there = _at(assumed.velocity_um_s, assumed, seen)
    also = []
    if seen.rolled_um_s is not None:
        also.append(GAIN * seen.rolled_um_s)
    for axis in np.eye(2):
        sides = [
            _at(assumed.velocity_um_s, assumed, replace(seen, position_um=seen.position_um + step * um_per_px * axis))
            for step in (0.5, -0.5)
        ]
        also.append(OFFSET_PX * (sides[0] - sides[1]))
    design = np.concatenate([columns, np.stack(also)]).reshape(len(columns) + len(also), -1).T
    y = (seen.flow_um_s - there).ravel()
    noise = np.repeat(np.hypot(seen.std_um_s, LEFT_SHARE[method] * np.linalg.norm(there, axis=1)), 2) + 1e-9
    weight, factor = np.ones(len(y)), 1.0
    for _ in range(ITERATIONS):
        scaled = weight / (factor * noise) ** 2
        covariance = np.linalg.inv(np.eye(design.shape[1]) + design.T @ (scaled[:, None] * design))
        z = covariance @ (design.T @ (scaled * y))
        residual = np.abs(y - design @ z) / noise
        factor = max(1.0, STD_PER_MAD * float(np.median(residual)))
        weight = np.minimum(1.0, HUBER * factor / np.maximum(residual, 1e-9))
    return z, covariance, factor


def _resistor_flows(chip: Chip) -> tuple[Floats, Floats, float]:
    """Flow rates (n, 2) of the assumed inlets, those per unit of each opening (openings, n, 2), and the pressure drop.

    All are in units in which a pixel of width 1 conducts 1.
    """
    mask = chip.mask
    clearance = scipy.ndimage.distance_transform_edt(np.pad(mask, 4, mode="edge"))[4:-4, 4:-4]
    reach = 2 * int(np.ceil(2.0 * float(np.median(clearance[mask])))) + 1
    conductance = np.maximum(2.0 * scipy.ndimage.maximum_filter(clearance * mask, reach), 1.0) ** 2
    number = np.full(mask.shape, -1)
    number[mask] = np.arange(np.count_nonzero(mask))
    count = int(number.max()) + 1
    laplacian, links = scipy.sparse.lil_array((count, count)).tocsr(), []
    for a, b, here, beyond in (
        (number[:, :-1], number[:, 1:], conductance[:, :-1], conductance[:, 1:]),
        (number[:-1], number[1:], conductance[:-1], conductance[1:]),
    ):
        both = (a >= 0) & (b >= 0)
        one, two = a[both], b[both]
        link = scipy.sparse.csr_array(
            (np.tile([1.0, -1.0], len(one)), (np.repeat(np.arange(len(one)), 2), np.column_stack([one, two]).ravel())),
            (len(one), count),
        )
        conduct = scipy.sparse.diags_array(2.0 * here[both] * beyond[both] / (here[both] + beyond[both]))
        laplacian = laplacian + link.T @ conduct @ link
        # Half of the flow through each link belongs to either of its pixels.
        links.append(0.5 * abs(link).T @ conduct @ link)
    # Fluid that no outlet reaches leaks a little, or its pressure would be any.
    loads, grounded = np.zeros((len(chip.openings), count)), np.full(count, 1e-9 * conductance.max())
    for load, opening in zip(loads, chip.openings, strict=True):
        pixels = border(number, opening.side)[opening.first : opening.last + 1]
        pixels = pixels[pixels >= 0]
        load[pixels] = 1.0 if opening.kind == "inlet" else 2.0 * conductance[mask][pixels]
        grounded[pixels] += 0.0 if opening.kind == "inlet" else load[pixels]
    factors = scipy.sparse.linalg.splu((laplacian + scipy.sparse.diags_array(grounded)).tocsc())
    pressures = factors.solve(np.ascontiguousarray(loads.T))
    flows = np.stack([(link @ pressures).T for link in links], axis=-1)
    inlets = np.array([o.value if o.kind == "inlet" else 0.0 for o in chip.openings])
    return np.tensordot(inlets, flows, axes=1), flows, float(np.ptp(pressures @ inlets))


def _divergence_free(one: Floats, two: Floats, length: float) -> Floats:
    """(2 n, 2 m) covariance of divergence-free fields of variance 1 at points (n, 2), (m, 2): all x, then all y."""
    apart = (one[:, None] - two) / length
    bell = np.exp(-0.5 * (apart**2).sum(axis=-1))
    x, y = apart[..., 0], apart[..., 1]
    return np.block([[(1.0 - y**2) * bell, x * y * bell], [x * y * bell, (1.0 - x**2) * bell]])
