"""One hypothesis about a chip (its walls, its depth): the most probable flow, its uncertainty and its evidence."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import scipy  # its sparse loads at first use, not at start-up

from flowrec.core import Bools, Floats
from flowrec.physics import Registration, Remainder, fluid_image
from flowrec.stages.refine.causes import (
    CURVED,
    RESISTANCE,
    WALL_BIAS_NAME,
    WALLS,
    WALLS_LONG,
    Observed,
    lines_hz,
)
from flowrec.stages.refine.disturbances import likeliest_hz, shaking
from flowrec.stages.refine.evidence import Effect, EffectModel, Posterior, Sizes, gains_of_trials
from flowrec.stages.refine.noise import (
    MOST_OBSERVATIONS,
    NOISE,
    NOISIER,
    Robust,
    averages,
    outlying,
    robust_noise,
)
from flowrec.stages.refine.observation_operator import Disturbance

MOST_MOVES = 3  # iterations of fit and registration; the first finds nearly all of the offset
# Other starts of the registration, tried where the map is doubtful: offset x and y in px, scale, angle in rad.
REGISTRATIONS = ((0.0, 0.0, 0.025, 0.0), (0.0, 0.0, -0.025, 0.0))
# Effects, their usual size, and the factor on it above which the map is doubted.
DOUBTED = (
    ("walls", WALLS[0], 2.0),
    ("resistance", RESISTANCE[0], 2.0),
    ("curved", CURVED[0], 3.0),
    ("noise", 1.0, 1.2),
)
FAR_PX = 0.5  # by which an observation is moved at least: over less, the flow is linear
WORTH_A_LINE = 4.0  # in ln evidence, for a spectral line at the best of some fifty independent frequencies
WORTH_A_SHAKE = 8.0  # in ln evidence, at the best of some hundred independent frequencies
LINE_TRIALS = (0.03, 0.1, 0.3)  # amplitudes at which frequencies are compared
FIELD_EFFECTS = (
    "boundary",
    "fluid",
    "resistance",
    "walls",
    WALL_BIAS_NAME,
)  # the first ones, in the order of the columns of the flow


@dataclass(frozen=True, slots=True, eq=False)
class HypothesisFit:
    """The flow of a hypothesis. Its unknowns are those of the effects, in order."""

    observed: Observed
    effects: list[Effect]
    sizes: Sizes
    posterior: Posterior
    flow: Floats  # (n, 2) mean
    in_use: Floats  # (n, 2) the flow around which the effects are linear
    remainder: Remainder
    line_hz: float | None
    robust: Robust
    evidence: EffectModel

    def gain(self) -> float:
        """Ln evidence over that of the assumed flow, when robot, registration and pump may differ in both."""
        return self.sizes.evidence - self.in_assumed_flow().sizes().evidence

    def in_assumed_flow(self) -> EffectModel:
        """The observations in the assumed flow, where robot, registration and pump alone may differ."""
        base = self.observed.model.base
        full = _evidence(self.observed, self.robust, np.zeros_like(base), base, self.line_hz)
        return replace(full, effects=[effect for effect in full.effects if effect.name not in FIELD_EFFECTS])

    def on_pixels_of(self, mask: Bools, values: Floats) -> Floats:
        """Values (n, ...) of its own fluid pixels, on those of a mask (h, w); 0 where it has no fluid."""
        own = self.observed.model.chip.mask
        return values if own is mask else fluid_image(own, values)[mask]

    def unknowns(self, *names: str) -> tuple[Floats, Floats]:
        """Mean (k,) and covariance (k, k) of the unknowns of effects; what there is not is left out."""
        first, chosen = 0, []
        for effect in self.effects:
            if effect.name in names:
                chosen.append(np.arange(first, first + len(effect.columns)))
            first += len(effect.columns)
        which = np.concatenate([np.zeros(0, np.intp), *chosen])
        return self.posterior.mean[which], self.posterior.covariance[np.ix_(which, which)]

    def size(self, name: str) -> float:
        """Size of an effect."""
        return float(self.posterior.sizes[[effect.name for effect in self.effects].index(name)])

    @property
    def registration(self) -> Registration:
        """The most probable one."""
        px, places = self.observed.um_per_px, self.observed.stated.points
        offset, scale, angle = (self.unknowns(name)[0] for name in ("offset", "scale", "angle"))
        return Registration(px * offset, float(scale[0]), float(angle[0]), px * places.mean(axis=0))

    @property
    def depth_um(self) -> tuple[float, float]:
        """Depth of the chip and its standard deviation; 0 where the depth is no unknown."""
        prior, stated = self.observed.model.prior, self.observed.model.chip.depth_um
        if prior.depth_index is None or stated is None:
            return 0.0, 0.0
        mean, covariance = self.unknowns("boundary", "fluid")
        index = prior.depth_index
        depth = stated * float(np.exp(prior.depth_std * mean[index]))
        return depth, depth * prior.depth_std * float(np.sqrt(covariance[index, index]))

    @property
    def law(self) -> dict[str, tuple[float, float]]:
        """Unknowns of the chip's law of viscosity by name, each with its standard deviation."""
        prior, law = self.observed.model.prior, self.observed.model.chip.law
        mean, covariance = self.unknowns("boundary", "fluid")
        result = {}
        for number, std in enumerate(prior.law_stds):
            assert law is not None
            index = prior.law_index + number
            name = law.unknowns[number].removeprefix("ln ")
            change, error = std * float(mean[index]), std * float(np.sqrt(covariance[index, index]))
            value = float(getattr(law, name))
            if name != law.unknowns[number]:
                change, error = value * float(np.expm1(change)), value * float(np.exp(change)) * error
            result[f"viscosity_{name}"] = value + change, error
        return result


