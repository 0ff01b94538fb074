"""Frame to Track: where is the robot?

The previous messages alone decide where to search: near the last position, or, after the robot has been missing for a
while, in the whole channel. There are two ways to find it.

Disc: positions that correlate with the template of a disc are candidates, and a disc is fitted to each with sub-pixel
precision. Near the last position the disc of the right size that fits best is the robot; in the whole channel it is the
darkest of those, because debris is paler. It needs no help from the user.

Learned appearance (learned.py): for a robot that a user has pointed at, and for bright ones.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Annotated, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from flowrec.chip.chip import Chip
from flowrec.chip.registration import Calibration
from flowrec.declarations import Image
from flowrec.interpolation import nearest_pixel
from flowrec.messages import Appearance, Frame, Track
from flowrec.ranges import Range, Share
from flowrec.robot import Robot
from flowrec.units import seconds
from flowrec.vision.disc_fit import fit_disc, fit_radius, initial_edge_px
from flowrec.vision.learned import (
    BLUR_PX,
    Box,
    Scale,
    alone,
    assigned,
    candidates,
    expected_motion,
    is_isolated,
    located,
    neighbours_of,
    region_of,
    similar,
    updated_state,
    updated_views,
)
from flowrec.vision.learning import box_of, energy_of, learn, pixel_noise
from flowrec.vision.masked_ncc import masked_ncc, template

Polarity = Literal["dark", "bright", "auto"]
_Pixel = Annotated[float, Range(-1e5, 1e5)]
_COARSE_RADIUS_PX = 2.5  # of the robot in the reduced image in which candidates are found
_FINE_RADIUS_PX = 6.0  # of the robot in the image that the disc is fitted to, unless it is smaller in the camera's
_LEAST_CORRELATION = 0.35  # of a candidate
_SIZE_PX = 0.5  # uncertainty of any disc's radius because of blur
_SURE = 0.92  # a score that needs no comparison
_SMALLEST, _LARGEST = 0.75, 1.35  # expected radius relative to the robot's own
_DISTANCE_PENALTY = 0.1  # at the end of the search range
_RADIUS_WEIGHT = 0.05  # of the newest radius in the tracked one: focus drifts, single frames are unreliable
_FAR_PX = 1e4  # distance to the walls of a chip without walls
_NOISE_LEVELS = 2.0  # of a normalised image: least_contrast is three times its default noise
_WALL_ERROR_RADII = 0.5
_ENERGY_SHARE = 0.05  # least energy of a candidate relative to the robot's
_UPDATE_NS = 100_000_000  # least time between two updates of a known look


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
    slack_px: float = 0.0  # the walls may be off by this much


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


@dataclass(frozen=True, slots=True, eq=False)
class _Scene:
    """An image and what is known about it."""

    frame: Frame
    walls: Walls
    calibration: Calibration
    robot: Robot


@dataclass(frozen=True, slots=True)
class Tracker:
    """Finds the robot; its memory is the previous Track, and the Appearance."""

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
    # Brightness of the robot relative to the background; auto: found out on the first image that shows it. None: auto
    # in a new run; a session recorded before this setting existed is replayed as it was, dark and with exact walls.
    polarity: Polarity | None = None
    click_px: tuple[_Pixel, _Pixel] | None = None  # a point (column, row) on the robot: its look is learned there
    box_px: tuple[_Pixel, _Pixel, _Pixel, _Pixel] | None = None  # the same by a box around it: x0, y0, x1, y1
    click_frame: Annotated[int, Range(0, 2**62)] | None = None  # index of the image of click_px; None: the first one
    # the walls of the mask may be off by this many robot radii; None: 0.5 in a new run
    wall_error_radii: Annotated[float, Range(0.0, 2.0)] | None = None

    def for_a_new_run(self) -> Tracker:
        """The settings that are None chosen."""
        wall_error = _WALL_ERROR_RADII if self.wall_error_radii is None else self.wall_error_radii
        return replace(self, polarity=self.polarity or "auto", wall_error_radii=wall_error)

    def follow(
        self,
        previous: Track | None,
        appearance: Appearance | None,
        frame: Frame,
        chip: Chip,
        calibration: Calibration,
        robot: Robot,
    ) -> tuple[Track, Appearance | None]:
        """The robot in this frame, and how it looks; the given appearance itself if nothing new is known of it."""
        if self.polarity is None:
            return self.track(previous, frame, chip, calibration, robot), None
        walls = walls_in_view(chip, calibration, (frame.image.shape[0], frame.image.shape[1]))
        scene = _Scene(frame, walls, calibration, robot)
        if appearance is None:
            return self._first_look(previous, scene)
        if appearance.note:
            return _not_seen(previous, scene, self._everywhere(previous, scene)), appearance
        if len(appearance.views):
            assert previous is not None, "the robot was seen when its look was learned"
            return self._follow_learned(previous, appearance, scene)
        search = self._plan(previous, frame, walls, calibration, robot)
        found = self._dark_disc(scene, search, appearance.noise)
        return (_not_seen(previous, scene, search) if found is None else _seen(scene, search, found)), appearance

    def track(self, previous: Track | None, frame: Frame, chip: Chip, calibration: Calibration, robot: Robot) -> Track:
        """The dark disc in this frame; `seen` False keeps the last position (the image's centre before the first)."""
        walls = walls_in_view(chip, calibration, (frame.image.shape[0], frame.image.shape[1]))
        scene = _Scene(frame, walls, calibration, robot)
        search = self._plan(previous, frame, walls, calibration, robot)
        found = self.best_disc(frame.image, walls, search)
        return _not_seen(previous, scene, search) if found is None else _seen(scene, search, found)

    def footprint(self, chip: Chip, calibration: Calibration, robot: Robot, shape: tuple[int, int]) -> Footprint:
        """The pixels of an image of `shape` that can influence a track, whatever the image shows."""
        pad_px = self.disc_pad_px(robot.radius_um / calibration.um_per_px)
        if self.polarity is not None:
            pad_px = max(pad_px, Scale(self._radius_px(calibration, robot) + BLUR_PX).pad_px)
        return Footprint(pad_px, walls_in_view(chip, calibration, shape).box)

    def disc_pad_px(self, nominal: float) -> int:
        """How far around a searched box the search for a disc of a radius, in px, reads."""
        coarse = _coarse_step(nominal)
        # Blocks of the reduced image that a template on the outermost block of the region covers; the last of them may
        # exceed the region by all but a pixel.
        correlated = coarse * (len(template(nominal, coarse)) // 2 + 1) - 1
        # A disc is fitted around the middle of a block, to blocks that begin on whole pixels.
        largest = _LARGEST * nominal
        fitted = 0.5 * (coarse - 1) + fit_radius(largest, initial_edge_px(largest)) + 1.0
        return max(correlated, math.ceil(fitted))

    def _radius_px(self, calibration: Calibration, robot: Robot) -> float:
        """Radius of what is learned: that of the user's box, or the robot's."""
        return robot.radius_um / calibration.um_per_px if self.box_px is None else max(box_of(self.box_px)[1], 1.0)

    def _first_look(self, previous: Track | None, scene: _Scene) -> tuple[Track, Appearance | None]:
        """Find a robot of unknown look; its appearance is None until it is seen."""
        frame, assumed = scene.frame, self.polarity or "dark"
        search = self._everywhere(previous, scene)
        if self.click_px is not None or self.box_px is not None:
            if self.click_frame is not None and frame.index < self.click_frame:
                return _not_seen(previous, scene, search), None
            at_px, what = self.click_px, f"tracker.click_px = {list(self.click_px or ())}"
            if self.box_px is not None:
                at_px, what = box_of(self.box_px)[0], f"tracker.box_px = {list(self.box_px)}"
            assert at_px is not None
            return self._learned(previous, scene, at_px, assumed, f"{what} of image {frame.index}")
        noise = pixel_noise(frame.image)
        dark = self._dark_disc(scene, search, noise) if assumed != "bright" else None
        bright = _normalised(self, scene, search, noise, bright=True) if assumed != "dark" else None
        if bright is not None and (dark is None or bright.score * bright.darkness > dark.score * dark.darkness):
            return self._learned(previous, scene, (bright.x, bright.y), "bright", "the brightest disc")
        if dark is None:
            return _not_seen(previous, scene, search), None
        nothing = np.zeros((0, 1, 1), np.float32)
        appearance = Appearance(
            frame.stamp_ns, "dark", noise, 0.0, search.nominal_px, np.array([dark.x, dark.y]), nothing
        )
        return _seen(scene, search, dark), appearance

    def _learned(
        self, previous: Track | None, scene: _Scene, at_px: tuple[float, float], polarity: str, what: str
    ) -> tuple[Track, Appearance]:
        """The track and the appearance after learning the robot's look at a point."""
        frame, walls = scene.frame, scene.walls
        radius_px = self._radius_px(scene.calibration, scene.robot)
        solid_px = self._solid_px(radius_px)
        appearance = learn(frame.image, walls.distance_px, frame.stamp_ns, at_px, radius_px, polarity, solid_px, what)
        search = self._everywhere(previous, scene)
        if appearance.note:
            return _not_seen(previous, scene, search), appearance
        x, y = appearance.centre_px.tolist()
        scale = Scale(appearance.radius_px)
        box = _clipped((x, y), 4.0 * radius_px, walls.box)
        region = region_of(frame.image, walls.distance_px, _padded(box, scale.margin_px), scale, solid_px)
        found = candidates(region, appearance, box, walls.distance_px, 0.0, appearance.centre_px)
        near = np.hypot(*(found.px - appearance.centre_px).T) < 0.7 * appearance.radius_px
        track = _seen(scene, search, _Disc(x, y, search.expected_px, 0.0, 1.0, 1.0))
        return replace(
            track,
            velocity_px_s=np.zeros(2),
            spread_px=0.3 * appearance.radius_px,
            energy=energy_of(appearance),
            neighbours_px=neighbours_of(found, int(near.argmax()) if near.any() else None),
        ), appearance

    def _follow_learned(
        self, previous: Track, appearance: Appearance, scene: _Scene
    ) -> tuple[Track, Appearance | None]:
        """The robot by its learned look: near where it is expected, then as far as it can be, or in the whole image."""
        frame, walls, calibration = scene.frame, scene.walls, scene.calibration
        scale, solid_px = Scale(appearance.radius_px), self._solid_px(appearance.radius_px)
        place_px = calibration.to_px(previous.position_um)
        dt, frames = seconds(frame.stamp_ns - previous.stamp_ns), 1 + previous.lost_frames
        motion = expected_motion(previous, place_px, scale.radius_px, dt)
        expected = (float(motion.expected_px[0]), float(motion.expected_px[1]))
        everywhere = previous.lost_frames > self.reacquire_after
        displacement = self.reach_speed * scene.robot.speed_limit_um_s * dt / calibration.um_per_px
        farthest_px = max(self.search_radii * scale.radius_px + displacement, self.search_px) * frames
        near_px = max(self.search_px, 4.0 * scale.radius_px, 6.0 * motion.spread_px)
        which = None
        for range_px in (math.inf,) if everywhere else (near_px, max(farthest_px, 1.5 * near_px)):
            box = walls.box if everywhere else _clipped(expected, range_px, walls.box)
            region = region_of(frame.image, walls.distance_px, _padded(box, scale.margin_px), scale, solid_px)
            near = None if everywhere else motion.expected_px
            found = candidates(region, appearance, box, walls.distance_px, _ENERGY_SHARE * previous.energy, near)
            if everywhere:
                which = alone(found, previous.energy, self.acquire_score)
            else:
                which = assigned(found, previous, motion, range_px)
                least = self.acquire_score if previous.lost_frames else self.least_score
                if which is not None and not (
                    found.similarity[which] >= least or similar(found, which, previous, motion, scale.radius_px)
                ):
                    which = None
            if which is not None:
                break
        roi = np.array(box, np.float64)
        if which is None:
            return replace(unseen(previous, frame.stamp_ns), roi_px=roi), appearance
        blocks, score = located(region, found, which, appearance)
        to_px = region.to_px(blocks)
        neighbours = neighbours_of(found, which)
        views = updated_views(
            region,
            blocks,
            appearance,
            score,
            is_isolated(neighbours, to_px, scale.radius_px),
            frame.stamp_ns - appearance.stamp_ns >= _UPDATE_NS,
        )
        track = replace(
            previous,
            stamp_ns=frame.stamp_ns,
            seen=True,
            position_um=calibration.to_um(to_px),
            score=min(max(score, 0.01), 1.0),
            lost_frames=0,
            roi_px=roi,
            neighbours_px=neighbours,
            **updated_state(previous, motion, place_px, to_px, float(found.energy[which]), dt),
        )
        return track, appearance if views is None else replace(appearance, stamp_ns=frame.stamp_ns, views=views)

    def _solid_px(self, radius_px: float) -> float:
        """Distance to the mask's walls (negative: depth in the solid) from which on a pixel may show fluid."""
        return -(self.wall_error_radii or 0.0) * radius_px

    def _dark_disc(self, scene: _Scene, search: _Search, noise: float) -> _Disc | None:
        """The dark disc; where there is none, one that is paler, or nearer to the walls than they permit if exact."""
        frame, walls = scene.frame, scene.walls
        found = None
        if frame.bits == 8:
            found = self.best_disc(frame.image, walls, search)
        return found or _normalised(self, scene, search, noise, bright=False)

    def _everywhere(self, previous: Track | None, scene: _Scene) -> _Search:
        """A search in the whole channel."""
        return self._plan(
            None if previous is None else replace(previous, score=0.0),
            scene.frame,
            scene.walls,
            scene.calibration,
            scene.robot,
        )

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

    def best_disc(self, image: Image, walls: Walls, search: _Search) -> _Disc | None:
        """The best disc within the search range."""
        x0, y0, x1, y1 = search.box
        if x1 <= x0 or y1 <= y0:
            return None
        nominal = search.nominal_px
        step = _coarse_step(nominal)
        clearance = 0.7 * nominal - search.slack_px
        match = masked_ncc(
            image, walls.distance_px, search.box, step, search.margin_px, clearance, template(nominal, step)
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
        if walls.distance_px[nearest_pixel(fx, fy, image.shape)] < 0.6 * search.nominal_px - search.slack_px:
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


def _seen(scene: _Scene, search: _Search, found: _Disc) -> Track:
    radius_px = search.expected_px + _RADIUS_WEIGHT * (found.radius_px - search.expected_px)
    return Track(
        stamp_ns=scene.frame.stamp_ns,
        seen=True,
        position_um=scene.calibration.to_um((found.x, found.y)),
        score=found.score,
        lost_frames=0,
        radius_px=min(max(radius_px, _SMALLEST * search.nominal_px), _LARGEST * search.nominal_px),
        roi_px=np.array(search.box, np.float64),
    )


def _not_seen(previous: Track | None, scene: _Scene, search: _Search) -> Track:
    height, width = scene.frame.image.shape
    middle = scene.calibration.to_um(((width - 1) / 2, (height - 1) / 2))
    return Track(
        stamp_ns=scene.frame.stamp_ns,
        seen=False,
        position_um=middle if previous is None else previous.position_um,
        score=0.0 if previous is None else previous.score,
        lost_frames=1 if previous is None else previous.lost_frames + 1,
        radius_px=search.expected_px,
        roi_px=np.array(search.box, np.float64),
    )


def _normalised(tracker: Tracker, scene: _Scene, search: _Search, noise: float, *, bright: bool) -> _Disc | None:
    """The best disc in an image whose noise is 2 grey levels, with walls that may be off."""
    image, (x0, y0, x1, y1) = scene.frame.image, search.box
    pad = tracker.disc_pad_px(search.nominal_px)
    left, top = max(x0 - pad, 0), max(y0 - pad, 0)
    part = image[top : y1 + pad, left : x1 + pad].astype(np.float32)
    if not part.size:
        return None
    gain = np.float32((-1.0 if bright else 1.0) * _NOISE_LEVELS / noise)
    part = np.float32(128.0) + gain * (part - np.median(part[:: max(1, len(part) // 64)]))
    slack_px = (tracker.wall_error_radii or 0.0) * search.nominal_px
    distance = np.ascontiguousarray(scene.walls.distance_px[top : y1 + pad, left : x1 + pad])
    shifted = replace(
        search,
        box=(x0 - left, y0 - top, x1 - left, y1 - top),
        centre=(search.centre[0] - left, search.centre[1] - top),
        margin_px=search.margin_px - slack_px,
        slack_px=slack_px,
    )
    found = tracker.best_disc(part, Walls(distance, shifted.box), shifted)
    return None if found is None else replace(found, x=found.x + left, y=found.y + top)


def unseen(previous: Track, stamp_ns: int) -> Track:
    """The track after a frame that shows nothing new."""
    return replace(previous, stamp_ns=stamp_ns, seen=False, lost_frames=previous.lost_frames + 1)


def _clipped(centre: tuple[float, float], range_px: float, box: Box) -> Box:
    """The box of a range around a centre, within another box."""
    x0, y0, x1, y1 = box
    (x, y), reach = centre, min(range_px, 1e5)
    left, top = max(math.floor(x - reach), x0), max(math.floor(y - reach), y0)
    return left, top, max(min(math.ceil(x + reach) + 1, x1), left), max(min(math.ceil(y + reach) + 1, y1), top)


def _padded(box: Box, margin_px: int) -> Box:
    return box[0] - margin_px, box[1] - margin_px, box[2] + margin_px, box[3] + margin_px


def _coarse_step(nominal_px: float) -> int:
    return max(1, int(nominal_px / _COARSE_RADIUS_PX))
