"""The figure of `flowrec bench plan`: paths over the speed of the flow, and below length and time of all trips."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from flowrec.bench.figure_flow import INK, MM_PER_UM, QUIET, SOLID

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from flowrec.bench.trips import Trip, World
    from flowrec.messages import Route

# Told apart by the colour-blind (Okabe and Ito).
COLOURS = {
    "time_field": "#d55e00",
    "astar_time": "#e69f00",
    "astar_paper": "#0072b2",
    "astar_paper:8": "#56b4e9",
    "astar_length": "#009e73",
    "astar_length:8": "#88c9b5",
    "rrt": "#999999",
    "rrt_star": "#cc79a7",
}
DRAWN = ("astar_length:8", "astar_paper", "rrt", "rrt_star", "time_field")


def draw(path: Path, shown: list[tuple[World, Trip, dict[str, Route]]], rows: list[dict[str, Any]]) -> None:
    """Write a PNG. `shown` are channels with their routes upstream, `rows` those of `flowrec bench plan`."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(12.0, 10.5), layout="constrained", dpi=150)
    FigureCanvasAgg(figure)
    above, below = figure.subfigures(2, 1, squeeze=False, height_ratios=[1.1, 1.0])[:, 0]
    for ax, (world, trip, routes) in zip(above.subplots(1, 2, squeeze=False)[0], shown, strict=False):
        _paths(ax, world, trip, routes)
    columns = list(dict.fromkeys((row["ratio"], row["direction"]) for row in rows))
    axes = below.subplots(2, len(columns), squeeze=False, sharey="row")
    methods = list(dict.fromkeys(row["method"] for row in rows))
    for column, (ratio, direction) in enumerate(columns):
        some = [row for row in rows if (row["ratio"], row["direction"]) == (ratio, direction)]
        axes[0, column].set_title(f"{ratio:g} v_max, {direction}stream", fontsize=9, color=INK)
        _bars(axes[0, column], some, methods, "length_um", MM_PER_UM)
        _bars(axes[1, column], some, methods, "time_s", 1.0)
        axes[0, column].set_xticks([])
        axes[1, column].set_xticks(range(len(methods)), methods, rotation=90, fontsize=7)
    axes[0, 0].set_ylabel("path length (mm)", fontsize=8)
    axes[1, 0].set_ylabel("travel time (s)", fontsize=8)
    figure.savefig(path)


def _paths(ax: Axes, world: World, trip: Trip, routes: dict[str, Route]) -> None:
    mask = world.chip.mask
    speed = np.hypot(world.flow.velocity_um_s[..., 0], world.flow.velocity_um_s[..., 1])
    extent = (-0.5, mask.shape[1] - 0.5, mask.shape[0] - 0.5, -0.5)
    ax.set_facecolor(SOLID)
    ax.imshow(np.where(mask, speed, np.nan), cmap="Greys_r", vmin=0.0, vmax=1.0, extent=extent)
    for method in DRAWN:
        route = routes.get(method)
        if route is None or not route.reachable:
            continue
        x, y = (route.waypoints_um / world.chip.um_per_px).T
        ax.plot(x, y, color=COLOURS[method], linewidth=1.4, label=f"{method} {route.arrival_s[-1]:.1f} s")
    for point, marker in ((trip.lower_um, "o"), (trip.upper_um, "*")):
        ax.plot(*(point / world.chip.um_per_px), marker, color=INK, markersize=7, markerfacecolor="white")
    ax.set_title(f"{world.name}: upstream, fastest flow 0.9 v_max", fontsize=9, color=INK)
    ax.legend(fontsize=7, loc="best")
    ax.set_xticks([])
    ax.set_yticks([])


def _bars(ax: Axes, rows: list[dict[str, Any]], methods: list[str], name: str, scale: float) -> None:
    """Mean as a bar, every trip as a diamond; trips that were not possible are counted above."""
    for place, method in enumerate(methods):
        mine = [row for row in rows if row["method"] == method]
        values = [scale * row[name] for row in mine if row[name] is not None]
        lost = len(mine) - len(values)
        if values:
            ax.bar(place, float(np.mean(values)), color=COLOURS[method], width=0.7, alpha=0.75)
            ax.plot([place] * len(values), values, "D", color=INK, markersize=2.2, markerfacecolor="none", mew=0.4)
        if lost:
            ax.annotate(f"{lost} lost", (place, 0.02), fontsize=6, rotation=90, ha="center", color=INK)
    ax.tick_params(labelsize=7, colors=QUIET)
    for side in ("top", "right"):
        ax.spines[side].set_visible(False)
