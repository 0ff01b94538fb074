"""The layout of Rerun's viewer for a session file itself, whose entities are its topics (store/viewer_topics.py)."""

from __future__ import annotations

from collections.abc import Sequence
from collections.abc import Set as AbstractSet

import rerun as rr
import rerun.blueprint as rrb
from rerun.blueprint.encodings import ComponentSourceKind, VisualizerComponentMapping

from flowrec.store import SLOTS, VERDICT
from flowrec.view import colours
from flowrec.view.bare_plots import EVENTS, IMAGE, MAPS, ON_IMAGE, PLOTS, STATES, Plot
from flowrec.view.blueprint import LEGEND, axis_of, events_view, existing, layout_of, legend_of, tabs
from flowrec.view.entities import LOG_TIME, points

_MISSION = "/run/mission"


def bare_blueprint(
    present: AbstractSet[str], begin_ns: int, end_ns: int, extra: Sequence[tuple[str, Plot]] = ()
) -> rrb.Blueprint:
    """The layout for a file that holds messages of the topics `present`; views that would be empty are left out.

    `begin_ns` and `end_ns` are the Unix times between which it was recorded, `extra` the plots of extra topics, each
    after the name of its schema.
    """
    camera = _picture("Camera: robot (orange), route (cyan), goal (green)", IMAGE, present, 1.2)
    maps = existing(_picture(name, topic, present, 0.9) for topic, name in MAPS.items())
    axis = axis_of(
        *(rr.TimeRangeBoundary.absolute(nanos=ns) for ns in (begin_ns, end_ns + int(LEGEND * (end_ns - begin_ns))))
    )
    groups = [
        [(SLOTS[plot.topic].schema.name, plot) for plot in each if plot.topic in present] for each in PLOTS.values()
    ]
    plots = existing(tabs(*(_plot(plot, axis, schema) for schema, plot in group)) for group in (*groups, extra))
    state = rr.StateChange().visualizer(
        mappings=[_mapping("StateChange:state", SLOTS[_MISSION].schema.name, STATES[_MISSION][0])]
    )
    lanes = rrb.StateTimelineView(name="Mission", origin=_MISSION, overrides={_MISSION: state})
    above = existing([camera, rrb.Vertical(*maps) if maps else None])
    verdict = rrb.TextDocumentView(name="Verdict", origin=VERDICT) if VERDICT in present else None
    shown = existing([verdict, lanes, events_view(EVENTS)])
    texts = rrb.Vertical(*shown, row_shares=[0.6, 0.38, 0.62][-len(shown) :])
    below = rrb.Horizontal(texts, *plots, column_shares=[0.3, *(0.7 / len(plots) for _ in plots)])
    body = rrb.Vertical(rrb.Horizontal(*above, column_shares=[0.6, 0.4][: len(above)]), below, row_shares=[0.6, 0.4])
    return layout_of(body if above else below, timeline=LOG_TIME)


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


def _plot(plot: Plot, axis: rrb.TimeAxis, schema: str) -> rrb.View:
    """Fields of a message, whose schema has this name, over time; of an extra topic its single numbers."""
    series = []
    for field, label in plot.lines.items():
        if "[" in field:
            continue
        shown = rr.SeriesPoints(names=label) if plot.points else rr.SeriesLines(names=label)
        series.append(shown.visualizer(mappings=[_mapping("Scalars:scalars", schema, field)]))
    return rrb.TimeSeriesView(
        name=plot.title,
        origin=plot.topic,
        contents=["+ $origin"],
        overrides={plot.topic: series},
        plot_legend=legend_of(visible=len(plot.lines) > 1),
        axis_x=axis,
    )


def _mapping(target: str, schema: str, field: str) -> VisualizerComponentMapping:
    return VisualizerComponentMapping(
        target=target,
        source_kind=ComponentSourceKind.SourceComponent,
        source_component=f"{schema}:message",
        selector=f".{field}",
    )
