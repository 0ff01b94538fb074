"""The figure of `flowrec bench track`: the paper's three ways to track, and beside them ours with everything wrong."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from flowrec.bench.figure_flow import INK, MM_PER_UM, QUIET
from flowrec.bench.lemniscate import PERIOD_S, Flight

if TYPE_CHECKING:
    from matplotlib.axes import Axes

COLOURS = ("#0a8f9c", "#d1495b", "#edae49")  # told apart by the colour-blind
_LEAST_UM = 0.1  # of the logarithmic axis


def draw(path: Path, curve_um: NDArray[np.floating], first: dict[str, Flight], ours: dict[str, Flight]) -> None:
    """Write a PNG: above the ways, below the errors; left `first` in an ideal world, right `ours` in a worse one.

    `curve_um` (n, 2) is the reference; flights are by name; all in um about the curve's middle.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9.5, 6.4), layout="constrained", dpi=160)
    FigureCanvasAgg(figure)  # no window and no global state, unlike pyplot
    axes = figure.subplots(2, 2, height_ratios=[1.35, 1.0], sharey="row")
    titles = ("the paper's three, ideal", "40 ms latency, 10 um noise, flow map 10 % too strong")
    for column, (title, flights) in enumerate(zip(titles, (first, ours), strict=True)):
        _ways(axes[0, column], curve_um, flights)
        axes[0, column].set_title(title, color=INK, fontsize=10)
        _errors(axes[1, column], flights)
    axes[0, 0].set_ylabel("y, mm", color=INK)
    axes[1, 0].set_ylabel("error, um", color=INK)
    figure.savefig(path)


def _ways(axes: Axes, curve_um: NDArray[np.floating], flights: dict[str, Flight]) -> None:
    axes.plot(*(MM_PER_UM * curve_um.T), color=QUIET, linestyle="--", linewidth=1.0, label="reference")
    for (name, flight), colour in zip(flights.items(), COLOURS, strict=True):
        axes.plot(*(MM_PER_UM * flight.position_um.T), color=colour, linewidth=1.0, label=name)
    start = MM_PER_UM * next(iter(flights.values())).position_um[0]
    axes.plot(*start, "o", color=INK, markersize=4)
    axes.set_aspect("equal")
    axes.set_xlabel("x, mm", color=INK)
    axes.legend(fontsize=7, loc="upper center", ncols=2, frameon=False)
    axes.set_ylim(-1.25, 1.25)
    axes.invert_yaxis()  # y is down, as in every image


def _errors(axes: Axes, flights: dict[str, Flight]) -> None:
    for flight, colour in zip(flights.values(), COLOURS, strict=True):
        axes.semilogy(flight.time_s, np.maximum(flight.error_um, _LEAST_UM), color=colour, linewidth=0.8)
    axes.axvline(PERIOD_S, color=QUIET, linewidth=0.6)
    axes.set_xlabel("time, s", color=INK)
    axes.set_xlim(0.0, 2 * PERIOD_S)
    axes.grid(axis="y", color=QUIET, alpha=0.3, linewidth=0.5)