def of_the_field(found: HypothesisFit) -> tuple[Floats, Floats]:
    """The observations (n, 2) less what robot, registration and pump explain of them, and their noise (n,) in um/s.

    What changes in time and follows from no unknown (wander, rolling) counts as noise.
    """
    own, first, robust = found.observed.operator.flow_um_s.copy(), 0, found.robust
    variance = robust.factor**2 * robust.variance / robust.inlier
    for effect in found.observed.effects(found.in_use, found.line_hz):
        count = len(effect.columns)
        if effect.name not in (*FIELD_EFFECTS, "local"):
            z = slice(first, first + count)
            columns = effect.columns.reshape(count, len(own), 2)
            own -= np.tensordot(found.posterior.mean[z], columns, axes=1)
            spread = np.einsum("inc,ij,jnc->n", columns, found.posterior.covariance[z, z], columns)
            if effect.kernel is not None:
                spread = spread + found.size(effect.name) ** 2 * np.diag(effect.kernel).reshape(-1, 2).sum(axis=1)
            variance = variance + 0.5 * spread
        first += count
    return own - found.observed.beyond_first_order(found.in_use), np.sqrt(variance)


def shaking_stage(observed: Observed, robust: Robust) -> Disturbance | None:
    """A stage that shakes, where observations scatter more than they state and one frequency explains that.

    A pump that pulsates at that frequency must not explain it as well.
    """
    here, base = observed.operator, observed.model.base
    if here.time_s is None or robust.factor < NOISIER:
        return None
    evidence = _evidence(observed, robust, np.zeros_like(base), base, None)
    sizes = evidence.sizes()
    hz = likeliest_hz(evidence, sizes, averages(robust, here), here.time_s, float(np.median(here.std_um_s)))
    if hz is None:
        return None
    found = shaking(hz, here.time_s)
    shaken = replace(observed, operator=replace(here, disturbances=(*here.disturbances, found)))
    calmer = robust_noise(shaken)
    after = first_evidence(shaken, calmer) - outlying(calmer) + outlying(robust)
    if after <= sizes.evidence + WORTH_A_SHAKE:
        return None
    pump = _evidence(observed, robust, np.zeros_like(base), base, hz).sizes().evidence
    return found if after > pump else None


@dataclass(frozen=True, slots=True, eq=False)
class Steps:
    """Stopping rule of the iteration for the nonlinear remainder: settings of the assimilation."""

    most: int
    tolerance: float  # last step over the fastest speed


@dataclass(frozen=True, slots=True, eq=False)
class State:
    """The most probable flow of a hypothesis so far, with the most probable sizes."""

    observed: Observed
    sizes: Sizes
    evidence: EffectModel
    line_hz: float | None
    flow: Floats  # (n, 2)
    in_use: Floats  # (n, 2) the flow around which the effects were linear
    nonlinear: Floats  # (n, 2) what inertia, or a large change of the depth, add to the linear model
    remainder: Remainder


