"""Frame to Track: where is the robot?

Two ways to look, chosen from the previous message alone: near the last position, or, after it has been missing for a
while, in the whole channel. Either way places that correlate with the robot's appearance are candidates, and each
gets a disc fitted to sub-pixel precision. Near the last position the likest disc of the right size is the robot; in
the whole channel the darkest of those, for debris is paler.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np

from flowrec.chip.chip import Chip
from flowrec.chip.registration import Calibration
from flowrec.declarations import Image
from flowrec.messages import Frame, Track
from flowrec.ranges import Range, Share
from flowrec.robot import Robot
from flowrec.units import seconds
from flowrec.vision.disc_fit import disc_reach, fit_disc
from flowrec.vision.disc_model import edge_px, template
from flowrec.vision.masked_ncc import likeness
from flowrec.vision.wall_distance import Box, Walls, walls_in_view

_COARSE_RADIUS_PX = 2.5  # candidates are looked for at about this radius
_FINE_RADIUS_PX = 6.0  # and measured at about this one, or as they are when smaller
_LEAST_MATCH = 0.35  # correlation below which a place is not measured
_SIZE_PX = 0.5  # blur hides so much of the radius of any disc
_SURE = 0.92  # a score that needs no comparison
_SMALLEST, _LARGEST = 0.75, 1.35  # radius that is expected, as a share of the robot's own


@dataclass(frozen=True, slots=True)
class _Disc:
    """A robot, perhaps, in camera pixels and grey levels."""

    x: float
    y: float
    radius_px: float
    darkness: float
    likeness: float
    score: float  # likeness times agreement of size


@dataclass(frozen=True, slots=True)
class _Search:
    """Where to look for discs, and how much like the robot they have to be. Lengths in camera pixels."""

    box: Box  # of possible centres
    centre: tuple[float, float]
    reach: float  # from the centre; inf: anywhere
    nominal_px: float
    expected_px: float
    margin_px: float
    least_score: float
    least_likeness: float


@dataclass(frozen=True, slots=True)
class Sight:
    """Which pixels a tracker reads: those of Track.roi_px and no farther than `pad_px` around it."""

    pad_px: int
    everywhere_px: Box  # roi_px of a search in the whole channel


@dataclass(frozen=True, slots=True)
class Tracker:
    """Finds the robot; its memory is the previous Track. Lengths that belong to the robot are in its radii."""

    least_score: Share = 0.55  # likeness times agreement of size, 0 to 1, to be taken for the robot while locked
    acquire_score: Share = 0.65  # the same when it was not seen just before: there is more to be mistaken
    acquire_likeness: Share = 0.82  # and the likeness alone: touching pieces of debris have its size, not its shape
    least_contrast: Annotated[float, Range(0.0, 255.0)] = 6.0  # darkness of the robot in grey levels
    size_tolerance: Annotated[float, Range(0.01, 10.0)] = 0.25  # one sigma of ln(seen radius / expected radius)
    # how far from the last position to look, besides what v_max allows ...
    search_radii: Annotated[float, Range(0.0, 1e3)] = 2.0
    search_px: Annotated[float, Range(1.0, 1e4)] = 8.0  # ... and at least so many pixels
    # farthest drift since the last frame, in v_max dt: its own speed and the flow's
    reach_speed: Annotated[float, Range(0.0, 1e3)] = 3.0
    # frames without the robot, then the whole channel is searched
    reacquire_after: Annotated[int, Range(0, 1_000_000)] = 10
    # this near to a wall its own image spoils that of the robot
    wall_margin_um: Annotated[float, Range(0.0, 1e4)] = 18.0
    candidates: Annotated[int, Range(1, 1_000)] = 6  # measured at most per image

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
        # The radius follows slowly: focus drifts, single frames mislead.
        radius_px = search.expected_px + 0.05 * (found.radius_px - search.expected_px)
        return Track(
            stamp_ns=frame.stamp_ns,
            seen=True,
            position_um=calibration.to_um((found.x, found.y)),
            score=found.score,
            lost_frames=0,
            radius_px=min(max(radius_px, _SMALLEST * search.nominal_px), _LARGEST * search.nominal_px),
            roi_px=roi,
        )

    def sight(self, chip: Chip, calibration: Calibration, robot: Robot, shape: tuple[int, int]) -> Sight:
        """How far around the searched region pixels of an image of `shape` have a say, whatever is in them."""
        nominal = robot.radius_um / calibration.um_per_px
        coarse = _coarse_step(nominal)
        # Squares of the shrunk image that a template on the outermost square of the region covers; the last of them
        # may reach out of the region by all but a pixel.
        seen = coarse * (len(template(nominal, coarse)) // 2 + 1) - 1
        # A disc is fitted about the middle of a square, to squares that begin on whole pixels.
        largest = _LARGEST * nominal
        fitted = 0.5 * (coarse - 1) + disc_reach(largest, edge_px(largest)) + 1.0
        return Sight(max(seen, math.ceil(fitted)), walls_in_view(chip, calibration, shape).box)

    def _plan(
        self, previous: Track | None, frame: Frame, walls: Walls, calibration: Calibration, robot: Robot
    ) -> _Search:
        """Where to look, from the previous message."""
        nominal = robot.radius_um / calibration.um_per_px
        margin = min(max(self.wall_margin_um / calibration.um_per_px, 1.0), 0.5 * nominal)
        # A score of 0 says that it was never seen.
        if previous is None or previous.score <= 0 or previous.lost_frames > self.reacquire_after:
            expected = nominal if previous is None else previous.radius_px
            return _Search(
                walls.box, (0.0, 0.0), math.inf, nominal, expected, margin, self.acquire_score, self.acquire_likeness
            )
        x, y = calibration.to_px(previous.position_um).tolist()
        dt = seconds(frame.stamp_ns - previous.stamp_ns) / (1 + previous.lost_frames)
        drift = self.reach_speed * robot.speed_limit_um_s * dt / calibration.um_per_px
        reach = max(self.search_radii * previous.radius_px + drift, self.search_px) * (1 + previous.lost_frames)
        x0, y0, x1, y1 = walls.box
        left, top = max(math.floor(x - reach), x0), max(math.floor(y - reach), y0)
        box = (left, top, min(math.ceil(x + reach) + 1, x1), min(math.ceil(y + reach) + 1, y1))
        # Out of sight a poor likeness is rather a piece of debris that came along.
        least = (self.acquire_score, self.acquire_likeness) if previous.lost_frames else (self.least_score, 0.0)
        return _Search(box, (x, y), reach, nominal, previous.radius_px, margin, *least)

    def _search(self, image: Image, walls: Walls, search: _Search) -> _Disc | None:
        """The best disc in reach."""
        x0, y0, x1, y1 = search.box
        if x1 <= x0 or y1 <= y0:
            return None
        nominal = search.nominal_px
        step = _coarse_step(nominal)
        match = likeness(
            image, walls.distance_px, search.box, step, search.margin_px, 0.7 * nominal, template(nominal, step)
        )
        rows, columns = match.shape
        offset = 0.5 * (step - 1)
        near = math.isfinite(search.reach)
        if near:
            dx = x0 + offset - search.centre[0] + step * np.arange(columns, dtype=np.float32)
            dy = y0 + offset - search.centre[1] + step * np.arange(rows, dtype=np.float32)
            away = ((dx * dx)[None] + (dy * dy)[:, None]) / np.float32(search.reach**2)
            match = np.where(away <= 1.0, match - np.float32(0.1) * away, np.float32(-1.0))
        best, best_worth = None, 0.0
        hide = max(1, round(nominal / step))
        for _ in range(self.candidates):
            row, column = divmod(int(match.argmax()), columns)
            if match[row, column] < _LEAST_MATCH:
                break
            match[max(row - hide, 0) : row + hide + 1, max(column - hide, 0) : column + hide + 1] = -1.0
            found = self._measure(image, walls, x0 + offset + step * column, y0 + offset + step * row, search)
            if found is None or found.score < search.least_score or found.likeness < search.least_likeness:
                continue
            worth = found.score * found.darkness
            if near:
                distance2 = (found.x - search.centre[0]) ** 2 + (found.y - search.centre[1]) ** 2
                worth = found.score - 0.1 * distance2 / search.reach**2
            if worth > best_worth:
                best, best_worth = found, worth
            if near and found.score > _SURE:
                break
        return best

    def _measure(self, image: Image, walls: Walls, x: float, y: float, search: _Search) -> _Disc | None:
        """Fit a disc near a candidate; None when there is none of the robot's kind."""
        expected = search.expected_px
        step = _fine_step(search.nominal_px)
        fx, fy, radius_px, darkness, alike = fit_disc(
            image, walls.distance_px, search.margin_px, x, y, expected, edge_px(expected), step
        )
        if darkness < self.least_contrast or math.hypot(fx - x, fy - y) > max(1.2 * expected, 2.0):
            return None
        height, width = image.shape
        row, column = min(max(round(fy), 0), height - 1), min(max(round(fx), 0), width - 1)
        if walls.distance_px[row, column] < 0.6 * search.nominal_px:
            return None
        size = math.log(radius_px / expected) / math.hypot(self.size_tolerance, _SIZE_PX / expected)
        return _Disc(fx, fy, radius_px, darkness, alike, alike * math.exp(-0.5 * size * size))


def missed(previous: Track, stamp_ns: int) -> Track:
    """The track after a frame that shows nothing new."""
    return replace(previous, stamp_ns=stamp_ns, seen=False, lost_frames=previous.lost_frames + 1)


def _coarse_step(nominal_px: float) -> int:
    return max(1, int(nominal_px / _COARSE_RADIUS_PX))


def _fine_step(nominal_px: float) -> int:
    return max(1, int(nominal_px / _FINE_RADIUS_PX))
