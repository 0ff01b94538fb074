"""Figures of `flowrec bench paper`, of its rows alone, in the form that the paper gives them: 88 and 180 mm wide.

Bars and points are means with bootstrap 95 % intervals; small marks are single cases; n is the number of cases.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from flowrec.bench.figures import colours
from flowrec.bench.harness import Results
from flowrec.bench.paper_rows import mean_of, select
from flowrec.core import MM_PER_UM, Floats, replacing
from flowrec.exports import style

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Rows = Sequence[Results]
# Table I of the paper: mean and standard deviation of the relative RMSE of v over 10 images, by our names.
PAPER_TABLE_1 = {
    "pi_unet:printed": ((0.101, 0.033), (0.102, 0.056), (0.102, 0.044)),
    "fvm": ((0.162, 0.071), (0.191, 0.122), (0.173, 0.096)),
    "ni": ((0.673, 0.214), (0.795, 0.172), (0.713, 0.197)),
    "pinn": ((0.541, 0.067), (0.575, 0.069), (0.556, 0.062)),
    "unet": ((0.865, 0.032), (0.800, 0.012), (0.665, 0.011)),
}
TABLE_1 = ("fvm", "gain", "modes", "network", "gp", "ni", "pinn", "unet", "pi_unet:printed", "pi_unet", "assimilate")
VESSELS = {"crops": "fundus crops", "drawn": "drawn vessels", "openfoam": "OpenFOAM vessels"}
WAYS = {"down": (style.BLUE, "downstream"), "up": (style.VERMILLION, "upstream")}
_SPEEDS = "viridis"
_LAWS = {"paper, with compensation": "compensated", "paper, without": "without", "paper, with observer": "by observer"}


def refinements(rows: Rows, vessels: str) -> list[Results]:
    """The rows of Table I of a kind of vessels."""
    return [row for name in (f"table_1_{vessels}", f"table_1_{vessels}_dear") for row in select(rows, name)]


def table_1(rows: Rows, figure: Figure) -> None:
    """Relative RMSE of the velocity by method, a panel for each kind of vessels; hollow: the paper's."""
    kinds = [kind for kind in VESSELS if refinements(rows, kind)]
    axes = figure.subplots(len(kinds), 1, sharex=True, squeeze=False)[:, 0]
    for ax, kind in zip(axes, kinds, strict=True):
        mine = refinements(rows, kind)
        for at, method in enumerate(TABLE_1):
            some = [row for row in mine if row["method"] == method]
            _spread(ax, at, some, "error", style.BLUE)
            if method in PAPER_TABLE_1:
                mean, std = PAPER_TABLE_1[method][2]
                ax.errorbar(at + 0.3, mean, std, fmt="s", ms=3, mfc="white", color=style.QUIET, lw=0.8, capsize=1.5)
        ax.set_yscale("log")
        ax.set_ylim(0.005, 2.0)
        ax.yaxis.set_major_formatter("{x:g}")
        ax.set_ylabel("relative RMSE of v")
        counts = [sum(row["method"] == method for row in mine) for method in TABLE_1]
        ax.set_title(f"{VESSELS[kind]}, n = {_range(counts)} a method; squares: the paper, mean ± std")
    axes[-1].set_xticks(range(len(TABLE_1)), TABLE_1, rotation=45, ha="right", rotation_mode="anchor")


