"""Frame to Track: where is the robot?

The previous messages alone decide where to search: near the last position, or, after the robot has been missing for a
while, in the whole channel. There are two ways to find it.

Disc: positions that correlate with the template of a disc are candidates, and a disc is fitted to each with sub-pixel
precision. Near the last position the disc of the right size that fits best is the robot; in the whole channel it is the
darkest of those, because debris is paler. It needs no help from the user.

Learned appearance (learned.py, assignment.py): for a robot that a user has pointed at, and for bright ones.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Annotated, Literal

import numpy as np

from flowrec.core import Appearance, Floats, Frame, Range, Share, Track, UsageError
from flowrec.physics import Calibration, Chip, Robot
from flowrec.stages.vision.assignment import (
    ExpectedMotion,
    assign_objects,
    find_merged,
    hidden_neighbours,
    is_isolated,
    neighbours_of,
    similar,
    with_motion,
)
from flowrec.stages.vision.disc_search import (
    Disc,
    DiscSearch,
    best_disc,
    best_disc_normalised,
    disc_pad_px,
    tracked_radius_px,
)
from flowrec.stages.vision.learned import Candidates, View, alone, candidates, locate_robot, scale_of, updated_look
from flowrec.stages.vision.learning import box_of, brightest_spot, energy_of, learn, pixel_noise
from flowrec.stages.vision.several import Expected, Sought, first_tracks, next_tracks
from flowrec.stages.vision.tracers import TracerTracker
from flowrec.stages.vision.trackers import TRACKERS, Footprint, TrackingMethod, unseen
from flowrec.stages.vision.walls import Walls, box_around, clip_box, seen_walls, walls_in_view

Polarity = Literal["dark", "bright", "auto"]
_Pixel = Annotated[float, Range(-1e5, 1e5)]
_LENIENT_SCORE, _LENIENT_LIKENESS = 0.85, 0.9  # of a disc that may be pale or beside a wall: debris has less
_ENERGY_SHARE = 0.05  # least energy of a candidate relative to the robot's


@dataclass(frozen=True, slots=True, eq=False)
class _Scene:
    """An image and what is known about it."""

    previous: Track | None
    frame: Frame
    walls: Walls
    calibration: Calibration
    robot: Robot

    def track(self, search: DiscSearch, found: Disc | None) -> Track:
        """The track of a disc. Where there is none the last place stays, before the first the middle of the image."""
        previous, radius_px = self.previous, search.expected_px
        if found is not None:
            place_um, score, lost = self.calibration.to_um((found.x, found.y)), found.score, 0
            radius_px = tracked_radius_px(radius_px, found, search.nominal_px)
        elif previous is not None:
            place_um, score, lost = previous.position_um, previous.score, previous.lost_frames + 1
        else:
            height, width = self.frame.image.shape
            place_um, score, lost = self.calibration.to_um(((width - 1) / 2, (height - 1) / 2)), 0.0, 1
        return Track(
            stamp_ns=self.frame.stamp_ns,
            seen=found is not None,
            position_um=place_um,
            score=score,
            lost_frames=lost,
            radius_px=radius_px,
            roi_px=np.array(search.box, np.float64),
        )


@dataclass(frozen=True, slots=True)
class Tracker:
    """Finds the robot in each image; its memory is the previous Track, and the Appearance."""

    # method of the tracker; None: disc_or_look. A method of another package reads none of the settings below.
    method: Annotated[str, TRACKERS] | None = None

    least_score: Share = 0.55  # likeness times agreement of size, 0 to 1, for the robot while it is tracked
    # least score of a robot that was not seen on the frame before: more objects can be mistaken for it
    acquire_score: Share = 0.65
    # least likeness alone in that case: debris in contact may have the robot's size, but not its shape
    acquire_likeness: Share = 0.82
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
    # a point (column, row) on the robot, whose look is learned there; robot.radius_um should reach its border
    click_px: tuple[_Pixel, _Pixel] | None = None
    # a box around the robot, in place of a point: x0, y0, x1, y1
    box_px: tuple[_Pixel, _Pixel, _Pixel, _Pixel] | None = None
    click_frame: Annotated[int, Range(0, 2**62)] | None = None  # index of the image of click_px; None: the first one
    # the walls of the mask may be off by this many robot radii; ignored where polarity is None
    wall_error_radii: Annotated[float, Range(0.0, 2.0)] = 0.5
    # robots that are followed: the mission's one, which is the nearest to its start, and others in the same field
    robots: Annotated[int, Range(1, 100)] = 1
    # a point (column, row) on each robot in the first image, the mission's one first; []: the most similar discs
    robots_px: tuple[tuple[_Pixel, _Pixel], ...] = ()
    tracers: bool = False  # tracks of all bodies but the robot: beads that drift show the flow
    tracer: TracerTracker = field(default_factory=TracerTracker)

    @property
    def count(self) -> int:
        """Number of robots that are followed."""
        return max(self.robots, len(self.robots_px))

    def refuse_unfit(self) -> None:
        """Raise UsageError where settings are for one robot, and several are followed."""
        given = {"method": self._other, "click_px": self.click_px, "box_px": self.box_px}
        if self.count > 1 and (names := [name for name, value in given.items() if value is not None]):
            raise UsageError(
                f"tracker.{names[0]} is for one robot, and {self.count} are to be followed; leave it out "
                "(tracker.robots_px names a point on each)"
            )

    @property
    def _other(self) -> TrackingMethod | None:
        """The method of another package, if one is chosen."""
        if self.method is None or TRACKERS.own(self.method):
            return None
        return TRACKERS[self.method].build(self)

    def not_found_note(self, appearance: Appearance | None) -> str:
        """Advice for a robot that is not found; '' in a session that had no such note."""
        if self._other is not None:
            return f"tracker.method = {self.method!r} does not find it; see its settings"
        if self.polarity is None:
            return ""
        if appearance is not None and appearance.note:
            return appearance.note
        return (
            f"it is searched as a disc, tracker.polarity = {self.polarity!r}; for any other look name a point on it in "
            "the first image, as in tracker.click_px = [320, 256]"
        )

    def follow(
        self,
        previous: Track | None,
        appearance: Appearance | None,
        frame: Frame,
        chip: Chip,
        calibration: Calibration,
        robot: Robot,
        shift_px: tuple[float, float] = (0.0, 0.0),
    ) -> tuple[Track, Appearance | None]:
        """The robot in this frame, and how it looks; the given appearance itself if nothing new is known of it.

        `shift_px` (columns, rows): how far the image lies from where the calibration holds.
        """
        if self._other is not None:
            moved = calibration.for_shift(shift_px) if any(shift_px) else calibration
            return self._other.track(previous, frame, chip, moved, robot), None
        if self.polarity is None:
            return self.track(previous, frame, chip, calibration, robot), None
        walls, calibration = seen_walls(chip, calibration, frame.image.shape, shift_px)
        scene = _Scene(previous, frame, walls, calibration, robot)
        if appearance is None:
            return self._first_look(scene)
        if appearance.note:
            return scene.track(self._plan(scene, everywhere=True), None), appearance
        if len(appearance.views):
            assert previous is not None, "the robot was seen when its look was learned"
            return self._follow_learned(previous, appearance, scene)
        search = self._plan(scene)
        return scene.track(search, self._dark_disc(scene, search, appearance.noise)), appearance

    def follow_all(
        self,
        previous: Sequence[Track],
        expected: Sequence[Expected],
        appearance: Appearance | None,
        frame: Frame,
        chip: Chip,
        calibration: Calibration,
        robot: Robot,
        shift_px: tuple[float, float],
        start_um: Floats,
    ) -> tuple[list[Track], Appearance]:
        """All robots in this frame, the first one first, and the look of all; `expected` is where each one should be.

        Before the first image `previous` is empty. Then the first robot is the one that is nearest to `start_um`.
        """
        walls, calibration = seen_walls(chip, calibration, frame.image.shape, shift_px)
        search = self._plan(_Scene(None, frame, walls, calibration, robot), everywhere=True)
        if appearance is None:
            look = "bright" if self.polarity == "bright" else "dark"
            middle, nothing = 0.5 * (np.array(frame.image.shape[::-1]) - 1.0), np.zeros((0, 1, 1), np.float32)
            noise = pixel_noise(frame.image) / 2 ** (frame.bits - 8)
            appearance = Appearance(frame.stamp_ns, look, noise, 0.0, search.nominal_px, middle, nothing)
        image = frame.image if frame.bits == 8 else frame.image.astype(np.float32) / np.float32(2 ** (frame.bits - 8))
        image = image if appearance.polarity == "dark" else np.float32(255.0) - image.astype(np.float32)
        fixed = (self.least_score, self.search_px, self.reacquire_after, appearance.noise)
        sought = Sought(frame, image, walls, calibration, robot, search, *fixed)
        if previous:
            return next_tracks(sought, previous, expected), appearance
        at_um = [calibration.to_um(px) for px in self.robots_px] or [start_um]
        return first_tracks(sought, self.count, at_um), appearance

    def track(self, previous: Track | None, frame: Frame, chip: Chip, calibration: Calibration, robot: Robot) -> Track:
        """The dark disc in this frame; `seen` False keeps the last position (the image's centre before the first)."""
        walls = walls_in_view(chip, calibration, frame.image.shape)
        scene = _Scene(previous, frame, walls, calibration, robot)
        search = self._plan(scene)
        return scene.track(search, best_disc(frame.image, walls, search))

    def footprint(self, chip: Chip, calibration: Calibration, robot: Robot, shape: tuple[int, int]) -> Footprint:
        """The pixels of an image of `shape` that can influence a track, whatever the image shows."""
        if self._other is not None or self.tracers or self.count > 1:
            return Footprint(max(shape), (0, 0, shape[1], shape[0]))
        pad_px = disc_pad_px(robot.radius_um / calibration.um_per_px)
        if self.polarity is not None:
            pad_px = max(pad_px, scale_of(self._radius_px(calibration.um_per_px, robot)).pad_px)
        return Footprint(pad_px, walls_in_view(chip, calibration, shape).box)

    def _radius_px(self, um_per_px: float, robot: Robot) -> float:
        """Radius of what is learned: that of the user's box, or the robot's."""
        return robot.radius_um / um_per_px if self.box_px is None else max(box_of(self.box_px)[1], 1.0)

    def _first_look(self, scene: _Scene) -> tuple[Track, Appearance | None]:
        """Find a robot of unknown look; its appearance is None until it is seen."""
        frame, assumed = scene.frame, self.polarity or "dark"
        search = self._plan(scene, everywhere=True)
        at_px = self.click_px if self.box_px is None else box_of(self.box_px)[0]
        if at_px is not None:
            if self.click_frame is not None and frame.index < self.click_frame:
                return scene.track(search, None), None
            name, given = ("click_px", at_px) if self.box_px is None else ("box_px", self.box_px)
            what = f"tracker.{name} = {list(given)} of image {frame.index}"
            return self._learn_look(scene, search, at_px, assumed, what)
        noise = pixel_noise(frame.image)
        dark = self._dark_disc(scene, search, noise) if assumed != "bright" else None
        if assumed != "dark":
            radius_px = self._radius_px(scene.calibration.um_per_px, scene.robot)
            view = View(frame.image, scene.walls, radius_px, (1.0 + self.wall_error_radii) * radius_px)
            spot = brightest_spot(view, outstanding=assumed == "auto")
            if spot is not None and (dark is None or spot[1] > dark.darkness):
                return self._learn_look(scene, search, spot[0], "bright", "the brightest spot")
        if dark is None:
            return scene.track(search, None), None
        nothing, centre_px = np.zeros((0, 1, 1), np.float32), np.array([dark.x, dark.y])
        appearance = Appearance(frame.stamp_ns, "dark", noise, 0.0, search.nominal_px, centre_px, nothing)
        return scene.track(search, dark), appearance

    def _learn_look(
        self, scene: _Scene, search: DiscSearch, at_px: tuple[float, float], polarity: str, what: str
    ) -> tuple[Track, Appearance]:
        """The track and the appearance after learning the robot's look at a point."""
        view = self._view(scene, self._radius_px(scene.calibration.um_per_px, scene.robot))
        appearance = learn(view, scene.frame.stamp_ns, at_px, polarity, what)
        if appearance.note:
            return scene.track(search, None), appearance
        x, y = appearance.centre_px.tolist()
        box = clip_box((x, y), 4.0 * view.radius_px, scene.walls.box)
        found = candidates(view, appearance, box, 0.0, appearance.centre_px)[1]
        near = np.hypot(*(found.px - appearance.centre_px).T) < 0.7 * appearance.radius_px
        return replace(
            scene.track(search, Disc(x, y, search.expected_px, 0.0, 1.0, 1.0)),
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
        radius_px = appearance.radius_px
        view = self._view(scene, radius_px)
        dt, frames = frame.since_s(previous), 1 + previous.lost_frames
        motion = ExpectedMotion.after(previous, calibration.to_px(previous.position_um), radius_px, dt)
        expected = (float(motion.expected_px[0]), float(motion.expected_px[1]))
        everywhere = previous.lost_frames > self.reacquire_after
        farthest_px = self._range_px(scene, radius_px, dt) * frames
        near_px = max(self.search_px, 4.0 * radius_px, 6.0 * motion.spread_px)
        which, joined, missed = None, None, np.zeros((0, 3))
        for range_px in (math.inf,) if everywhere else (near_px, max(farthest_px, 1.5 * near_px)):
            box = walls.box if everywhere else clip_box(expected, range_px, walls.box)
            near = None if everywhere else motion.expected_px
            region, found = candidates(view, appearance, box, _ENERGY_SHARE * previous.energy, near)
            if everywhere:
                which = alone(found, previous.energy, self.acquire_score)
            else:
                which, missed = assign_objects(found, motion, range_px)
                if which is not None and not self._is_robot(found, which, motion, near_px):
                    which = None
            joined = find_merged(found, which, motion, missed)
            if which is not None or joined is not None:
                break
        roi = np.array(box, np.float64)
        seen = replace(previous, stamp_ns=frame.stamp_ns, seen=True, lost_frames=0, roi_px=roi)
        if joined is not None:
            merged, place_px, hidden = joined
            neighbours = np.concatenate([neighbours_of(found, merged), hidden.ravel()])
            return replace(seen, position_um=calibration.to_um(place_px), neighbours_px=neighbours), appearance
        if which is None:
            return replace(unseen(previous, frame.stamp_ns), roi_px=roi), appearance
        blocks, score = locate_robot(region, found, which, appearance)
        to_px = region.to_px(blocks)
        covered = hidden_neighbours(missed, to_px, radius_px)
        neighbours = np.concatenate([neighbours_of(found, which), covered.ravel()])
        isolated = is_isolated(neighbours, to_px, radius_px)
        track = replace(
            seen, position_um=calibration.to_um(to_px), score=min(max(score, 0.01), 1.0), neighbours_px=neighbours
        )
        if not len(covered):
            track = with_motion(track, motion, to_px, float(found.energy[which]))
        return track, updated_look(region, blocks, appearance, score, isolated, frame.stamp_ns)

    def _is_robot(self, found: Candidates, which: int, motion: ExpectedMotion, near_px: float) -> bool:
        """True if the candidate that was assigned to the robot looks like it; beyond `near_px` it must be the only one.

        The neighbours of the frame before are known nearby only.
        """
        previous = motion.previous
        known = found.similarity[which] >= (self.acquire_score if previous.lost_frames else self.least_score)
        if not (known or similar(found, which, motion)):
            return False
        far = math.dist(found.px[which], motion.expected_px) > near_px
        return not far or alone(found, previous.energy, self.acquire_score) == which

    def _view(self, scene: _Scene, radius_px: float) -> View:
        """The image of a scene, whose walls may be off."""
        return View(scene.frame.image, scene.walls, radius_px, -self.wall_error_radii * radius_px)

    def _dark_disc(self, scene: _Scene, search: DiscSearch, noise: float) -> Disc | None:
        """The dark disc; where there is none, one that is paler, or nearer to the walls than they permit if exact."""
        frame, walls = scene.frame, scene.walls
        found = best_disc(frame.image, walls, search) if frame.bits == 8 else None
        if found is None:
            score, likeness = max(search.least_score, _LENIENT_SCORE), max(search.least_likeness, _LENIENT_LIKENESS)
            search = replace(search, least_score=score, least_likeness=likeness)
            found = best_disc_normalised(frame.image, walls, search, noise, self.wall_error_radii * search.nominal_px)
        return found

    def _range_px(self, scene: _Scene, radius_px: float, dt: float) -> float:
        """Search range around the last position of an image before."""
        displacement = self.reach_speed * scene.robot.speed_limit_um_s * dt / scene.calibration.um_per_px
        return max(self.search_radii * radius_px + displacement, self.search_px)

    def _plan(self, scene: _Scene, *, everywhere: bool = False) -> DiscSearch:
        """Area of the search, from the previous message; or the whole channel."""
        previous, box = scene.previous, scene.walls.box
        nominal = scene.robot.radius_um / scene.calibration.um_per_px
        centre, range_px, score, likeness = (0.0, 0.0), math.inf, self.acquire_score, self.acquire_likeness
        # A score of 0 means that the robot was never seen.
        lost = previous is None or previous.score <= 0 or previous.lost_frames > self.reacquire_after
        if previous is not None and not (lost or everywhere):
            x, y = scene.calibration.to_px(previous.position_um).tolist()
            centre = (x, y)
            frames = 1 + previous.lost_frames
            dt = scene.frame.since_s(previous) / frames
            range_px = self._range_px(scene, previous.radius_px, dt) * frames
            box = box_around(centre, range_px, box)
            # While the robot is lost, an object of low likeness is more probably a piece of debris.
            if not previous.lost_frames:
                score, likeness = self.least_score, 0.0
        return DiscSearch(
            box=box,
            centre=centre,
            range_px=range_px,
            nominal_px=nominal,
            expected_px=nominal if previous is None else previous.radius_px,
            margin_px=min(max(self.wall_margin_um / scene.calibration.um_per_px, 1.0), 0.5 * nominal),
            least_score=score,
            least_likeness=likeness,
            least_contrast=self.least_contrast,
            size_tolerance=self.size_tolerance,
            candidates=self.candidates,
        )
