"""Which views a person sees first, and where. Every origin and every entity named here is logged by the loggers."""

from __future__ import annotations

from collections.abc import Set as AbstractSet

import rerun as rr
import rerun.blueprint as rrb

from flowrec.view import colours
from flowrec.view import entities as e
from flowrec.view.maps import ColourBar
from flowrec.view.scene import Scene

_EVERYTHING = frozenset(
    {"assumed", "refined", "change", "uncertainty", "truth", "true robot", "timing", "time to go", "health", "voltages"}
)
_COIL_WINDOW_S = 2.0  # the currents turn several times a second; a whole session of them is a solid block

_SEVERAL_LINES = frozenset({e.CURRENT, e.VOLTAGE, e.FLOW_SPEED, e.FLOW_COMPONENTS, e.TIMING})


def blueprint(scene: Scene, has_replay: bool = False, present: AbstractSet[str] = _EVERYTHING) -> rrb.Blueprint:
    """The layout for one session, or for a recorded and a replayed one beside each other.

    `present` (see `TickLogger.present`) leaves out the views that would stay empty.
    """
    body = _replay(scene, present) if has_replay else _single(scene, present)
    return rrb.Blueprint(
        body,
        rrb.TimePanel(state="collapsed", timeline=e.SESSION_TIME),
        rrb.SelectionPanel(state="hidden"),
        rrb.BlueprintPanel(state="hidden"),
        auto_layout=False,
        auto_views=False,
    )


def _single(scene: Scene, present: AbstractSet[str]) -> rrb.Container:
    first = _row(
        [
            _map(scene, "Flow speed: assumed", e.ASSUMED, e.SPEED_SCALE) if "assumed" in present else None,
            _map(scene, "Flow speed: refined", e.REFINED, e.SPEED_SCALE) if "refined" in present else None,
        ]
    )
    second = _row(
        [
            _map(scene, "Refined minus assumed speed", e.CHANGE, e.CHANGE_SCALE) if "change" in present else None,
            _tabs(
                _map(scene, "Flow speed: truth (simulated)", e.TRUE, e.SPEED_SCALE) if "truth" in present else None,
                _map(scene, "Uncertainty (1 σ)", e.UNCERTAINTY, e.UNCERTAINTY_SCALE)
                if "uncertainty" in present
                else None,
                _map(scene, "Time to go", e.TIME_TO_GO, e.TIME_TO_GO_SCALE) if "time to go" in present else None,
            ),
        ]
    )
    camera = _camera(scene, "Camera: path, robot, goal, flow", ["$origin/**"], e.under("", "camera"))
    maps = [row for row in (first, second) if row is not None]
    above = rrb.Horizontal(camera, rrb.Vertical(*maps), column_shares=_camera_shares(scene)) if maps else camera
    return rrb.Vertical(
        above,
        _phases([e.PHASE, e.SIGHT]),
        _plots(
            _tabs(
                _plot("Coil currents (A)", [e.CURRENT], window_s=_COIL_WINDOW_S),
                _plot("Amplifier voltages (V)", [e.VOLTAGE], window_s=_COIL_WINDOW_S)
                if "voltages" in present
                else None,
                _plot("Field frequency (Hz)", [e.FREQUENCY]),
                _plot("Field heading (°)", [e.HEADING]),
            ),
            _tabs(
                _plot("Tracking error (µm)", [e.TRACKING_ERROR]),
                _plot("Estimate error (µm)", [e.ESTIMATE_ERROR]) if "true robot" in present else None,
                _plot("Observer NIS", [e.NIS, e.NIS_MEAN] if "health" in present else [e.NIS]),
                _plot("Pulsation (% of the flow)", [e.PULSATION]) if "health" in present else None,
            ),
            _tabs(
                _plot("Flow at the robot: observer and map (µm/s)", [e.FLOW_SPEED]),
                _plot("Components (µm/s)", [e.FLOW_COMPONENTS]),
            ),
            _tabs(
                _events([e.EVENTS, e.OPERATOR]),
                _plot("Timing (ms)", [e.TIMING]) if "timing" in present else None,
            ),
        ),
        row_shares=[6.4, 1.45, 2.7],
    )


def _replay(scene: Scene, present: AbstractSet[str]) -> rrb.Container:
    old, new = "recorded", "replayed"
    hidden = [e.under(new, e.TRAIL), e.under(old, e.ARROWS), e.under(new, e.OUTLINE)]
    camera = _camera(
        scene,
        "Camera: recorded (orange) and replayed (cyan)",
        [f"+ /{old}/camera/**", f"+ /{new}/camera/**", *(f"- {path}" for path in hidden)],
        f"/{old}/camera",
    )
    first = _row(
        [
            _map(scene, "Recorded: refined speed", e.REFINED, e.SPEED_SCALE, old) if "refined" in present else None,
            _map(scene, "Replayed: refined speed", e.REFINED, e.SPEED_SCALE, new)
            if "replayed refined" in present
            else None,
        ]
    )
    second = _row(
        [
            _map(scene, "Assumed speed", e.ASSUMED, e.SPEED_SCALE, old) if "assumed" in present else None,
            _tabs(
                _map(scene, "Flow speed: truth (simulated)", e.TRUE, e.SPEED_SCALE, old)
                if "truth" in present
                else None,
                _map(scene, "Replayed: uncertainty (1 σ)", e.UNCERTAINTY, e.UNCERTAINTY_SCALE, new)
                if "replayed uncertainty" in present
                else None,
                _map(scene, "Replayed: time to go", e.TIME_TO_GO, e.TIME_TO_GO_SCALE, new)
                if "replayed time to go" in present
                else None,
            ),
        ]
    )
    maps = [row for row in (first, second) if row is not None]
    above = rrb.Horizontal(camera, rrb.Vertical(*maps), column_shares=_camera_shares(scene)) if maps else camera
    both = (old, new)
    return rrb.Vertical(
        above,
        _phases([e.PHASE], both),
        _plots(
            _tabs(
                _plot("Command: field frequency (Hz)", [e.FREQUENCY], both),
                _plot("Coil currents, recorded (A)", [e.CURRENT], (old,), _COIL_WINDOW_S),
                _plot("Coil currents, replayed (A)", [e.CURRENT], (new,), _COIL_WINDOW_S),
            ),
            _plot("Command: field heading (°)", [e.HEADING], both),
            _tabs(
                _plot("Tracking error (µm)", [e.TRACKING_ERROR], both),
                _plot("Estimate error (µm)", [e.ESTIMATE_ERROR], both) if "true robot" in present else None,
                _plot("Observer NIS", [e.NIS], both),
            ),
            _plot("Flow at the robot: observer and map (µm/s)", [e.FLOW_SPEED], both),
            _events([e.EVENTS, e.OPERATOR], both),
        ),
        row_shares=[6.4, 1.45, 2.7],
    )


