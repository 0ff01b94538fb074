"""The layout of Rerun's viewer for a session file itself, whose entities are its topics (store/viewer_topics.py)."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from collections.abc import Set as AbstractSet

import rerun as rr
import rerun.blueprint as rrb
from rerun.blueprint.encodings import ComponentSourceKind, VisualizerComponentMapping

from flowrec.store import SLOTS
from flowrec.view import colours
from flowrec.view.bare_plots import EVENTS, IMAGE, MAPS, ON_IMAGE, PLOTS, STATES, Plot
from flowrec.view.entities import points

_LOG_TIME = "message_log_time"  # Rerun's name for the time of an MCAP message
_MISSION = "/run/mission"
_LEGEND = 0.5  # of the time shown, kept free for a legend beside the curves


def bare_blueprint(
    present: AbstractSet[str], begin_ns: int, end_ns: int, extra: Sequence[tuple[str, Plot]] = ()
) -> rrb.Blueprint:
    """The layout for a file that holds messages of the topics `present`; views that would be empty are left out.

    `begin_ns` and `end_ns` are the Unix times between which it was recorded, `extra` the plots of extra topics, each
    after the name of its schema.
    """
    camera = _picture("Camera: robot (orange), route (cyan), goal (green)", IMAGE, present, 1.2)
    maps = _existing(_picture(name, topic, present, 0.9) for topic, name in MAPS.items())
    axis = _axis(begin_ns, end_ns)
    plots = _existing(
        _tabs(*(_plot(plot, axis) for plot in group if plot.topic in present)) for group in PLOTS.values()
    )
    plots += _existing([_tabs(*(_plot(plot, axis, schema) for schema, plot in extra))])
    events = rrb.TextLogView(
        name="Events",
        origin="/",
        contents=[f"+ {topic}" for topic in EVENTS],
        columns=rrb.TextLogColumns(timeline_columns=[], text_log_columns=["Body"]),
    )
    lanes = rrb.StateTimelineView(name="Mission", origin=_MISSION, overrides={_MISSION: _state(_MISSION)})
    above = _existing([camera, rrb.Vertical(*maps) if maps else None])
    texts = rrb.Vertical(lanes, events, row_shares=[0.38, 0.62])
    below = rrb.Horizontal(texts, *plots, column_shares=[0.3, *(0.7 / len(plots) for _ in plots)])
    body = rrb.Vertical(rrb.Horizontal(*above, column_shares=[0.6, 0.4][: len(above)]), below, row_shares=[0.6, 0.4])
    return rrb.Blueprint(
        body if above else below,
        rrb.TimePanel(state="collapsed", timeline=_LOG_TIME),
        rrb.SelectionPanel(state="hidden"),
        rrb.BlueprintPanel(state="hidden"),
        auto_layout=False,
        auto_views=False,
    )


def _picture(name: str, topic: str, present: AbstractSet[str], width: float) -> rrb.View | None:
    """An image with route, goal and robot, which Rerun projects by the camera of the image."""
    if topic not in present:
        return None
    overlays = [entity for entity in ON_IMAGE if entity in present]
    return rrb.Spatial2DView(
        name=name,
        origin=topic,
        contents=["+ $origin", *(f"+ {entity}" for entity in overlays)],
        overrides={entity: rr.Points3D.from_fields(radii=points(width)) for entity in overlays},
        background=colours.SOLID,
    )


def _plot(plot: Plot, axis: rrb.TimeAxis, schema: str = "") -> rrb.View:
    """Fields of a message over time; of an extra topic its single numbers."""
    series = []
    for field, label in plot.lines.items():
        if "[" in field:
            continue
        shown = rr.SeriesPoints(names=label) if plot.points else rr.SeriesLines(names=label)
        series.append(
            shown.visualizer(mappings=[_mapping("Scalars:scalars", schema or SLOTS[plot.topic].schema.name, field)])
        )
    return rrb.TimeSeriesView(
        name=plot.title,
        origin=plot.topic,
        contents=["+ $origin"],
        overrides={plot.topic: series},
        plot_legend=rrb.PlotLegend(corner=rrb.Corner2D.RightTop, visible=len(plot.lines) > 1),
        axis_x=axis,
    )


def _axis(begin_ns: int, end_ns: int) -> rrb.TimeAxis:
    """The time of the recording, and some beyond it for a legend beside the curves."""
    end_ns += int(_LEGEND * (end_ns - begin_ns))
    begin, end = (rr.TimeRangeBoundary.absolute(nanos=ns) for ns in (begin_ns, end_ns))
    return rrb.TimeAxis(view_range=rr.TimeRange(start=begin, end=end))


def _state(topic: str) -> rrb.Visualizer:
    """A field of a message as states."""
    return rr.StateChange().visualizer(
        mappings=[_mapping("StateChange:state", SLOTS[topic].schema.name, STATES[topic][0])]
    )


def _mapping(target: str, schema: str, field: str) -> VisualizerComponentMapping:
    return VisualizerComponentMapping(
        target=target,
        source_kind=ComponentSourceKind.SourceComponent,
        source_component=f"{schema}:message",
        selector=f".{field}",
    )


def _existing(parts: Iterable[rrb.View | rrb.Container | None]) -> list[rrb.View | rrb.Container]:
    return [part for part in parts if part is not None]


def _tabs(*views: rrb.View) -> rrb.Container | None:
    return rrb.Tabs(*views, active_tab=0) if views else None
