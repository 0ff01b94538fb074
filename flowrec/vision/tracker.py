"""Frame to Track: where is the robot?

The previous message alone decides where to search: near the last position, or, after the robot has been missing for a
while, in the whole channel. In both cases positions that correlate with the robot's template are candidates, and a disc
is fitted to each with sub-pixel precision. Near the last position the disc of the right size that fits best is the
robot; in the whole channel it is the darkest of those, because debris is paler.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Annotated

import cv2
import numpy as np
from numpy.typing import NDArray

from flowrec.chip.chip import Chip
from flowrec.chip.registration import Calibration
from flowrec.declarations import Image
from flowrec.interpolation import nearest_pixel
from flowrec.messages import Frame, Track
from flowrec.ranges import Range, Share
from flowrec.robot import Robot
from flowrec.units import seconds
from flowrec.vision.disc_fit import fit_disc, fit_radius, initial_edge_px
from flowrec.vision.masked_ncc import masked_ncc, template

Box = tuple[int, int, int, int]  # x0, y0, x1, y1 in camera px, the latter two exclusive
_COARSE_RADIUS_PX = 2.5  # of the robot in the reduced image in which candidates are found
_FINE_RADIUS_PX = 6.0  # of the robot in the image that the disc is fitted to, unless it is smaller in the camera's
_LEAST_CORRELATION = 0.35  # of a candidate
_SIZE_PX = 0.5  # uncertainty of any disc's radius because of blur
_SURE = 0.92  # a score that needs no comparison
_SMALLEST, _LARGEST = 0.75, 1.35  # expected radius relative to the robot's own
_DISTANCE_PENALTY = 0.1  # at the end of the search range
_RADIUS_WEIGHT = 0.05  # of the newest radius in the tracked one: focus drifts, single frames are unreliable
_FAR_PX = 1e4  # distance to the walls of a chip without walls


@dataclass(frozen=True, slots=True)
class _Disc:
    """A fitted disc, in camera pixels and grey levels."""

    x: float
    y: float
    radius_px: float
    darkness: float
    likeness: float
    score: float  # likeness times agreement of size


@dataclass(frozen=True, slots=True)
class _Search:
    """Where to search for discs, and how similar to the robot they must be. Lengths in camera pixels."""

    box: Box  # of possible centres
    centre: tuple[float, float]
    range_px: float  # from the centre; inf: everywhere
    nominal_px: float
    expected_px: float
    margin_px: float
    least_score: float
    least_likeness: float


@dataclass(frozen=True, slots=True)
class Footprint:
    """The pixels that a tracker reads: those of Track.roi_px and no farther than `pad_px` around it."""

    pad_px: int
    everywhere_px: Box  # roi_px of a search in the whole channel


@dataclass(frozen=True, slots=True, eq=False)
class Walls:
    """Distance to the walls in the camera's image, and the bounding box of the fluid."""

    distance_px: NDArray[np.float32]  # (h, w), negative in solid
    box: Box


