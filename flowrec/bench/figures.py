"""Figures of `flowrec bench plan`, `observer`, `track` and `missions`, and the style of all figures."""

from __future__ import annotations

from collections.abc import Iterable
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from flowrec.core import MM_PER_UM, Floats
from flowrec.exports import style as report_style

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from flowrec.bench.lemniscate import LemniscateRun
    from flowrec.bench.trips import Trip, TripCase
    from flowrec.core import Route

SOLID = "#d4d4d4"
INK = "#262626"
QUIET = "#8c8c8c"
MM_PER_INCH = report_style.MM_PER_INCH
# Distinguishable with colour blindness (Okabe and Ito), then lighter and darker ones.
_PALETTE = (
    "#d55e00", "#e69f00", "#0072b2", "#56b4e9", "#009e73", "#88c9b5", "#999999", "#cc79a7", "#7a5195", "#5c4a1f",
)  # fmt: skip
_AVERAGED_FRAMES = 31  # of the error curves of observers: one second, so that the curves can be distinguished
_LEAST_ERROR_UM = 0.1  # of a logarithmic axis
_WAYS = (("down", "with the flow", "#0072b2", -0.16), ("up", "against it", "#d55e00", 0.16))
_LARGEST_RATIO = 3.0  # of arrival times in the figure; larger ones are drawn at the edge


def new_figure(width_in: float, height_in: float) -> Figure:
    """An empty figure without a window and without pyplot's global state."""
    return report_style.new_figure(MM_PER_INCH * width_in, MM_PER_INCH * height_in, dpi=160)


def style(ax: Axes, title: str = "", x: str = "", y: str = "", *, grid: bool = True) -> None:
    """Title and axis labels in the style of all figures: no frame, horizontal grid lines behind the data."""
    ax.set_title(title, fontsize=9.5, color=INK, loc="left")
    ax.set_xlabel(x, fontsize=9, color=INK)
    ax.set_ylabel(y, fontsize=9, color=INK)
    ax.tick_params(labelsize=8.5, colors=INK, length=0)
    if grid:
        ax.grid(axis="y", color="#e6e6e6", lw=0.7)
    ax.set_axisbelow(True)
    ax.spines[["top", "right", "left"]].set_visible(False)
    ax.spines["bottom"].set_color(QUIET)


def colours(names: Iterable[str]) -> dict[str, str]:
    """A colour for each name, in order."""
    return {name: _PALETTE[number % len(_PALETTE)] for number, name in enumerate(dict.fromkeys(names))}


def draw_plan(path: Path, examples: list[tuple[TripCase, Trip, dict[str, Route]]], rows: list[dict[str, Any]]) -> None:
    """Routes upstream in two channels; path length and travel time of all trips (rows of `flowrec bench plan`)."""
    methods = list(dict.fromkeys(row["method"] for row in rows))
    colour = colours(methods)
    figure = new_figure(12.0, 10.5)
    above, below = figure.subfigures(2, 1, squeeze=False, height_ratios=[1.1, 1.0])[:, 0]
    for ax, (world, trip, routes) in zip(above.subplots(1, 2, squeeze=False)[0], examples, strict=False):
        mask, px = world.chip.mask, world.chip.um_per_px
        ax.set_facecolor(SOLID)
        speed = np.linalg.norm(world.flow.velocity_um_s, axis=-1)
        ax.imshow(np.where(mask, speed, np.nan), cmap="Greys_r", vmin=0, vmax=1)
        for method, route in reversed(routes.items()):  # time_field on top
            if route.reachable:
                label = f"{method} {route.lasts_s:.1f} s"
                ax.plot(*(route.waypoints_um / px).T, color=colour[method], linewidth=1.4, label=label)
        for point, marker in ((trip.lower_um, "o"), (trip.upper_um, "*")):
            ax.plot(*(point / px), marker, color=INK, markersize=7, markerfacecolor="white")
        ax.set_title(f"{world.name}: upstream, fastest flow 0.9 of the robot's speed", fontsize=9, color=INK)
        ax.legend(fontsize=7, loc="best")
        report_style.bare(ax)
    regimes = list(dict.fromkeys((row["ratio"], row["direction"]) for row in rows))
    axes = below.subplots(2, len(regimes), squeeze=False, sharey="row")
    for column, (ratio, direction) in enumerate(regimes):
        mine = [row for row in rows if (row["ratio"], row["direction"]) == (ratio, direction)]
        for ax, key, scale in ((axes[0, column], "length_um", MM_PER_UM), (axes[1, column], "time_s", 1.0)):
            _bars(ax, {method: [row[key] for row in mine if row["method"] == method] for method in methods}, scale)
        axes[0, column].set_title(f"{ratio:g} of its speed, {direction}stream", fontsize=9, color=INK)
        axes[0, column].set_xticks([])
        axes[1, column].set_xticks(range(len(methods)), methods, rotation=90, fontsize=7)
    axes[0, 0].set_ylabel("path length (mm)", fontsize=8)
    axes[1, 0].set_ylabel("travel time (s)", fontsize=8)
    figure.savefig(path)


