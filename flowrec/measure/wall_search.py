"""Coarse search for a chip's walls in a picture: correlation of orientations over every angle, scale and place.

A wall may be a dark line, a bright line, a step, or several of these side by side. In all of these the gradient of the
image is across the wall, to one side or to the other. So the gradient g = (gx, gy) is kept as z = (gx + i gy)^2 / |g|,
which is the same for both sides, and is divided by the mean |g| around, so that light and contrast do not matter.
Texture has gradients of all directions, whose z cancel. The mask is treated in the same way, and the correlation of
the two is Re sum conj(z_mask) z_image, by FFT for all shifts at once.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import cv2
import numpy as np
import scipy  # its fft and optimize load at first use, not at start-up
from numpy.typing import NDArray

from flowrec.core import cells_at
from flowrec.physics import Calibration

Complex = NDArray[np.complex64]
Points = NDArray[np.float64]
_FINE_PX, _COARSE_PX = 480, 80  # longer side of the image in which gradients are taken, and of the one that is searched
_ANGLE_PX, _SCALE_PX = 1.8, 1.4  # how far half a step moves the chip's farthest wall, in coarse pixels
_LEAST_SEEN = 0.2  # of the walls that must lie in the image
_PEAKS = 3  # places that are kept of each angle and scale
_LEAST_SCORE = 0.5  # of a candidate, relative to the best one
_MOST_POINTS = 2500  # on the walls, drawn at random, at which the agreement of a pose is computed
_MOST_TRIALS = 160  # of a pose in one refinement
_APART_PX = 6.0  # distance between two candidates, in coarse pixels


@dataclass(frozen=True, slots=True)
class Pose:
    """A candidate: how the chip may lie in the image, and the significance of the correlation."""

    calibration: Calibration
    score: float


def blur_image(image: NDArray[np.float32], sigma_px: float) -> NDArray[np.float32]:
    """An image (h, w) after a Gaussian blur; beyond the border its edge goes on."""
    return np.asarray(cv2.GaussianBlur(image, (0, 0), sigma_px, borderType=cv2.BORDER_REPLICATE), np.float32)


def gradient(image: NDArray[np.float32]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Sobel's derivatives (h, w) to the right and down."""
    right, down = (
        np.asarray(cv2.Sobel(image, cv2.CV_32F, *axis, ksize=3, borderType=cv2.BORDER_REPLICATE), np.float32)
        for axis in ((1, 0), (0, 1))
    )
    return right, down


def orientations(image: NDArray[np.float32], width_px: float) -> Complex:
    """(h, w) z of an image, at most about 1 in size, averaged over lines of this width."""
    gx, gy = gradient(blur_image(image, 1.0))
    size = np.asarray(np.hypot(gx, gy), np.float32)
    inverse = 1.0 / np.maximum(size, 1e-12)
    real, imaginary, around = (
        blur_image(part, sigma)
        for part, sigma in (
            (np.asarray((gx * gx - gy * gy) * inverse, np.float32), width_px),
            (np.asarray(2.0 * gx * gy * inverse, np.float32), width_px),
            (size, 3.0 * width_px),
        )
    )
    around = around + np.float32(0.5 * max(float(size.mean()), 1e-12))
    return np.asarray((real + 1j * imaginary) / around, np.complex64)


def wall_points(clearance_px: NDArray[np.float32]) -> tuple[Points, Points]:
    """Points (n, 2) on the walls in px of the mask, as (column, row), and the unit normals (n, 2) there."""
    down, right = (np.asarray(slope, np.float64) for slope in np.gradient(clearance_px.astype(np.float64)))
    size: Points = np.asarray(np.hypot(right, down), np.float64)
    near: NDArray[np.bool_] = np.asarray((np.abs(clearance_px) <= 0.75) & (size > 0.3))
    near[[0, -1]] = near[:, [0, -1]] = False
    rows, columns = np.nonzero(near)
    normals = np.stack((right[near], down[near]), -1) / size[near].reshape(-1, 1)
    points: Points = np.stack((columns, rows), -1) - clearance_px[near].reshape(-1, 1) * normals
    return points, normals


