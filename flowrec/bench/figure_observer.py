"""The figure of `flowrec bench observer`: what each observer tells of the flow, and by how much it is wrong."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from flowrec.bench.figure_flow import INK, QUIET

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Floats = NDArray[np.float64]

COLOURS = {
    "luenberger": "#b5651d",
    "luenberger, best gain": "#e0a458",
    "kalman": "#2f6f8f",
    "kalman_map": "#0a8f5c",
    "smoother": "#7a5195",
    "map alone": "#8c8c8c",
}
_SMOOTHED_FRAMES = 31  # of the error curves: a second, so that they can be told apart


def draw(path: Path, time_s: Floats, truth: Floats, curves: dict[str, Floats], rows: list[dict[str, Any]]) -> None:
    """Write a PNG: the flow's x component (n,) as told and as it is, the errors over time, and RMSE over noise.

    `truth` and each of `curves` are (n, 2) um/s at `time_s` (n,); `rows` are those of `flowrec bench observer`.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9.5, 6.4), layout="constrained", dpi=160)
    FigureCanvasAgg(figure)  # no window and no global state, unlike pyplot
    grid = figure.add_gridspec(2, 3, height_ratios=(1.0, 1.1))
    told, wrong, noise = (
        figure.add_subplot(grid[0, :]),
        figure.add_subplot(grid[1, :2]),
        figure.add_subplot(grid[1, 2]),
    )
    told.plot(time_s, truth[:, 0], color=INK, lw=2.4, label="truth")
    for name, flow in curves.items():
        colour = COLOURS[name]
        if name != "map alone":
            told.plot(time_s, flow[:, 0], color=colour, lw=0.9, alpha=0.9, label=name)
        miss = np.hypot(*(flow - truth).T)
        kernel = np.ones(_SMOOTHED_FRAMES) / _SMOOTHED_FRAMES
        half = _SMOOTHED_FRAMES // 2
        wrong.plot(time_s[half:-half], np.convolve(miss, kernel, "valid"), color=colour, lw=1.3, label=name)
    told.set_ylim(1.6 * truth[:, 0].min(), 1.6 * truth[:, 0].max())
    told.set_title("flow at the robot along x, 10 µm noise, 30 Hz", **_TITLE)
    told.set_ylabel("µm/s", fontsize=9, color=INK)
    told.legend(fontsize=8, ncols=6, frameon=False, loc="upper right")
    wrong.set_title("error of the vector, mean over a second", **_TITLE)
    wrong.set_ylabel("µm/s", fontsize=9, color=INK)
    wrong.set_xlabel("time (s)", fontsize=9, color=INK)
    wrong.set_ylim(0.0, 90.0)
    wrong.legend(fontsize=8, ncols=3, frameon=False, loc="upper right")
    levels = [5.0, 10.0, 15.0]
    for name, colour in COLOURS.items():
        values = [_rmse(rows, f"{level:g} um", name) for level in levels]
        noise.plot(levels, values, "o-", color=colour, lw=1.3, ms=4)
    noise.set_title("RMSE over position noise", **_TITLE)
    noise.set_xlabel("noise (µm)", fontsize=9, color=INK)
    noise.set_xticks(levels)
    noise.set_ylim(bottom=0.0)
    for ax in (told, wrong, noise):
        _plain(ax)
    figure.savefig(path)


_TITLE: dict[str, Any] = {"fontsize": 9.5, "color": INK, "loc": "left"}


def _rmse(rows: list[dict[str, Any]], case: str, observer: str) -> float:
    return next(float(row["rmse_um_s"]) for row in rows if (row["case"], row["observer"]) == (case, observer))


def _plain(ax: Axes) -> None:
    ax.tick_params(labelsize=8.5, colors=INK, length=0)
    ax.grid(axis="y", color="#e6e6e6", lw=0.7)
    ax.set_axisbelow(True)
    ax.spines[["top", "right", "left"]].set_visible(False)
    ax.spines["bottom"].set_color(QUIET)
