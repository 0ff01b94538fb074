"""The layout of the viewer: which views are shown first, and where. The loggers log every entity named here."""

from __future__ import annotations

from collections.abc import Iterable
from collections.abc import Set as AbstractSet
from dataclasses import dataclass

import rerun as rr
import rerun.blueprint as rrb

from flowrec.view import colours
from flowrec.view import entities as e
from flowrec.view.entities import entity_path, points
from flowrec.view.maps import ColourBar
from flowrec.view.scene import Scene

_SEVERAL_LINES = frozenset({e.FLOW_SPEED, e.FLOW_COMPONENTS, e.TIMING})
_OVERLAYS = (e.OUTLINE, e.PATH, e.ROBOT)  # of each map, for orientation
_ABOVE = 0.51  # height of camera and maps
_SUMMARY = 0.31  # width of the text panel
# Pixels of the area below, on a small screen: its height, the frame of the lanes and each of them.
_BELOW_PX, _LANES_PX, _LANE_PX = 315.0, 58.0, 34.0
_PANEL_PX = 300.0, 1280.0  # height of the camera's panel and width of a small screen
_FLAT = 1.6  # width over height of a chip that has its maps one above the other
_LEGEND = 0.5  # of the time shown, kept free for a legend beside the curves
Shown = rrb.View | rrb.Container
Part = Shown | None
Box = tuple[float, float, float, float]


def blueprint(
    scene: Scene,
    prefixes: tuple[str, ...],
    present: AbstractSet[str],
    end_s: float | None = None,
) -> rrb.Blueprint:
    """The layout of one session, or of two in one view.

    Parameters
    ----------
    prefixes : ("",), or those of two sessions, see entities.py.
    present : what was logged (see `TickLogger.present`), of the second session after its prefix and a space; views
        that would be empty are left out.
    end_s : of the session; such a view opens at the start and plays. None: it is live, and the view follows it.
    """
    views = _Views(scene, present, prefixes, end_s)
    body = _single(views) if len(prefixes) == 1 else _double(views)
    return rrb.Blueprint(
        body,
        rrb.TimePanel(
            state="collapsed", timeline=e.SESSION_TIME, play_state="following" if end_s is None else "playing"
        ),
        rrb.SelectionPanel(state="hidden"),
        rrb.BlueprintPanel(state="hidden"),
        auto_layout=False,
        auto_views=False,
    )


@dataclass(frozen=True, slots=True)
class _Views:
    """Makes the views of a layout; those of something that is not `present` are None."""

    scene: Scene
    present: AbstractSet[str]
    prefixes: tuple[str, ...]
    end_s: float | None

    def camera(self, name: str, contents: list[str], origin: str) -> Shown:
        return rrb.Spatial2DView(
            name=name,
            origin=origin,
            contents=contents,
            background=colours.SOLID,
            visual_bounds=_bounds(self.scene.shown_bounds()),
        )

    def map(self, name: str, entity: str, scale: str, needs: str, prefix: str = "") -> Part:
        """A map with its colour bar and the overlays."""
        if needs not in self.present:
            return None
        overlays = [f"+ {entity_path(prefix, overlay)}" for overlay in _OVERLAYS]
        return rrb.Spatial2DView(
            name=name,
            origin=entity_path(prefix, entity.rsplit("/", 1)[0]),
            contents=["+ $origin/**", f"+ {entity_path(prefix, scale)}/**", *overlays],
            # A thin path, because the fastest flow is usually along it.
            overrides={entity_path(prefix, e.PATH): rr.LineStrips2D.from_fields(radii=points(0.6))},
            background=colours.SOLID,
            visual_bounds=_bounds(ColourBar.beside(self.scene).bounds_with(self.scene)),
        )

    def plot(self, name: str, *entities: str, needs: str = "", prefixes: tuple[str, ...] | None = None) -> Part:
        """Lines over the whole session."""
        if needs and needs not in self.present:
            return None
        paths = [entity_path(prefix, entity) for prefix in prefixes or self.prefixes for entity in entities]
        legend = len(paths) > 1 or entities[0] in _SEVERAL_LINES  # the title suffices for a single line
        axis = None
        if legend and self.end_s is not None:
            axis = rrb.TimeAxis(
                view_range=rr.TimeRange(
                    start=rr.TimeRangeBoundary.absolute(seconds=0.0),
                    end=rr.TimeRangeBoundary.absolute(seconds=(1.0 + _LEGEND) * self.end_s),
                )
            )
        return rrb.TimeSeriesView(
            name=name,
            origin=paths[0] if len(paths) == 1 else "/",
            contents=[f"+ {path}" for path in paths],
            plot_legend=rrb.PlotLegend(corner=rrb.Corner2D.RightTop, visible=legend),
            axis_x=axis,
        )

    def lanes(self) -> tuple[Shown, int]:
        """The timeline of states, and the number of its lanes."""
        paths = [entity_path(prefix, lane) for lane in e.LANES for prefix in self.prefixes if self._has(prefix, lane)]
        contents = [f"+ {path}" for path in paths]
        view = rrb.StateTimelineView(name="Mission, alarms, marks", origin="/", contents=contents)
        return view, max(len(paths), 1)

    def _has(self, prefix: str, name: str) -> bool:
        second = len(self.prefixes) == 2 and prefix == self.prefixes[1]
        return (f"{prefix} {name}" if second else name) in self.present

    def texts(self) -> Part:
        """The summary, and behind it the events."""
        paths = [entity_path(prefix, entity) for prefix in self.prefixes for entity in (e.EVENTS, e.OPERATOR)]
        events = rrb.TextLogView(
            name="Events",
            origin="/",
            contents=[f"+ {path}" for path in paths],
            columns=rrb.TextLogColumns(timeline_columns=[], text_log_columns=["Body"]),
        )
        summary = rrb.TextDocumentView(name="Summary", origin=entity_path("", e.SUMMARY)) if self._summary else None
        return _tabs(summary, events)

    @property
    def _summary(self) -> bool:
        return "summary" in self.present

    @property
    def aspect(self) -> float:
        """Width over height of what is shown."""
        left, top, right, bottom = self.scene.shown_bounds()
        return (right - left) / (bottom - top)

    def layout(self, camera: Shown, maps: Iterable[Part], plots: Iterable[Part]) -> Shown:
        """Camera and maps above; below the summary, and beside it the states over the plots.

        The camera is as wide as the chip needs on a usual screen.
        """
        aspect = self.aspect
        width = min(max(aspect * _PANEL_PX[0] / _PANEL_PX[1], 0.28), 0.62)
        above: Shown = camera
        if existing := _existing(maps):
            beside = rrb.Vertical(*existing) if aspect >= _FLAT else rrb.Horizontal(*existing)
            above = rrb.Horizontal(camera, beside, column_shares=[width, 1.0 - width])
        states, lanes = self.lanes()
        share = min((_LANES_PX + _LANE_PX * lanes) / _BELOW_PX, 0.6)
        right_side = rrb.Vertical(states, rrb.Horizontal(*_existing(plots)), row_shares=[share, 1.0 - share])
        below = rrb.Horizontal(*_existing([self.texts()]), right_side, column_shares=[_SUMMARY, 1.0 - _SUMMARY])
        return rrb.Vertical(above, below, row_shares=[_ABOVE, 1.0 - _ABOVE])


