"""Walls of a chip as a picture shows them: how the chip lies in it, and where each wall differs from the mask.

Along the contour of the mask stand profiles across the wall. They look alike, whatever walls look like: a dark line, a
step, both. In oblique light they also differ by the direction in which the fluid lies, as a + b cos + c sin of it. A
chip that lies elsewhere makes the same difference. So this difference is fitted only if the walls look different even
after they were allowed to move, and the fit begins at the pose of wall_fit.py, which such light does not mislead.

The wall of each profile is moved to where it correlates best with the common profile, by dynamic programming:
neighbours along a wall move nearly alike (an active contour; Amini, Weymouth and Jain 1990). The motion that all walls
share is one of the chip in the image, by robust least squares; what is left are errors of the mask.

A wall that the picture does not show, and one that debris or the robot hides, moves as its neighbours do.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import NamedTuple

import cv2
import numpy as np
import scipy  # its ndimage and spatial load at first use, not at start-up

from flowrec.core import STD_PER_MAD, Bools, ChipError, Floats, Floats32, FlowError, Image, Ints
from flowrec.measure.images import Levels, shrink
from flowrec.measure.picture_registration import apart_px, fit_nearby, is_legible, is_loose
from flowrec.measure.wall_contours import ALONG_PX, WallContours
from flowrec.measure.wall_fit import level_contrast
from flowrec.measure.wall_search import move_chip
from flowrec.physics import Calibration, Chip, check_point, median_width_um, with_levels
from flowrec.stages import ResolvedConfig, registration_of

_STEP_PX = 0.125  # between the places that are compared, in px of the mask, as all lengths here
_OUT_PX, _IN_WIDTHS = 3.0, 0.7  # largest motion of a wall outwards; and inwards, in median channel widths
_WINDOW_WIDTHS, _WINDOW_PX = 0.3, (1.0, 2.0)  # half length of a profile: in median channel widths, but within this
_STEPS_ALONG = 4  # by which neighbours may differ at most
_STIFFNESS, _REST = 0.15, 0.01  # costs of a difference (px^2) between neighbours, and of a motion (px)
_LIKE = 0.5  # correlation from which a wall counts as seen
# Profiles' b and c over their a from which on light comes from one side: 0.30 and 0.57 in relief, under 0.1 in eleven
# other looks of walls.
_SIDED = 0.2
# The same of their extremes, whose place does not matter, over contrast: 0.7 to 2.7 in relief, 0.23 at most in others.
_LIT = 0.45
_FAINT = 0.3  # contrast of a profile, relative to the median, below which it shows no wall
# Walls that differ by less (root mean square) are those of the mask: so far a right one is taken off. In pixels of the
# mask or, where those are larger, of the camera; so is the next one.
_NOISE_PX = 0.15
# All walls lie aside of the mask's from here on, as far as the middle of their steep profile; with a right mask that
# is 0 to 0.4 px off, because some walls have a fringe on one side.
_ASIDE_PX = 0.45
_ROUNDS, _STILL_PX = 6, 0.05  # of profile, walls and pose; until the pose moves less
# Part of the walls in the picture, their length, and how far they may be off: walls that are found in blurred noise are
# 82 to 85 % alike and 2.1 px off (root mean square), those of chips with walls up to a pixel off 97 % and 0.8 px.
_LEAST_SEEN, _LEAST_WALL_PX, _MOST_WALL_PX = 0.9, 30, 1.5
# Where a motion moves walls by less, relative to the others, the scale is as stated: of straight channels that meet at
# one place (0.01 to 0.05) only the widths tell it. What then is such a motion stays, too: along a straight channel.
_UNKNOWN = 0.1
# Points of a wall, and times the noise: a corner of a right mask is at most 1.1 px off over so many, an obstacle that
# leaves half or two thirds of a channel 1.9 to 7 px.
_STRETCH, _OBSTACLE = 7, 10.0
# Median correlation of a picture clear enough to correct a mask: of a right one, a trace in noise (correlation 0.86 to
# 0.94) or out of focus (0.75 to 0.85) is 0.3 to 0.6 px off, of other looks (over 0.98) at most 0.14.
_CLEAR = 0.96
_SAME_PX = 0.3  # of the camera: a pose that differs by less is the stated one; of dye, a right one is so far taken off


class TracedWalls(NamedTuple):
    """Places of the walls in a picture."""

    calibration: Calibration  # how the chip lies in the picture
    moved_px: float  # root mean square distance, in the picture's pixels, of the walls by it from the stated ones
    level_px: Floats32  # (h, w) signed distances of the mask's pixel centres to the walls
    wall_px: float  # root mean square distance of the walls from those of the mask, in its pixels
    noise_px: float  # that of a right mask
    obstacle_px: float  # distance from the mask's that a stretch of _STRETCH points of a wall exceeds in its half
    alike: float  # median correlation of a wall with the others

    @property
    def walls_differ(self) -> bool:
        """True if the mask differs from what the picture shows by more than the noise of a trace."""
        differs = self.wall_px > self.noise_px or self.obstacle_px > _OBSTACLE * self.noise_px
        return differs and self.alike >= _CLEAR


def as_pictured(config: ResolvedConfig, chip: Chip, picture: Image) -> tuple[ResolvedConfig, Chip, str]:
    """A configuration and its chip with the registration and the walls of a picture (h, w); and what changed, in words.

    Both stay as they are where the picture does not show the walls, or shows them within the noise of a trace. A chip
    whose openings would close, or with no room for the robot at start or goal, keeps the walls of its mask. An open
    field has none: '' then.
    """
    if chip.is_open_field:
        return config, chip, ""
    stated = registration_of(config.camera, chip)
    traced = trace_walls(picture, chip, stated)
    if traced is None:
        return config, chip, "the image does not show the walls: registration and mask are as stated"
    found = []
    if traced.moved_px > _SAME_PX:
        height, width = picture.shape
        now = traced.calibration
        x_um, y_um = now.to_um((0.5 * (width - 1), 0.5 * (height - 1))).tolist()
        camera = replace(config.camera, um_per_px=now.um_per_px, angle_deg=now.angle_deg, centre_um=(x_um, y_um))
        config = replace(config, camera=camera)
        found.append(f"the chip lies {traced.moved_px:.2g} px from where the registration puts it")
    if traced.walls_differ:
        walls = f"its walls are {traced.wall_px * chip.um_per_px:.2g} um off the mask's (root mean square)"
        try:
            measured = with_levels(chip, traced.level_px)
            for name, place in (("start", config.mission.start), ("goal", config.mission.goal)):
                check_point(measured, place, name, config.robot.radius_um)
            chip = measured
            found.append(walls)
        except (ChipError, FlowError) as error:
            found.append(f"{walls}, which are kept ({error})")
    if not found:
        return config, chip, "the image shows the chip where registration and mask have it"
    return config, chip, f"{'; '.join(found)}: taken from the image"


def trace_walls(picture: Image, chip: Chip, stated: Calibration) -> TracedWalls | None:
    """Trace the walls of a chip in a picture (h, w), which shows it about as a registration states.

    None if the picture does not show them.
    """
    if not is_legible(picture, chip):
        return None
    contours = WallContours.of(chip)
    levels = _level_picture(picture, contours, stated)
    lit = _is_lit_from_one_side(levels, contours, stated)
    found = None if lit else _follow(levels, contours, stated, sided=False)
    if found is None or found.sided > _SIDED:  # scale and place may be farther off than walls are sought
        nearby = fit_nearby(picture, chip, stated)
        if nearby is None or is_loose(nearby):
            return None
        levels = _level_picture(picture, contours, nearby.calibration)
        for sided in (True,) if lit else (False, True):
            if found is None or found.sided > _SIDED:
                found = _follow(levels, contours, nearby.calibration, sided)
    if found is None:
        return None
    calibration, out_px, like, _ = found
    seen = like >= _LIKE
    return TracedWalls(
        calibration,
        apart_px(calibration, stated, contours.points * chip.um_per_px),
        contours.levels(out_px),
        float(np.sqrt((out_px[seen] ** 2).mean())),
        _NOISE_PX * max(1.0, calibration.um_per_px / chip.um_per_px),
        float(scipy.ndimage.median_filter(np.abs(out_px), _STRETCH).max()),
        float(np.nanmedian(like)),
    )


class _Followed(NamedTuple):
    """Walls and pose near a first one."""

    calibration: Calibration
    out_px: Floats  # (n,) how far out each wall is
    like: Floats  # (n,) correlation with the common profile; NaN beside the picture
    sided: float  # size of the profiles' b and c over that of a


def _follow(levels: tuple[Levels, int], contours: WallContours, start: Calibration, sided: bool) -> _Followed | None:
    """Walls and pose near a first one, in light from one side or not; None if too few of the walls look alike."""
    chip, (image, step) = contours.chip, levels
    width_px = median_width_um(chip) / chip.um_per_px
    calibration = start
    window = round(float(np.clip(_WINDOW_WIDTHS * width_px, *_WINDOW_PX)) / _STEP_PX)
    places = np.arange(-math.ceil(_IN_WIDTHS * width_px / _STEP_PX), math.ceil(_OUT_PX / _STEP_PX) + 1)
    out_px = np.zeros(len(contours.points))
    for _ in range(_ROUNDS):
        profiles = _profiles(image, step, contours, calibration, places, window)
        usable = contours.inside & np.isfinite(profiles).all(axis=1)
        if np.count_nonzero(usable) < _LEAST_WALL_PX or not profiles[usable].std() > 0.0:
            return None
        at = _nearest_places(out_px, places)
        at_walls = _windows(profiles, window)[at]
        expected, share = _expect_profiles(at_walls, _directions(calibration, contours), usable, sided)
        likeness = _likeness(profiles, expected, usable)
        out_px = _move_walls(likeness, usable, places, contours)
        like = np.where(usable, likeness[_nearest_places(out_px, places)], np.nan)
        if np.count_nonzero(like >= _LIKE) < _LEAST_WALL_PX:
            return None
        calibration, out_px, moved_px = _move_pose(calibration, contours, out_px, like >= _LIKE)
        if moved_px < _STILL_PX:
            break
    seen = like >= _LIKE
    plausible = np.mean(seen[usable]) >= _LEAST_SEEN and np.sqrt((out_px[seen] ** 2).mean()) <= _MOST_WALL_PX
    if not plausible:
        return None
    aside_px = _steep_place(expected)
    if abs(aside_px) > _ASIDE_PX * max(1.0, calibration.um_per_px / chip.um_per_px):
        out_px = np.where(contours.inside, out_px + aside_px, 0.0)
    return _Followed(calibration, out_px, like, share)


def _is_lit_from_one_side(levels: tuple[Levels, int], contours: WallContours, start: Calibration) -> bool:
    """True if, as in relief, walls that face one way are bright and walls that face the other way are dark.

    The extremes of a profile do not tell where on it the wall is, so a chip that lies elsewhere makes no difference. In
    profiles that are moved, relief looks like a chip that lies half a channel aside, and all its walls alike.
    """
    image, step = levels
    width_px = median_width_um(contours.chip) / contours.chip.um_per_px
    reach = int(min(_OUT_PX, 0.5 * width_px) / _STEP_PX)  # the wall across the channel is not to be seen
    profiles = _profiles(image, step, contours, start, np.arange(-reach, reach + 1), 0)
    usable = contours.inside & np.isfinite(profiles).all(axis=1)
    if np.count_nonzero(usable) < _LEAST_WALL_PX:
        return False
    high, low = profiles[usable].max(axis=1), profiles[usable].min(axis=1)
    directions = _directions(start, contours)[usable]
    common, *_ = np.linalg.lstsq(directions, high + low, rcond=_UNKNOWN)
    return float(np.hypot(*common[1:])) > _LIT * max(float(np.median(high - low)), 1e-9)


def _nearest_places(out_px: Floats, places: Ints) -> tuple[Ints, Ints]:
    """Indices (n,) of points and of the places nearest to where their walls are, together."""
    return np.arange(len(out_px)), np.clip(np.rint(out_px / _STEP_PX).astype(np.intp) - places[0], 0, len(places) - 1)


def _steep_place(expected: Floats32) -> float:
    """Distance in px from the present walls, outwards, to where profiles (n, m) are steep: a mean by squared slope."""
    steep = (np.diff(expected, axis=1) ** 2).sum(axis=0)
    places = _STEP_PX * (np.arange(len(steep)) - 0.5 * (len(steep) - 1))
    return float((steep * places).sum() / max(float(steep.sum()), 1e-9))


def _level_picture(picture: Image, contours: WallContours, start: Calibration) -> tuple[Levels, int]:
    """A picture without its slow variation, with pixels of at most half the mask's, and how many of its own they are.

    Slow is what is wider than a channel.
    """
    chip = contours.chip
    width_px = median_width_um(chip) / chip.um_per_px
    step = max(int(0.5 * chip.um_per_px / start.um_per_px), 1)
    height, width = (n // step for n in picture.shape)
    small = shrink(np.asarray(picture[: step * height, : step * width], np.float32), (width, height))
    return level_contrast(small, max(1.2 * width_px * chip.um_per_px / (step * start.um_per_px), 12.0)), step


def _profiles(
    image: Levels, step: int, contours: WallContours, calibration: Calibration, places: Ints, window: int
) -> Floats32:
    """(n, m) grey levels across the walls, outwards: a window before the first place to one after the last.

    `step` pixels of the camera are one of the image. NaN beside the image.
    """
    out_px = _STEP_PX * np.arange(places[0] - window, places[-1] + window + 1)
    at_um = (contours.points[:, None] - out_px[None, :, None] * contours.inward[:, None]) * contours.chip.um_per_px
    at_px = ((calibration.to_px(at_um) + 0.5) / step - 0.5).astype(np.float32)
    columns, rows = (np.ascontiguousarray(at_px[..., axis]) for axis in (0, 1))
    seen = cv2.remap(image, columns, rows, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=math.nan)
    return np.asarray(contours.along(np.asarray(seen, np.float64), ALONG_PX), np.float32)


def _windows(profiles: Floats32, window: int) -> Floats32:
    """(n, places, 2 window + 1) the part of profiles (n, m) around each place."""
    return np.lib.stride_tricks.sliding_window_view(profiles, 2 * window + 1, axis=1)


def _directions(calibration: Calibration, contours: WallContours) -> Floats:
    """(n, 3) 1, cos and sin of the direction in which the fluid lies at each wall, in the image: what a, b, c weigh."""
    return np.column_stack([np.ones(len(contours.inward)), (calibration.axes @ contours.inward.T).T])


def _expect_profiles(present: Floats32, directions: Floats, usable: Bools, sided: bool) -> tuple[Floats32, float]:
    """(n, m) the common profile at each wall, of mean 0, and the size of its b and c over that of its a.

    Parameters
    ----------
    present : (n, m) profiles where the walls are taken to be.
    directions : (n, 3) `_directions`.
    sided : b and c are part of the profile.
    """
    now = present - present.mean(axis=1, keepdims=True)
    chosen = usable
    for _ in range(2):  # the second time without those that look different
        common, *_ = np.linalg.lstsq(directions[chosen], now[chosen], rcond=None)
        off = np.sqrt(((now - directions @ common) ** 2).mean(axis=1))
        chosen = usable & (off <= 2.0 * np.median(off[usable]))
    share = float(np.linalg.norm(common[1:])) / max(float(np.linalg.norm(common[0])), 1e-9)
    expected = directions @ common if sided else np.tile(common[0], (len(now), 1))
    return np.asarray(expected - expected.mean(axis=1, keepdims=True), np.float32), share


def _likeness(profiles: Floats32, expected: Floats32, usable: Bools) -> Floats:
    """(n, places) correlation of profiles (n, m) around each place with the expected one (n, 2 window + 1)."""
    length = expected.shape[1]
    around = _windows(profiles, length // 2)
    power = np.maximum(_windows(profiles**2, length // 2).mean(axis=-1) - around.mean(axis=-1) ** 2, 0.0)
    size = np.sqrt((expected**2).mean(axis=1))[:, None]
    both = np.einsum("npu,nu->np", around, expected) / length
    faint = _FAINT * float(np.median(np.sqrt(power[usable].max(axis=1)))) + 1e-9
    return np.asarray(both / np.maximum(np.sqrt(power), faint) / np.maximum(size, 1e-9), np.float64)


def _move_walls(likeness: Floats, usable: Bools, places: Ints, contours: WallContours) -> Floats:
    """(n,) px by which each wall moves outwards."""
    cost = np.where(usable[:, None], 1.0 - likeness, 1.0) + _REST * np.abs(_STEP_PX * places)
    cost[~contours.inside] = np.abs(_STEP_PX * places)
    out_px = np.zeros(len(cost))
    for which, closed in contours.walls:
        each = cost[which]
        chosen = np.clip(_cheapest(each, closed), 1, len(places) - 2)
        before, here, after = (each[np.arange(len(chosen)), chosen + step] for step in (-1, 0, 1))
        part = np.clip(0.5 * (before - after) / np.maximum(before - 2.0 * here + after, 1e-6), -1.0, 1.0)
        out_px[which] = _STEP_PX * (places[chosen] + part)
    return np.where(contours.inside, contours.along(out_px, 0.7 * ALONG_PX), 0.0)


def _cheapest(cost: Floats, closed: bool) -> Ints:
    """(n,) places along a wall with the least sum of costs (n, places), and of differences between neighbours."""
    again = min(len(cost), round(0.25 * len(cost)) + 2 * _STEPS_ALONG) if closed else 0
    line = np.concatenate([cost[len(cost) - again :], cost, cost[:again]]) if again else cost
    steps = np.arange(-_STEPS_ALONG, _STEPS_ALONG + 1)
    stiff = (_STIFFNESS * (_STEP_PX * steps) ** 2)[:, None]
    came = np.zeros(line.shape, np.intp)
    padded = np.pad(line[0], _STEPS_ALONG, constant_values=np.inf)
    total = padded[_STEPS_ALONG:-_STEPS_ALONG]
    neighbours = np.lib.stride_tricks.sliding_window_view(padded, len(total))
    for number in range(1, len(line)):
        options = neighbours + stiff
        came[number] = options.argmin(axis=0)
        total[:] = options.min(axis=0) + line[number]
    path = np.empty(len(line), np.intp)
    path[-1] = int(total.argmin())
    for number in range(len(line) - 1, 0, -1):
        path[number - 1] = path[number] + steps[came[number, path[number]]]
    return path[again : again + len(cost)]


def _move_pose(
    calibration: Calibration, contours: WallContours, out_px: Floats, seen: Bools
) -> tuple[Calibration, Floats, float]:
    """The pose that leaves the walls least out (n,) px, what then is left, and how far it moves walls, in px."""
    points, inward = contours.points, contours.inward
    arm = points - points.mean(axis=0)
    reach = max(float(np.hypot(*arm.T).mean()), 1.0)
    turned = np.stack([-arm[:, 1], arm[:, 0]], axis=1)
    design = -np.column_stack([inward, (turned * inward).sum(axis=1) / reach, (arm * inward).sum(axis=1) / reach])
    told = np.linalg.svd(design[seen] - design[seen].mean(axis=0), compute_uv=False)
    if told[-1] < _UNKNOWN * told[0]:
        design[:, 3] = 0.0  # the scale is as stated
    weight = seen.astype(np.float64)
    for _ in range(10):  # Cauchy's weights: a blocked branch is no motion of the chip
        root = np.sqrt(weight)[:, None]
        # A mean motion outwards is none of the chip: where on its profile a wall is, no picture tells, the mask does.
        about, mean_px = np.average(design, axis=0, weights=weight), np.average(out_px, weights=weight)
        move, *_ = np.linalg.lstsq(root * (design - about), root[:, 0] * (out_px - mean_px), rcond=_UNKNOWN)
        left = out_px - mean_px - (design - about) @ move
        scale = STD_PER_MAD * float(np.median(np.abs(left[seen]))) + 1e-6
        weight = seen / (1.0 + (left / (2.0 * scale)) ** 2)
    px = contours.chip.um_per_px
    middle_um = px * points.mean(axis=0)
    middle_px, per = calibration.to_px(middle_um), px / calibration.um_per_px
    shift_px = calibration.vectors_to_px(px * move[:2])
    turn = -move[2] if calibration.mirror else move[2]
    moved = move_chip(calibration, np.array([*shift_px, per * turn, per * move[3]]), middle_px, per * reach)
    return moved, left, float(np.abs(move).max())
