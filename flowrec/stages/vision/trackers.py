"""The table of trackers. Ours is the stage itself (tracker.py); packages of others bring more."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Protocol

from flowrec.core import Frame, Method, Methods, Track
from flowrec.physics import Calibration, Chip, Robot
from flowrec.stages.vision.walls import Box


@dataclass(frozen=True, slots=True)
class Footprint:
    """The pixels that a tracker reads: those of Track.roi_px and no farther than `pad_px` around it."""

    pad_px: int
    everywhere_px: Box  # roi_px of a search in the whole channel


class TrackingMethod(Protocol):
    """Interface of another package's row in TRACKERS: the frozen dataclass of its settings, with this method."""

    def track(self, previous: Track | None, frame: Frame, chip: Chip, calibration: Calibration, robot: Robot) -> Track:
        """The robot in this frame. Where it is not seen, `unseen(previous, frame.stamp_ns)` is its track.

        The first track of a run may be unseen, at any place, with a score of 0. It is the only memory: its score,
        radius_px and other fields, which people see, are the method's to use.
        """
        ...


TRACKERS = Methods(
    "tracker.method",
    Method(
        "disc_or_look", "flowrec.stages.vision.tracker:Tracker", "a disc of the robot's size, or the look at a point"
    ),
    group="flowrec.trackers",
    verb="track",
)


def unseen(previous: Track, stamp_ns: int) -> Track:
    """The track after a frame that shows nothing new."""
    return replace(previous, stamp_ns=stamp_ns, seen=False, lost_frames=previous.lost_frames + 1)
