"""The layout of the viewer: which views are shown first, and where. The loggers log every entity named here."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from collections.abc import Set as AbstractSet
from dataclasses import dataclass
from typing import Any

import rerun as rr
import rerun.blueprint as rrb
from rerun.blueprint.encodings import TimelineColumn

from flowrec.core import seconds
from flowrec.view import colours
from flowrec.view import entities as e
from flowrec.view.entities import FRAME, SESSION_TIME, entity_path, points
from flowrec.view.maps import ColourBar
from flowrec.view.scene import Box, Scene

_SEVERAL_LINES = frozenset({e.POSITION, e.FLOW_SPEED, e.FLOW_COMPONENTS, e.TIMING, e.READ_BACK})
_OVERLAYS = (e.OUTLINE, e.PATH, e.ROBOT)  # of each map, for orientation
_SUMMARY = 0.31  # width of the text panel
_SMALL = 0.42  # of all beside a camera without maps
# Pixels on a small screen: its width, the height of all, that of text and plots below, the frame of the lanes and each.
_WIDTH_PX, _ALL_PX, _BELOW_PX, _LANES_PX, _LANE_PX = 1280.0, 653.0, 345.0, 60.0, 40.0
_FEW_LANES, _MOST_LANES = 2, 5  # more than few make the area below higher; more than most are scrolled
_MOST_EXTRA = 6  # plots of extra topics beside each other
_TITLE_PX = 28.0
_LEGEND_LIVE_S = 6.0  # least time kept free for a legend in a view that follows the run
_WITH_LEGEND = 1.5  # width of a plot with a legend over that of one without
_LEGEND_OF_TWO = 0.5  # as LEGEND, in a view of two sessions, where all plots have one
LEGEND = 0.35  # of the time shown, kept free for a legend beside the curves, in all plots alike
Shown = rrb.View | rrb.Container
Part = Shown | None


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
    present : what was logged (see `EntityLogger.present`, and SUMMARY), of the second session after its prefix and a
        space; views that would be empty are left out.
    end_s : of the session so far.
    phases : of each session, see StateLogger.
    live : the view follows the run; otherwise it opens at the start and plays.
    """
    views = _Views(scene, present, prefixes, end_s, tuple(phases), live)
    body = _single(views) if len(prefixes) == 1 else _double(views)
    return layout_of(body, timeline=SESSION_TIME, play_state="following" if live else "playing")


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

    def map(self, name: str, entity: str, prefix: str = "") -> Part:
        """A map with its colour bar and the overlays."""
        if not self._has(prefix, entity):
            return None
        overlays = [f"+ {entity_path(prefix, overlay)}" for overlay in _OVERLAYS]
        return rrb.Spatial2DView(
            name=name,
            origin=entity_path(prefix, entity.rsplit("/", 1)[0]),
            contents=["+ $origin/**", f"+ {entity_path(prefix, e.SCALES[entity])}/**", *overlays],
            # Thin, because a map is small, and the fastest flow is usually along the path.
            overrides={
                entity_path(prefix, each): rr.LineStrips2D.from_fields(radii=points(radius))
                for each, radius in ((e.PATH, 0.6), (e.ROBOT, 0.9))
            },
            background=colours.SOLID,
            visual_bounds=_bounds(ColourBar(self.scene).bounds),
        )

    def plot(self, name: str, *entities: str, prefixes: Sequence[str] = ()) -> Part:
        """Lines over the whole session, of these sessions or all."""
        if entities[0] in e.OPTIONAL and entities[0] not in self.present:
            return None
        paths = [entity_path(prefix, entity) for prefix in prefixes or self.prefixes for entity in entities]
        legend = len(paths) > 1 or entities[0] in _SEVERAL_LINES  # the title suffices for a single line
        return rrb.TimeSeriesView(
            name=name,
            origin=paths[0] if len(paths) == 1 else "/",
            contents=_contents(paths),
            plot_legend=legend_of(visible=legend),
            axis_x=self._time_axis(),
        )

    def _time_axis(self) -> rrb.TimeAxis:
        """From the start to the end, and longer for the legend."""
        free = LEGEND if len(self.prefixes) == 1 else _LEGEND_OF_TWO
        end = rr.TimeRangeBoundary.absolute(seconds=(1.0 + free) * self.end_s)
        if self.live:
            end = rr.TimeRangeBoundary.cursor_relative(seconds=max(free * self.end_s, _LEGEND_LIVE_S))
        return axis_of(rr.TimeRangeBoundary.absolute(seconds=0.0), end)

    def lanes(self) -> Shown:
        """The timeline of states, all of it, on the axis of the plots."""
        return rrb.StateTimelineView(
            name=self._lanes_name(),
            origin="/",
            contents=_contents(self._lane_paths),
            time_view=self._time_axis(),
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

    def pair(self, maps: Mapping[str, Part]) -> Part:
        """Maps that are seen at once, by the word of each, arranged so that they are largest."""
        known = {word: shown for word, shown in maps.items() if shown is not None}
        if not known:
            return None
        left, top, right, bottom = ColourBar(self.scene).bounds
        width_px, height_px = (1.0 - self.camera_share) * _WIDTH_PX, _ALL_PX - self.below_px - 2.0 * _TITLE_PX
        beside = min(0.5 * width_px / (right - left), height_px / (bottom - top))
        above = min(width_px / (right - left), 0.5 * (height_px - _TITLE_PX) / (bottom - top))
        words = ", ".join(known)
        return (rrb.Vertical if above > beside else rrb.Horizontal)(*known.values(), name=words[0].upper() + words[1:])

    def texts(self) -> Shown:
        """The summary, and behind it the events."""
        paths = [entity_path(prefix, entity) for prefix in self.prefixes for entity in (e.EVENTS, e.OPERATOR)]
        # Hidden by name: an empty list would show the timeline of the view.
        events = events_view(paths, [TimelineColumn(each, visible=False) for each in (SESSION_TIME, FRAME)])
        summary = rrb.TextDocumentView(name="Summary", origin=entity_path("", e.SUMMARY))
        return rrb.Tabs(*([summary] if e.SUMMARY in self.present else []), events, active_tab=0)

    @property
    def camera_share(self) -> float:
        """Fraction of the width that the chip needs on a small screen."""
        left, top, right, bottom = self.scene.shown_bounds()
        height_px = _ALL_PX - self.below_px - _TITLE_PX
        return min(max((right - left) / (bottom - top) * height_px / _WIDTH_PX, 0.28), 0.62)

    @property
    def tells_flow(self) -> bool:
        """False in an open field that nothing drives, where no refinement has found a flow."""
        return not self.scene.chip.is_still or any(self._has(prefix, e.REFINED) for prefix in self.prefixes)

    def layout(self, camera: Shown, maps: Iterable[Part]) -> Shown:
        """Camera and maps above; below the summary, and beside it the states over the plots.

        Without a flow to tell of the camera is as high as the window.
        """
        width = self.camera_share
        if not self.tells_flow:
            texts = rrb.Vertical(*existing([tabs(*_plots(self)), self.lanes(), self.texts()]))
            return rrb.Horizontal(camera, texts, column_shares=[1.0 - _SMALL, _SMALL])
        above: Shown = camera
        if beside := tabs(*maps):
            above = rrb.Horizontal(camera, beside, column_shares=[width, 1.0 - width])
        share = self.lanes_px / self.below_px
        right_side = rrb.Vertical(*existing([self.lanes(), tabs(*_plots(self))]), row_shares=[share, 1.0 - share])
        below = rrb.Horizontal(self.texts(), right_side, column_shares=[_SUMMARY, 1.0 - _SUMMARY])
        return rrb.Vertical(above, below, row_shares=[_ALL_PX - self.below_px, self.below_px])


def _single(v: _Views) -> Shown:
    more = ", other robots" if e.OTHERS in v.present else ""
    more += ", tracers (purple)" if e.TRACERS in v.present else ""
    name = f"Robot (orange), route (cyan){more}, flow" if v.tells_flow else f"Robot (orange){more}"
    camera = v.camera(name, ["$origin/**"], entity_path("", "camera"))
    maps = (
        v.pair({"assumed": v.map("Assumed flow", e.ASSUMED), "refined": v.map("Refined flow", e.REFINED)}),
        v.pair(
            {"change": v.map("Refined - assumed", e.CHANGE), "uncertainty": v.map("Uncertainty (1 σ)", e.UNCERTAINTY)}
        ),
        v.pair({"truth": v.map("True flow", e.TRUE), "time to go": v.map("Time to go", e.TIME_TO_GO)}),
    )
    return v.layout(camera, maps)


def _double(v: _Views) -> Shown:
    old, new = v.prefixes
    hidden = [entity_path(new, e.TRAIL), entity_path(old, e.ARROWS), entity_path(new, e.OUTLINE)]
    camera = v.camera(
        f"{old[0].upper()}{old[1:]} (orange), {new} (cyan)",
        [f"+ /{old}/camera/**", f"+ /{new}/camera/**", *(f"- {path}" for path in hidden)],
        f"/{old}/camera",
    )
    refined = {
        f"refined {old}": v.map(f"Refined, {old}", e.REFINED, old),
        new: v.map(f"Refined, {new}", e.REFINED, new),
    }
    uncertainty = v.map(f"Uncertainty, {new} (1 σ)", e.UNCERTAINTY, new)
    to_go = v.map(f"Time to go, {new}", e.TIME_TO_GO, new)
    maps = (
        v.pair(refined),
        v.pair({"uncertainty": uncertainty, "assumed": v.map("Assumed flow", e.ASSUMED, old)}),
        v.pair({"truth": v.map("True flow", e.TRUE, old), "time to go": to_go}),
    )
    return v.layout(camera, maps)


def _plots(v: _Views) -> tuple[Part, ...]:
    """Three pages of plots: all of a page are seen at once, and no title is cut."""
    single = len(v.prefixes) == 1
    told = v.tells_flow
    flow = [
        v.plot("Flow at the robot (µm/s)" if single else f"Flow, {prefix} (µm/s)", e.FLOW_SPEED, prefixes=(prefix,))
        for prefix in v.prefixes
        if told
    ]
    nis = (e.NIS, e.NIS_MEAN) if e.PULSATION in v.present and single else (e.NIS,)
    frequency = v.plot("Field (Hz)", e.FREQUENCY)
    extra = sorted(name for name in v.present if name.startswith(f"{e.EXTRA}/"))
    return (
        _row(
            "Robot",
            *flow,
            v.plot("Position (µm)", e.POSITION),
            v.plot("Tracking error (µm)", e.TRACKING_ERROR),
            frequency if single and told else None,
            first_share=_WITH_LEGEND if single else 1.0,
        ),
        _row(
            "Observer",
            v.plot("Estimate error (µm)", e.ESTIMATE_ERROR),
            v.plot("Observer NIS", *nis),
            v.plot("Pulsation (%)", e.PULSATION),
        ),
        _row(
            "Components",
            v.plot("Flow at the robot by components (µm/s)", e.FLOW_COMPONENTS) if single and told else None,
        ),
        _row(
            "Coils",
            None if single and told else frequency,
            v.plot("Heading (°)", e.HEADING),
            v.plot("Field (mT)", e.AMPLITUDE),
            v.plot("Measured less put out (A)", e.READ_BACK),
        ),
        _row("Timing", v.plot("Timing (ms)", e.TIMING)),
        _row("Other topics", *(v.plot(entity.removeprefix(e.EXTRA), entity) for entity in extra[:_MOST_EXTRA])),
    )


def layout_of(body: Shown, **time: Any) -> rrb.Blueprint:
    """A layout of these views alone; `time`: timeline, and whether it plays."""
    return rrb.Blueprint(
        body,
        rrb.TimePanel(state="collapsed", **time),
        rrb.SelectionPanel(state="hidden"),
        rrb.BlueprintPanel(state="hidden"),
        auto_layout=False,
        auto_views=False,
    )


def events_view(paths: Iterable[str], timeline_columns: Sequence[TimelineColumn] = ()) -> rrb.TextLogView:
    """The events of some entities as a log."""
    columns = rrb.TextLogColumns(timeline_columns=timeline_columns, text_log_columns=["Body"])
    return rrb.TextLogView(name="Events", origin="/", contents=_contents(paths), columns=columns)


def axis_of(start: rr.TimeRangeBoundary, end: rr.TimeRangeBoundary) -> rrb.TimeAxis:
    """The axis of a plot between two times."""
    return rrb.TimeAxis(view_range=rr.TimeRange(start=start, end=end))


def legend_of(*, visible: bool) -> rrb.PlotLegend:
    """The legend of a plot, in its upper right corner."""
    return rrb.PlotLegend(corner=rrb.Corner2D.RightTop, visible=visible)


def existing(parts: Iterable[Part]) -> list[Shown]:
    """The parts that are there."""
    return [part for part in parts if part is not None]


def tabs(*parts: Part) -> Part:
    """Views one behind the other, the first in front; None without any."""
    found = existing(parts)
    return rrb.Tabs(*found, active_tab=0) if found else None


def _row(name: str, *parts: Part, first_share: float = 1.0) -> Part:
    """Views side by side, the first one wider by a factor."""
    found = existing(parts)
    return rrb.Horizontal(*found, name=name, column_shares=[first_share, *[1.0] * (len(found) - 1)]) if found else None


def _contents(paths: Iterable[str]) -> list[str]:
    """The contents of a view that shows these entities."""
    return [f"+ {path}" for path in paths]


def _bounds(box: Box) -> rrb.VisualBounds2D:
    left, top, right, bottom = box
    return rrb.VisualBounds2D(x_range=[left, right], y_range=[top, bottom])
