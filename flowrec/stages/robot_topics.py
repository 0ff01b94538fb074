"""Topics of robots beside the first one: those of a table of fields of `Tick`, once for each robot.

The first robot, number 0, has the fields themselves; the paths of number k have /robot/k where those have /robot, and
/robot/k/observations for /flow/observations.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

from flowrec.core import BY_FIELD, WALLS, Estimate, Observations, RobotWalls, Source, Tick, Topic, Track
from flowrec.stages.rig_settings import SIMULATED

_NUMBERED = re.compile(r"(?:/truth)?/robot/(\d+)(?:/|$)")
_OF_EACH = ("track", "estimate")  # fields of Tick that each robot has
_WALLS_TOPIC = Topic(WALLS, Source.STAGE, 1e-6, type=RobotWalls)
_TRACK, _ESTIMATE = (BY_FIELD[name].path for name in _OF_EACH)
_OBSERVATIONS = replace(BY_FIELD["observations"], path="/robot/observations")


def robot_topic(path: str, number: int) -> str:
    """The path of a topic of robot `number`, given that of the first one."""
    return path.replace("/robot", f"/robot/{number}", 1) if number else path


def robot_topics(config: Any) -> Iterator[Topic]:
    """The topics of the other robots of a run."""
    for number in range(1, config.tracker.count):
        yield from (_of(BY_FIELD[name], number) for name in _OF_EACH)
        if config.others.observe_flow:
            yield _of(_OBSERVATIONS, number)
    if config.tracker.count > 1:
        yield _WALLS_TOPIC
    if config.rig == SIMULATED:
        yield from (_of(BY_FIELD["truth"], number) for number in range(1, config.simulated.robots))


def _of(topic: Topic, number: int) -> Topic:
    return replace(topic, path=robot_topic(topic.path, number))


def track_of(tick: Tick, number: int) -> Track | None:
    """The latest track of a robot."""
    return tick.track if number == 0 else tick.extra.of(robot_topic(_TRACK, number), Track)


def estimate_of(tick: Tick, number: int) -> Estimate | None:
    """The latest estimate of a robot."""
    return tick.estimate if number == 0 else tick.extra.of(robot_topic(_ESTIMATE, number), Estimate)


def observations_of_others(tick: Tick) -> dict[int, Observations]:
    """The latest flow observations of the robots other than the first one, by number."""
    found = {robot_number(path): message for path, message in tick.extra.items() if path.endswith("/observations")}
    return {number: each for number, each in found.items() if number and isinstance(each, Observations)}


def observations_topic(number: int) -> str:
    """The path of the flow observations of a robot other than the first one."""
    return robot_topic(_OBSERVATIONS.path, number)


def robot_number(path: str) -> int:
    """The number of the robot that a topic is of; 0 for the first one's, and for topics of none."""
    found = _NUMBERED.match(path)
    return int(found[1]) if found else 0


def tracks_of_others(tick: Tick) -> list[Track]:
    """The latest tracks of all robots but the first one, in the order of their numbers; none before the first image."""
    found: list[Track] = []
    while (track := track_of(tick, len(found) + 1)) is not None:
        found.append(track)
    return found


def estimates_of_others(tick: Tick) -> list[Estimate]:
    """The latest estimates of all robots but the first one, in the order of their numbers."""
    found: list[Estimate] = []
    while (estimate := estimate_of(tick, len(found) + 1)) is not None:
        found.append(estimate)
    return found


def messages_of(number: int, track: Track, estimate: Estimate) -> dict[str, Track | Estimate]:
    """Messages of a robot other than the first one, by path."""
    return {robot_topic(_TRACK, number): track, robot_topic(_ESTIMATE, number): estimate}
