"""Reliability of a track, from recorded messages alone, so of any session, while it is made or later.

A track is doubtful where what was followed may not have been the robot all the time, or is not known well:

- jumps: it is farther from where its last two places lead than a body of this size goes at the speed that was measured;
- border: a part of the body lies beyond the border of the image, so the place is that of the rest;
- rivals: another body of like brightness is as near to the expected place as the robot itself may be, so that the two
  may have been exchanged;
- looks: at the end it looks or shines as it did not at the beginning.

Of the other robots of a run, which come and go, jumps alone are told: their observations of the flow are those of
another body from there on.
"""

from __future__ import annotations

import math
from array import array

import numpy as np

from flowrec.core import Appearance, Floats, Shift, Tick, Track, seconds, shift_px
from flowrec.physics import Calibration, Robot
from flowrec.stages.robot_topics import tracks_of_others
from flowrec.stages.vision.assignment import EXPECTED_FRAMES
from flowrec.stages.vision.foreground import correlation
from flowrec.stages.vision.learned import ReducedScale

_NOISE = 6.0  # standard deviations of the distance from the expected place that are no jump
# The standard deviation over the lower quartile of distances in the plane: a track may jump on half of the images.
_QUARTILE, _OF_QUARTILE = 0.25, 1.0 / 0.7585
_FAST = 0.95  # quantile of the measured speeds that counts as the speed of the robot
# That a reversal at this speed may take it between two images: in a track that jumps often it is that of the jumps.
_FARTHEST_RADII = 4.0
_LEAST_STEPS = 5  # from which a speed is measured
_CUT_RADII = 0.5  # a centre nearer to the border than this is that of a part of the body
_LIKE_ENERGY = 2.0  # factor of the energy within which another body is as bright
_GATE = 3.0  # mean distances from the expected place within which the robot is
# Factor of the energy by which the robot does not change; assignment.py follows one within it.
_BRIGHTER = 4.0
_ROUND, _ALIKE = 0.8, 0.5  # correlation of a view with itself turned, and with the first look
_SETTLED = 10  # tracks after which the mean energy is that of the robot


