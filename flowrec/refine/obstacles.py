"""Obstacles: places where a channel resists the flow more than its walls and its depth say.

A bubble, a clot, debris or a collapsed wall closes a part of a short piece of channel. The flow of all branches
changes with it, and beside the obstacle it runs through what is left. No boundary value explains that, and a small
error of the map only a part of it. So obstacles are tried in pieces of the channels, as a large friction in a part of
the cross-section or a moderate one in all of it.

A scan ranks the pieces. Friction a w with the volumes V of the faces of a piece changes the flow q by a m / (1 + a r)
outside: m = -A^-1 w V q is the linear change, and r = -(q w V m) / (q w V q) the part of it that comes back to the
piece, because a blocked piece can not take more flow than it has. So the gain in ln likelihood costs one solution with
known factors. From the best pieces a coordinate search over side, depth, length and place of the obstacle follows, with
the flow of each computed in full and every effect on the observations at its usual size.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import scipy  # its linalg and ndimage load at first use, not at start-up

from flowrec.chip.chip import Chip
from flowrec.flow import FlowSolver
from flowrec.flow.newton_solver import NotConvergedError, System, local_friction, with_friction
from flowrec.flow.sensitivities import sensitivities
from flowrec.refine.causes import Observed
from flowrec.refine.hypothesis import NOISE, Robust
from flowrec.refine.observation_operator import Floats
from flowrec.units import UM_PER_M

RATIOS = (2.0, 4.0, 10.0, 40.0, 1000.0)  # resistance of a piece over that of a free one: half the width is 8
BLOCKED = 100.0  # the same of what nothing flows through: 1 % of the flow is less than any observation sees
SPACING = 1.0  # of the pieces along a channel, in half widths
MOST_PIECES = 160  # of a chip: with more, they are farther apart
PLACES = 3.0 * MOST_PIECES  # places of an obstacle that are equally probable: each piece as a whole, or one half of it
WORTH_TRYING = 3.0  # gain in ln likelihood
TRIED = 4  # pieces that are computed in full, blocked as a whole and from either side
KEPT = 5  # of these obstacles
SEARCHED = 2  # of those, from which a search starts
MOST_STEPS = 3  # of a search, each with the six neighbours of an obstacle
LEAST_STEP = 0.2  # gain in ln likelihood for which a search goes on
PLANE_CHANNEL = 12.0  # friction of a plane channel of width 1
LEAST_INLIER = 0.1  # what looks like an outlier may be what the obstacle explains
BATCH = 64  # right sides that are solved at once


@dataclass(frozen=True, slots=True)
class Obstacle:
    """A part of a piece of channel, and its resistance."""

    row: float  # of the centre of the channel there, in pixels
    column: float
    along: tuple[float, float]  # unit vector (x, y) of the flow
    half_width_px: float
    side: int  # of the flow from which it reaches into the channel: -1 left, 1 right, 0 the whole width
    depth: float  # in half widths, from the middle of the channel to the other side; of a side only
    reach: float  # half of its length, in half widths
    ratio: float  # of the resistance to that of the free channel

    def friction_per_um2(self, chip: Chip) -> Floats:
        """(h, w) see Chip."""
        r = self.half_width_px
        box, along, across = self.around(max(self.reach, 1.6) * r + 2.0, chip.mask.shape)
        inside = chip.mask[box] & (np.abs(along) <= self.reach * r) & (np.abs(across) <= 1.6 * r + 1.0)
        if self.side:
            inside &= self.side * across >= -self.depth * r
        friction = np.zeros(chip.mask.shape)
        friction[box][inside] = (self.ratio - 1.0) * PLANE_CHANNEL / (2.0 * r * chip.um_per_px) ** 2
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

    def on(self, chip: Chip) -> Chip:
        """The chip with this obstacle."""
        before = 0.0 if chip.friction_per_um2 is None else chip.friction_per_um2
        return replace(chip, friction_per_um2=before + self.friction_per_um2(chip))

    def neighbours(self) -> Iterator[Obstacle]:
        """Obstacles that differ a little."""
        step = 0.6 * self.half_width_px
        for sign in (-1.0, 1.0):
            yield replace(
                self, row=self.row + sign * step * self.along[1], column=self.column + sign * step * self.along[0]
            )
            yield replace(self, reach=self.reach * 1.5**sign)
            if self.side:
                yield replace(self, depth=self.depth + 0.3 * sign)
            else:
                yield replace(self, ratio=max(self.ratio * 2.0**sign, 1.2))


def likely_obstacles(observed: Observed, robust: Robust, solver: FlowSolver) -> list[Obstacle]:
    """Obstacles that could explain the observations of a chip, the likeliest first; [] where none is worth trying."""
    likelihood = _Likelihood.of(observed, robust)
    starts = [
        (_gain(start, observed, likelihood, solver), start)
        for piece in _ranked(observed, likelihood)
        for start in (piece, *(replace(piece, side=side, ratio=BLOCKED) for side in (-1, 1)))
    ]
    starts.sort(key=lambda entry: -entry[0])
    best = [_searched(*start, observed, likelihood, solver) for start in starts[:SEARCHED]]
    found = sorted([*best, *starts[SEARCHED:KEPT]], key=lambda entry: -entry[0])
    return [obstacle for gain, obstacle in found if gain > WORTH_TRYING]


def _searched(
    gain: float, obstacle: Obstacle, observed: Observed, likelihood: _Likelihood, solver: FlowSolver
) -> tuple[float, Obstacle]:
    """The best obstacle on the way of steepest ascent, and its gain."""
    for _ in range(MOST_STEPS):
        tried = [(_gain(one, observed, likelihood, solver), one) for one in obstacle.neighbours()]
        most, other = max(tried, key=lambda entry: entry[0])
        if most <= gain + LEAST_STEP:
            break
        gain, obstacle = most, other
    return gain, obstacle


def _ranked(observed: Observed, likelihood: _Likelihood) -> list[Obstacle]:
    """The best pieces of the channels at different places, blocked as a whole with the best ratio."""
    chip, expansion = observed.model.chip, observed.model.expansion
    equations, ratios = expansion.equations, np.array(RATIOS)
    pieces = _pieces(chip, expansion.base)
    gains = np.empty((len(pieces), len(ratios)))
    curl, volume = equations.stream.curl, equations.momentum.volume
    for first in range(0, len(pieces), BATCH):
        batch = pieces[first : first + BATCH]
        unit = np.stack(
            [local_friction(piece.friction_per_um2(chip), chip.um_per_px, equations.grid) for piece in batch], axis=1
        )
        drag = unit * (volume * expansion.flux)[:, None]
        modes = curl @ expansion.factors.solve(np.ascontiguousarray(-(curl.T @ drag)))
        back = -(drag * modes).sum(axis=0) / np.maximum(drag.T @ expansion.flux, 1e-300)
        change = (ratios - 1.0) / (1.0 + np.maximum(back, 0.0)[:, None] * (ratios - 1.0))
        pixels = np.ascontiguousarray((equations.momentum.centre @ modes).T).reshape(len(batch), -1, 2) * UM_PER_M
        gains[first : first + len(batch)] = likelihood.gains(observed.operator.predict(pixels), change)
    chosen: list[Obstacle] = []
    for index in np.argsort(-gains.max(axis=1)):
        piece = replace(pieces[index], ratio=float(ratios[gains[index].argmax()]))
        if len(chosen) == TRIED or gains[index].max() < WORTH_TRYING:
            break
        if all(
            np.hypot(piece.row - other.row, piece.column - other.column) > 2.0 * piece.half_width_px for other in chosen
        ):
            chosen.append(piece)
    return chosen


def _gain(obstacle: Obstacle, observed: Observed, likelihood: _Likelihood, solver: FlowSolver) -> float:
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
    return likelihood.of_flow(here.predict(changed.base), here.predict(known))


def _pieces(chip: Chip, flow: Floats) -> list[Obstacle]:
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
            piece = Obstacle(row, column, (float(u[0]), float(u[1])), radius, 0, 0.0, 1.5 * spacing, 2.0)
            box, along, across = piece.around(2.0 * radius + 2.0, mask.shape)
            free[box] &= ~((np.abs(along) <= spacing * radius) & (np.abs(across) <= 1.3 * radius + 1.0))
            if radius >= 1.5:
                found.append(piece)
        if len(found) <= MOST_PIECES:
            return found
        spacing *= 1.3


@dataclass(frozen=True, slots=True, eq=False)
class _Likelihood:
    """Of the observations y (m,), when every effect has its usual size; z of the boundary values is integrated out."""

    y: Floats
    others: Floats  # (m, m) covariance of all but the boundary values
    root: Floats  # (m, m) Cholesky factor of the whole covariance of the chip without an obstacle
    whitened: Floats  # (m,) misfit of its flow, divided by that
    without: float  # ln likelihood of that

    @classmethod
    def of(cls, observed: Observed, robust: Robust) -> _Likelihood:
        here, model = observed.operator, observed.model
        noise = (NOISE[1] * robust.factor) ** 2 * robust.variance / np.maximum(robust.inlier, LEAST_INLIER)
        others = observed.local_error() + np.diag(np.repeat(noise, 2))
        for effect in observed.effects(model.base, None):
            if effect.name not in ("boundary", "fluid"):
                others += effect.median**2 * effect.matrix
        y = here.flow_um_s.ravel()
        design = here.predict(model.known).reshape(len(model.known), -1)
        root = scipy.linalg.cholesky(others + design.T @ design, lower=True)
        whitened = scipy.linalg.solve_triangular(root, y - here.predict(model.base).ravel(), lower=True)
        without = -0.5 * float(whitened @ whitened) - float(np.log(np.diag(root)).sum())
        return cls(y, others, root, whitened, without)

    def of_flow(self, base: Floats, known: Floats) -> float:
        """Gain of another flow (n, 2) and its boundary modes (p, n, 2) at the observations."""
        design = known.reshape(len(known), -1)
        root = scipy.linalg.cholesky(self.others + design.T @ design, lower=True)
        whitened = scipy.linalg.solve_triangular(root, self.y - base.ravel(), lower=True)
        return -0.5 * float(whitened @ whitened) - float(np.log(np.diag(root)).sum()) - self.without

    def gains(self, modes: Floats, change: Floats) -> Floats:
        """(k, r) gain of r changes (k, r) along each mode (k, n, 2), to first order."""
        along = scipy.linalg.solve_triangular(self.root, modes.reshape(len(modes), -1).T, lower=True)
        return np.asarray(change * (self.whitened @ along)[:, None] - 0.5 * change**2 * (along**2).sum(axis=0)[:, None])
