"""Points along the walls of a mask, in order, and the signed distances to walls that lie elsewhere."""

from __future__ import annotations

import math
from typing import NamedTuple

import cv2
import numpy as np
import scipy  # its ndimage and spatial load at first use, not at start-up

from flowrec.core import Bools, Floats, Floats32, Ints
from flowrec.physics import Chip, smooth_contours

ALONG_PX = 1.0  # over which normals, and profiles across walls, are averaged along a wall
_BORDER_PX = 2.0  # from the border of the mask: openings keep their place
_REACH_PX = 6.0  # from a wall: farther distances are not distinguished
_DENSE = 8  # points of a wall per pixel, from which distances are taken
_FINER = 5  # odd: pixels that walls sweep for one of the mask, whose centre then is that of one of them
_BESIDE_PX = 0.5  # from a wall: on which side of it a pixel is, those pixels do not tell better than its normal


class WallContours(NamedTuple):
    """Points on the walls of a mask, a pixel apart, in order along each wall."""

    chip: Chip
    points: Floats  # (n, 2) x, y in px of the mask
    inward: Floats  # (n, 2) unit normals, into the fluid
    walls: list[tuple[slice, bool]]  # the points of each wall, and whether it is closed
    inside: Bools  # (n,) away from the border of the mask

    @classmethod
    def of(cls, chip: Chip) -> WallContours:
        points: list[Floats] = []
        walls: list[tuple[slice, bool]] = []
        first = 0
        for contour, closed in smooth_contours(chip.mask):
            each = _evenly(contour, closed, 1.0)
            points.append(each)
            walls.append((slice(first, first + len(each)), closed))
            first += len(each)
        every = np.concatenate(points) if points else np.zeros((0, 2))
        size = np.array(chip.mask.shape[::-1])
        border = np.minimum(every + 0.5, size - 0.5 - every).min(axis=1, initial=math.inf)
        inward = np.concatenate([_normals(every[which], closed) for which, closed in walls] or [every])
        return cls(chip, every, inward, walls, border > _BORDER_PX)

    def along(self, values: Floats, sigma_px: float) -> Floats:
        """Values (n, ...) of the points, averaged along each wall."""
        averaged = np.empty_like(values)
        for which, closed in self.walls:
            mode = "wrap" if closed else "nearest"
            averaged[which] = scipy.ndimage.gaussian_filter1d(values[which], sigma_px, axis=0, mode=mode)
        return averaged

    def levels(self, out_px: Floats) -> Floats32:
        """(h, w) signed distances of the pixel centres to the walls, each moved outwards by (n,)."""
        mask = self.chip.mask
        drawn, moved = (self._distances(self.points - by * self.inward) for by in (0.0, out_px[:, None]))
        # Normals tell the side of a smooth wall; beside a corner, whose walls may cross as they move, they do not.
        swept = self._sweep(out_px)
        fluid = np.where(np.abs(drawn) < 1.0, drawn > 0.0, mask)
        fluid = np.where(swept == 0, fluid, swept > 0)
        fluid = np.where(np.abs(moved) < _BESIDE_PX, moved > 0.0, fluid)
        return np.asarray(np.where(fluid, np.abs(moved), -np.abs(moved)), np.float32)

    def _distances(self, points: Floats) -> Floats:
        """(h, w) distances of the pixel centres to walls at points (n, 2), by their normals positive in fluid."""
        dense = [(_evenly(points[which], closed, 1.0 / _DENSE), closed) for which, closed in self.walls]
        line = np.concatenate([each for each, _ in dense])
        inward = np.concatenate([_normals(each, closed) for each, closed in dense])
        mask = self.chip.mask
        rows, columns = np.indices(mask.shape)
        centres = np.stack((columns, rows), axis=-1).reshape(-1, 2).astype(np.float64)
        distance, nearest = scipy.spatial.cKDTree(line).query(centres, distance_upper_bound=_REACH_PX)
        near = np.isfinite(distance)
        level = np.where(mask.ravel(), _REACH_PX, -_REACH_PX)
        across = (centres[near] - line[nearest[near]]) * inward[nearest[near]]
        level[near] = np.copysign(distance[near], across.sum(axis=1))
        return np.asarray(level.reshape(mask.shape))

    def _sweep(self, out_px: Floats) -> Ints:
        """(h, w) 1 where walls that move outwards by (n,) leave fluid behind, -1 where they bring solid, else 0."""
        height, width = self.chip.mask.shape
        canvas = np.zeros((_FINER * height, _FINER * width), np.int8)
        at, moved = (_FINER * (each + 0.5) - 0.5 for each in (self.points, self.points - out_px[:, None] * self.inward))
        for which, closed in self.walls:
            here = np.arange(which.start, which.stop)
            ahead = np.roll(here, -1)
            if not closed:
                here, ahead = here[:-1], ahead[:-1]
            corners = np.rint(np.stack([at[here], at[ahead], moved[ahead], moved[here]], axis=1)).astype(np.int32)
            for each, outwards in zip(corners, out_px[here] + out_px[ahead] > 0.0, strict=True):
                cv2.fillConvexPoly(canvas, each, 1 if outwards else -1)
        return np.asarray(canvas[_FINER // 2 :: _FINER, _FINER // 2 :: _FINER], np.intp)


def _evenly(contour: Floats, closed: bool, step_px: float) -> Floats:
    """Points (m, 2) a step apart along a contour (n, 2)."""
    line = np.concatenate([contour, contour[:1]]) if closed else contour
    at = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(line, axis=0).T))])
    count = max(round(float(at[-1]) / step_px), 2)
    places = np.linspace(0.0, at[-1], count, endpoint=not closed)
    return np.stack([np.interp(places, at, line[:, axis]) for axis in (0, 1)], axis=1)


def _normals(points: Floats, closed: bool) -> Floats:
    """(n, 2) unit normals of a contour to its right, where the fluid is."""
    smooth = scipy.ndimage.gaussian_filter1d(points, ALONG_PX, axis=0, mode="wrap" if closed else "nearest")
    along = np.roll(smooth, -1, 0) - np.roll(smooth, 1, 0) if closed else np.gradient(smooth, axis=0)
    right = np.stack([-along[:, 1], along[:, 0]], axis=1)
    return np.asarray(right / np.maximum(np.hypot(*along.T), 1e-9)[:, None])
