"""Robots, tracers, route and flow drawn over the images by OpenCV, with a status bar below for clock, state and scale.

Nothing covers the robot: within its ring the camera's pixels stay as they are, and all words are in the bar. The image
stays as the camera took it: where it shakes, or a refinement found another registration, what lies on the chip is
drawn where the image shows it.
"""

from __future__ import annotations

import math

import cv2
import numpy as np
from numpy.typing import NDArray

from flowrec.core import Estimate, Floats, FlowField, Tick, Tracers, shift_px
from flowrec.stages import estimates_of_others
from flowrec.view import colours
from flowrec.view.colours import round_below
from flowrec.view.drawing import CIRCLE, NOMINAL_PX, Layer, Picture, Trail, arrows, draw_outline, drawable, restore
from flowrec.view.flow_values import arrow_grid, flow_arrows
from flowrec.view.scene import Scene, goal_of, tracer_ways_um, way_of
from flowrec.view.status_bar import FLOW, GOAL, GOAL_SIGN, ROBOT, ROUTE, TRACER, StatusBar

_LEAST_WIDTH_PX = 480  # smaller images are enlarged by a whole factor, so that words and lines are readable
_LETTER_PX = 13.0
_LINE_PX = 1.6
_THIN_PX = 0.8 * _LINE_PX  # of arrows and tracers
_SPARSER = 1.9  # distance of the arrows over that of the viewer's map, which is larger
_TRAIL_STEP_PX = 3.0  # between two points of the trail: its lines are thicker than the viewer's
_RING_PX = 3.0  # between the robot and its ring
_LONGEST = 0.9  # arrow, in spacings of the arrows
_FASTEST = 0.99  # quantile of the speeds that has this length


