"""Logs flow fields as maps and arrows, and the time to go of a route."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import rerun as rr

from flowrec.core import Floats, FlowField, Route, Tick
from flowrec.view import colours, flow_values, maps
from flowrec.view import entities as e
from flowrec.view.entities import EntityLogger, label, points
from flowrec.view.scene import Scene

_MAPS = {"assumed": e.ASSUMED, "refined": e.REFINED, "true_field": e.TRUE}  # of speed, by field of a tick
_ARROW_POINTS = 1.6  # half the width of the shaft; Rerun draws a head in proportion


class FlowLogger:
    """Logs the maps of one session. Loggers that share `speeds` paint them on one scale."""

    def __init__(self, entities: EntityLogger, scene: Scene, speeds: maps.SpeedScale) -> None:
        self._entities = entities
        self._log = entities.log
        self._scene = scene
        self._mask = scene.chip.mask
        self._speeds = speeds
        self._painted: colours.ColourScale | None = None  # the scale with which the maps were painted
        self._grid = flow_values.arrow_grid(scene, flow_values.ARROWS_ACROSS_VIEW)
        self._bar = maps.ColourBar(scene)
        for entity in e.SCALES:
            self._log(entity, maps.transform_of(scene.mask_to_plane()), static=True)

    def log_not_yet(self, refined: FlowField | None, last: Tick) -> None:
        """Label the maps that wait for a refinement, and remove the label when it has arrived."""
        for entity in (e.REFINED, e.CHANGE):
            beside = f"{entity.rsplit('/', 1)[0]}/{e.NOT_YET}"
            if refined is None and last.stamp_ns < 0:
                left, top, right, bottom = self._scene.fluid_bounds()
                centre = np.array([0.5 * (left + right), 0.5 * (top + bottom)])
                self._log(beside, label(centre, "not refined yet", colours.PALE))
            elif refined is not None and last.refined is None:
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
            self._log(_MAPS[name], maps.encode_png(scale.paint(flow_values.speed(known[name], self._mask))))
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
        self._log(entity, maps.encode_png(scale.paint(values)))
        self._log_scale(e.SCALES[entity], scale)

    def _log_scale(self, entity: str, scale: colours.ColourScale) -> None:
        self._log(f"{entity}/bar", *self._bar.strip(scale))
        self._log(f"{entity}/ticks", *self._bar.ticks(scale))

    def _log_arrows(self, field: FlowField, scale: colours.ColourScale) -> None:
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
        self._log(e.TIME_TO_GO, maps.wave_fronts(time_s, self._mask, scale))
        self._log_scale(scale_entity, scale)
