"""Flow fields for Rerun: coloured maps with their colour bars, arrows, and the time to go of a route.

All maps of speed share one scale, so adjacent maps are comparable.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import rerun as rr
from numpy.typing import NDArray

from flowrec.core import Bools, Floats, Floats32, FlowField, Matrix, Route, Tick
from flowrec.view import colours, flow_values
from flowrec.view import entities as e
from flowrec.view.colours import ColourScale
from flowrec.view.entities import EntityLogger, label, points
from flowrec.view.scene import Scene

_NOT_YET = {"assumed": "not computed yet", "refined": "not refined yet"}  # by the field of a tick
_MAPS = {"assumed": e.ASSUMED, "refined": e.REFINED, "true_field": e.TRUE}  # of speed, by field of a tick
_ARROW_POINTS = 1.6  # half the width of the shaft; Rerun draws a head in proportion
_BAR_ROWS = 256
_BAR_SHARE = 0.74  # of the height of the channels: words need room above and below
_LEAST_BAR = 0.3  # height of a colour bar over the width of the channels


class SpeedScale:
    """The scale of all maps of speed, also of a recorded and a replayed session in one view."""

    scale: ColourScale | None = None  # another one when maps must be painted again

    def include(self, peak_um_s: float) -> None:
        """Extend the scale to a speed."""
        if self.scale is None or peak_um_s > self.scale.high:
            self.scale = ColourScale.up_to(peak_um_s, "speed")


def wave_fronts(time_s: Floats32, mask: Bools, scale: ColourScale) -> rr.EncodedImage:
    """A time to go (h, w) with darker isochrones, two for each tick; red where the goal can not be reached."""
    time_s = np.where(mask & np.isfinite(time_s), time_s, np.nan)
    pixels = scale.paint(time_s)
    interval = np.floor(time_s / (0.5 * scale.step))
    front = np.zeros(mask.shape, np.bool_)
    front[:, :-1] |= np.abs(np.diff(interval, axis=1)) > 0.0  # NaN is not above
    front[:-1] |= np.abs(np.diff(interval, axis=0)) > 0.0
    pixels[front] = (0.6 * pixels[front]).astype(np.uint8)
    pixels[mask & np.isnan(time_s)] = colours.UNREACHABLE
    return encode_png(pixels)


def encode_png(pixels: NDArray[np.uint8]) -> rr.EncodedImage:
    """An image (h, w, 3) in RGB as PNG."""
    done, png = cv2.imencode(".png", pixels[..., ::-1], [cv2.IMWRITE_PNG_COMPRESSION, 1])
    assert done
    return rr.EncodedImage(contents=png.tobytes(), media_type="image/png")


def transform_of(matrix: Matrix) -> rr.Transform3D:
    """The transform of an image into the picture plane: `matrix` (2, 3) says where a point (x, y, 1) of it lies."""
    turned = np.eye(3)
    turned[:2, :2] = matrix[:, :2]
    return rr.Transform3D(translation=[*matrix[:, 2], 0.0], mat3x3=turned)


class ColourBar:
    """Position of the colour bar beside a map, in the picture plane.

    It is to the right of the channels, a little lower; of a very flat chip not shorter than a third of its width.
    `bounds`: left, top, right, bottom of the channels together with the bar and its numbers.
    """

    def __init__(self, scene: Scene) -> None:
        left, top, right, bottom = scene.fluid_bounds()
        size = max(bottom - top, _LEAST_BAR * (right - left))
        top = 0.5 * (top + bottom) - 0.5 * size
        self.left, self.top = right + 0.06 * size, top + 0.16 * size
        self.width, self.height = 0.05 * size, _BAR_SHARE * size
        right = self.left + self.width
        self.bounds = left - 0.03 * size, top - 0.02 * size, right + 0.34 * size, top + 1.02 * size

    def strip(self, scale: ColourScale) -> tuple[rr.Image, rr.Transform3D]:
        """The colours, the highest value on top."""
        values = np.linspace(scale.high, scale.low, _BAR_ROWS)[:, None]
        size = [self.width, self.height / _BAR_ROWS, 1.0]
        return rr.Image(scale.paint(values)), rr.Transform3D(translation=[self.left, self.top, 0.0], scale=size)

    def ticks(self, scale: ColourScale) -> tuple[rr.LineStrips2D, rr.Points2D]:
        """The ticks with their values to the right of them, and the unit above the bar."""
        fraction = (np.array(scale.ticks) - scale.low) / (scale.high - scale.low)
        y = self.top + self.height * (1.0 - fraction)
        right = self.left + self.width
        dash = 0.25 * self.width
        marks = rr.LineStrips2D(
            [[[right, at], [right + dash, at]] for at in y], colors=colours.WHITE, radii=points(0.8)
        )
        labels = [*scale.labels, "s" if scale.table == "time" else "µm/s"]
        # Rerun centres a label below its point: a little up and half a label to the right puts it beside its tick.
        positions = [(right + 3.2 * self.width, row - 0.045 * self.height) for row in y]
        positions.append((self.left + 0.5 * self.width, self.top - 0.2 * self.height))
        numbers = rr.Points2D(positions, labels=labels, show_labels=True, colors=colours.WHITE, radii=points(0))
        return marks, numbers


class FlowLogger:
    """Logs the maps of one session. Loggers that share `speeds` paint them on one scale."""

    def __init__(self, entities: EntityLogger, scene: Scene, speeds: SpeedScale) -> None:
        self._entities = entities
        self._log = entities.log
        self._scene = scene
        self._mask = scene.chip.mask
        self._speeds = speeds
        self._painted: ColourScale | None = None  # the scale with which the maps were painted
        self._grid = flow_values.arrow_grid(scene, flow_values.ARROWS_ACROSS_VIEW)
        self._bar = ColourBar(scene)
        for entity in e.SCALES:
            self._log(entity, transform_of(scene.mask_to_plane()), static=True)

    def log_not_yet(self, tick: Tick, last: Tick) -> None:
        """Label the maps that come later, and remove the label when one has arrived."""
        for entity, name in ((e.ASSUMED, "assumed"), (e.REFINED, "refined"), (e.CHANGE, "refined")):
            field, before = getattr(tick, name), getattr(last, name)
            beside = f"{entity.rsplit('/', 1)[0]}/{e.NOT_YET}"
            if field is None and last.stamp_ns < 0:
                left, top, right, bottom = self._scene.fluid_bounds()
                centre = np.array([0.5 * (left + right), 0.5 * (top + bottom)])
                self._log(beside, label(centre, _NOT_YET[name], colours.PALE))
            elif field is not None and before is None:
                self._entities.clear(beside)

    def log_fields(self, tick: Tick, last: Tick) -> None:
        """Log the maps of new fields, and all maps when their scale has changed."""
        known: dict[str, Any] = tick.news(Tick(), _MAPS)
        new = tick.news(last, _MAPS).keys()
        for name in new:
            self._speeds.include(flow_values.peak(known[name]))
        scale = self._speeds.scale
        repaint = self._painted is not scale
        if scale is None or not known or not (new or repaint):
            return
        self._painted = scale
        if repaint:
            self._log_scale(e.SPEED_SCALE, scale)
        for name in known if repaint else new:
            self._log(_MAPS[name], encode_png(scale.paint(flow_values.speed(known[name], self._mask))))
        if tick.assumed is not None and tick.refined is not None and new & {"assumed", "refined"}:
            self._log_map(e.CHANGE, "change", flow_values.change(tick.refined, tick.assumed, self._mask))
        best = tick.field
        if best is None:
            return
        best_is_new = ("assumed" if tick.refined is None else "refined") in new
        if best_is_new and best.std_um_s is not None:
            self._log_map(e.UNCERTAINTY, "uncertainty", flow_values.uncertainty(best, self._mask))
        if best_is_new or repaint:
            self._log_arrows(best, scale)

    def _log_map(self, entity: str, table: colours.Table, values: Floats) -> None:
        """A map with a scale of its own."""
        scale = flow_values.scale_of(values, table)
        self._log(entity, encode_png(scale.paint(values)))
        self._log_scale(e.SCALES[entity], scale)

    def _log_scale(self, entity: str, scale: ColourScale) -> None:
        self._log(f"{entity}/bar", *self._bar.strip(scale))
        self._log(f"{entity}/ticks", *self._bar.ticks(scale))

    def _log_arrows(self, field: FlowField, scale: ColourScale) -> None:
        origins, vectors, speed = flow_values.flow_arrows(self._scene, field, self._grid)
        light = replace(scale, table="arrows").paint(speed)
        arrows = rr.Arrows2D(
            origins=origins, vectors=vectors, colors=light, radii=points(_ARROW_POINTS), draw_order=5.0
        )
        self._log(e.ARROWS, arrows)

    def log_time_to_go(self, route: Route) -> None:
        """The time from everywhere to the goal; nothing if the route does not state it."""
        scale_entity = e.SCALES[e.TIME_TO_GO]
        if route.time_to_go_s is None:
            for entity in (e.TIME_TO_GO, f"{scale_entity}/bar", f"{scale_entity}/ticks"):
                self._entities.clear(entity)
            return
        um_per_px = self._scene.chip.um_per_px
        finer = round(um_per_px / (route.time_to_go_um_per_px or um_per_px))
        time_s = route.time_to_go_s[::finer, ::finer]
        scale = flow_values.scale_of(np.where(self._mask, time_s, np.nan), "time")
        self._log(e.TIME_TO_GO, wave_fronts(time_s, self._mask, scale))
        self._log_scale(scale_entity, scale)