def _single(v: _Views) -> Shown:
    camera = v.camera("Robot (orange), route (cyan), goal (green), flow", ["$origin/**"], entity_path("", "camera"))
    maps = (
        v.map("Assumed flow", e.ASSUMED, e.SPEED_SCALE, "assumed"),
        v.map("Refined flow", e.REFINED, e.SPEED_SCALE, "refined"),
        v.map("Refined - assumed", e.CHANGE, e.CHANGE_SCALE, "change"),
        v.map("Uncertainty (1 σ)", e.UNCERTAINTY, e.UNCERTAINTY_SCALE, "uncertainty"),
        v.map("True flow", e.TRUE, e.SPEED_SCALE, "truth"),
        v.map("Time to go", e.TIME_TO_GO, e.TIME_TO_GO_SCALE, "time to go"),
    )
    return v.layout(camera, _arranged(v, maps), _plots(v))


def _double(v: _Views) -> Shown:
    old, new = v.prefixes
    hidden = [entity_path(new, e.TRAIL), entity_path(old, e.ARROWS), entity_path(new, e.OUTLINE)]
    camera = v.camera(
        f"{old} (orange), {new} (cyan), goal (green)",
        [f"+ /{old}/camera/**", f"+ /{new}/camera/**", *(f"- {path}" for path in hidden)],
        f"/{old}/camera",
    )
    maps = (
        v.map(f"Refined, {old}", e.REFINED, e.SPEED_SCALE, "refined", old),
        v.map(f"Refined, {new}", e.REFINED, e.SPEED_SCALE, f"{new} refined", new),
        v.map(f"Uncertainty, {new} (1 σ)", e.UNCERTAINTY, e.UNCERTAINTY_SCALE, f"{new} uncertainty", new),
        v.map("Assumed flow", e.ASSUMED, e.SPEED_SCALE, "assumed", old),
        v.map("True flow", e.TRUE, e.SPEED_SCALE, "truth", old),
        v.map(f"Time to go, {new}", e.TIME_TO_GO, e.TIME_TO_GO_SCALE, f"{new} time to go", new),
    )
    return v.layout(camera, _arranged(v, maps), _plots(v))


def _arranged(v: _Views, maps: Iterable[Part]) -> list[Part]:
    """The first two maps, and the others one behind the other: of a flat chip behind the second."""
    first, second, *others = maps
    return [first, _tabs(second, *others)] if v.aspect >= _FLAT else [first, second, _tabs(*others)]


def _plots(v: _Views) -> tuple[Part, ...]:
    single = len(v.prefixes) == 1
    flow = (
        (v.plot("Flow at the robot (µm/s)", e.FLOW_SPEED), v.plot("Components (µm/s)", e.FLOW_COMPONENTS))
        if single
        else [v.plot(f"Flow, {prefix} (µm/s)", e.FLOW_SPEED, prefixes=(prefix,)) for prefix in v.prefixes]
    )
    nis = (e.NIS, e.NIS_MEAN) if "health" in v.present and single else (e.NIS,)
    return (
        _tabs(*flow),
        _tabs(
            v.plot("Tracking error (µm)", e.TRACKING_ERROR),
            v.plot("Estimate error (µm)", e.ESTIMATE_ERROR, needs="true robot"),
            v.plot("Observer NIS", *nis),
            v.plot("Pulsation (%)", e.PULSATION, needs="health"),
        ),
        _tabs(
            v.plot("Field (Hz)", e.FREQUENCY),
            v.plot("Heading (°)", e.HEADING),
            v.plot("Field (mT)", e.AMPLITUDE),
            v.plot("Timing (ms)", e.TIMING, needs="timing"),
        ),
    )


def _existing(parts: Iterable[Part]) -> list[Shown]:
    return [part for part in parts if part is not None]


def _tabs(*parts: Part) -> Part:
    """Views one behind the other, the first in front."""
    existing = _existing(parts)
    return rrb.Tabs(*existing, active_tab=0) if existing else None


def _bounds(box: Box) -> rrb.VisualBounds2D:
    left, top, right, bottom = box
    return rrb.VisualBounds2D(x_range=[left, right], y_range=[top, bottom])
