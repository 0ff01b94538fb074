"""Logs flow fields as maps and arrows, and the time to go of a route."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import rerun as rr

from flowrec.core import FlowField, Route, Tick
from flowrec.view import colours, flow_values, maps
from flowrec.view import entities as e
from flowrec.view.entities import EntityLogger, label, points
from flowrec.view.scene import Scene

_ARROW_POINTS = 1.6  # half the width of the shaft; Rerun draws a head in proportion
_MAPS = (e.ASSUMED, e.REFINED, e.TRUE, e.CHANGE, e.UNCERTAINTY, e.TIME_TO_GO)


class FlowLogger:
    """Logs the maps of one session. Loggers that share `speeds` paint them on one scale.

    `present` collects the names of maps that were logged.
    """

    def __init__(self, entities: EntityLogger, scene: Scene, speeds: maps.SpeedScale, present: set[str]) -> None:
        self._log = entities.log
        self._scene = scene
        self._mask = scene.chip.mask
        self._speeds = speeds
        self._present = present
        self._painted = 0  # version of the scale with which the maps were painted
        self._grid = flow_values.arrow_grid(scene, flow_values.ARROWS_ACROSS_VIEW)
        self._bar = maps.ColourBar.beside(scene)
        for entity in _MAPS:
            self._log(entity, maps.transform_of(scene.mask_placement()), static=True)

    def log_not_yet(self, refined: FlowField | None, last: Tick) -> None:
        """Label the maps that wait for a refinement, and remove the label when it has arrived."""
        if refined is None and last.stamp_ns < 0:
            left, top, right, bottom = self._scene.fluid_bounds()
            centre = np.array([0.5 * (left + right), 0.5 * (top + bottom)])
            for entity in (e.REFINED, e.CHANGE):
                self._log(_label_of(entity), label(centre, "not refined yet", colours.PALE))
        elif refined is not None and last.refined is None:
            for entity in (e.REFINED, e.CHANGE):
                self._log(_label_of(entity), rr.Clear(recursive=False))

    def log_fields(self, tick: Tick, last: Tick) -> None:
        """Log the maps of new fields, and all maps when their scale has changed."""
        fields = {"assumed": tick.assumed, "refined": tick.refined, "truth": tick.true_field}
        before = (last.assumed, last.refined, last.true_field)
        known = {name: field for name, field in fields.items() if field is not None}
        new = {name for name, old in zip(fields, before, strict=True) if name in known and known[name] is not old}
        for name in fields:
            if name in new:
                self._speeds.include(flow_values.peak(known[name]))
        scale = self._speeds.scale
        repaint = self._painted != self._speeds.version
        if scale is None or not known or not (new or repaint):
            return
        self._painted = self._speeds.version
        if repaint:
            self._log_scale(e.SPEED_SCALE, scale)
        for name, entity in (("assumed", e.ASSUMED), ("refined", e.REFINED), ("truth", e.TRUE)):
            if name in known and (repaint or name in new):
                self._present.add(name)
                self._log(entity, maps.encode_png(scale.paint(flow_values.speed(known[name], self._mask))))
        if {"assumed", "refined"} <= known.keys() and new & {"assumed", "refined"}:
            values = flow_values.change(known["refined"], known["assumed"], self._mask)
            self._log_map("change", e.CHANGE, e.CHANGE_SCALE, values)
        best = tick.field
        if best is None:
            return
        best_is_new = ("refined" if "refined" in known else "assumed") in new
        if best_is_new and best.std_um_s is not None:
            values = flow_values.uncertainty(best, self._mask)
            self._log_map("uncertainty", e.UNCERTAINTY, e.UNCERTAINTY_SCALE, values)
        if best_is_new or repaint:
            self._log_arrows(best, scale)

    def _log_map(self, table: colours.Table, entity: str, scale_entity: str, values: flow_values.Floats) -> None:
        """A map with a scale of its own."""
        self._present.add(table)
        scale = flow_values.scale_of(values, table)
        self._log(entity, maps.encode_png(scale.paint(values)))
        self._log_scale(scale_entity, scale)

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
        if route.time_to_go_s is None:
            for entity in (e.TIME_TO_GO, f"{e.TIME_TO_GO_SCALE}/bar", f"{e.TIME_TO_GO_SCALE}/ticks"):
                self._log(entity, rr.Clear(recursive=False))
            return
        self._present.add("time to go")
        um_per_px = self._scene.chip.um_per_px
        finer = round(um_per_px / (route.time_to_go_um_per_px or um_per_px))
        time_s = route.time_to_go_s[::finer, ::finer]
        scale = flow_values.scale_of(np.where(self._mask, time_s, np.nan), "time")
        self._log(e.TIME_TO_GO, maps.wave_fronts(time_s, self._mask, scale))
        self._log_scale(e.TIME_TO_GO_SCALE, scale)


def _label_of(entity: str) -> str:
    """The entity of a label beside a map."""
    return f"{entity.rsplit('/', 1)[0]}/{e.NOT_YET}"
