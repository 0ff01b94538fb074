"""Obstacles: places where a channel resists the flow more than its walls and its depth say.

A bubble, a clot, debris or a collapsed wall closes a part of a short piece of channel. The flow of all branches
changes with it, and beside the obstacle it runs through what is left. No boundary value explains that, and a small
error of the map only a part of it. So obstacles are tried in pieces of the channels, as a large friction in a part of
the cross-section or a moderate one in all of it.

A scan ranks the pieces. Friction a w with the volumes V of the faces of a piece changes the flow q by a m / (1 + a r)
outside: m = -A^-1 w V q is the linear change, and r = -(q w V m) / (q w V q) the part of it that comes back to the
piece, because a blocked piece can not take more flow than it has. So the gain in ln likelihood costs one solution with
known factors. A second list has the pieces in which the observations contradict the fitted flow most: there, deposits
on either wall are tried, because to linear order their jet can not be told. From the best of both lists a pattern
search over place, height and length follows, with the flow of each computed in full and every effect on the
observations at its usual size. The true shape is another one, so the flow beside an obstacle is uncertain in proportion
to what the obstacle changes.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import scipy  # its linalg and ndimage load at first use, not at start-up

from flowrec.core import UM_PER_M, Floats, NotFiniteError
from flowrec.physics import (
    Chip,
    FlowSolver,
    NotConvergedError,
    Sensitivities,
    System,
    local_friction,
    sensitivities,
    with_friction,
)
from flowrec.stages.refine.causes import Observed
from flowrec.stages.refine.flow_model import FlowModel
from flowrec.stages.refine.hypothesis import HypothesisFit, of_the_field
from flowrec.stages.refine.noise import NOISE, Robust

RATIOS = (2.0, 4.0, 10.0, 40.0, 1000.0)  # resistance of a piece over that of a free one: half the width is 8
DEPOSIT = 1.2  # reach of the deposits that are tried first
BLOCKED = 100.0  # the same of what nothing flows through: 1 % of the flow is less than any observation sees
SPACING = 1.0  # of the pieces along a channel, in half widths
MOST_PIECES = 160  # of a chip: with more, they are farther apart
PLACES = 3.0 * MOST_PIECES  # places of an obstacle that are equally probable: each piece as a whole, or one half of it
WORTH_TRYING = 3.0  # gain in ln likelihood
TRIED = 3  # pieces of either list that are computed in full; a search starts from the best of each
HEIGHTS = (0.8, 1.3)  # of the deposits that are tried first, in half widths
KEPT = 4  # of these obstacles
MOST_SOLUTIONS = 26  # of a search
STEPS = (0.5, 0.25)  # of a search, in half widths for place and height, and in the logarithm of length or resistance
CONTRADICTED = 20.0  # chi squared of the observations in a piece, from which on deposits are tried there
OUTLYING = 50.0  # of one observation: no more of it counts
# Of the change that an obstacle makes, one standard deviation of the error of its shape: a box in the place of a round
# deposit that fills as much is off by about so much in the middle of the channel.
SHAPE = 0.25
LEAST_AND_MOST = (0.2, 1.9)  # height of a deposit, in half widths: at 2 the channel is closed
PLANE_CHANNEL = 12.0  # friction of a plane channel of width 1
LEAST_INLIER = 0.1  # what looks like an outlier may be what the obstacle explains
BATCH = 64  # right sides that are solved at once
# Of the usual error of the walls, in the search: walls that are off everywhere could look like one obstacle. What is
# found is then compared with them at whatever size the observations ask for.
QUIET = 0.3


@dataclass(frozen=True, slots=True)
class Obstacle:
    """A part of a piece of channel, and its resistance: a round deposit on one wall, or all of the cross-section."""

    row: float  # of the centre of the channel there, in pixels
    column: float
    along: tuple[float, float]  # unit vector (x, y) of the flow
    half_width_px: float
    side: int  # of the flow on which its wall is: -1 left, 1 right; 0 the whole width
    height: float  # of a deposit, in half widths
    reach: float  # half of its length, in half widths
    ratio: float  # of the resistance to that of the free channel

    def friction_per_um2(self, chip: Chip) -> Floats:
        """(h, w) see Chip; at the edges of the obstacle in proportion to what it covers of a pixel."""
        r = self.half_width_px
        box, along, across = self.around(max(self.reach, 1.6) * r + 2.0, chip.mask.shape)
        inside = chip.mask[box] & (np.abs(across) <= 1.6 * r + 1.0)
        covered = np.clip(self.reach * r - np.abs(along) + 0.5, 0.0, 1.0) * inside
        if self.side:
            profile = np.sqrt(np.clip(1.0 - (along / (self.reach * r)) ** 2, 0.0, 1.0))
            covered = covered * np.clip(self.side * across - r * (1.0 - self.height * profile) + 0.5, 0.0, 1.0)
        friction = np.zeros(chip.mask.shape)
        friction[box] = covered * (self.ratio - 1.0) * PLANE_CHANNEL / (2.0 * r * chip.um_per_px) ** 2
        return friction

    def around(self, reach_px: float, shape: tuple[int, ...]) -> tuple[tuple[slice, slice], Floats, Floats]:
        """The part of an image of a shape within a distance along both axes, and its pixels along and across the flow.

        From the centre, in pixels; across is positive to the right of the flow.
        """
        rows, columns = (
            slice(max(int(at - reach_px), 0), min(int(np.ceil(at + reach_px)) + 1, size))
            for at, size in zip((self.row, self.column), shape, strict=True)
        )
        y, x = np.ogrid[rows, columns]
        x, y = x - self.column, y - self.row
        ux, uy = self.along
        return (rows, columns), x * ux + y * uy, y * ux - x * uy

    def apart(self, other: Obstacle) -> bool:
        """True if another one is at another place."""
        return bool(np.hypot(self.row - other.row, self.column - other.column) > 2.0 * self.half_width_px)

    def on(self, chip: Chip) -> Chip:
        """The chip with this obstacle."""
        before = 0.0 if chip.friction_per_um2 is None else chip.friction_per_um2
        return replace(chip, friction_per_um2=before + self.friction_per_um2(chip))

    def neighbours(self, step: float) -> Iterator[Obstacle]:
        """Obstacles that differ a little: farther down, up, larger, smaller, longer, shorter."""
        away = step * self.half_width_px
        for sign in (1.0, -1.0):
            yield replace(
                self, row=self.row + sign * away * self.along[1], column=self.column + sign * away * self.along[0]
            )
            if self.side:
                yield replace(self, height=float(np.clip(self.height + sign * step, *LEAST_AND_MOST)))
            else:
                yield replace(self, ratio=max(self.ratio * float(np.exp(2.0 * sign * step)), 1.2))
            yield replace(self, reach=self.reach * float(np.exp(sign * step)))


def likely_obstacles(free: HypothesisFit, solver: FlowSolver) -> list[Obstacle]:
    """Obstacles that could explain the observations of a chip, the likeliest first; [] where none is worth trying.

    `free` is the flow that fits best without any.
    """
    observed = free.observed
    likelihood = Likelihood.of(observed, free.robust)
    pieces = pieces_of(observed.model.chip, observed.model.expansion.base)
    deposits = [
        replace(piece, side=side, height=height, reach=DEPOSIT, ratio=BLOCKED)
        for piece in _contradicted_pieces(pieces, free)
        for side in (-1, 1)
        for height in HEIGHTS
    ]
    found: list[tuple[float, Obstacle]] = []
    for starts in (_rank_pieces(pieces, observed, likelihood), deposits):
        tried = sorted(((_gain(one, observed, likelihood, solver), one) for one in starts), key=lambda one: -one[0])
        found += [_pattern_search(*one, observed, likelihood, solver) for one in tried[:1]]
        found += tried[1:]
    found.sort(key=lambda entry: -entry[0])
    chosen: list[Obstacle] = []
    for gain, obstacle in found:
        if gain > WORTH_TRYING and len(chosen) < KEPT and all(obstacle.apart(other) for other in chosen):
            chosen.append(obstacle)
    return chosen


def with_shape_error(model: FlowModel, free: FlowModel) -> FlowModel:
    """The model of a chip with an obstacle, whose shape is not known, beside that of the chip without it."""
    changed = np.linalg.norm(model.base - free.base, axis=1) / np.sqrt(2.0)
    return replace(model, error_std=np.hypot(model.error_std, SHAPE * changed))


def _pattern_search(
    gain: float, obstacle: Obstacle, observed: Observed, likelihood: Likelihood, solver: FlowSolver
) -> tuple[float, Obstacle]:
    """The best obstacle of a pattern search (Hooke and Jeeves, 1961), and its gain."""
    solutions = 0
    for step in STEPS:
        better = True
        while better and solutions < MOST_SOLUTIONS:
            better = False
            for other in obstacle.neighbours(step):
                solutions += 1
                more = _gain(other, observed, likelihood, solver)
                if more > gain:
                    gain, obstacle, better = more, other, True
    return gain, obstacle


def _contradicted_pieces(pieces: list[Obstacle], free: HypothesisFit) -> list[Obstacle]:
    """Pieces at different places in which the observations contradict a flow most, whatever is wrong with the robot."""
    here = free.observed.operator
    measured, _ = of_the_field(free)  # where the stated registration has the observations; they were made `here`
    misfit = ((free.observed.predict_stated(free.flow) - measured) ** 2).sum(axis=1) / here.noise_um_s**2
    excess = np.minimum(misfit, OUTLYING) - 2.0
    points = here.points
    score, moved = [], []
    for piece in pieces:
        away = points - np.array([piece.column, piece.row])
        near = np.hypot(*away.T) <= 2.0 * piece.half_width_px
        score.append(float(excess[near].sum()))
        # To the middle of the contradictions along the channel.
        weight = np.maximum(excess[near], 0.0)
        along = float((weight * (away[near] @ piece.along)).sum() / max(float(weight.sum()), 1e-9))
        moved.append(
            replace(piece, row=piece.row + along * piece.along[1], column=piece.column + along * piece.along[0])
        )
    chosen: list[Obstacle] = []
    for index in np.argsort(-np.array(score)):
        if len(chosen) == TRIED or score[index] < CONTRADICTED:
            break
        if all(moved[index].apart(other) for other in chosen):
            chosen.append(moved[index])
    return chosen


def _rank_pieces(pieces: list[Obstacle], observed: Observed, likelihood: Likelihood) -> list[Obstacle]:
    """The best pieces of the channels at different places, blocked as a whole with the best ratio."""
    chip, expansion, ratios = observed.model.chip, observed.model.expansion, np.array(RATIOS)
    gains = np.empty((len(pieces), len(ratios)))
    for first in range(0, len(pieces), BATCH):
        batch = pieces[first : first + BATCH]
        modes, back = saturating_modes(batch, chip, expansion)
        change = (ratios - 1.0) / (1.0 + back[:, None] * (ratios - 1.0))
        gains[first : first + len(batch)] = likelihood.gains(observed.operator.predict(modes), change)
    chosen: list[Obstacle] = []
    for index in np.argsort(-gains.max(axis=1)):
        piece = replace(pieces[index], ratio=float(ratios[gains[index].argmax()]))
        if len(chosen) == TRIED or gains[index].max() < WORTH_TRYING:
            break
        if all(piece.apart(other) for other in chosen):
            chosen.append(piece)
    return chosen


def saturating_modes(obstacles: list[Obstacle], chip: Chip, expansion: Sensitivities) -> tuple[Floats, Floats]:
    """First-order change of the flow m (k, n, 2) um/s by the friction of obstacles, and r (k,), see above."""
    equations = expansion.equations
    assert isinstance(equations, System), "obstacles are tried in Newtonian fluids only"
    curl, volume = equations.stream.curl, equations.momentum.volume
    unit = np.stack(
        [local_friction(one.friction_per_um2(chip), chip.um_per_px, equations.grid) for one in obstacles], axis=1
    )
    drag = unit * (volume * expansion.flux)[:, None]
    modes = curl @ expansion.factors.solve(np.ascontiguousarray(-(curl.T @ drag)))
    back = -(drag * modes).sum(axis=0) / np.maximum(drag.T @ expansion.flux, 1e-300)
    pixels = np.ascontiguousarray((equations.momentum.centre @ modes).T).reshape(len(obstacles), -1, 2) * UM_PER_M
    return pixels, np.maximum(back, 0.0)


def _gain(obstacle: Obstacle, observed: Observed, likelihood: Likelihood, solver: FlowSolver) -> float:
    """Gain in ln likelihood of the observations over the chip without it; minus infinity where nothing can flow."""
    model = observed.model
    chip, expansion = model.chip, model.expansion
    assert isinstance(expansion.equations, System), "obstacles are tried in Newtonian fluids only"
    equations = with_friction(expansion.equations, obstacle.friction_per_um2(chip), chip.um_per_px)
    scales = expansion.scales
    try:
        flux = equations.steady(scales.drive, scales.inertia, solver.max_iterations, 1e-4)
    except NotConvergedError:
        return -np.inf
    changed = sensitivities(equations, scales, flux, expansion.with_friction, False)
    known = np.tensordot(model.prior.effect, changed.modes, axes=1)
    here = observed.operator
    return likelihood.of_flow(
        here.predict(changed.base), here.predict(known), here.predict(changed.base - expansion.base)
    )


def pieces_of(chip: Chip, flow: Floats) -> list[Obstacle]:
    """Pieces of twice the usual resistance that cover the channels in which something flows."""
    mask = chip.mask
    half = scipy.ndimage.distance_transform_edt(np.pad(mask, 16, mode="edge"))[16:-16, 16:-16]
    velocity = np.zeros((*mask.shape, 2))
    velocity[mask] = flow
    least = 1e-3 * float(np.hypot(*flow.T).max())
    rows, columns = np.nonzero(mask)
    order = np.argsort(-half[mask], kind="stable")
    spacing = SPACING
    while True:
        free, found = mask.copy(), []
        for row, column in zip(rows[order].tolist(), columns[order].tolist(), strict=True):
            if not free[row, column]:
                continue
            radius, u = float(half[row, column]), velocity[row, column]
            size = float(np.hypot(*u))
            if size <= least:
                continue
            u = u / size
            piece = Obstacle(row, column, (float(u[0]), float(u[1])), radius, 0, 1.0, 1.5 * spacing, 2.0)
            box, along, across = piece.around(2.0 * radius + 2.0, mask.shape)
            free[box] &= ~((np.abs(along) <= spacing * radius) & (np.abs(across) <= 1.3 * radius + 1.0))
            if radius >= 1.5:
                found.append(piece)
        if len(found) <= MOST_PIECES:
            return found
        spacing *= 1.3


@dataclass(frozen=True, slots=True, eq=False)
class Likelihood:
    """Likelihood of observations y (m,) with effects of usual size; z of the boundary values is integrated out."""

    y: Floats
    others: Floats  # (m, m) covariance of all but the boundary values
    root: Floats  # (m, m) Cholesky factor of the whole covariance of the chip without an obstacle
    whitened: Floats  # (m,) misfit of its flow, divided by that
    without: float  # ln likelihood of that

    @classmethod
    def of(cls, observed: Observed, robust: Robust) -> Likelihood:
        here, model = observed.operator, observed.model
        noise = (NOISE[1] * robust.factor) ** 2 * robust.variance / np.maximum(robust.inlier, LEAST_INLIER)
        others = np.diag(np.repeat(noise, 2))
        for effect in observed.effects(model.base, None):
            if effect.name not in ("boundary", "fluid"):
                size = effect.median * (QUIET if effect.name == "walls" else 1.0)
                others = others + size**2 * effect.matrix
        y = here.flow_um_s.ravel()
        design = here.predict(model.known).reshape(len(model.known), -1)
        root = _factor(others + design.T @ design)
        whitened = _solve_triangle(root, y - here.predict(model.base).ravel())
        without = -0.5 * float(whitened @ whitened) - float(np.log(np.diag(root)).sum())
        return cls(y, others, root, whitened, without)

    def of_flow(self, base: Floats, known: Floats, change: Floats) -> float:
        """Gain of another flow (n, 2) and its boundary modes (p, n, 2) at the observations, where it changed (n, 2)."""
        design = known.reshape(len(known), -1)
        shape = 0.5 * SHAPE**2 * np.repeat((change**2).sum(axis=1), 2)
        root = _factor(self.others + np.diag(shape) + design.T @ design)
        whitened = _solve_triangle(root, self.y - base.ravel())
        return -0.5 * float(whitened @ whitened) - float(np.log(np.diag(root)).sum()) - self.without

    def gains(self, modes: Floats, change: Floats, shape: bool = False) -> Floats:
        """(k, r) gain of r changes (k, r) along each mode (k, n, 2), to first order.

        `shape`: the error of a shape counts, too.
        """
        flat = modes.reshape(len(modes), -1)
        along = _solve_triangle(self.root, flat.T)
        gains = change * (self.whitened @ along)[:, None] - 0.5 * change**2 * (along**2).sum(axis=0)[:, None]
        if not shape:
            return np.asarray(gains)
        # Only where an observation is so near that the shape decides.
        noise = np.sqrt(np.diag(self.others))
        whole, misfit = self.root @ self.root.T, self.root @ self.whitened
        for k in np.flatnonzero((SHAPE * np.abs(flat) > noise).any(axis=1)):
            for r, size in enumerate(change[k]):
                error = 0.5 * (SHAPE * size) ** 2 * np.repeat((modes[k] ** 2).sum(axis=1), 2)
                root = _factor(whole + np.diag(error))
                whitened = _solve_triangle(root, misfit - size * flat[k])
                gains[k, r] = -0.5 * float(whitened @ whitened) - float(np.log(np.diag(root)).sum()) - self.without
        return np.asarray(gains)


def _factor(covariance: Floats) -> Floats:
    """The lower Cholesky factor (m, m)."""
    return np.asarray(scipy.linalg.cholesky(_finite(covariance), lower=True, check_finite=False))


def _solve_triangle(root: Floats, right: Floats) -> Floats:
    """Solve with a lower triangle (m, m) for a right-hand side (m, ...)."""
    return np.asarray(scipy.linalg.solve_triangular(root, _finite(right), lower=True, check_finite=False))


def _finite(values: Floats) -> Floats:
    """Return finite values unchanged. SciPy's own check raises ValueError, which would end the run."""
    if not np.isfinite(values).all():
        raise NotFiniteError("the flow that was fitted is not finite at the observations")
    return values