class WallSearch:
    """Candidates for the place of a mask in a picture.

    Parameters
    ----------
    picture : (h, w) grey levels.
    mask, um_per_px : (h, w) True in fluid, and the size of its pixels.
    clearance_um : (h, w) smooth signed distance to the walls.
    """

    def __init__(
        self,
        picture: NDArray[np.float32],
        mask: NDArray[np.bool_],
        um_per_px: float,
        clearance_um: NDArray[np.float32],
    ) -> None:
        self._mask, self._chip_um = mask, um_per_px
        height, width = picture.shape
        self._size_px = (width, height)
        self._fine = max(1.0, max(width, height) / _FINE_PX)  # image pixels per fine pixel
        self._coarse = max(1.0, max(width, height) / self._fine / _COARSE_PX)  # fine pixels per coarse pixel
        small = _block_means(picture, self._fine)
        self._maps = [orientations(small, sigma) for sigma in (4.0, 2.5)]
        fine = orientations(small, 1.0)
        self._z = _block_means(fine.real, self._coarse) + 1j * _block_means(fine.imag, self._coarse)
        points, normals = wall_points(clearance_um / np.float32(um_per_px))
        chosen = np.random.default_rng(0).permutation(len(points))[:_MOST_POINTS]
        self._points_um, self._normals = points[chosen] * um_per_px, normals[chosen]

    def candidates(self, um_per_px: tuple[float, float], mirrors: tuple[bool, ...], count: int) -> list[Pose]:
        """The best poses, refined to about a pixel, best first; `um_per_px` is the range that is searched."""
        found = sorted(self._coarse_poses(um_per_px, mirrors), key=lambda pose: -pose.score)
        kept: list[Pose] = []
        for pose in found:
            if pose.score < _LEAST_SCORE * found[0].score:
                break
            if all(self._distance_px(pose, other) > _APART_PX for other in kept):
                kept.append(pose)
                if len(kept) == count:
                    break
        kept = sorted((self._refine(pose) for pose in kept), key=lambda pose: -pose.score)
        distinct: list[Pose] = []
        for pose in kept:
            if all(self._distance_px(pose, other) > 0.5 * _APART_PX for other in distinct):
                distinct.append(pose)
        return distinct

    def agreement(self, calibration: Calibration) -> float:
        """Agreement of wall directions at one pose, which may be off by some 4 of 480 pixels."""
        return self._agreement(self._maps[0], calibration)

    def _distance_px(self, one: Pose, other: Pose) -> float:
        """Root mean square distance of the walls of two poses, in coarse pixels."""
        off = one.calibration.to_px(self._points_um[::10]) - other.calibration.to_px(self._points_um[::10])
        return math.sqrt(float(np.mean(np.sum(off * off, -1)))) / float(self._fine * self._coarse)

    def _coarse_poses(self, um_per_px: tuple[float, float], mirrors: tuple[bool, ...]) -> Iterator[Pose]:
        low, high = um_per_px
        step_px = self._fine * self._coarse  # image pixels per coarse pixel
        for scale_um in _steps(low, high, self._z.shape, _SCALE_PX):
            z_mask = self._mask_orientations(scale_um * step_px)
            reach = 0.5 * min(math.hypot(*z_mask.shape), math.hypot(*self._z.shape))
            count = math.ceil(math.pi * reach / _ANGLE_PX)
            side = math.ceil(math.hypot(*z_mask.shape)) + 2
            shape = tuple(scipy.fft.next_fast_len(n + side) for n in self._z.shape)
            image_fft = scipy.fft.fft2(self._z, shape)
            for mirror in mirrors:
                for n in range(count):
                    angle_deg = 360.0 * n / count
                    yield from self._at(z_mask, scale_um, angle_deg, mirror, side, shape, image_fft)

    def _mask_orientations(self, coarse_um: float) -> Complex:
        """(h, w) z of the mask on coarse pixels."""
        fine_um = coarse_um / self._coarse
        scale = self._chip_um / fine_um
        pad = max(self._mask.shape) // 8
        padded = np.pad(self._mask, pad, mode="edge").astype(np.float32)
        height, width = (max(8, round(n * scale)) for n in padded.shape)
        how = cv2.INTER_AREA if scale < 1.0 else cv2.INTER_LINEAR
        drawn = np.asarray(cv2.resize(padded, (width, height), interpolation=how), np.float32)
        fine = orientations(drawn, 1.0)
        cut = round(pad * scale)
        fine = fine[cut : height - cut, cut : width - cut]
        return np.asarray(
            _block_means(fine.real, self._coarse) + 1j * _block_means(fine.imag, self._coarse), np.complex64
        )

    def _at(
        self,
        z_mask: Complex,
        scale_um: float,
        angle_deg: float,
        mirror: bool,
        side: int,
        shape: tuple[int, ...],
        image_fft: Complex,
    ) -> Iterator[Pose]:
        """The best places of one angle and scale."""
        axes = Calibration(1.0, (0.0, 0.0), angle_deg, mirror).axes
        middle = (np.array(z_mask.shape[::-1]) - 1) / 2
        centre = (side - 1) / 2
        matrix = np.column_stack((axes, centre - axes @ middle))
        parts = np.stack((z_mask.real, z_mask.imag), -1)
        turned = cv2.warpAffine(parts, matrix, (side, side), flags=cv2.INTER_LINEAR)
        z = turned[..., 0] + 1j * turned[..., 1]
        turn = np.exp(2j * math.radians(angle_deg)).astype(np.complex64)
        z = turn * (np.conj(z) if mirror else z)
        agreement = scipy.fft.ifft2(image_fft * np.conj(scipy.fft.fft2(z, shape))).real
        # Of the walls that the image shows at each shift: the sum of |z| over a window, by summed areas.
        weight = np.abs(z)
        h, w = self._z.shape
        padded = np.zeros((side + 2 * h + 1, side + 2 * w + 1))
        padded[h + 1 : h + 1 + side, w + 1 : w + 1 + side] = weight
        total = padded.cumsum(0).cumsum(1)
        rows, columns = np.arange(-side + 1, h), np.arange(-side + 1, w)
        top, left = h - rows, w - columns
        seen = (
            total[np.ix_(top + h, left + w)]
            - total[np.ix_(top, left + w)]
            - total[np.ix_(top + h, left)]
            + total[np.ix_(top, left)]
        )
        whole = float(weight.sum())
        score = agreement[np.ix_(rows % shape[0], columns % shape[1])] / np.sqrt(np.maximum(seen, 1e-6 * whole))
        score[seen < _LEAST_SEEN * whole] = -np.inf
        for _ in range(_PEAKS):
            row, column = np.unravel_index(int(score.argmax()), score.shape)
            if not score[row, column] > 0.0:
                return
            best = float(score[row, column])
            score[max(row - 3, 0) : row + 4, max(column - 3, 0) : column + 4] = -np.inf
            at = np.array((columns[column] + centre, rows[row] + centre))  # the chip's centre in coarse pixels
            yield Pose(self._calibration(scale_um, angle_deg, mirror, at), best)

    def _calibration(self, scale_um: float, angle_deg: float, mirror: bool, at: Points) -> Calibration:
        """The calibration with the chip's centre at a place (2,) in coarse pixels."""
        step = self._fine * self._coarse
        at_px = step * (at + 0.5) - 0.5
        height, width = self._mask.shape
        middle_um = 0.5 * self._chip_um * np.array((width - 1, height - 1))
        upright = Calibration(scale_um, (0.0, 0.0), angle_deg, mirror)
        x, y = (middle_um - upright.to_um(at_px)).tolist()
        return replace(upright, origin_um=(x, y))

    def _refine(self, pose: Pose) -> Pose:
        """The pose that agrees best with the directions at the walls' points."""
        start = pose.calibration
        points_px = start.to_px(self._points_um)
        inside = ((points_px >= 0) & (points_px < self._size_px)).all(-1)
        middle = points_px[inside].mean(0) if inside.any() else points_px.mean(0)
        reach = max(float(np.hypot(*(points_px - middle).T).mean()), 1.0)
        best = start
        score = 0.0
        for z in self._maps:

            def worse(move: Points, z: Complex = z, start: Calibration = best) -> float:
                return -self._agreement(z, move_chip(start, move, middle, reach))

            unit = self._fine * self._coarse
            simplex = np.vstack((np.zeros(4), unit * np.eye(4)))
            options = {"initial_simplex": simplex, "xatol": 0.05 * unit, "fatol": 1e-4, "maxfev": _MOST_TRIALS}
            found = scipy.optimize.minimize(worse, np.zeros(4), method="Nelder-Mead", options=options)
            best, score = move_chip(best, found.x, middle, reach), -float(found.fun)
        return Pose(best, score)

    def _agreement(self, z: Complex, calibration: Calibration) -> float:
        """Mean agreement at the points in the image, times the root of their number relative to all."""
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