def _bars(ax: Axes, values: dict[str, list[float | None]], scale: float) -> None:
    """The mean as a bar and each trip as a diamond, by method; the number of trips without a route."""
    style(ax, grid=False)
    for place, (method, colour) in enumerate(colours(values).items()):
        known = [scale * value for value in values[method] if value is not None]
        if known:
            ax.bar(place, float(np.mean(known)), color=colour, width=0.7, alpha=0.75)
            ax.plot([place] * len(known), known, "D", color=INK, markersize=2.2, markerfacecolor="none", mew=0.4)
        if lost := len(values[method]) - len(known):
            ax.annotate(f"{lost} lost", (place, 0.02), fontsize=6, rotation=90, ha="center", color=INK)


def draw_observer(
    path: Path,
    time_s: Floats,
    truth: Floats,
    estimates: dict[str, Floats],
    rmse: dict[str, dict[float, float]],
) -> None:
    """Estimated and true flow (n, 2) in um/s at `time_s` (n,), the errors, and RMSE by observer and noise in um."""
    colour = colours(rmse)
    figure = new_figure(9.5, 6.4)
    grid = figure.add_gridspec(2, 3, height_ratios=(1.0, 1.1))
    flow, error, noise = (figure.add_subplot(grid[place]) for place in ((0, slice(None)), (1, slice(2)), (1, 2)))
    flow.plot(time_s, truth[:, 0], color=INK, lw=2.4, label="truth")
    kernel, half = np.ones(_AVERAGED_FRAMES) / _AVERAGED_FRAMES, _AVERAGED_FRAMES // 2
    for name, estimated in sorted(estimates.items(), key=lambda item: -float(np.std(item[1] - truth))):
        if name == "no observer":
            continue
        if name != "map alone":
            flow.plot(time_s, estimated[:, 0], color=colour[name], lw=0.9, alpha=0.9, label=name)
        average = np.convolve(np.hypot(*(estimated - truth).T), kernel, "valid")
        error.plot(time_s[half:-half], average, color=colour[name], lw=1.3, label=name)
    flow.set_ylim(1.6 * truth[:, 0].min(), 1.6 * truth[:, 0].max())
    error.set_ylim(0.0, 90.0)
    for name, by_noise in rmse.items():
        if name != "no observer":
            noise.plot(list(by_noise), list(by_noise.values()), "o-", color=colour[name], lw=1.3, ms=4)
            noise.set_xticks(list(by_noise))
    noise.set_ylim(bottom=0.0)
    style(flow, "flow at the robot along x, 10 µm noise, 30 Hz", y="µm/s")
    style(error, "error of the flow vector, average over 1 s", "time (s)", "µm/s")
    style(noise, "RMSE by position noise", "noise (µm)")
    for ax, columns in ((flow, 6), (error, 3)):
        ax.legend(fontsize=8, ncols=columns, frameon=False, loc="upper right")
    figure.savefig(path)


