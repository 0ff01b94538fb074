"""The other robots of a simulated world: in the same field and the same flow, each with a response of its own.

Of each is drawn: um per revolution, step-out frequency, a lag behind the first robot, noise of its rolling, radius and
darkness. They start near the first robot, as a lab puts them in. Robots exert no force on each other, neither by
contact nor as magnets: they pass over each other, and then one hides the other.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from flowrec.core import Floats32, RigError, Truth
from flowrec.physics import Chip, Robot
from flowrec.rigs.simulated.bodies import Swimmer
from flowrec.rigs.simulated.microscope import DrawnRobot
from flowrec.stages import Simulated, robot_topic

_STREAM = 10  # of the seed, with the number of the robot
_RESPONSE = 0.25  # um per revolution and step-out are those of the first robot times 1 +- this
_LAG_S = 0.03  # behind the first robot, at most
_NOISE = (0.7, 1.5)  # rolling noise over that of the first robot
_RADIUS = (0.88, 1.12)  # over that of the first robot
_DARKNESS = (0.6, 0.85)  # that of the first robot is 0.8
_NEAR_RADII, _FAR_RADII = 4.0, 25.0  # from the start of the first robot
_APART_RADII = 3.0  # between the starts of the others
_ROOM_RADII = 1.5  # from a start to the walls


@dataclass(frozen=True, slots=True)
class _Command:
    """A constant field for a duration."""

    duration_s: float
    frequency_hz: float
    heading_rad: float
    strength: float


class OtherRobot(Swimmer):
    """A robot that follows the field a lag later than the first one.

    Parameters
    ----------
    number : from 1 on; all that is drawn of it depends on the seed and on this number.
    robot, simulated : the first robot as it truly is, and its noise.
    options : of `Swimmer`, from `field` on.
    """

    def __init__(
        self, number: int, position_um: tuple[float, float], robot: Robot, simulated: Simulated, **options: Any
    ) -> None:
        rng = np.random.default_rng([simulated.seed, _STREAM, number])
        rolls, steps_out = 1.0 + _RESPONSE * rng.uniform(-1.0, 1.0, 2)
        noise = float(rng.uniform(*_NOISE))
        own = replace(
            robot,
            um_per_rev=robot.um_per_rev * float(rolls),
            step_out_hz=robot.step_out_hz * float(steps_out),
            radius_um=robot.radius_um * float(rng.uniform(*_RADIUS)),
        )
        uneven = {name: noise * simulated.value(name) for name in ("heading_noise_rad", "speed_noise")}
        super().__init__(position_um, own, replace(simulated, **uneven), **options, rng=rng)
        self.number, self.radius_um, self.um_per_rev = number, own.radius_um, own.um_per_rev
        self.darkness = float(rng.uniform(*_DARKNESS))
        self._coming = deque([_Command(float(rng.uniform(0.0, _LAG_S)), 0.0, 0.0, 0.0)])
        self._before_um = self.position_um

    def advance(self, duration_s: float, frequency_hz: float, heading_rad: float, strength: float) -> None:
        """Move for a duration in the fields of as long, a lag ago; this one comes later."""
        self._coming.append(_Command(duration_s, frequency_hz, heading_rad, strength))
        left_s = duration_s
        while left_s > 0.0 and self._coming:
            now = self._coming.popleft()
            lasts_s = min(now.duration_s, left_s)
            super().advance(lasts_s, now.frequency_hz, now.heading_rad, now.strength)
            if now.duration_s > lasts_s:
                self._coming.appendleft(replace(now, duration_s=now.duration_s - lasts_s))
            left_s -= lasts_s

    def look(self, elapsed_s: float) -> DrawnRobot:
        """Its place and look in an image that comes so long after the last one."""
        velocity = (self.position_um - self._before_um) / elapsed_s if elapsed_s > 0 else np.zeros(2)
        self._before_um = self.position_um
        return DrawnRobot(self.position_um, self.radius_um, velocity, self.darkness)

    def truth(self, stamp_ns: int) -> tuple[str, Truth]:
        """Path of its topic, and all that is true of it now."""
        told = Truth(stamp_ns, self.position_um, self.flow_um_s, self.clearance_um, self.contacts)
        return robot_topic("/truth/robot", self.number), told


def other_robots(
    chip: Chip,
    robot: Robot,
    simulated: Simulated,
    start_um: tuple[float, float],
    clearance_um: Floats32,
    **options: Any,
) -> list[OtherRobot]:
    """The other robots of a world, at their starts; `robot`, `start_um` are the first one's.

    Raises RigError: the chip has no place for one.
    """
    if simulated.robots == 1:
        return []
    rng = np.random.default_rng([simulated.seed, _STREAM])
    rows, columns = np.nonzero(chip.mask & (clearance_um > _ROOM_RADII * robot.radius_um))
    if not len(rows):
        raise RigError(f"chip '{chip.name}' has no room for another robot; set simulated.robots = 1")
    places = np.stack((columns, rows), -1) * chip.um_per_px
    away = np.hypot(*(places - start_um).T) / robot.radius_um
    near = places[(away > _NEAR_RADII) & (away < _FAR_RADII)]
    places = near if len(near) else places
    common = {"clearance_um": clearance_um, "um_per_px": chip.um_per_px, **options}
    made: list[OtherRobot] = []
    for number in range(1, simulated.robots):
        x, y = places[int(rng.integers(len(places)))].tolist()
        made.append(OtherRobot(number, (x, y), robot, simulated, **common))
        left = places[np.hypot(*(places - (x, y)).T) > _APART_RADII * robot.radius_um]
        places = left if len(left) else places
    return made