def _camera_shares(scene: Scene) -> list[float]:
    """Widths of camera and maps: as wide as the image needs on a usual screen, so that little stays grey."""
    left, top, right, bottom = scene.image_bounds()
    camera = min(max(0.34 * (right - left) / (bottom - top), 0.3), 0.55)
    return [camera, 1.0 - camera]


def _row(parts: list[rrb.View | rrb.Container | None]) -> rrb.Container | None:
    """What is there, side by side."""
    there = [part for part in parts if part is not None]
    return rrb.Horizontal(*there) if there else None


def _plots(*parts: rrb.View | rrb.Container | None) -> rrb.Container:
    """The row at the bottom."""
    return rrb.Horizontal(*(part for part in parts if part is not None))


def _tabs(*parts: rrb.View | None) -> rrb.Container | None:
    """What is there, one behind the other, the first in front."""
    there = [part for part in parts if part is not None]
    return rrb.Tabs(*there, active_tab=0) if there else None


def _camera(scene: Scene, name: str, contents: list[str], origin: str) -> rrb.View:
    return rrb.Spatial2DView(
        name=name,
        origin=origin,
        contents=contents,
        background=colours.SOLID,
        visual_bounds=_bounds(scene.image_bounds()),
    )


def _map(scene: Scene, name: str, entity: str, scale: str, prefix: str = "") -> rrb.View:
    """A map with its colour bar and, to find one's way, the path, the robot and the goal."""
    overlays = (e.OUTLINE, e.PATH, e.ROBOT)
    return rrb.Spatial2DView(
        name=name,
        origin=e.under(prefix, entity.rsplit("/", 1)[0]),
        contents=[
            "+ $origin/**",
            f"+ {e.under(prefix, scale)}/**",
            *(f"+ {e.under(prefix, overlay)}" for overlay in overlays),
        ],
        # Thin here: the fastest flow is just where the path runs.
        overrides={e.under(prefix, e.PATH): rr.LineStrips2D.from_fields(radii=rr.Radius.ui_points(0.6))},
        background=colours.SOLID,
        visual_bounds=_bounds(ColourBar.beside(scene).bounds_with(scene)),
    )


def _bounds(box: tuple[float, float, float, float]) -> rrb.VisualBounds2D:
    left, top, right, bottom = box
    return rrb.VisualBounds2D(x_range=[left, right], y_range=[top, bottom])


def _plot(
    name: str, entities: list[str], prefixes: tuple[str, ...] = ("",), window_s: float | None = None
) -> rrb.TimeSeriesView:
    """Lines over the whole session, or over a window around the time cursor."""
    ranges = None
    if window_s is not None:
        ranges = rrb.VisibleTimeRange(
            e.SESSION_TIME,
            start=rrb.TimeRangeBoundary.cursor_relative(seconds=-window_s),
            end=rrb.TimeRangeBoundary.cursor_relative(seconds=0.25 * window_s),
        )
    paths = [e.under(prefix, entity) for prefix in prefixes for entity in entities]
    legend = len(paths) > 1 or entities[0] in _SEVERAL_LINES  # of a single line the title says it all
    return rrb.TimeSeriesView(
        name=name,
        origin=paths[0] if len(paths) == 1 else "/",
        contents=[f"+ {path}" for path in paths],
        plot_legend=rrb.PlotLegend(corner=rrb.Corner2D.LeftTop, visible=legend),
        time_ranges=ranges,
    )


def _phases(entities: list[str], prefixes: tuple[str, ...] = ("",)) -> rrb.StateTimelineView:
    paths = [e.under(prefix, entity) for entity in entities for prefix in prefixes]
    return rrb.StateTimelineView(name="Mission", origin="/", contents=[f"+ {path}" for path in paths])


def _events(entities: list[str], prefixes: tuple[str, ...] = ("",)) -> rrb.TextLogView:
    paths = [e.under(prefix, entity) for prefix in prefixes for entity in entities]
    return rrb.TextLogView(
        name="Events",
        origin="/",
        contents=[f"+ {path}" for path in paths],
        columns=rrb.TextLogColumns(timeline_columns=[e.SESSION_TIME], text_log_columns=["LogLevel", "Body"]),
    )