def move_chip(calibration: Calibration, move: Points, middle_px: Points, reach_px: float) -> Calibration:
    """The calibration after a small motion of the chip in the image.

    Parameters
    ----------
    move : (4,) px: shift right and down, turn and growth as the motion of a point at `reach_px`.
    middle_px : (2,) px: the point about which the chip turns and grows.
    """
    right, down, turn, growth = move.tolist()
    fixed_um = calibration.to_um(middle_px)
    scale_um = calibration.um_per_px * math.exp(-growth / reach_px)
    angle_deg = calibration.angle_deg + math.degrees(turn / reach_px)
    turned = Calibration(scale_um, (0.0, 0.0), angle_deg, calibration.mirror)
    x, y = (fixed_um - turned.to_um(middle_px + np.array((right, down)))).tolist()
    return replace(turned, origin_um=(x, y))


def _steps(low: float, high: float, shape: tuple[int, ...], tolerance_px: float) -> NDArray[np.float64]:
    """Scales between two, so close that half a step moves the image's border by the tolerance."""
    ratio = 1.0 + 2.0 * tolerance_px / (0.5 * max(shape))
    count = max(1, math.ceil(math.log(high / low) / math.log(ratio)))
    return low * (high / low) ** ((np.arange(count) + 0.5) / count)


def _block_means(image: NDArray[np.float32], factor: float) -> NDArray[np.float32]:
    """An image averaged over squares of `factor` pixels; pixel centres as cv2.resize counts them."""
    if factor <= 1.0:
        return np.ascontiguousarray(image, np.float32)
    height, width = (max(8, round(n / factor)) for n in image.shape)
    return np.asarray(cv2.resize(np.ascontiguousarray(image), (width, height), interpolation=cv2.INTER_AREA))