def first_evidence(observed: Observed, robust: Robust) -> float:
    """Ln evidence around the assumed flow, before the registration is moved, a line is tried or inertia is followed."""
    base = observed.model.base
    return _evidence(observed, robust, np.zeros_like(base), base, None).sizes().evidence


def begin(observed: Observed, robust: Robust, steps: Steps) -> State:
    """The most probable flow, with the effects around the assumed flow; a spectral line where the evidence asks."""
    model = observed.model
    nothing = np.zeros_like(model.base)
    observed, evidence, sizes = _register_and_fit(observed, robust, None)
    line_hz = None
    if doubtful(evidence, sizes):
        # In the middle of a channel the flow has no gradient, so a few pixels to the side are not found from there.
        moved = [observed.at(observed.moved_by(np.array(start))) for start in REGISTRATIONS]
        others = [_register_and_fit(other, robust, sizes.mode) for other in moved]
        best = max(others, key=lambda entry: entry[2].evidence)
        if best[2].evidence > sizes.evidence:
            observed, evidence, sizes = best
    hz = _line_hz(observed, robust, evidence, sizes)
    if hz is not None:
        pulsating = _evidence(observed, robust, nothing, model.base, hz)
        found = pulsating.sizes()
        if found.evidence > sizes.evidence + WORTH_A_LINE:
            line_hz, evidence, sizes = hz, pulsating, found
    return _iterate_remainder(
        observed,
        robust,
        State(observed, sizes, evidence, line_hz, model.base, model.base, nothing, model.expansion.start()),
        steps,
    )


def complete(robust: Robust, state: State, steps: Steps) -> HypothesisFit:
    """Fit with the effects around the flow that was found, and averaged over the sizes."""
    # The effects are linearised around the flow of the boundary values alone: one that follows the observations
    # everywhere would explain them by itself.
    observed, z = state.observed, state.evidence.most_probable(state.sizes)
    known = observed.model.known
    in_use = observed.model.base + state.nonlinear + np.tensordot(z[: len(known)], known, axes=1)
    observed = _register(observed, z, state.evidence) or observed
    evidence = _evidence(observed, robust, state.nonlinear, in_use, state.line_hz)
    sizes = evidence.sizes(state.sizes.mode)
    state = replace(state, observed=observed, evidence=evidence, sizes=sizes, in_use=in_use)
    state = _iterate_remainder(observed, robust, state, steps)
    posterior = state.evidence.posterior(sizes)
    flow = _flow(observed, posterior.mean, state.in_use, state.nonlinear)
    effects = list(state.evidence.effects)
    return HypothesisFit(
        observed, effects, sizes, posterior, flow, state.in_use, state.remainder, state.line_hz, robust, state.evidence
    )


def _register_and_fit(observed: Observed, robust: Robust, start: Floats | None) -> tuple[Observed, EffectModel, Sizes]:
    """The observations where the most probable registration has them, around the assumed flow."""
    base = observed.model.base
    for _ in range(MOST_MOVES):
        evidence = _evidence(observed, robust, np.zeros_like(base), base, None)
        sizes = evidence.sizes(start)
        again = _register(observed, evidence.most_probable(sizes), evidence)
        if again is None:
            break
        observed, start = again, sizes.mode
    return observed, evidence, sizes


def doubtful(evidence: EffectModel, sizes: Sizes) -> bool:
    """True if errors of the map along the channels, or the noise, are larger than usual."""
    found = dict(zip([effect.name for effect in evidence.effects], np.exp(sizes.mode), strict=True))
    return any(found.get(name, 0.0) > factor * usual for name, usual, factor in DOUBTED)


def _register(observed: Observed, z: Floats, evidence: EffectModel) -> Observed | None:
    """The observations where the most probable registration has them; None where they are near that already."""
    effects = evidence.effects
    owner = np.repeat([effect.name for effect in effects], [len(effect.columns) for effect in effects])
    moved = observed.moved_by(np.concatenate([z[owner == name] for name in ("offset", "scale", "angle")]))
    return observed.at(moved) if float(np.abs(moved - observed.moved).max()) > FAR_PX else None