class Overlay:
    """Draws the ticks of one session in order.

    `image_px`: width and height of the camera's images.

    Attributes
    ----------
    zoom : pixels of the picture per pixel of the camera.
    size_px : width and height of the picture, both even.
    """

    def __init__(self, scene: Scene, image_px: tuple[int, int]) -> None:
        self.zoom = max(1, math.ceil(_LEAST_WIDTH_PX / image_px[0]))
        self._width, self._height = (self.zoom * each for each in image_px)
        self._unit = max(1.0, self._width / NOMINAL_PX)
        letter = round(_LETTER_PX * self._unit)
        width, height = self._width, self._height + round(1.9 * letter)
        self.size_px = width + width % 2, height + height % 2
        self._scene = scene
        self._canvas = np.zeros((self.size_px[1], self.size_px[0], 3), np.uint8)
        self._line_px = _LINE_PX * self._unit
        self._robot_px = self.zoom * scene.length_px(scene.robot.radius_um)
        self._ring_px = self._robot_px + _RING_PX * self._unit
        self._grid = _sparser(*arrow_grid(scene))
        self._to_image: Floats = np.eye(2, 3)  # by the refined registration and the shift
        self._trail = Trail(_TRAIL_STEP_PX * self._unit)
        um_per_px = scene.calibration.um_per_px / self.zoom
        self._status_bar = StatusBar((self.size_px[0], self.size_px[1] - self._height), letter, um_per_px)
        self._tick = Tick()
        self._layer = self._redraw(self._tick)

    def draw(self, image: NDArray[np.uint8], tick: Tick, ended: str = "") -> Picture:
        """The picture in BGR of an image (h, w) of 8 bits and its tick; it is valid until the next call.

        `ended` is, of the last image, the outcome of the run, which a mission that was stopped does not state.
        """
        last, self._tick = self._tick, tick
        if _content_key(tick) != _content_key(last):
            self._layer = self._redraw(tick)
        if self.zoom > 1:
            size = (self._width, self._height)
            image = np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_CUBIC), np.uint8)
        clean = np.asarray(cv2.cvtColor(image, cv2.COLOR_GRAY2BGR), np.uint8)
        picture = clean.copy()
        self._layer.blend(image, picture)
        if tick.tracers is not None:
            self._draw_tracers(picture, tick.tracers)
        if tick.estimate is not None:
            self._draw_robot(picture, clean, tick.estimate)
        for number, estimate in enumerate(estimates_of_others(tick), start=1):
            self._draw_other(picture, estimate, colours.of_robot(number))
        canvas = self._canvas
        canvas[: self._height, : self._width] = picture
        canvas[: self._height, self._width :] = picture[:, -1:]
        self._status_bar.draw(canvas[self._height :], tick, ended, doubtful=bool(self._scene.doubts))
        return canvas

    def _to_px(self, plane: Floats) -> Floats:
        """Points (..., 2) of the picture plane to pixels of this picture."""
        return self.zoom * (plane @ self._to_image[:, :2].T + self._to_image[:, 2]) - 0.5

    def _seen_px(self, measured_um: Floats) -> Floats:
        """Measured points (..., 2) as pixels of this picture, with the shift of its image."""
        return self.zoom * (self._scene.to_plane(measured_um) + np.array(shift_px(self._tick.shift))) - 0.5

    def _redraw(self, tick: Tick) -> Layer:
        """Draw what does not move: flow, route, goal, and the legend."""
        layer, field = Layer((self._height, self._width)), tick.field
        self._to_image = self._scene.plane_to_image(tick)
        flow = None if field is None else self._draw_flow(layer, field, refined=tick.refined is not None)
        path = self._to_px(self._scene.to_plane(way_of(tick.route)))
        has_route = len(path) > 0 and drawable(path)
        if has_route:
            layer.lines([path], (), ROUTE, self._line_px)
        goal = goal_of(tick.mission)
        if goal is not None:
            centre, reach = self._to_px(self._scene.to_plane(goal)), max(1.5 * self._robot_px, 8.0 * self._unit)
            layer.lines([centre + reach * part for part in GOAL_SIGN], (), GOAL, self._line_px)
        self._status_bar.set_legend(goal=goal is not None, route=has_route, tracers=tick.tracers is not None, flow=flow)
        return layer

    def _draw_flow(self, layer: Layer, field: FlowField, *, refined: bool) -> tuple[str, float, float] | None:
        """Arrows as long as the flow is fast; returns what the legend says of them."""
        origins, vectors, speed = flow_arrows(self._scene, field, self._grid)
        known = np.isfinite(speed) & np.isfinite(vectors).all(axis=1) & (speed > 0.0)
        if not known.any():
            return None
        fastest = float(np.quantile(speed[known], _FASTEST))
        px_per_speed = _LONGEST * self.zoom * self._scene.length_px(self._grid[1]) / fastest
        middle = self._to_px((origins + 0.5 * vectors)[known])
        along = vectors[known] @ self._to_image[:, :2].T
        along /= np.linalg.norm(along, axis=1, keepdims=True)
        half = 0.5 * px_per_speed * np.minimum(speed[known], 1.2 * fastest)[:, None] * along
        width_px = _THIN_PX * self._unit
        layer.lines(*arrows(middle - half, middle + half, width_px), FLOW, width_px)
        return "refined flow" if refined else "assumed flow", round_below(fastest), px_per_speed

    def _draw_robot(self, picture: Picture, clean: Picture, estimate: Estimate) -> None:
        # Counted at the centres of pixels, of a picture without shift.
        centre = self.zoom * self._scene.to_plane(estimate.position_um) - 0.5
        if not drawable(centre):
            return
        trail = self._trail.add(estimate.stamp_ns, centre)
        colour = ROBOT if estimate.seen else colours.PALE
        off = self.zoom * np.array(shift_px(self._tick.shift))
        way = np.array([*trail, centre]) + off
        centre = centre + off
        draw_outline(picture, way, colour, self._line_px)
        restore(picture, clean, centre, self._ring_px)
        draw_outline(picture, centre + self._ring_px * CIRCLE, colour, self._line_px)

    def _draw_tracers(self, picture: Picture, tracers: Tracers) -> None:
        """A line from each tracer that moves to where it will be soon."""
        for way in np.stack([self._seen_px(ends) for ends in tracer_ways_um(tracers)], axis=1):
            if drawable(way):
                draw_outline(picture, way, TRACER, _THIN_PX * self._unit)

    def _draw_other(self, picture: Picture, estimate: Estimate, colour: colours.Rgb) -> None:
        """The ring of a robot that is not the mission's."""
        centre = self._seen_px(estimate.position_um)
        if drawable(centre):
            ring = centre + self._ring_px * CIRCLE
            draw_outline(picture, ring, colour if estimate.seen else colours.PALE, self._line_px)


def _content_key(tick: Tick) -> tuple[object, ...]:
    """Key of the content of a tick's layer: it is drawn anew where this changes."""
    goal = goal_of(tick.mission)
    goal_key = None if goal is None else goal.tobytes()
    return id(tick.field), id(tick.route), goal_key, shift_px(tick.shift), tick.tracers is None


def _sparser(points_um: Floats, spacing_um: float) -> tuple[Floats, float]:
    """Points of a grid, in its order, each far enough from those taken before; and their spacing."""
    spacing_um *= _SPARSER
    chosen: list[Floats] = []
    for point in points_um:
        if not chosen or np.hypot(*(np.array(chosen) - point).T).min() >= spacing_um:
            chosen.append(point)
    return np.array(chosen, np.float64).reshape(-1, 2), spacing_um