def flow_maps(rows: Rows, figure: Figure) -> None:
    """Fig. 4: the true speed and that of each method, from 0 to 1, and each relative RMSE."""
    kinds = [kind for kind in VESSELS if any("truth" in row for row in refinements(rows, kind))]
    width = 4 if _is_narrow(figure) else 6
    blocks = figure.subfigures(len(kinds), 1, squeeze=False)[:, 0]
    for block, kind in zip(blocks, kinds, strict=True):
        found = {row["method"]: row for row in refinements(rows, kind) if "truth" in row}
        names = [name for name in TABLE_1 if name in found]
        axes = block.subplots(-(-(len(names) + 1) // width), width, squeeze=False)
        for ax in axes.flat:
            style.bare(ax)
        first = found[names[0]]
        _show(axes.flat[0], first["truth"], first["image_width"])
        axes.flat[0].set_title("truth")
        for ax, name in zip(axes.flat[1:], names, strict=False):
            _show(ax, found[name]["image"], found[name]["image_width"])
            ax.set_title(f"{name}\n{found[name]['error']:.3f}", pad=1.5)
        block.suptitle(VESSELS[kind], x=0.01, ha="left", fontsize=7)


def plan_bars(rows: Rows, figure: Figure) -> None:
    """Fig. 5: path length and travel time at full speed, bars and diamonds as in the paper."""
    trips = select(rows, "planning", ratio=0.9)
    names = list(dict.fromkeys(row["planner"] for row in trips))
    colour = colours(names)
    axes = figure.subplots(2, 2, sharex="col", sharey="row")
    for (length, time), (way, (_, label)) in zip(axes.T, WAYS.items(), strict=True):
        for ax, key, scale in ((length, "length_um", MM_PER_UM), (time, "time_s", 1.0)):
            for at, name in enumerate(names):
                mine = select(trips, "planning", way=way, planner=name)
                values = [scale * row[key] for row in mine if row.get(key) is not None]
                if values:
                    ax.bar(at, float(np.mean(values)), 0.7, color=colour[name], alpha=0.75)
                    ax.plot([at] * len(values), values, "D", ms=2, mfc="none", mew=0.4, color=style.INK)
                if lost := len(mine) - len(values):
                    ax.annotate(f"{lost} lost", (at, 0.0), fontsize=5.5, rotation=90, ha="center", va="bottom")
        length.set_title(f"{label}, n = {len({row['seed'] for row in trips})}")
        time.set_xticks(range(len(names)), names, rotation=45, ha="right", rotation_mode="anchor")
    axes[0, 0].set_ylabel("path length (mm)")
    axes[1, 0].set_ylabel("travel time (s)")


def plan_paths(rows: Rows, figure: Figure) -> None:
    """Fig. 6: the paths of one network, downstream and upstream, above the speed of the flow."""
    trips = [row for row in select(rows, "planning", ratio=0.9) if "trace_x_um" in row]
    colour = colours(row["planner"] for row in trips)
    axes = figure.subplots(1, 2)
    for ax, (way, (_, label)) in zip(axes, WAYS.items(), strict=True):
        mine = [row for row in trips if row["way"] == way]
        if mine:
            _show(ax, mine[0]["image"], mine[0]["image_width"], mine[0]["um_per_px"], "Greys")
        for row in mine:
            x, y = _in_mm(row, "trace")
            ax.plot(x, y, color=colour[row["planner"]], lw=0.9, label=f"{row['planner']} {row['time_s']:.1f} s")
        ax.set_title(label)
        _legend_below(ax, figure)


def tracking(rows: Rows, figure: Figure) -> None:
    """Fig. 7 and 8: paths of the paper's three laws, their errors, and dashed the error of the observed flow."""
    flown = {law: select(rows, "tracking_ideal", law=law)[:1] for law in _LAWS}
    shown = {law: found[0] for law, found in flown.items() if found}
    path, error = figure.subplots(2, 1, height_ratios=(1.2, 1.0)) if _is_narrow(figure) else figure.subplots(1, 2)
    for (law, row), colour in zip(shown.items(), (style.BLUE, style.VERMILLION, style.GREEN), strict=False):
        x, y = _in_mm(row, "trace")
        path.plot(x, y, color=colour, lw=0.8, label=_LAWS[law])
        path.plot(x[0], y[0], "o", ms=3, color=style.INK)
        time = np.asarray(row["trace_s"])
        error.semilogy(time, np.maximum(row["trace_error_um"], 0.1), color=colour, lw=0.8)
        if law == "paper, with observer":
            error.semilogy(time, np.maximum(row["trace_miss_um_s"], 0.1), "--", color=colour, lw=0.7)
    path.set(aspect="equal", xlabel="x (mm)", ylabel="y (mm)")
    path.invert_yaxis()  # as in images
    style.legend_above(path, 3)
    error.set(xlabel="time (s)", ylabel="error (µm); dashed: flow (µm/s)")
    error.yaxis.set_major_formatter("{x:g}")


def mission_paths(rows: Rows, figure: Figure) -> None:
    """Fig. 10: the way of the robot through the bifurcation, downstream and upstream, with the refined flow."""
    maps = [row for row in select(rows, "survey", chip="bifurcation", sampler="trimmed") if "image" in row]
    axes = figure.subplots(len(maps), 2, squeeze=False)
    for line, known in zip(axes, maps, strict=True):
        name = "missions" if known["world"] == "moderate" else "missions_kind"
        for ax, (way, (_, label)) in zip(line, WAYS.items(), strict=True):
            _show(ax, known["image"], known["image_width"], known["um_per_px"])
            shown = [row for row in select(rows, name, chip="bifurcation", way=way) if row.get("trace_x_um")]
            colour = colours(row["navigation"] for row in shown)
            for row in shown:
                x, y = _in_mm(row, "trace")
                ended = f"{row['time_s']:.0f} s" if row["reached"] else row["outcome"]
                ax.plot(x, y, color=colour[row["navigation"]], lw=0.9, label=f"{row['navigation']}: {ended}")
            ax.set_title(f"{known['world']}, {label}")
            _legend_below(ax, figure)


def mission_times(rows: Rows, figure: Figure) -> None:
    """Time to the goal of each way to navigate, by chip and world; missions that did not arrive are counted."""
    names = ("missions", "missions_kind", "missions_untrimmed", "laws")
    flown = [row for name in names for row in select(rows, name)]
    panels = list(dict.fromkeys((row["chip"], row["world"], row["sampler"]) for row in flown))
    columns = 1 if _is_narrow(figure) else 2
    axes = figure.subplots(-(-len(panels) // columns), columns, squeeze=False)
    for ax in axes.flat[len(panels) :]:
        ax.set_visible(False)
    for ax, panel in zip(axes.flat, panels, strict=False):
        mine = [row for row in flown if (row["chip"], row["world"], row["sampler"]) == panel]
        navigations = list(dict.fromkeys(row["navigation"] for row in mine))
        for at, navigation in enumerate(navigations):
            for way, (colour, _) in WAYS.items():
                some = [row for row in mine if row["navigation"] == navigation and row["way"] == way]
                place = at + (-0.15 if way == "down" else 0.15)
                _spread(ax, place, some, "time_s", colour)
                if lost := sum(not row["reached"] for row in some):
                    ax.annotate(f"{lost}×", (place, 0.98), xycoords=("data", "axes fraction"), ha="center", va="top")
        ax.set_ylim(0.0, 1.15 * max((row["time_s"] for row in mine if row.get("time_s")), default=1.0))
        count = len({row["seed"] for row in mine})
        ax.set_title(f"{panel[0]}, {panel[1]}, {panel[2]}, n ≤ {count}")
        ax.set_ylabel("time to the goal (s)")
        ax.set_xticks(range(len(navigations)), navigations, rotation=30, ha="right", rotation_mode="anchor")
    figure.suptitle("blue: downstream; red: upstream; ×: did not arrive", fontsize=7, x=0.01, ha="left")


def survey(rows: Rows, figure: Figure) -> None:
    """Fig. 11: the flow that the observer estimates, the observations as they are trimmed, and the refined flow."""
    found = [row for row in select(rows, "survey", chip="bifurcation", sampler="trimmed") if "image" in row]
    axes = figure.subplots(len(found), 3, squeeze=False) if not _is_narrow(figure) else figure.subplots(3, len(found))
    for (time, seen, refined), row in zip(axes if not _is_narrow(figure) else np.transpose(axes), found, strict=True):
        time.plot(row["trace_s"], MM_PER_UM * np.asarray(row["trace_um_s"]), color=style.BLUE, lw=0.8)
        time.set(title=f"(a) {row['world']}: estimated", xlabel="time (s)", ylabel="speed (mm/s)")
        x, y = _in_mm(row, "seen")
        top = MM_PER_UM * row["top_um_s"]
        dots = seen.scatter(x, y, c=MM_PER_UM * np.asarray(row["seen_um_s"]), s=5, cmap=_SPEEDS, vmin=0.0, vmax=top)
        height, width = np.multiply(_pixels(row["image"], row["image_width"]).shape, MM_PER_UM * row["um_per_px"])
        seen.set(title="(b) observations", xlabel="x (mm)", ylabel="y (mm)", aspect="equal")
        seen.set(xlim=(0.0, width), ylim=(height, 0.0))  # y points down
        _show(refined, row["image"], row["image_width"], row["um_per_px"])
        refined.set_title(f"(c) refined: {row['refined_error']:.3f}")
        style.bare(refined)
        below = _is_narrow(figure)
        place = {"ax": refined, "orientation": "horizontal"} if below else {"ax": [seen, refined], "shrink": 0.7}
        figure.colorbar(dots, label="mm/s", **place)


def sensitivity(varied: str, vessels: str, label: str, *, log: bool) -> Callable[[Rows, Figure], None]:
    """The drawing of a study: error of each method over what was varied, its interval as a band."""

    def draw(rows: Rows, figure: Figure) -> None:
        mine, ax = select(rows, f"sens_{varied}"), figure.subplots()
        for method, colour in colours(row["method"] for row in mine).items():
            levels = sorted({row["level"] for row in mine})
            found = [
                mean_of([row for row in mine if (row["method"], row["level"]) == (method, x)], "error") for x in levels
            ]
            ax.plot(levels, [one["mean"] for one in found], "o-", ms=3, color=colour, label=method)
            low, high = np.transpose([one["interval_95"] for one in found])
            ax.fill_between(levels, low, high, color=colour, alpha=0.15, lw=0)
        if log:
            ax.set_xscale("log")
            ax.set_xticks(levels, [f"{x:g}" for x in levels], minor=False)
            ax.minorticks_off()
        ax.set(xlabel=f"{label}; {vessels}, n = {len({row['seed'] for row in mine})}", ylabel="relative RMSE of v")
        ax.set_ylim(bottom=0.0)
        style.legend_above(ax)

    return draw


def ablation(rows: Rows, figure: Figure) -> None:
    """Error without each term of PI-UNet's loss; the dashed line is the solver's field that all start from."""
    mine, ax = select(rows, "ablation"), figure.subplots()
    names = list(dict.fromkeys(row["method"] for row in mine))
    for at, name in enumerate(names):
        _spread(ax, at, [row for row in mine if row["method"] == name], "error", style.BLUE)
    seeds = {row["seed"] for row in mine}
    start = [row for row in select(rows, "table_1_drawn", method="fvm") if row["seed"] in seeds]
    if start:
        ax.axhline(mean_of(start, "error")["mean"], color=style.QUIET, ls="--", lw=0.8)
    ax.set_xticks(range(len(names)), names, rotation=45, ha="right", rotation_mode="anchor")
    ax.set(ylabel="relative RMSE of v", title=f"drawn vessels, n = {len(seeds)}; dashed: the initial field")
    ax.set_ylim(bottom=0.0)


# By name: the experiments without whose rows there is nothing to draw, the drawing, heights in mm of 88 and 180 mm.
FIGURES: dict[str, tuple[str, Callable[[Rows, Figure], None], tuple[float, float]]] = {
    "table_1": ("table_1_drawn", table_1, (140.0, 140.0)),
    "fig_4": ("table_1_drawn", flow_maps, (230.0, 210.0)),
    "fig_5": ("planning", plan_bars, (100.0, 100.0)),
    "fig_6": ("planning", plan_paths, (75.0, 105.0)),
    "fig_7_8": ("tracking_ideal", tracking, (120.0, 70.0)),
    "fig_10": ("survey", mission_paths, (110.0, 150.0)),
    "missions": ("missions", mission_times, (260.0, 190.0)),
    "fig_11": ("survey", survey, (125.0, 90.0)),
    "sens_share": (
        "sens_share",
        sensitivity("share", "drawn", "observed share of the skeleton", log=True),
        (65.0, 80.0),
    ),
    "sens_noise": ("sens_noise", sensitivity("noise", "drawn", "noise over the rms speed", log=False), (65.0, 80.0)),
    "sens_inlets": ("sens_inlets", sensitivity("inlets", "drawn", "error of inlet speeds", log=False), (65.0, 80.0)),
    "sens_viscosity": (
        "sens_viscosity",
        sensitivity("viscosity", "drawn", "assumed over true viscosity", log=True),
        (65.0, 80.0),
    ),
    "sens_mesh": ("sens_mesh", sensitivity("mesh", "OpenFOAM", "cells per pixel side", log=True), (65.0, 80.0)),
    "ablation": ("ablation", ablation, (85.0, 85.0)),
}


def draw(name: str, rows: Rows, width_mm: float) -> bytes:
    """A figure of FIGURES as PDF."""
    with style.drawing():
        return style.as_pdf(_figure_of(name, rows, width_mm), name)


def _figure_of(name: str, rows: Rows, width_mm: float) -> Figure:
    _, drawing, heights = FIGURES[name]
    figure = style.new_figure(width_mm, heights[width_mm != style.NARROW_MM])
    drawing(rows, figure)
    return figure


def picture(name: str, rows: Rows, path: Path, width_mm: float = style.WIDE_MM, dpi: int = style.PAGE_DPI) -> Path:
    """Write a figure as PNG."""
    with style.drawing():
        _figure_of(name, rows, width_mm).savefig(path, format="png", dpi=dpi)
    return path


def write_figures(rows: Rows, folder: Path) -> list[str]:
    """Write each figure that there are rows for as PDF and PNG of both widths; the names of those."""
    names = [name for name, (experiment, _, _) in FIGURES.items() if select(rows, experiment)]
    for name in names:
        for width_mm in style.WIDTHS_MM:
            with replacing(folder / f"{name}_{width_mm:.0f}mm.pdf") as part:
                part.write_bytes(draw(name, rows, width_mm))
            with replacing(folder / f"{name}_{width_mm:.0f}mm.png") as part:
                picture(name, rows, part, width_mm, style.PAPER_DPI)
    return names


def _spread(ax: Axes, at: float, rows: Rows, key: str, colour: str) -> None:
    """Each value as a small dot, their mean and its interval."""
    values = [row[key] for row in rows if row.get(key) is not None]
    if not values:
        return
    found = mean_of(rows, key)
    low, high = found["interval_95"]
    ax.plot(np.full(len(values), at - 0.08), values, ".", ms=2.5, color=style.QUIET, alpha=0.6, mew=0)
    error = [[found["mean"] - low], [high - found["mean"]]]
    ax.errorbar(at + 0.08, found["mean"], error, fmt="o", ms=3, color=colour, lw=1.0, capsize=1.5)


def _show(ax: Axes, image: Iterable[float], width: int, um_per_px: float = 0.0, colour_map: str = _SPEEDS) -> None:
    """An image of the rows: speeds from 0 to 1, solid grey; in mm if `um_per_px` is given."""
    pixels = _pixels(image, width)
    px = MM_PER_UM * um_per_px if um_per_px else 1.0
    extent = (-0.5 * px, (pixels.shape[1] - 0.5) * px, (pixels.shape[0] - 0.5) * px, -0.5 * px)
    ax.set_facecolor(style.SOLID)
    shown = np.ma.masked_less(pixels, 0.0)
    ax.imshow(shown, cmap=colour_map, vmin=0.0, vmax=1.0, extent=extent, interpolation="nearest")


def _pixels(image: Iterable[float], width: int) -> Floats:
    return np.asarray(image, np.float64).reshape(-1, int(width))


def _in_mm(row: Results, what: str) -> tuple[Floats, Floats]:
    """X and y of a path of a row."""
    x, y = (MM_PER_UM * np.asarray(row[f"{what}_{axis}_um"]) for axis in "xy")
    return x, y


def _legend_below(ax: Axes, figure: Figure) -> None:
    """The legend of a map, which has no axes."""
    ax.legend(fontsize=5.5, loc="upper center", bbox_to_anchor=(0.5, 0.0), ncols=1 if _is_narrow(figure) else 2)
    style.bare(ax)


def _is_narrow(figure: Figure) -> bool:
    return bool(figure.get_figwidth() * style.MM_PER_INCH <= style.NARROW_MM + 0.5)


def _range(counts: Sequence[Any]) -> str:
    low, high = min(counts), max(counts)
    return f"{low}" if low == high else f"{low} to {high}"