def _iterate_remainder(observed: Observed, robust: Robust, state: State, steps: Steps) -> State:
    """The state with the nonlinear remainder of its most probable unknowns."""
    model, last = observed.model, np.inf
    for _ in range(steps.most):
        z = state.evidence.most_probable(state.sizes)
        remainder = model.expansion.approach(model.prior.offset(z[: len(model.known)]), state.remainder)
        if not remainder.step < last:  # inertia for which frozen factors are too far off
            break
        last = remainder.step
        nonlinear = model.expansion.pixels(remainder.flux)
        shift = averages(robust, observed.operator) @ observed.operator.predict(nonlinear - state.nonlinear).ravel()
        evidence = replace(state.evidence, y=state.evidence.y - shift)
        state = replace(state, evidence=evidence, remainder=remainder, nonlinear=nonlinear)
        if remainder.step <= steps.tolerance:
            break
    z = state.evidence.most_probable(state.sizes)
    return replace(state, flow=_flow(observed, z, state.in_use, state.nonlinear))


def _flow(observed: Observed, z: Floats, in_use: Floats, nonlinear: Floats) -> Floats:
    """(n, 2) flow of unknowns z, those of the field first."""
    model = observed.model
    known, cells = len(model.known), len(model.resistance)
    wider = WALLS_LONG * z[known + cells : known + 2 * cells] * model.widening
    flow = model.base + nonlinear + np.tensordot(z[:known], model.known, axes=1)
    flow = flow + np.tensordot(z[known : known + cells] - 3.0 * wider, model.resistance, axes=1)
    flow = flow - (wider @ model.cells)[:, None] * in_use
    if observed.wall_mode is not None:
        # The bias counts from the walls as they were drawn, the flow of the model is that in its own walls.
        flow = flow + (z[known + 2 * cells] - model.chip.wall_offset_px) * observed.wall_mode
    return np.asarray(flow)


def _evidence(
    observed: Observed, robust: Robust, nonlinear: Floats, in_use: Floats, line_hz: float | None
) -> EffectModel:
    """The observations, averaged, and the effects on them."""
    here = observed.operator
    model = observed.model
    drawn = model.base + nonlinear
    if observed.wall_mode is not None:  # its unknown counts from walls without a bias
        drawn = drawn - model.chip.wall_offset_px * observed.wall_mode
    misfit = observed.misfit(drawn, in_use)
    noise = np.repeat(robust.factor**2 * robust.variance / robust.inlier, 2)
    effects, stated, y = observed.effects(in_use, line_hz), np.diag(noise), misfit.ravel()
    if here.count > MOST_OBSERVATIONS:
        average = averages(robust, here)
        few = scipy.sparse.csr_array(average)  # a mean is of two or three observations
        effects = [
            replace(
                effect,
                columns=(few @ effect.columns.T).T,
                kernel=None if effect.kernel is None else few @ (few @ effect.kernel).T,  # it is symmetric
            )
            for effect in effects
        ]
        stated, y = (average * noise) @ average.T, average @ y
    effects.append(Effect(*NOISE, np.zeros((0, len(y))), stated))
    least = 1e-9 * float(np.trace(stated)) / len(stated)
    return EffectModel(y, least * np.eye(len(stated)), effects)


def _line_hz(observed: Observed, robust: Robust, evidence: EffectModel, sizes: Sizes) -> float | None:
    """The frequency at which a spectral line of the assumed flow explains most; None where none could be seen."""
    time_s = observed.operator.time_s
    frequencies = lines_hz(time_s)
    if time_s is None or not len(frequencies):
        return None
    base = np.array(evidence.noise)
    for effect, ln_size in zip(evidence.effects, sizes.mode, strict=True):
        # A line must not be taken for a wander.
        wander = effect.name.startswith("wander")
        base += (effect.median**2 if wander else np.exp(2.0 * ln_size)) * effect.matrix
    average = averages(robust, observed.operator)
    weighted = average * observed.operator.predict(observed.model.base).ravel()  # (m, 2 n): times a wave, its column
    phase = np.repeat(2.0 * np.pi * frequencies[:, None] * time_s, 2, axis=1)
    columns = np.stack([np.cos(phase), np.sin(phase)], axis=1) @ weighted.T  # (k, 2, m)
    return float(frequencies[int(np.argmax(gains_of_trials(columns, base, evidence.y, LINE_TRIALS)))])
