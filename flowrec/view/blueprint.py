"""The layout of the viewer: which views are shown first, and where. The loggers log every entity named here."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from collections.abc import Set as AbstractSet
from dataclasses import dataclass

import rerun as rr
import rerun.blueprint as rrb
from rerun.blueprint.encodings import TimelineColumn

from flowrec.core import seconds
from flowrec.view import colours
from flowrec.view import entities as e
from flowrec.view.entities import entity_path, points
from flowrec.view.maps import ColourBar
from flowrec.view.scene import Scene

_SEVERAL_LINES = frozenset({e.FLOW_SPEED, e.FLOW_COMPONENTS, e.TIMING})
_OVERLAYS = (e.OUTLINE, e.PATH, e.ROBOT)  # of each map, for orientation
_SUMMARY = 0.31  # width of the text panel
# Pixels on a small screen: its width, the height of all, that of text and plots below, the frame of the lanes and each.
_WIDTH_PX, _ALL_PX, _BELOW_PX, _LANES_PX, _LANE_PX = 1280.0, 653.0, 345.0, 60.0, 40.0
_FEW_LANES, _MOST_LANES = 2, 5  # more than few make the area below higher; more than most are scrolled
_MOST_EXTRA = 6  # plots of extra topics beside each other
_TITLE_PX = 28.0
_LEGEND_LIVE_S = 6.0  # least time kept free for a legend in a view that follows the run
_LEGEND = 0.5  # of the time shown, kept free for a legend beside the curves
Shown = rrb.View | rrb.Container
Part = Shown | None
Box = tuple[float, float, float, float]


def blueprint(
    scene: Scene,
    prefixes: tuple[str, ...],
    present: AbstractSet[str],
    end_s: float,
    phases: Iterable[Mapping[str, int]],
    live: bool = False,
) -> rrb.Blueprint:
    """The layout of one session, or of two in one view.

    Parameters
    ----------
    prefixes : ("",), or those of two sessions, see entities.py.
    present : what was logged (see `TickLogger.present`), of the second session after its prefix and a space; views
        that would be empty are left out.
    end_s : of the session so far.
    phases : of each session, see StateLogger.
    live : the view follows the run; otherwise it opens at the start and plays.
    """
    views = _Views(scene, present, prefixes, end_s, tuple(phases), live)
    body = _single(views) if len(prefixes) == 1 else _double(views)
    return rrb.Blueprint(
        body,
        rrb.TimePanel(state="collapsed", timeline=e.SESSION_TIME, play_state="following" if live else "playing"),
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
    end_s: float
    phases: tuple[Mapping[str, int], ...]
    live: bool

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
            # Thin, because a map is small, and the fastest flow is usually along the path.
            overrides={
                entity_path(prefix, each): rr.LineStrips2D.from_fields(radii=points(radius))
                for each, radius in ((e.PATH, 0.6), (e.ROBOT, 0.9))
            },
            background=colours.SOLID,
            visual_bounds=_bounds(ColourBar.beside(self.scene).bounds_with(self.scene)),
        )

    def plot(self, name: str, *entities: str, needs: str = "", prefixes: tuple[str, ...] | None = None) -> Part:
        """Lines over the whole session."""
        if needs and needs not in self.present:
            return None
        paths = [entity_path(prefix, entity) for prefix in prefixes or self.prefixes for entity in entities]
        legend = len(paths) > 1 or entities[0] in _SEVERAL_LINES  # the title suffices for a single line
        return rrb.TimeSeriesView(
            name=name,
            origin=paths[0] if len(paths) == 1 else "/",
            contents=[f"+ {path}" for path in paths],
            plot_legend=rrb.PlotLegend(corner=rrb.Corner2D.RightTop, visible=legend),
            axis_x=self._time_axis() if legend else None,
        )

    @property
    def extra(self) -> list[str]:
        """The entities of the extra topics that are shown."""
        return sorted(name for name in self.present if name.startswith(f"{e.EXTRA}/"))[:_MOST_EXTRA]

    def _time_axis(self) -> rrb.TimeAxis:
        """From the start to the end, and longer for the legend."""
        end = rr.TimeRangeBoundary.absolute(seconds=(1.0 + _LEGEND) * self.end_s)
        if self.live:
            end = rr.TimeRangeBoundary.cursor_relative(seconds=max(_LEGEND * self.end_s, _LEGEND_LIVE_S))
        start = rr.TimeRangeBoundary.absolute(seconds=0.0)
        return rrb.TimeAxis(view_range=rr.TimeRange(start=start, end=end))

    def lanes(self) -> Shown:
        """The timeline of states."""
        return rrb.StateTimelineView(
            name=self._lanes_name(), origin="/", contents=[f"+ {path}" for path in self._lane_paths]
        )

    @property
    def _lane_paths(self) -> list[str]:
        return [entity_path(prefix, lane) for prefix in self.prefixes for lane in e.LANES if self._has(prefix, lane)]

    @property
    def lanes_px(self) -> float:
        """Height of the timeline of states on a small screen."""
        return _LANES_PX + _LANE_PX * min(max(len(self._lane_paths), 1), _MOST_LANES)

    @property
    def below_px(self) -> float:
        """Height of all that is below camera and maps; many lanes take room from those."""
        return max(_BELOW_PX, _BELOW_PX + self.lanes_px - _LANES_PX - _LANE_PX * _FEW_LANES)

    def _lanes_name(self) -> str:
        """The phases in words: the name of a short one has no room in its lane."""
        if len(self.prefixes) == 1:
            parts = [f"{name} {seconds(stamp_ns):.1f} s" for name, stamp_ns in self.phases[0].items()]
            return f"Mission: {', '.join(parts)}" if parts else "Mission, alarms, marks"
        texts = [", ".join(phases) for phases in self.phases]
        if texts[0] == texts[1]:
            return f"Missions: {texts[0]}" if texts[0] else "Missions, alarms, marks"
        return "; ".join(f"{prefix}: {text or 'none'}" for prefix, text in zip(self.prefixes, texts, strict=True))

    def _has(self, prefix: str, name: str) -> bool:
        second = len(self.prefixes) == 2 and prefix == self.prefixes[1]
        if second and self.prefixes == e.REPLAY and name in e.LANES_OF_RUN:
            return False
        return (f"{prefix} {name}" if second else name) in self.present

    def pair(self, **maps: Part) -> Part:
        """Maps that are seen at once, by the word of each, arranged so that they are largest."""
        existing = {word.replace("_", " "): shown for word, shown in maps.items() if shown is not None}
        if not existing:
            return None
        left, top, right, bottom = ColourBar.beside(self.scene).bounds_with(self.scene)
        width_px, height_px = (1.0 - self.camera_share) * _WIDTH_PX, _ALL_PX - self.below_px - 2.0 * _TITLE_PX
        beside = min(0.5 * width_px / (right - left), height_px / (bottom - top))
        above = min(width_px / (right - left), 0.5 * (height_px - _TITLE_PX) / (bottom - top))
        words = ", ".join(existing)
        return (rrb.Vertical if above > beside else rrb.Horizontal)(
            *existing.values(), name=words[0].upper() + words[1:]
        )

    def texts(self) -> Part:
        """The summary, and behind it the events."""
        paths = [entity_path(prefix, entity) for prefix in self.prefixes for entity in (e.EVENTS, e.OPERATOR)]
        events = rrb.TextLogView(
            name="Events",
            origin="/",
            contents=[f"+ {path}" for path in paths],
            columns=rrb.TextLogColumns(
                # Hidden by name: an empty list would show the timeline of the view.
                timeline_columns=[TimelineColumn(each, visible=False) for each in (e.SESSION_TIME, e.FRAME)],
                text_log_columns=["Body"],
            ),
        )
        summary = rrb.TextDocumentView(name="Summary", origin=entity_path("", e.SUMMARY)) if self._summary else None
        return _tabs(summary, events)

    @property
    def _summary(self) -> bool:
        return "summary" in self.present

    @property
    def camera_share(self) -> float:
        """Fraction of the width that the chip needs on a small screen."""
        left, top, right, bottom = self.scene.shown_bounds()
        height_px = _ALL_PX - self.below_px - _TITLE_PX
        return min(max((right - left) / (bottom - top) * height_px / _WIDTH_PX, 0.28), 0.62)

    def layout(self, camera: Shown, maps: Iterable[Part], plots: Iterable[Part]) -> Shown:
        """Camera and maps above; below the summary, and beside it the states over the plots."""
        width = self.camera_share
        above: Shown = camera
        if beside := _tabs(*maps):
            above = rrb.Horizontal(camera, beside, column_shares=[width, 1.0 - width])
        share = self.lanes_px / self.below_px
        right_side = rrb.Vertical(*_existing([self.lanes(), _tabs(*plots)]), row_shares=[share, 1.0 - share])
        below = rrb.Horizontal(*_existing([self.texts()]), right_side, column_shares=[_SUMMARY, 1.0 - _SUMMARY])
        return rrb.Vertical(above, below, row_shares=[_ALL_PX - self.below_px, self.below_px])


def _single(v: _Views) -> Shown:
    camera = v.camera("Robot (orange), route (cyan), flow", ["$origin/**"], entity_path("", "camera"))
    assumed = v.map("Assumed flow", e.ASSUMED, e.SPEED_SCALE, "assumed")
    refined = v.map("Refined flow", e.REFINED, e.SPEED_SCALE, "refined")
    change = v.map("Refined - assumed", e.CHANGE, e.CHANGE_SCALE, "change")
    uncertainty = v.map("Uncertainty (1 σ)", e.UNCERTAINTY, e.UNCERTAINTY_SCALE, "uncertainty")
    truth = v.map("True flow", e.TRUE, e.SPEED_SCALE, "truth")
    to_go = v.map("Time to go", e.TIME_TO_GO, e.TIME_TO_GO_SCALE, "time to go")
    maps = (
        v.pair(assumed=assumed, refined=refined),
        v.pair(change=change, uncertainty=uncertainty),
        v.pair(truth=truth, time_to_go=to_go),
    )
    return v.layout(camera, maps, _plots(v))


def _double(v: _Views) -> Shown:
    old, new = v.prefixes
    hidden = [entity_path(new, e.TRAIL), entity_path(old, e.ARROWS), entity_path(new, e.OUTLINE)]
    camera = v.camera(
        f"{old[0].upper()}{old[1:]} (orange), {new} (cyan)",
        [f"+ /{old}/camera/**", f"+ /{new}/camera/**", *(f"- {path}" for path in hidden)],
        f"/{old}/camera",
    )
    was = v.map(f"Refined, {old}", e.REFINED, e.SPEED_SCALE, "refined", old)
    now = v.map(f"Refined, {new}", e.REFINED, e.SPEED_SCALE, f"{new} refined", new)
    uncertainty = v.map(f"Uncertainty, {new} (1 σ)", e.UNCERTAINTY, e.UNCERTAINTY_SCALE, f"{new} uncertainty", new)
    assumed = v.map("Assumed flow", e.ASSUMED, e.SPEED_SCALE, "assumed", old)
    truth = v.map("True flow", e.TRUE, e.SPEED_SCALE, "truth", old)
    to_go = v.map(f"Time to go, {new}", e.TIME_TO_GO, e.TIME_TO_GO_SCALE, f"{new} time to go", new)
    maps = (
        v.pair(**{f"refined {old}": was, new: now}),
        v.pair(uncertainty=uncertainty, assumed=assumed),
        v.pair(truth=truth, time_to_go=to_go),
    )
    return v.layout(camera, maps, _plots(v))


def _plots(v: _Views) -> tuple[Part, ...]:
    """Three pages of plots: all of a page are seen at once, and no title is cut."""
    single = len(v.prefixes) == 1
    flow = (
        [v.plot("Flow at the robot (µm/s)", e.FLOW_SPEED)]
        if single
        else [v.plot(f"Flow, {prefix} (µm/s)", e.FLOW_SPEED, prefixes=(prefix,)) for prefix in v.prefixes]
    )
    nis = (e.NIS, e.NIS_MEAN) if "health" in v.present and single else (e.NIS,)
    frequency = v.plot("Field (Hz)", e.FREQUENCY)
    return (
        _row(
            "Robot",
            *flow,
            v.plot("Tracking error (µm)", e.TRACKING_ERROR, needs="tracking"),
            frequency if single else None,
        ),
        _row(
            "Observer",
            v.plot("Estimate error (µm)", e.ESTIMATE_ERROR, needs="true robot"),
            v.plot("Observer NIS", *nis),
            v.plot("Pulsation (%)", e.PULSATION, needs="health"),
        ),
        _row("Components", v.plot("Flow at the robot by components (µm/s)", e.FLOW_COMPONENTS) if single else None),
        _row(
            "Coils",
            None if single else frequency,
            v.plot("Heading (°)", e.HEADING),
            v.plot("Field (mT)", e.AMPLITUDE),
        ),
        _row("Timing", v.plot("Timing (ms)", e.TIMING, needs="timing")),
        _row("Other topics", *(v.plot(entity.removeprefix(e.EXTRA), entity) for entity in v.extra)),
    )


def _existing(parts: Iterable[Part]) -> list[Shown]:
    return [part for part in parts if part is not None]


def _row(name: str, *parts: Part) -> Part:
    """Views side by side."""
    existing = _existing(parts)
    return rrb.Horizontal(*existing, name=name) if existing else None


def _tabs(*parts: Part) -> Part:
    """Views one behind the other, the first in front."""
    existing = _existing(parts)
    return rrb.Tabs(*existing, active_tab=0) if existing else None


def _bounds(box: Box) -> rrb.VisualBounds2D:
    left, top, right, bottom = box
    return rrb.VisualBounds2D(x_range=[left, right], y_range=[top, bottom])