def draw_track(path: Path, curve_um: Floats, panels: dict[str, dict[str, LemniscateRun]], period_s: float) -> None:
    """Paths and errors, a column per panel: its title, flights by law; `curve_um` (n, 2) is the reference."""
    figure = new_figure(9.5, 6.4)
    axes = figure.subplots(2, len(panels), height_ratios=[1.35, 1.0], sharey="row", squeeze=False)
    for (above, below), (title, flights) in zip(axes.T, panels.items(), strict=True):
        above.plot(*(MM_PER_UM * curve_um.T), color=QUIET, linestyle="--", linewidth=1.0, label="reference")
        for name, colour in colours(flights).items():
            flight = flights[name]
            above.plot(*(MM_PER_UM * flight.position_um.T), color=colour, linewidth=1.0, label=name)
            below.semilogy(flight.time_s, np.maximum(flight.error_um, _LEAST_ERROR_UM), color=colour, linewidth=0.8)
        above.plot(*(MM_PER_UM * next(iter(flights.values())).position_um[0]), "o", color=INK, markersize=4)
        above.set_aspect("equal")
        above.set_ylim(1.25, -1.25)  # y points down, as in images
        above.legend(fontsize=7, loc="upper center", ncols=2, frameon=False)
        below.axvline(period_s, color=QUIET, linewidth=0.6)
        below.set_xlim(0.0, 2 * period_s)
        style(above, title, "x (mm)", "y (mm)", grid=False)
        style(below, "", "time (s)", "error (µm)")
    figure.savefig(path)


def draw_missions(path: Path, results: dict[str, Any]) -> None:
    """Arrival time over the least time by policy, a row of panels per world, one per map; trips are joined.

    Failures and contacts are counted.
    """
    rows, worlds = results["rows"], list(results["summary"])
    policies = list(results["summary"][worlds[0]])
    maps = list(dict.fromkeys(row["map"] for row in rows))
    figure = new_figure(1.5 + 1.35 * len(policies) * len(maps), 0.9 + 3.5 * len(worlds))
    axes = figure.subplots(len(worlds), len(maps), sharey=True, squeeze=False)
    for ax, (world, known) in zip(axes.flat, product(worlds, maps), strict=True):
        for way, label, colour, shift in _WAYS:
            mine = [row for row in rows if (row["world"], row["map"], row["way"]) == (world, known, way)]
            for seed in sorted({row["seed"] for row in mine}):
                ratio = {row["policy"]: row["ratio"] for row in mine if row["seed"] == seed}
                places = [at + shift for at, name in enumerate(policies) if ratio.get(name) is not None]
                shown = [min(ratio[name], _LARGEST_RATIO) for name in policies if ratio.get(name) is not None]
                ax.plot(places, shown, color=colour, alpha=0.15, lw=0.7)
                ax.scatter(places, shown, s=9, color=colour, alpha=0.6, linewidths=0.0)
            for at, name in enumerate(policies):
                some = [row for row in mine if row["policy"] == name]
                if ratios := [row["ratio"] for row in some if row["ratio"] is not None]:
                    ends = [at + shift - 0.12, at + shift + 0.12]
                    median = min(float(np.median(ratios)), _LARGEST_RATIO)
                    ax.plot(ends, [median] * 2, color=colour, lw=2.2, label=label if at == 0 else None)
                failed = sum(row["outcome"] not in ("reached", "unreachable", "refused") for row in some)
                touched = sum(row["contacts"] > 0 for row in some)
                note = " ".join([f"{failed}×"] * bool(failed) + [f"{touched}▮"] * bool(touched))
                place = (at + shift, _LARGEST_RATIO)
                ax.annotate(note, place, ha="center", va="top", fontsize=8, color=colour)
        ax.axhline(1.0, color=INK, lw=0.8)
        ax.axhline(1.1, color=QUIET, lw=0.8, ls=":")
        style(ax, f"{world}, on the {known} map", grid=False)
        ax.set_xticks(range(len(policies)), policies, fontsize=9, color=INK)
        ax.set_xlim(-0.5, len(policies) - 0.5)
        ax.set_ylim(0.9, _LARGEST_RATIO)
    for ax in axes[:, 0]:
        ax.set_ylabel("arrival time / least time in the true flow", fontsize=9, color=INK)
    axes[0, 0].legend(fontsize=8, frameon=False, loc="upper left")
    text = f"{results['seeds']} seeds, coils {results['coils']}; bars: medians, "
    figure.suptitle(f"{text}lines: one trip; × failed, ▮ touched a wall", fontsize=8.5, color=INK, x=0.01, ha="left")
    figure.savefig(path)
