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

_EVERYTHING = frozenset(
    {"assumed", "refined", "change", "uncertainty", "truth", "true robot", "timing", "time to go", "health", "voltages"}
)
_COIL_WINDOW_S = 2.0  # the currents oscillate several times a second: a whole session would be a solid block
_SEVERAL_LINES = frozenset({e.CURRENT, e.VOLTAGE, e.FLOW_SPEED, e.FLOW_COMPONENTS, e.TIMING})
_OVERLAYS = (e.OUTLINE, e.PATH, e.ROBOT)  # of each map, for orientation
_ROW_HEIGHTS = [6.4, 1.45, 2.7]  # images, phases, plots
_OLD, _NEW = "recorded", "replayed"
Shown = rrb.View | rrb.Container
Part = Shown | None
Box = tuple[float, float, float, float]


def blueprint(scene: Scene, has_replay: bool = False, present: AbstractSet[str] = _EVERYTHING) -> rrb.Blueprint:
    """The layout of one session, or of a recorded and a replayed one side by side.

    `present` (see `TickLogger.present`) excludes views that would be empty.
    """
    body = _replay(_Views(scene, present, (_OLD, _NEW))) if has_replay else _single(_Views(scene, present, ("",)))
    return rrb.Blueprint(
        body,
        rrb.TimePanel(state="collapsed", timeline=e.SESSION_TIME),
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

    def camera(self, name: str, contents: list[str], origin: str) -> Shown:
        return rrb.Spatial2DView(
            name=name,
            origin=origin,
            contents=contents,
            background=colours.SOLID,
            visual_bounds=_bounds(self.scene.image_bounds()),
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

    def plot(
        self,
        name: str,
        *entities: str,
        needs: str = "",
        prefixes: tuple[str, ...] | None = None,
        window_s: float | None = None,
    ) -> Part:
        """Lines over the whole session, or over a window around the time cursor."""
        if needs and needs not in self.present:
            return None
        ranges = None
        if window_s is not None:
            ranges = rrb.VisibleTimeRange(
                e.SESSION_TIME,
                start=rrb.TimeRangeBoundary.cursor_relative(seconds=-window_s),
                end=rrb.TimeRangeBoundary.cursor_relative(seconds=0.25 * window_s),
            )
        paths = [entity_path(prefix, entity) for prefix in prefixes or self.prefixes for entity in entities]
        legend = len(paths) > 1 or entities[0] in _SEVERAL_LINES  # the title suffices for a single line
        return rrb.TimeSeriesView(
            name=name,
            origin=paths[0] if len(paths) == 1 else "/",
            contents=[f"+ {path}" for path in paths],
            plot_legend=rrb.PlotLegend(corner=rrb.Corner2D.LeftTop, visible=legend),
            time_ranges=ranges,
        )

    def phases(self, *entities: str) -> Shown:
        paths = [entity_path(prefix, entity) for entity in entities for prefix in self.prefixes]
        return rrb.StateTimelineView(name="Mission", origin="/", contents=[f"+ {path}" for path in paths])

    def events(self) -> Part:
        paths = [entity_path(prefix, entity) for prefix in self.prefixes for entity in (e.EVENTS, e.OPERATOR)]
        return rrb.TextLogView(
            name="Events",
            origin="/",
            contents=[f"+ {path}" for path in paths],
            columns=rrb.TextLogColumns(timeline_columns=[e.SESSION_TIME], text_log_columns=["LogLevel", "Body"]),
        )

    def layout(self, camera: Shown, rows: Iterable[Iterable[Part]], phases: Shown, plots: Iterable[Part]) -> Shown:
        """Camera and rows of maps above, then the phases, then the plots."""
        maps = [rrb.Horizontal(*existing) for row in rows if (existing := _existing(row))]
        # The camera is as wide as its image needs on a usual screen, so that little background shows.
        left, top, right, bottom = self.scene.image_bounds()
        width = min(max(0.34 * (right - left) / (bottom - top), 0.3), 0.55)
        above: Shown = camera
        if maps:
            above = rrb.Horizontal(camera, rrb.Vertical(*maps), column_shares=[width, 1.0 - width])
        return rrb.Vertical(above, phases, rrb.Horizontal(*_existing(plots)), row_shares=_ROW_HEIGHTS)


def _single(v: _Views) -> Shown:
    camera = v.camera("Camera: path, robot, goal, flow", ["$origin/**"], entity_path("", "camera"))
    first = (
        v.map("Flow speed: assumed", e.ASSUMED, e.SPEED_SCALE, "assumed"),
        v.map("Flow speed: refined", e.REFINED, e.SPEED_SCALE, "refined"),
    )
    second = (
        v.map("Refined minus assumed speed", e.CHANGE, e.CHANGE_SCALE, "change"),
        _tabs(
            v.map("Flow speed: truth (simulated)", e.TRUE, e.SPEED_SCALE, "truth"),
            v.map("Uncertainty (1 σ)", e.UNCERTAINTY, e.UNCERTAINTY_SCALE, "uncertainty"),
            v.map("Time to go", e.TIME_TO_GO, e.TIME_TO_GO_SCALE, "time to go"),
        ),
    )
    plots = (
        _tabs(
            v.plot("Coil currents (A)", e.CURRENT, window_s=_COIL_WINDOW_S),
            v.plot("Amplifier voltages (V)", e.VOLTAGE, needs="voltages", window_s=_COIL_WINDOW_S),
            v.plot("Field frequency (Hz)", e.FREQUENCY),
            v.plot("Field heading (°)", e.HEADING),
        ),
        _tabs(
            v.plot("Tracking error (µm)", e.TRACKING_ERROR),
            v.plot("Estimate error (µm)", e.ESTIMATE_ERROR, needs="true robot"),
            v.plot("Observer NIS", *((e.NIS, e.NIS_MEAN) if "health" in v.present else (e.NIS,))),
            v.plot("Pulsation (% of the flow)", e.PULSATION, needs="health"),
        ),
        _tabs(
            v.plot("Flow at the robot: observer and map (µm/s)", e.FLOW_SPEED),
            v.plot("Components (µm/s)", e.FLOW_COMPONENTS),
        ),
        _tabs(v.events(), v.plot("Timing (ms)", e.TIMING, needs="timing")),
    )
    return v.layout(camera, (first, second), v.phases(e.PHASE, e.SIGHT), plots)


def _replay(v: _Views) -> Shown:
    hidden = [entity_path(_NEW, e.TRAIL), entity_path(_OLD, e.ARROWS), entity_path(_NEW, e.OUTLINE)]
    camera = v.camera(
        "Camera: recorded (orange) and replayed (cyan)",
        [f"+ /{_OLD}/camera/**", f"+ /{_NEW}/camera/**", *(f"- {path}" for path in hidden)],
        f"/{_OLD}/camera",
    )
    first = (
        v.map("Recorded: refined speed", e.REFINED, e.SPEED_SCALE, "refined", _OLD),
        v.map("Replayed: refined speed", e.REFINED, e.SPEED_SCALE, "replayed refined", _NEW),
    )
    second = (
        v.map("Assumed speed", e.ASSUMED, e.SPEED_SCALE, "assumed", _OLD),
        _tabs(
            v.map("Flow speed: truth (simulated)", e.TRUE, e.SPEED_SCALE, "truth", _OLD),
            v.map("Replayed: uncertainty (1 σ)", e.UNCERTAINTY, e.UNCERTAINTY_SCALE, "replayed uncertainty", _NEW),
            v.map("Replayed: time to go", e.TIME_TO_GO, e.TIME_TO_GO_SCALE, "replayed time to go", _NEW),
        ),
    )
    plots = (
        _tabs(
            v.plot("Command: field frequency (Hz)", e.FREQUENCY),
            v.plot("Coil currents, recorded (A)", e.CURRENT, prefixes=(_OLD,), window_s=_COIL_WINDOW_S),
            v.plot("Coil currents, replayed (A)", e.CURRENT, prefixes=(_NEW,), window_s=_COIL_WINDOW_S),
        ),
        v.plot("Command: field heading (°)", e.HEADING),
        _tabs(
            v.plot("Tracking error (µm)", e.TRACKING_ERROR),
            v.plot("Estimate error (µm)", e.ESTIMATE_ERROR, needs="true robot"),
            v.plot("Observer NIS", e.NIS),
        ),
        v.plot("Flow at the robot: observer and map (µm/s)", e.FLOW_SPEED),
        v.events(),
    )
    return v.layout(camera, (first, second), v.phases(e.PHASE), plots)


def _existing(parts: Iterable[Part]) -> list[Shown]:
    return [part for part in parts if part is not None]


def _tabs(*parts: Part) -> Part:
    """Views one behind the other, the first in front."""
    existing = _existing(parts)
    return rrb.Tabs(*existing, active_tab=0) if existing else None


def _bounds(box: Box) -> rrb.VisualBounds2D:
    left, top, right, bottom = box
    return rrb.VisualBounds2D(x_range=[left, right], y_range=[top, bottom])
