"""Frame to the places of the robots and the tracers in it: the stages of vision in their order, from tick to tick."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple, Protocol

import numpy as np

from flowrec.core import Appearance, Background, Extra, Frame, Shift, Tick, Tracers, Track, shift_px
from flowrec.physics import Calibration, Chip, Robot
from flowrec.stages.control.mission import MissionStateMachine
from flowrec.stages.inputs import FROM_IMAGE, Inputs
from flowrec.stages.other_robots import expected_robots, expected_unmoved
from flowrec.stages.robot_topics import tracks_of_others
from flowrec.stages.vision import Expected, Stabiliser, Tracker, move_neighbours, unseen


class Looking(Protocol):
    """The stages of vision, and the scene that they look at; a Pipeline has all of them."""

    @property
    def chip(self) -> Chip: ...
    @property
    def calibration(self) -> Calibration: ...
    @property
    def robot(self) -> Robot: ...
    @property
    def stabiliser(self) -> Stabiliser: ...
    @property
    def tracker(self) -> Tracker: ...
    @property
    def mission(self) -> MissionStateMachine: ...


class Sight(NamedTuple):
    """Results of an image: the robot, how it looks, how far the image lies off, the tracers, and the other robots."""

    track: Track | None = None
    appearance: Appearance | None = None
    background: Background | None = None
    shift: Shift | None = None
    tracers: Tracers | None = None
    others: tuple[Track, ...] = ()


def look(p: Looking, last: Sight, frame: Frame, expected: Sequence[Expected] = ()) -> Sight:
    """Register the next image and find the robot in it; or all of several, each of which is expected somewhere."""
    shift, background = p.stabiliser.register(
        last.shift, last.background, last.track, frame, p.chip, p.calibration, p.robot
    )
    previous = last.track
    if shift is not None and previous is not None and last.shift is not None:
        previous = move_neighbours(previous, shift.shift_px - last.shift.shift_px)
    off_px = shift_px(shift)
    others: list[Track] = []
    if p.tracker.count > 1:
        seen = [] if previous is None else [previous, *last.others]
        expected = expected or [expected_unmoved(track, p.robot, frame.stamp_ns) for track in seen]
        (first, *others), appearance = p.tracker.follow_all(
            seen, expected, last.appearance, frame, p.chip, p.calibration, p.robot, off_px, np.array(p.mission.start)
        )
        found: tuple[Track, Appearance | None] = first, appearance
    else:
        found = p.tracker.follow(previous, last.appearance, frame, p.chip, p.calibration, p.robot, off_px)
    tracers = None
    if p.tracker.tracers:
        tracers = p.tracker.tracer.follow(last.tracers, found[0], frame, p.chip, p.calibration, p.robot, off_px, others)
    return Sight(*found, background, shift, tracers, tuple(others))


def find_robots(p: Looking, last: Tick, inputs: Inputs) -> Sight:
    """Position of the robots, when each was last seen, and how they look. A repeated image counts as not seen."""
    count, known = p.tracker.count, tracks_of_others(last)[: p.tracker.count - 1]
    previous, before = last.track, Sight(*(getattr(last, name) for name in FROM_IMAGE))._replace(others=tuple(known))
    if inputs.applied.repeats_image and previous is not None:
        others = tuple(unseen(each, inputs.stamp_ns) for each in known)
        return before._replace(track=unseen(previous, inputs.stamp_ns), others=others)
    if inputs.frame is None:
        assert inputs.track is not None, "a tick has a frame or, where that was dropped, the recorded track"
        new = {name: message for name in FROM_IMAGE if (message := getattr(inputs, name)) is not None}
        return before._replace(**new, others=tuple(tracks_of_others(Tick(extra=Extra(inputs.extra)))[: count - 1]))
    expected = expected_robots(last, count, inputs.applied, inputs.stamp_ns, p.robot) if known else []
    sight = look(p, before, inputs.frame, expected)
    if sight.others:
        before_them: list[Track | None] = [*known] or [None] * len(sight.others)
        pairs = zip(sight.others, before_them, strict=True)
        sight = sight._replace(others=tuple(replace(new, seen_ns=_seen_ns(new, old)) for new, old in pairs))
    track = sight.track
    if inputs.applied.image_since_ns is None or track is None:
        return sight
    return sight._replace(track=replace(track, seen_ns=_seen_ns(track, previous)))


def _seen_ns(track: Track, previous: Track | None) -> int | None:
    """Stamp of the latest frame in which a robot was seen."""
    return track.stamp_ns if track.seen else None if previous is None else previous.seen_ns
