"""Flow fields to maps and arrows, and the time to go of a route that knows it from everywhere."""

from __future__ import annotations

import numpy as np
import rerun as rr

from flowrec.messages import FlowField, Route, Tick
from flowrec.view import colours, maps
from flowrec.view import entities as e
from flowrec.view.arrows import arrow_grid, flow_arrows
from flowrec.view.entity_logger import Pen, label
from flowrec.view.scene import Scene


class FlowLogger:
    """Paints the maps of one session. Loggers that share `speeds` paint them on one scale."""

    def __init__(self, pen: Pen, scene: Scene, speeds: maps.SpeedScale, present: set[str]) -> None:
        self._pen = pen
        self._scene = scene
        self._speeds = speeds
        self._present = present
        self._painted = 0  # version of the scale the maps were painted on
        self._grid = arrow_grid(scene)
        self._bar = maps.ColourBar.beside(scene)
        placement = scene.mask_placement(scene.chip.um_per_px)
        for entity in (e.ASSUMED, e.REFINED, e.TRUE, e.CHANGE, e.UNCERTAINTY, e.TIME_TO_GO):
            pen.log(entity, maps.placed(placement), static=True)

    def log_not_yet(self, refined: FlowField | None, last: Tick) -> None:
        """Say in the maps that wait for a refinement that they do."""
        if refined is None and last.stamp_ns < 0:
            left, top, right, bottom = self._scene.chip_bounds()
            centre = np.array([0.5 * (left + right), 0.5 * (top + bottom)])
            for entity in (e.REFINED, e.CHANGE):
                self._pen.log(_beside(entity), label(centre, "not refined yet", colours.PALE))
        elif refined is not None and last.refined is None:
            for entity in (e.REFINED, e.CHANGE):
                self._pen.log(_beside(entity), rr.Clear(recursive=False))

    def log_fields(self, tick: Tick, last: Tick) -> None:
        new = [
            field
            for field, before in (
                (tick.assumed, last.assumed),
                (tick.refined, last.refined),
                (tick.true_field, last.true_field),
            )
            if field is not None and field is not before
        ]
        for field in new:
            self._speeds.hold(maps.peak(field))
        if self._speeds.scale is None or (tick.field is None and tick.true_field is None):
            return
        repaint = self._painted != self._speeds.version
        if not new and not repaint:
            return
        self._painted = self._speeds.version
        scale, mask = self._speeds.scale, self._scene.chip.mask
        if repaint:
            self._log_scale(e.SPEED_SCALE, scale)
        known = (
            (e.ASSUMED, "assumed", tick.assumed),
            (e.REFINED, "refined", tick.refined),
            (e.TRUE, "truth", tick.true_field),
        )
        for entity, name, known_field in known:
            if known_field is not None and (repaint or any(known_field is other for other in new)):
                self._present.add(name)
                self._pen.log(entity, maps.picture(maps.speed(known_field, mask), scale))
        self._log_change(tick.refined, tick.assumed, new)
        self._log_uncertainty(tick.field, new)
        if tick.field is not None and (repaint or tick.field is not last.field):
            self._log_arrows(tick.field)

    def _log_change(self, refined: FlowField | None, assumed: FlowField | None, new: list[FlowField]) -> None:
        if refined is None or assumed is None or not any(field is refined or field is assumed for field in new):
            return
        self._present.add("change")
        values = maps.change(refined, assumed, self._scene.chip.mask)
        scale = maps.scale_of(values, "change")
        self._pen.log(e.CHANGE, maps.picture(values, scale))
        self._log_scale(e.CHANGE_SCALE, scale)

    def _log_uncertainty(self, field: FlowField | None, new: list[FlowField]) -> None:
        if field is None or field.std_um_s is None or not any(field is other for other in new):
            return
        self._present.add("uncertainty")
        values = maps.uncertainty(field, self._scene.chip.mask)
        scale = maps.scale_of(values, "uncertainty")
        self._pen.log(e.UNCERTAINTY, maps.picture(values, scale))
        self._log_scale(e.UNCERTAINTY_SCALE, scale)

    def _log_scale(self, entity: str, scale: colours.Scale) -> None:
        self._pen.log(f"{entity}/bar", *self._bar.strip(scale))
        self._pen.log(f"{entity}/ticks", *self._bar.ticks(scale))

    def _log_arrows(self, field: FlowField) -> None:
        assert self._speeds.scale is not None
        origins, vectors, speed = flow_arrows(self._scene, field, self._grid)
        radius = 0.08 * self._scene.length_px(self._grid[1])
        self._pen.log(
            e.ARROWS,
            rr.Arrows2D(
                origins=origins, vectors=vectors, colors=self._speeds.scale.paint(speed), radii=radius, draw_order=5.0
            ),
        )

    def log_time_to_go(self, route: Route) -> None:
        """The time from everywhere to the goal; nothing where the route does not know it."""
        if route.time_to_go_s is None:
            for entity in (e.TIME_TO_GO, f"{e.TIME_TO_GO_SCALE}/bar", f"{e.TIME_TO_GO_SCALE}/ticks"):
                self._pen.log(entity, rr.Clear(recursive=False))
            return
        self._present.add("time to go")
        chip = self._scene.chip
        closer = round(chip.um_per_px / (route.time_to_go_um_per_px or chip.um_per_px))
        time_s = route.time_to_go_s[::closer, ::closer]
        scale = maps.scale_of(np.where(chip.mask, time_s, np.nan), "time")
        self._pen.log(e.TIME_TO_GO, maps.wave_fronts(time_s, chip.mask, scale))
        self._log_scale(e.TIME_TO_GO_SCALE, scale)


def _beside(entity: str) -> str:
    """Where a map's word about its absence is logged."""
    return f"{entity.rsplit('/', 1)[0]}/{e.NOT_YET}"
