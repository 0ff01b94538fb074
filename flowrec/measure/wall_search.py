"""Coarse search for a chip's walls in a picture: correlation of orientations over every angle, scale and place.

A wall may be a dark line, a bright line, a step, or several of these side by side. In all of these the gradient of the
image is across the wall, to one side or to the other. So the gradient g = (gx, gy) is kept as z = (gx + i gy)^2 / |g|,
which is the same for both sides, and is divided by the mean |g| around, so that light and contrast do not matter.
Texture has gradients of all directions, whose z cancel. The mask is treated in the same way, and the correlation of
the two is Re sum conj(z_mask) z_image, by FFT for all shifts at once.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Iterator
from dataclasses import replace
from typing import NamedTuple

import cv2
import numpy as np
import scipy  # its fft and optimize load at first use, not at start-up
from numpy.typing import NDArray

from flowrec.core import Floats, cells_at
from flowrec.measure.images import Levels, Mask, blur_image, gradient, shrink
from flowrec.physics import Calibration, clearance_um

Complex = NDArray[np.complex64]
_FINE_PX, _COARSE_PX = 480, 80  # longer side of the image in which gradients are taken, and of the one that is searched
_ANGLE_PX, _SCALE_PX = 1.8, 1.4  # how far half a step moves the chip's farthest wall, in coarse pixels
_LEAST_SEEN = 0.2  # of the walls that must lie in the image
_PEAKS = 3  # places that are kept of each angle and scale
_LEAST_SCORE = 0.5  # of a candidate, relative to the best one
_MOST_POINTS = 2500  # on the walls, drawn at random, at which the agreement of a pose is computed
_MOST_TRIALS = 160  # of a pose in one refinement
_APART_PX = 6.0  # distance between two candidates, in coarse pixels
_PAD_PX = 4  # by which channels go on straight beyond the mask


class WallMap:
    """Smooth signed distance to the walls of a mask, in um, also a little beyond its border.

    Attributes
    ----------
    mask, um_per_px : (h, w) True in fluid, and the size of its pixels.
    clearance_um : (h, w).
    size_um : width and height of the mask.
    points_um : (n, 2) pixel centres beside the walls.
    """

    def __init__(self, mask: Mask, um_per_px: float) -> None:
        self.mask, self.um_per_px = mask, um_per_px
        distance = clearance_um(np.pad(mask, _PAD_PX, mode="edge"), um_per_px)
        smooth = cv2.GaussianBlur(distance, (0, 0), 1.0)[_PAD_PX:-_PAD_PX, _PAD_PX:-_PAD_PX]
        self.clearance_um = np.ascontiguousarray(smooth, np.float32)
        down, right = np.gradient(self.clearance_um, um_per_px)
        height, width = mask.shape
        self.size_um = (width * um_per_px, height * um_per_px)
        rows, columns = np.nonzero(np.abs(self.clearance_um) < um_per_px)
        self.points_um: Floats = np.asarray(np.stack((columns, rows), -1) * um_per_px, np.float64)
        self._all = np.stack((self.clearance_um, right, down), -1)

    def at(self, points_um: Floats) -> tuple[Floats, Floats, Mask]:
        """Distances (n,), their gradients (n, 2), and whether the points (n, 2) lie on the mask (n,)."""
        cells = cells_at(points_um / self.um_per_px, self.clearance_um.shape)
        found = cells.interpolate(self._all)
        return found[:, 0], found[:, 1:], cells.inside

    def draw_distances(self, to_um: Floats, shape: tuple[int, ...]) -> Levels:
        """Distances (h, w) at the pixels of an image, roughly; infinite beside the mask.

        `to_um` (2, 3) takes (column, row, 1) of a pixel to the chip.
        """
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        size, to_px = (shape[1], shape[0]), to_um / self.um_per_px
        drawn = cv2.warpAffine(self.clearance_um, to_px, size, flags=flags, borderValue=math.inf)
        return np.asarray(drawn, np.float32)

    def lines(self) -> tuple[Floats, Floats]:
        """Points (n, 2) on the walls in px of the mask, as (column, row), and the unit normals (n, 2) there."""
        clearance_px = self.clearance_um / np.float32(self.um_per_px)
        down, right = (np.asarray(slope, np.float64) for slope in np.gradient(clearance_px.astype(np.float64)))
        size = np.asarray(np.hypot(right, down))
        near: Mask = np.asarray((np.abs(clearance_px) <= 0.75) & (size > 0.3))
        near[[0, -1]] = near[:, [0, -1]] = False
        rows, columns = np.nonzero(near)
        normals = np.stack((right[near], down[near]), -1) / size[near][:, None]
        return np.stack((columns, rows), -1) - clearance_px[near][:, None] * normals, normals


class Pose(NamedTuple):
    """A candidate: how the chip may lie in the image, and the significance of the correlation."""

    calibration: Calibration
    score: float


def orientations(image: Levels, width_px: float) -> Complex:
    """(h, w) z of an image, at most about 1 in size, averaged over lines of this width."""
    gx, gy = gradient(blur_image(image, 1.0))
    size = np.hypot(gx, gy)
    inverse = 1.0 / np.maximum(size, 1e-12)
    real, imaginary, around = (
        blur_image(np.asarray(part, np.float32), sigma_px)
        for part, sigma_px in (
            ((gx * gx - gy * gy) * inverse, width_px),
            (2.0 * gx * gy * inverse, width_px),
            (size, 3.0 * width_px),
        )
    )
    around = around + np.float32(0.5 * max(float(size.mean()), 1e-12))
    return np.asarray((real + 1j * imaginary) / around, np.complex64)


class WallSearch:
    """Candidates for the place of a mask in a picture (h, w)."""

    def __init__(self, picture: Levels, walls: WallMap) -> None:
        self._mask, self._chip_um = walls.mask, walls.um_per_px
        height, width = picture.shape
        self._size_px = (width, height)
        self._fine = max(1.0, max(width, height) / _FINE_PX)  # image pixels per fine pixel
        self._coarse = max(1.0, max(width, height) / self._fine / _COARSE_PX)  # fine pixels per coarse pixel
        self._step = self._fine * self._coarse  # image pixels per coarse pixel
        small = _block_means(picture, self._fine)
        self._maps = [orientations(small, sigma) for sigma in (4.0, 2.5)]
        self._z = self._coarse_means(orientations(small, 1.0))
        points, normals = walls.lines()
        chosen = np.random.default_rng(0).permutation(len(points))[:_MOST_POINTS]
        self._points_um, self._normals = points[chosen] * self._chip_um, normals[chosen]

    def candidates(self, um_per_px: tuple[float, float], mirrors: tuple[bool, ...], count: int) -> list[Pose]:
        """The best poses, refined to about a pixel, best first; `um_per_px` is the range that is searched."""
        found = _best_first(self._coarse_poses(um_per_px, mirrors))
        good = (pose for pose in found if pose.score >= _LEAST_SCORE * found[0].score)
        kept = itertools.islice(self._distinct(good, _APART_PX), count)
        return list(self._distinct(_best_first(map(self._refine, kept)), 0.5 * _APART_PX))

    def _distinct(self, poses: Iterable[Pose], apart_px: float) -> Iterator[Pose]:
        """The poses whose walls are so far, in coarse pixels, from those of each one before."""
        kept: list[Floats] = []
        for pose in poses:
            walls_px = pose.calibration.to_px(self._points_um[::10])
            apart = (math.sqrt(float(np.mean(np.sum((walls_px - other) ** 2, -1)))) / self._step for other in kept)
            if all(each > apart_px for each in apart):
                kept.append(walls_px)
                yield pose

    def _coarse_means(self, z: Complex) -> Complex:
        means = _block_means(z.real, self._coarse) + 1j * _block_means(z.imag, self._coarse)
        return np.asarray(means, np.complex64)

    def _coarse_poses(self, um_per_px: tuple[float, float], mirrors: tuple[bool, ...]) -> Iterator[Pose]:
        for scale_um in _steps(*um_per_px, self._z.shape, _SCALE_PX):
            z_mask = self._mask_orientations(scale_um * self._step)
            reach = 0.5 * min(math.hypot(*z_mask.shape), math.hypot(*self._z.shape))
            count = math.ceil(math.pi * reach / _ANGLE_PX)
            side = math.ceil(math.hypot(*z_mask.shape)) + 2
            image_fft = scipy.fft.fft2(self._z, tuple(scipy.fft.next_fast_len(n + side) for n in self._z.shape))
            for mirror in mirrors:
                for n in range(count):
                    upright = Calibration(scale_um, (0.0, 0.0), 360.0 * n / count, mirror)
                    yield from self._places(z_mask, upright, side, image_fft)

    def _mask_orientations(self, coarse_um: float) -> Complex:
        """(h, w) z of the mask on coarse pixels."""
        scale = self._chip_um / (coarse_um / self._coarse)
        pad = max(self._mask.shape) // 8
        padded = np.pad(self._mask, pad, mode="edge").astype(np.float32)
        height, width = (max(8, round(n * scale)) for n in padded.shape)
        how = cv2.INTER_AREA if scale < 1.0 else cv2.INTER_LINEAR
        drawn = np.asarray(cv2.resize(padded, (width, height), interpolation=how), np.float32)
        cut = round(pad * scale)
        return self._coarse_means(orientations(drawn, 1.0)[cut : height - cut, cut : width - cut])

    def _places(self, z_mask: Complex, upright: Calibration, side: int, image_fft: Complex) -> Iterator[Pose]:
        """The best places of a mask in one angle and scale, drawn on a square of `side` coarse pixels."""
        axes, shape = upright.axes, image_fft.shape
        middle = (np.array(z_mask.shape[::-1]) - 1) / 2
        centre = (side - 1) / 2
        matrix = np.column_stack((axes, centre - axes @ middle))
        parts = np.stack((z_mask.real, z_mask.imag), -1)
        turned = cv2.warpAffine(parts, matrix, (side, side), flags=cv2.INTER_LINEAR)
        z = turned[..., 0] + 1j * turned[..., 1]
        turn = np.exp(2j * math.radians(upright.angle_deg)).astype(np.complex64)
        z = turn * (np.conj(z) if upright.mirror else z)
        agreement = scipy.fft.ifft2(image_fft * np.conj(scipy.fft.fft2(z, shape))).real
        # Of the walls that the image shows at each shift: the sum of |z| over a window, by summed areas.
        weight = np.abs(z)
        h, w = self._z.shape
        total = np.pad(weight.astype(np.float64), ((h, h - 1), (w, w - 1))).cumsum(0).cumsum(1)
        seen = (total[h:, w:] - total[:-h, w:] - total[h:, :-w] + total[:-h, :-w])[::-1, ::-1]
        whole = float(weight.sum())
        rows, columns = np.arange(-side + 1, h), np.arange(-side + 1, w)
        score = agreement[np.ix_(rows % shape[0], columns % shape[1])] / np.sqrt(np.maximum(seen, 1e-6 * whole))
        score[seen < _LEAST_SEEN * whole] = -np.inf
        middle_um = 0.5 * self._chip_um * (np.array(self._mask.shape[::-1]) - 1)
        for _ in range(_PEAKS):
            row, column = np.unravel_index(int(score.argmax()), score.shape)
            best = float(score[row, column])
            if not best > 0.0:
                return
            score[max(row - 3, 0) : row + 4, max(column - 3, 0) : column + 4] = -np.inf
            at_px = self._step * (np.array((columns[column], rows[row])) + centre + 0.5) - 0.5
            yield Pose(_with_point(upright, at_px, middle_um), best)

    def _refine(self, pose: Pose) -> Pose:
        """The pose that agrees best with the directions at the walls' points."""
        best, score = pose.calibration, 0.0
        points_px = best.to_px(self._points_um)
        inside = ((points_px >= 0) & (points_px < self._size_px)).all(-1)
        middle = points_px[inside].mean(0) if inside.any() else points_px.mean(0)
        reach = max(float(np.hypot(*(points_px - middle).T).mean()), 1.0)
        simplex = np.vstack((np.zeros(4), self._step * np.eye(4)))
        options = {"initial_simplex": simplex, "xatol": 0.05 * self._step, "fatol": 1e-4, "maxfev": _MOST_TRIALS}
        for number in range(len(self._maps)):

            def worse(move: Floats, number: int = number, start: Calibration = best) -> float:
                return -self.agreement(move_chip(start, move, middle, reach), number)

            found = scipy.optimize.minimize(worse, np.zeros(4), method="Nelder-Mead", options=options)
            best, score = move_chip(best, found.x, middle, reach), -float(found.fun)
        return Pose(best, score)

    def agreement(self, calibration: Calibration, number: int = 0) -> float:
        """Agreement of wall directions at one pose, which may be off by some 4 of 480 pixels.

        It is the mean at the points in the image, times the root of their number relative to all. `number`: of the map
        of the image; the second one is finer.
        """
        z = self._maps[number]
        at = (calibration.to_px(self._points_um) + 0.5) / self._fine - 0.5
        height, width = z.shape
        inside = ((at >= 0) & (at <= (width - 1, height - 1))).all(-1)
        if inside.mean() < 0.5 * _LEAST_SEEN:
            return 0.0
        normals = self._normals[inside] @ calibration.axes.T
        across = (normals[:, 0] + 1j * normals[:, 1]) ** 2
        cells = cells_at(at[inside], z.shape)
        real, imaginary = cells.interpolate(z.view(np.float32).reshape(height, width, 2)).T
        agreement = across.real * real + across.imag * imaginary
        return float(agreement.mean()) * math.sqrt(float(inside.mean()))


