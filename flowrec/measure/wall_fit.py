"""Sub-pixel registration of a chip's walls: the pose for which grey levels depend most on the distance to the walls.

Near the walls the image is a function f of the signed distance d to the walls: a dark line, a step, both. f is unknown
and the same everywhere but for light and contrast, which differ from one patch k of the chip to the next. The pose p,
f (piecewise linear), a and b minimise

    sum_x w(x) [I(x) - a_k - b_k f(d(x; p))]^2

by Gauss-Newton; w are Tukey's weights, which leave out debris and the robot. So it does not matter whether walls are
dark or bright, how wide they look, or whether all of them look wider than the mask says.

f is free, so it can also explain a wrong pose. In relief (oblique light, differential interference contrast) walls are
bright on one side of the channel and dark on the other; with the chip shifted by half the width of these lines, f is
dark outside of the channel, bright inside, and every wall shows half of that. Two things tell:

- The wall of a patch counts as found if its own profile correlates with the f of walls that face the other way.
- The picture is read twice: as grey levels I, and as local contrast |grad I|, which is a function of d also in relief.
  Both fits begin at the same pose. They end at the same one if it is right; if it is not, their errors have nothing in
  common. The difference is part of the standard error.

The offsets of the patches across the walls are the residual; the scatter of their normal equations gives the standard
error of one reading.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import cv2
import numpy as np

from flowrec.core import STD_PER_MAD, TUKEY, Floats, Ints
from flowrec.measure.images import Levels, blur_image, gradient, shrink
from flowrec.measure.wall_search import WallMap, move_chip
from flowrec.physics import Calibration

Stages = tuple[tuple[float, int, float], ...]
_LONGEST_PX = 1280  # side of the image that is fitted
# Blur, most pixels, and the motion in px at which Gauss-Newton ends; one row after the other.
_STAGES = ((4.0, 30_000, 0.05), (2.0, 30_000, 0.05), (1.0, 30_000, 0.02), (0.0, 100_000, 0.003))
_COARSE = (8.0, 30_000, 0.05)  # before these, where they do not lead to the same pose
_STEPS = 8  # of Gauss-Newton, at most, in each stage
_CONTRAST_BLUR_PX = 1.5  # at least, where local contrast is taken: noise has contrast too
_HOPELESS = 0.4  # part of the walls found by grey levels below which local contrast is not asked
_RELIEF_FOUND, _RELIEF_MORE = 0.9, 0.1  # part of the walls found by local contrast, and by how much less by grey levels
_KNOTS = 12  # of f on either side of the wall
_ALL_KNOTS = 2 * _KNOTS + 1
_BEND = np.diff(np.eye(_ALL_KNOTS), 2, axis=0).T @ np.diff(np.eye(_ALL_KNOTS), 2, axis=0)
_LIKE = 0.5  # correlation of a patch's profile with f from which on the patch counts as found
_LEAST_PIXELS = 30  # of a patch
_LEAST_ALL = 200  # pixels of a fit


class WallFit(NamedTuple):
    """A pose with all that is known of its quality."""

    calibration: Calibration  # the pose
    explained: float  # relative variance of the grey levels near the walls that f explains
    found: float  # part of the walls in the image that look like the others, 0 to 1
    seen: float  # part of the chip's walls that the image shows
    residual_um: float  # root mean square distance of the walls of the patches from where the pose puts them
    # (4,) standard errors: shift of the image's centre along x and y in um, angle in degrees, relative scale
    std: Floats
    apart: Floats  # (4,) the part of them that is the difference of the two readings; 0 where only one of them counts


class Fitter:
    """Fits poses of one chip to one picture.

    Parameters
    ----------
    picture : (h, w) grey levels.
    walls : of the chip.
    reach_um : distance from the walls up to which the picture is used.
    um_per_px : of the picture, roughly.
    """

    def __init__(self, picture: Levels, walls: WallMap, reach_um: float, um_per_px: float) -> None:
        self._walls, self._reach_um = walls, reach_um
        self._size_px = np.array(picture.shape[::-1])
        self._middle_px = (self._size_px - 1) / 2
        step = max(1.0, max(picture.shape) / _LONGEST_PX)
        small = picture
        if step > 1.0:
            height, width = (round(n / step) for n in picture.shape)
            small = shrink(picture, (width, height))
        # Pixels of the picture to one of those that are fitted, along x and y.
        self._step = self._size_px / small.shape[::-1]
        self._sigma_px = 2.0 * reach_um / (um_per_px * step)
        self._levelled = level_contrast(small, 2.0 * self._sigma_px)
        self._contrasts: dict[float, Levels] = {}

    def fit(self, start: Calibration) -> WallFit:
        """The pose near a first one, by both readings."""
        grey = self._fit(self._grey, start)
        if grey.found < _HOPELESS:
            return grey
        contrast = self._fit(self._contrast, start)
        apart = self._apart(grey, contrast)
        if contrast.found < _RELIEF_FOUND and (apart > grey.std + contrast.std).any():
            # Local contrast has more local minima than grey levels.
            other = self._fit(self._contrast, start, (_COARSE, *_STAGES))
            contrast = max(contrast, other, key=lambda fit: fit.found)
            apart = self._apart(grey, contrast)
        if contrast.found >= _RELIEF_FOUND and grey.found < contrast.found - _RELIEF_MORE:
            return contrast
        return grey._replace(std=np.hypot(grey.std, apart), apart=apart)

    def _apart(self, one: WallFit, other: WallFit) -> Floats:
        """(4,) difference of two poses, in the units of `WallFit.std`."""
        a, b = one.calibration, other.calibration
        turned = (a.angle_deg - b.angle_deg + 180.0) % 360.0 - 180.0
        shift_um = a.to_um(self._middle_px) - b.to_um(self._middle_px)
        return np.abs((*shift_um, turned, math.log(a.um_per_px / b.um_per_px)))

    def _grey(self, blur_px: float) -> Levels:
        return blur_image(self._levelled, blur_px) if blur_px > 0.0 else self._levelled

    def _contrast(self, blur_px: float) -> Levels:
        sigma_px = max(blur_px, _CONTRAST_BLUR_PX)
        if sigma_px not in self._contrasts:
            size = np.hypot(*gradient(blur_image(self._levelled, sigma_px)))
            self._contrasts[sigma_px] = level_contrast(size, 2.0 * self._sigma_px)
        return self._contrasts[sigma_px]

    def _fit(self, reading: Callable[[float], Levels], start: Calibration, stages: Stages = _STAGES) -> WallFit:
        now = start
        for blur_px, most, enough_px in stages:
            sample = self._sample(reading(blur_px), now, most)
            model = None
            for _ in range(_STEPS):
                model = _Model(sample, self._walls, now, self._reach_um, model)
                move = model.step()
                now = move_chip(now, move, sample.middle_px, sample.reach_px)
                if float(np.abs(move).max()) < enough_px:
                    break
        return self._judge(_Model(sample, self._walls, now, self._reach_um, model), now, sample)

    def _sample(self, image: Levels, start: Calibration, most: int) -> _Sample:
        """At most so many pixels of the image near the walls, for a pose that moves a little yet."""
        to_um = start.matrix @ np.vstack(
            (np.column_stack((np.diag(self._step), 0.5 * self._step - 0.5)), (0.0, 0.0, 1.0))
        )
        near = np.flatnonzero(np.abs(self._walls.draw_distances(to_um, image.shape)) < 1.2 * self._reach_um)
        near = np.random.default_rng(0).permutation(near)[:most]
        rows, columns = np.divmod(near, image.shape[1])
        at_px = (np.stack((columns, rows), -1) + 0.5) * self._step - 0.5
        return _Sample(at_px, image[rows, columns].astype(np.float64))

    def _judge(self, model: _Model, now: Calibration, sample: _Sample) -> WallFit:
        found, residual_um, covariance = model.patches()
        # The shift of the image's centre rather than of the middle of the pixels.
        right, down = self._middle_px - sample.middle_px
        per = 1.0 / sample.reach_px
        to_centre = np.array(
            [[1, 0, -down * per, right * per], [0, 1, right * per, down * per], [0, 0, per, 0], [0, 0, 0, per]]
        )
        std = np.full(4, math.inf)
        if np.isfinite(covariance).all():
            std = np.sqrt(np.maximum(np.diag(to_centre @ covariance @ to_centre.T), 0.0))
        std *= (now.um_per_px, now.um_per_px, math.degrees(1.0), 1.0)
        at_px = now.to_px(self._walls.points_um)
        seen = float(((at_px >= 0) & (at_px <= self._size_px - 1)).all(-1).mean())
        return WallFit(now, model.explained, found, seen, residual_um, std, np.zeros(4))


def level_contrast(image: Levels, sigma_px: float) -> Levels:
    """An image without its slow variation, of even contrast."""
    high = image - cv2.GaussianBlur(image, (0, 0), sigma_px, borderType=cv2.BORDER_REFLECT)
    power = cv2.GaussianBlur(high * high, (0, 0), 2.0 * sigma_px, borderType=cv2.BORDER_REFLECT)
    return np.asarray(high / np.sqrt(power + 0.05 * max(float(power.mean()), 1e-12)), np.float32)


class _Sample:
    """Pixels (n, 2) and their grey levels (n,); the point about which poses turn, and the mean distance from it."""

    def __init__(self, at_px: Floats, levels: Floats) -> None:
        self.at_px, self.levels = at_px, levels
        self.middle_px = at_px.mean(0) if len(at_px) else np.zeros(2)
        self.reach_px = max(float(np.hypot(*(at_px - self.middle_px).T).mean()), 1.0) if len(at_px) else 1.0


class _Model:
    """f, a and b at one pose, the residuals, and the normal equations for a motion of the chip.

    `before` is the model at a pose nearby, with which the search for f, a and b begins.

    Attributes
    ----------
    offset, gain : (patches,) a and b.
    """

    def __init__(
        self, sample: _Sample, walls: WallMap, now: Calibration, reach_um: float, before: _Model | None = None
    ) -> None:
        points_um = now.to_um(sample.at_px)
        distance, gradient, inside = walls.at(points_um)
        used = inside & (np.abs(distance) < reach_um)
        self._distance, self._reach_um = distance[used], reach_um
        self._levels = sample.levels[used]
        place = (self._distance / reach_um + 1.0) * _KNOTS
        self._low = np.clip(place.astype(np.intp), 0, _ALL_KNOTS - 2)
        self._part = place - self._low
        columns, rows = np.floor(points_um[used] / (2.0 * reach_um) + 0.5).astype(np.intp).T
        across, down = (int(length // (2.0 * reach_um)) + 2 for length in walls.size_um)
        self._patch = np.clip(rows, 0, down - 1) * across + np.clip(columns, 0, across - 1)
        self._count = across * down
        slope_px = now.um_per_px * gradient[used] @ now.axes.T  # of d, in um per px of the image
        self._across = slope_px
        arm = (sample.at_px[used] - sample.middle_px) / sample.reach_px
        turn = slope_px[:, 1] * arm[:, 0] - slope_px[:, 0] * arm[:, 1]
        # (n, 4) derivatives of d by right, down, turn, growth
        self._of_d = -np.column_stack((slope_px, turn, (slope_px * arm).sum(-1)))
        self.offset: Floats = before.offset if before is not None else np.zeros(self._count)
        self.gain: Floats = before.gain if before is not None else np.ones(self._count)
        self._weigh(np.ones(len(self._levels)))
        for _ in range(5 if before is None else 3):
            self._improve()

    def _improve(self) -> None:
        """Solve for f with a and b as they are, for a and b with f, then for the weights."""
        a, b = self.offset[self._patch], self.gain[self._patch]
        self._profile = self._solve(self._weight * b, self._levels - a, b)
        f = self._at(self._profile)
        self.gain = np.clip(self._gain(f), 0.2, 5.0)
        b = self.gain[self._patch]
        self.offset = self._mean(self._levels - b * f)
        self._rest = self._levels - self.offset[self._patch] - b * f
        scale = STD_PER_MAD * float(np.median(np.abs(self._rest))) + 1e-9 if len(self._rest) else 1.0
        self._weigh(np.maximum(1.0 - (self._rest / (TUKEY * scale)) ** 2, 0.0) ** 2)

    def _weigh(self, weight: Floats) -> None:
        self._weight = weight
        self._total = self._sums(weight) + 1e-9

    def _gain(self, f: Floats) -> Floats:
        """(patches,) slope of the line through the grey levels of each patch over f, drawn towards 1."""
        df, dv = (values - self._mean(values)[self._patch] for values in (f, self._levels))
        square, cross = (self._sums(self._weight * df * each) for each in (df, dv))
        draw = 0.1 * float(square.sum()) / max(int(np.count_nonzero(square)), 1) + 1e-12
        return (cross + draw) / (square + draw)

    def _solve(self, weight: Floats, values: Floats, gain: Floats) -> Floats:
        """The g at the knots that minimises sum weight / gain (values - gain g(d))^2, with a little smoothness."""
        return np.asarray(np.linalg.solve(self._normal(weight * gain), self._on_knots(weight * values)), np.float64)

    def _normal(self, weight: Floats) -> Floats:
        """(knots, knots) matrix of the normal equations for g at the knots, with a little smoothness."""
        upper = weight * self._part
        both = upper * self._part
        # (1 - part)^2, part^2 and part (1 - part) from the sums of 1, part and part^2 between two knots.
        one, first, second = (_sums(self._low, each, _ALL_KNOTS) for each in (weight, upper, both))
        diagonal = one - 2.0 * first + second
        diagonal[1:] += second[:-1]
        beside = (first - second)[:-1]
        matrix = np.diag(diagonal) + np.diag(beside, 1) + np.diag(beside, -1)
        matrix += 1e-4 * max(float(diagonal.mean()), 1e-9) * _BEND
        return matrix + 1e-9 * np.eye(_ALL_KNOTS)

    def _on_knots(self, values: Floats) -> Floats:
        """(knots,) sums of values (n,), of which each knot gets its share."""
        upper = _sums(self._low, self._part * values, _ALL_KNOTS)
        found = _sums(self._low, values, _ALL_KNOTS) - upper
        found[1:] += upper[:-1]
        return found

    def _at(self, profile: Floats) -> Floats:
        return profile.take(self._low) + self._part * np.diff(profile).take(self._low)

    def _sums(self, values: Floats) -> Floats:
        """(patches,) sums of values (n,) over the patches."""
        return _sums(self._patch, values, self._count)

    def _mean(self, values: Floats) -> Floats:
        """Weighted mean (patches,) of the values of each patch."""
        return self._sums(self._weight * values) / self._total

    @property
    def explained(self) -> float:
        """Relative weighted variance within the patches that f explains."""
        if not len(self._levels):
            return 0.0
        off = self._levels - self._mean(self._levels)[self._patch]
        whole = float(np.sum(self._weight * off**2))
        return max(1.0 - float(np.sum(self._weight * self._rest**2)) / max(whole, 1e-12), 0.0)

    def _of_motion(self) -> Floats:
        """(n,) derivative of b f(d) by d."""
        slope = np.gradient(self._profile) * _KNOTS / self._reach_um
        return self.gain[self._patch] * self._at(slope)

    def _jacobian(self) -> tuple[Floats, Floats]:
        """(n, 4) derivatives of b f(d) by the motion, without what other f, a and b could explain; normal matrix."""
        gain = self.gain[self._patch]
        jacobian = self._of_motion()[:, None] * self._of_d
        weighted = self._weight * gain
        inverse = np.linalg.inv(self._normal(weighted * gain))
        for column in range(4):
            values = jacobian[:, column]
            for _ in range(2):
                values = values - gain * self._at(inverse @ self._on_knots(weighted * values))
                values = values - self._mean(values)[self._patch]
            jacobian[:, column] = values
        return jacobian, jacobian.T @ (self._weight[:, None] * jacobian)

    def step(self) -> Floats:
        """The motion (4,) px that Gauss-Newton makes, at most two pixels of each kind."""
        if len(self._levels) < _LEAST_ALL:
            return np.zeros(4)
        jacobian, normal = self._jacobian()
        right = jacobian.T @ (self._weight * self._rest)
        normal += 1e-6 * np.trace(normal) * np.eye(4) + 1e-12 * np.eye(4)
        return np.clip(np.linalg.solve(normal, right), -2.0, 2.0)

    def _other_profiles(self) -> Floats:
        """(4, knots) f of the walls whose channel lies to the left, above, to the right and below."""
        gain, levels = self.gain[self._patch], self._levels - self.offset[self._patch]
        ways = np.array([(1, 0), (0, 1), (-1, 0), (0, -1)])
        return np.stack([self._solve(gain * (self._across @ way < 0.0), levels, gain) for way in ways])

    def patches(self) -> tuple[float, float, Floats]:
        """The part of the walls that is found, the residual in um, and the covariance (4, 4) of the motion in px^2."""
        if len(self._levels) < _LEAST_ALL:
            return 0.0, math.inf, np.full((4, 4), math.inf)
        # The walls of a patch that face one of four ways, and how their mean profile correlates with f of the others.
        way = np.rint(np.arctan2(self._across[:, 1], self._across[:, 0]) / (0.5 * math.pi)).astype(np.intp) % 4
        wall, walls = 4 * self._patch + way, 4 * self._count
        nearest = np.clip(np.rint(self._low + self._part).astype(np.intp), 0, _ALL_KNOTS - 1)
        key = wall * _ALL_KNOTS + nearest
        number, total = (
            np.bincount(key, values, walls * _ALL_KNOTS).reshape(walls, _ALL_KNOTS) for values in (None, self._levels)
        )
        like = _correlation(total / np.maximum(number, 1), np.tile(self._other_profiles(), (self._count, 1)), number)
        usable = (np.bincount(wall, minlength=walls) >= _LEAST_PIXELS) & ((number > 0).sum(1) >= _KNOTS // 2)
        length = np.bincount(wall, np.abs(self._distance) < 0.25 * self._reach_um, walls)
        found = usable & (like > _LIKE)
        share = float(length[found].sum() / max(length[usable].sum(), 1e-9))
        of_d = self._of_motion()
        square, moved = (_sums(wall, of_d * self._weight * each, walls) for each in (of_d, self._rest))
        off_um = moved / np.maximum(square, 1e-12)
        weights = length * found
        residual = math.sqrt(float(np.sum(weights * off_um**2) / max(weights.sum(), 1e-9)))
        jacobian, normal = self._jacobian()
        parts = np.stack([self._sums(self._weight * self._rest * jacobian[:, k]) for k in range(4)], -1)
        values, vectors = np.linalg.eigh(normal)
        inverse = vectors @ np.diag(1.0 / np.maximum(values, 1e-9 * values[-1])) @ vectors.T
        return share, residual, inverse @ (parts.T @ parts) @ inverse


def _sums(places: Ints, values: Floats, count: int) -> Floats:
    """(count,) sums of the values (n,) at each place."""
    return np.asarray(np.bincount(places, values, count), np.float64)


def _correlation(a: Floats, b: Floats, weight: Ints) -> Floats:
    """Weighted correlation of the rows of a and b."""
    total = np.maximum(weight.sum(1, keepdims=True), 1)
    a = a - (weight * a).sum(1, keepdims=True) / total
    b = b - (weight * b).sum(1, keepdims=True) / total
    both = np.sqrt((weight * a * a).sum(1) * (weight * b * b).sum(1))
    return (weight * a * b).sum(1) / np.maximum(both, 1e-12)