@dataclass(frozen=True, slots=True)
class Tracker:
    """Finds the robot; its memory is the previous Track."""

    least_score: Share = 0.55  # likeness times agreement of size, 0 to 1, for the robot while it is tracked
    acquire_score: Share = 0.65  # the same if it was not seen on the frame before: more objects can be mistaken for it
    acquire_likeness: Share = 0.82  # and the likeness alone: debris in contact may have its size, but not its shape
    least_contrast: Annotated[float, Range(0.0, 255.0)] = 6.0  # darkness of the robot in grey levels
    size_tolerance: Annotated[float, Range(0.01, 10.0)] = 0.25  # one sigma of ln(measured radius / expected radius)
    # search range around the last position in robot radii, besides what v_max permits
    search_radii: Annotated[float, Range(0.0, 1e3)] = 2.0
    search_px: Annotated[float, Range(1.0, 1e4)] = 8.0  # least search range
    # largest displacement since the last frame, by itself and by the flow, in units of v_max dt
    reach_speed: Annotated[float, Range(0.0, 1e3)] = 3.0
    # frames without the robot after which the whole channel is searched
    reacquire_after: Annotated[int, Range(0, 1_000_000)] = 10
    # width of the band along walls whose own image disturbs that of the robot
    wall_margin_um: Annotated[float, Range(0.0, 1e4)] = 18.0
    candidates: Annotated[int, Range(1, 1_000)] = 6  # largest number of fitted discs per image

    def track(self, previous: Track | None, frame: Frame, chip: Chip, calibration: Calibration, robot: Robot) -> Track:
        """The robot in this frame; `seen` False keeps the last position (the image's centre before the first)."""
        height, width = frame.image.shape
        walls = walls_in_view(chip, calibration, (height, width))
        search = self._plan(previous, frame, walls, calibration, robot)
        found = self._search(frame.image, walls, search)
        roi = np.array(search.box, np.float64)
        if found is None:
            middle = calibration.to_um(((width - 1) / 2, (height - 1) / 2))
            return Track(
                stamp_ns=frame.stamp_ns,
                seen=False,
                position_um=middle if previous is None else previous.position_um,
                score=0.0 if previous is None else previous.score,
                lost_frames=1 if previous is None else previous.lost_frames + 1,
                radius_px=search.expected_px,
                roi_px=roi,
            )
        radius_px = search.expected_px + _RADIUS_WEIGHT * (found.radius_px - search.expected_px)
        return Track(
            stamp_ns=frame.stamp_ns,
            seen=True,
            position_um=calibration.to_um((found.x, found.y)),
            score=found.score,
            lost_frames=0,
            radius_px=min(max(radius_px, _SMALLEST * search.nominal_px), _LARGEST * search.nominal_px),
            roi_px=roi,
        )

    def footprint(self, chip: Chip, calibration: Calibration, robot: Robot, shape: tuple[int, int]) -> Footprint:
        """The pixels of an image of `shape` that can influence a track, whatever the image shows."""
        nominal = robot.radius_um / calibration.um_per_px
        coarse = _coarse_step(nominal)
        # Blocks of the reduced image that a template on the outermost block of the region covers; the last of them may
        # exceed the region by all but a pixel.
        correlated = coarse * (len(template(nominal, coarse)) // 2 + 1) - 1
        # A disc is fitted around the middle of a block, to blocks that begin on whole pixels.
        largest = _LARGEST * nominal
        fitted = 0.5 * (coarse - 1) + fit_radius(largest, initial_edge_px(largest)) + 1.0
        return Footprint(max(correlated, math.ceil(fitted)), walls_in_view(chip, calibration, shape).box)

    def _plan(
        self, previous: Track | None, frame: Frame, walls: Walls, calibration: Calibration, robot: Robot
    ) -> _Search:
        """Where to search, from the previous message."""
        nominal = robot.radius_um / calibration.um_per_px
        margin = min(max(self.wall_margin_um / calibration.um_per_px, 1.0), 0.5 * nominal)
        # A score of 0 means that the robot was never seen.
        if previous is None or previous.score <= 0 or previous.lost_frames > self.reacquire_after:
            expected = nominal if previous is None else previous.radius_px
            return _Search(
                walls.box, (0.0, 0.0), math.inf, nominal, expected, margin, self.acquire_score, self.acquire_likeness
            )
        x, y = calibration.to_px(previous.position_um).tolist()
        frames = 1 + previous.lost_frames
        dt = seconds(frame.stamp_ns - previous.stamp_ns) / frames
        displacement = self.reach_speed * robot.speed_limit_um_s * dt / calibration.um_per_px
        range_px = max(self.search_radii * previous.radius_px + displacement, self.search_px) * frames
        x0, y0, x1, y1 = walls.box
        left, top = max(math.floor(x - range_px), x0), max(math.floor(y - range_px), y0)
        box = (left, top, min(math.ceil(x + range_px) + 1, x1), min(math.ceil(y + range_px) + 1, y1))
        # While the robot is lost, an object of low likeness is more probably a piece of debris.
        least = (self.acquire_score, self.acquire_likeness) if previous.lost_frames else (self.least_score, 0.0)
        return _Search(box, (x, y), range_px, nominal, previous.radius_px, margin, *least)

    def _search(self, image: Image, walls: Walls, search: _Search) -> _Disc | None:
        """The best disc within the search range."""
        x0, y0, x1, y1 = search.box
        if x1 <= x0 or y1 <= y0:
            return None
        nominal = search.nominal_px
        step = _coarse_step(nominal)
        match = masked_ncc(
            image, walls.distance_px, search.box, step, search.margin_px, 0.7 * nominal, template(nominal, step)
        )
        rows, columns = match.shape
        offset = 0.5 * (step - 1)
        near = math.isfinite(search.range_px)
        if near:
            dx = x0 + offset - search.centre[0] + step * np.arange(columns, dtype=np.float32)
            dy = y0 + offset - search.centre[1] + step * np.arange(rows, dtype=np.float32)
            distance2 = ((dx * dx)[None] + (dy * dy)[:, None]) / np.float32(search.range_px**2)
            match = np.where(distance2 <= 1.0, match - np.float32(_DISTANCE_PENALTY) * distance2, np.float32(-1.0))
        best, best_rank = None, 0.0
        suppressed = max(1, round(nominal / step))  # around a candidate
        for _ in range(self.candidates):
            row, column = divmod(int(match.argmax()), columns)
            if match[row, column] < _LEAST_CORRELATION:
                break
            top, left = max(row - suppressed, 0), max(column - suppressed, 0)
            match[top : row + suppressed + 1, left : column + suppressed + 1] = -1.0
            found = self._measure(image, walls, x0 + offset + step * column, y0 + offset + step * row, search)
            if found is None or found.score < search.least_score or found.likeness < search.least_likeness:
                continue
            rank = found.score * found.darkness
            if near:
                moved2 = (found.x - search.centre[0]) ** 2 + (found.y - search.centre[1]) ** 2
                rank = found.score - _DISTANCE_PENALTY * moved2 / search.range_px**2
            if rank > best_rank:
                best, best_rank = found, rank
            if near and found.score > _SURE:
                break
        return best

    def _measure(self, image: Image, walls: Walls, x: float, y: float, search: _Search) -> _Disc | None:
        """Fit a disc near a candidate; None if the result can not be the robot."""
        expected = search.expected_px
        step = max(1, int(search.nominal_px / _FINE_RADIUS_PX))
        fx, fy, radius_px, darkness, likeness = fit_disc(
            image, walls.distance_px, search.margin_px, x, y, expected, initial_edge_px(expected), step
        )
        if darkness < self.least_contrast or math.hypot(fx - x, fy - y) > max(1.2 * expected, 2.0):
            return None
        if walls.distance_px[nearest_pixel(fx, fy, image.shape)] < 0.6 * search.nominal_px:
            return None
        size = math.log(radius_px / expected) / math.hypot(self.size_tolerance, _SIZE_PX / expected)
        return _Disc(fx, fy, radius_px, darkness, likeness, likeness * math.exp(-0.5 * size * size))


@lru_cache(maxsize=4)
def walls_in_view(chip: Chip, calibration: Calibration, shape: tuple[int, int]) -> Walls:
    """Walls of a chip (compared by identity) in an image of `shape` (rows, columns)."""
    height, width = shape
    scale = calibration.um_per_px / chip.um_per_px  # mask pixels per camera pixel
    to_mask = calibration.matrix / chip.um_per_px  # of (column, row, 1) in the image
    # Distances interpolate smoothly, while an interpolated mask would have stairs.
    distance = cv2.warpAffine(
        _mask_distance_px(chip.mask) / np.float32(scale),
        to_mask,
        (width, height),
        flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
        borderMode=cv2.BORDER_REPLICATE,  # a channel that the border cuts continues straight
    )
    rows, columns = chip.mask.shape
    right, down = np.arange(width), np.arange(height)[:, None]
    x, y = (row[2] + row[0] * right + row[1] * down for row in to_mask)
    fluid = (distance > 0) & (y >= -0.5) & (y <= rows - 0.5) & (x >= -0.5) & (x <= columns - 0.5)
    across, down = np.flatnonzero(fluid.any(axis=0)), np.flatnonzero(fluid.any(axis=1))
    box = (int(across[0]), int(down[0]), int(across[-1]) + 1, int(down[-1]) + 1) if len(across) else (0, 0, 0, 0)
    return Walls(np.ascontiguousarray(distance, np.float32), box)


def _mask_distance_px(mask: NDArray[np.bool_]) -> NDArray[np.float32]:
    """Signed distance (h, w) to the walls of a mask in its pixels, as `clearance_um` defines it.

    It differs from `clearance_um` in the last bits: it is not rounded, and far from any wall it is finite. The two are
    kept apart because a replay compares the tracks of recorded sessions.
    """
    if mask.all():
        return np.full(mask.shape, _FAR_PX, np.float32)
    pad = 16
    fluid = np.pad(mask, pad, mode="edge").astype(np.uint8)
    inside = cv2.distanceTransform(fluid, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    outside = cv2.distanceTransform(1 - fluid, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    return np.asarray(np.where(fluid, inside - 0.5, 0.5 - outside)[pad:-pad, pad:-pad], np.float32)


def unseen(previous: Track, stamp_ns: int) -> Track:
    """The track after a frame that shows nothing new."""
    return replace(previous, stamp_ns=stamp_ns, seen=False, lost_frames=previous.lost_frames + 1)


def _coarse_step(nominal_px: float) -> int:
    return max(1, int(nominal_px / _COARSE_RADIUS_PX))
