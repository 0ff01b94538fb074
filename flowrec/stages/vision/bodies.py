"""The bodies in an image that may be the robot, for a person who has to say which one is."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from flowrec.core import Appearance, Image
from flowrec.stages.vision.foreground import energy_map, peaks
from flowrec.stages.vision.learned import ENERGY_SPREAD, ForegroundRegion, ReducedScale, candidates, region_of, scale_of
from flowrec.stages.vision.learning import energy_of, learn, pixel_noise
from flowrec.stages.vision.walls import Walls

Places = NDArray[np.float64]
# Likeness to the robot from which on a body may be it: debris of the simulated worlds reaches 0.49, and of a hundred
# beads of one kind each has more than 0.7.
_LEAST_LIKE = 0.6
_STANDS_OUT = 0.3  # energy of a body relative to that of the strongest one, where nothing is known of the robot
_LEAST_ENERGY = 20.0  # of such a body, in units of the noise's variance
MOST = 64  # bodies that are told apart


@dataclass(frozen=True, slots=True)
class View:
    """An image with the walls in it.

    Attributes
    ----------
    radius_px : of the robot.
    solid_px : distance to the mask's walls (negative: depth in the solid) from which on a pixel may show fluid.
    """

    image: Image
    walls: Walls
    radius_px: float
    solid_px: float

    def region(self, scale: ReducedScale) -> ForegroundRegion:
        """The foreground of all fluid."""
        x0, y0, x1, y1 = self.walls.box
        m = scale.margin_px
        return region_of(self.image, self.walls.distance_px, (x0 - m, y0 - m, x1 + m, y1 + m), scale, self.solid_px)


def bodies_like(view: View, at_px: tuple[float, float], appearance: Appearance) -> Places:
    """Places (n, 2) in px of the bodies that look like the one at a place, itself included; the most alike first."""
    distance_px = view.walls.distance_px
    look = learn(
        view.image, distance_px, 0, at_px, view.radius_px, appearance.polarity, view.solid_px, "the robot's place"
    )
    if look.note:  # nothing that stands out from the background: nothing else is like it
        return np.array([at_px])
    energy = energy_of(look)
    region = view.region(ReducedScale(look.radius_px))
    found = candidates(region, look, view.walls.box, distance_px, 0.1 * energy, None)
    changed = np.log(np.maximum(found.energy, 1e-6) / energy) / ENERGY_SPREAD
    like = found.similarity * np.exp(-0.125 * changed**2)
    order = [number for number in np.argsort(-like, kind="stable").tolist() if like[number] >= _LEAST_LIKE]
    return found.px[order][:MOST] if order else np.array([at_px])


def bodies_that_stand_out(view: View) -> Places:
    """Places (n, 2) in px of the bodies that differ most from the background, dark or bright; the strongest first."""
    scale = scale_of(view.radius_px)
    region = view.region(scale)
    noise = max(pixel_noise(view.image) / scale.step, 1e-6)
    found = peaks(energy_map(region.c, noise, 0, scale.apart), _LEAST_ENERGY, scale.apart, 4 * MOST)
    kept: list[tuple[float, float, float]] = []
    height, width = view.walls.distance_px.shape
    for column, row, energy in found.tolist():
        x, y = region.to_px(np.array([column, row])).tolist()
        inside = 0.0 <= x <= width - 1.0 and 0.0 <= y <= height - 1.0
        if not inside or view.walls.distance_px[round(y), round(x)] < 0.0:
            continue
        if all(np.hypot(x - other[0], y - other[1]) > 1.5 * scale.radius_px for other in kept):
            kept.append((x, y, energy))
    strongest = max((energy for *_, energy in kept), default=0.0)
    return np.array([(x, y) for x, y, energy in kept if energy >= _STANDS_OUT * strongest]).reshape(-1, 2)[:MOST]