class TrackQuality:
    """A sink of the messages of one session, in order; `doubts` judges what was taken so far.

    Parameters
    ----------
    calibration : of the camera.
    image_shape : (height, width) in px.
    robot : its radius.
    """

    def __init__(self, calibration: Calibration, image_shape: tuple[int, int], robot: Robot) -> None:
        self._calibration, self._image_shape, self._robot = calibration, image_shape, robot
        self._last: Track | None = None
        self._velocity: Floats | None = None  # um/s, between the last two places
        self._appearance: Appearance | None = None
        self._energy: tuple[float, float] | None = None  # at the beginning and now
        self._count = self._cut = self._rivals = 0
        self._steps_s, self._steps_um, self._off_um, self._at_s = array("d"), array("d"), array("d"), array("d")
        self._others: list[TrackQuality] = []  # of the other robots, in the order of their numbers

    def write(self, tick: Tick) -> None:
        """Take one tick, with the tracks of all robots."""
        self.take(tick.track, tick.appearance, tick.shift)
        for number, track in enumerate(tracks_of_others(tick)):
            if number == len(self._others):
                self._others.append(TrackQuality(self._calibration, self._image_shape, self._robot))
            self._others[number].take(track, None, tick.shift)

    def take(self, track: Track | None, appearance: Appearance | None, shift: Shift | None) -> None:
        """Take the latest messages of these kinds; a track counts once."""
        if appearance is not None:
            self._appearance = appearance
        if track is None or not track.seen or (self._last is not None and track.stamp_ns <= self._last.stamp_ns):
            return
        self._count += 1
        place_px = self._calibration.to_px(track.position_um) + shift_px(shift)
        height, width = self._image_shape
        border_px = min(place_px[0], place_px[1], width - 1.0 - place_px[0], height - 1.0 - place_px[1])
        self._cut += bool(border_px < _CUT_RADII * self._robot.radius_um / self._calibration.um_per_px)
        self._rivals += _has_rival(track, place_px)
        if track.energy > 0.0:
            begin = self._energy[0] if self._energy is not None and self._count > _SETTLED else track.energy
            self._energy = begin, track.energy
        self._step(track)
        self._last = track

    def _step(self, track: Track) -> None:
        last = self._last
        if last is None:
            return
        step_s = track.since_s(last)
        moved_um = off_um = track.position_um - last.position_um
        if self._velocity is not None and len(self._steps_s):
            off_um = moved_um - self._velocity * min(step_s, EXPECTED_FRAMES * self._steps_s[-1])
        self._steps_s.append(step_s)
        self._steps_um.append(math.hypot(*moved_um))
        self._off_um.append(math.hypot(*off_um))
        self._at_s.append(seconds(track.stamp_ns))
        self._velocity = moved_um / step_s

    def doubts(self) -> list[str]:
        """Reasons why the track is doubtful, for people; empty if there are none."""
        found = self.jumps()
        if self._cut:
            found.append(f"the robot is cut by the border of the image on {self._of(self._cut)}")
        if self._rivals:
            found.append(
                f"another body like the robot is as near as the robot itself on {self._of(self._rivals)}: the two may "
                "have been exchanged"
            )
        found += self._looks()
        return found + [f"robot {n}: {doubt}" for n, each in enumerate(self._others, 1) for doubt in each.jumps()]

    def jumps(self) -> list[str]:
        """The doubt that jumps of this track raise; empty if it has none."""
        jumps_s = self._jumps_s()
        if not jumps_s:
            return []
        where = ", ".join(f"{time_s:.2f}" for time_s in jumps_s[:3]) + (", ..." if len(jumps_s) > 3 else "")
        return [
            f"the track jumps {_times(len(jumps_s))} farther than the robot goes (at {where} s): to another body, or "
            "images are missing there"
        ]

    def _jumps_s(self) -> list[float]:
        """Times of the steps that are no motion of the robot."""
        if len(self._steps_s) < _LEAST_STEPS:
            return []
        time_s, step_um, off_um = (np.frombuffer(each) for each in (self._steps_s, self._steps_um, self._off_um))
        speed = float(np.quantile(step_um / time_s, _FAST))
        noise_um = _NOISE * _OF_QUARTILE * float(np.quantile(off_um, _QUARTILE))
        radius_um = self._robot.radius_um
        jumps = off_um > radius_um + noise_um + np.minimum(2.0 * speed * time_s, _FARTHEST_RADII * radius_um)
        # After a jump the velocity is that of the jump, so the next step is off as well.
        jumps[1:] &= ~jumps[:-1]
        return [float(time_s) for time_s in np.frombuffer(self._at_s)[jumps]]

    def _looks(self) -> list[str]:
        found = []
        if self._energy is not None and self._count > _SETTLED:
            factor = self._energy[1] / max(self._energy[0], 1e-9)
            if not 1.0 / _BRIGHTER < factor < _BRIGHTER:
                more = f"{factor:.1f} times as strong" if factor > 1.0 else f"{100.0 * factor:.0f} % as strong"
                found.append(f"at the end the image of the robot is {more} as at the beginning")
        look = self._appearance
        if look is not None and len(look.views) > 1:
            first, recent = look.views[0], look.views[1]
            window = ReducedScale(look.radius_px).window()
            turned = correlation(first, np.ascontiguousarray(first.T[::-1]), window)
            alike = correlation(first, np.ascontiguousarray(recent), window)
            if turned > _ROUND and alike < _ALIKE:
                found.append(f"the robot no longer looks as at the beginning (correlation {alike:.2f})")
        return found

    def _of(self, count: int) -> str:
        return f"{count} of {self._count} images"


def _has_rival(track: Track, place_px: Floats) -> bool:
    """True if another body of like energy is where the robot may be as well."""
    others = track.neighbours_px.reshape(-1, 3)
    if not len(others) or track.energy <= 0.0:
        return False
    distance_px = np.hypot(*(others[:, :2] - place_px).T)
    ratio = others[:, 2] / track.energy
    alike = (ratio > 1.0 / _LIKE_ENERGY) & (ratio < _LIKE_ENERGY)
    return bool((alike & (distance_px < max(_GATE * track.spread_px, track.radius_px))).any())


def _times(count: int) -> str:
    return "once" if count == 1 else "twice" if count == 2 else f"{count} times"