def move_chip(calibration: Calibration, move: Floats, middle_px: Floats, reach_px: float) -> Calibration:
    """The calibration after a small motion of the chip in the image.

    Parameters
    ----------
    move : (4,) px: shift right and down, turn and growth as the motion of a point at `reach_px`.
    middle_px : (2,) px: the point about which the chip turns and grows.
    """
    right, down, turn, growth = move.tolist()
    scale_um = calibration.um_per_px * math.exp(-growth / reach_px)
    angle_deg = calibration.angle_deg + math.degrees(turn / reach_px)
    turned = Calibration(scale_um, (0.0, 0.0), angle_deg, calibration.mirror)
    return _with_point(turned, middle_px + np.array((right, down)), calibration.to_um(middle_px))


def _with_point(turned: Calibration, at_px: Floats, point_um: Floats) -> Calibration:
    """A calibration whose origin is 0, moved so that a chip point (2,) lies at a pixel (2,)."""
    x, y = (point_um - turned.to_um(at_px)).tolist()
    return replace(turned, origin_um=(x, y))


def _best_first(poses: Iterable[Pose]) -> list[Pose]:
    return sorted(poses, key=lambda pose: -pose.score)


def _steps(low: float, high: float, shape: tuple[int, ...], tolerance_px: float) -> Floats:
    """Scales between two, so close that half a step moves the image's border by the tolerance."""
    ratio = 1.0 + 2.0 * tolerance_px / (0.5 * max(shape))
    count = max(1, math.ceil(math.log(high / low) / math.log(ratio)))
    return low * (high / low) ** ((np.arange(count) + 0.5) / count)


def _block_means(image: Levels, factor: float) -> Levels:
    """An image averaged over squares of `factor` pixels; pixel centres as cv2.resize counts them."""
    image = np.ascontiguousarray(image, np.float32)
    if factor <= 1.0:
        return image
    height, width = (max(8, round(n / factor)) for n in image.shape)
    return shrink(image, (width, height))
