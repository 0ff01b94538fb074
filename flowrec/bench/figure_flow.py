"""The figure of `flowrec bench flow`: one case as in Fig. 4 of the paper, and the errors of all cases."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt

from flowrec.bench.figures import INK, QUIET, SOLID, new_figure, style
from flowrec.core import MM_PER_UM, Bools, Ints
from flowrec.exports import style as report_style

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import SubFigure

OBSERVED = "#0a8f9c"
SPEEDS, ERRORS = "viridis", "magma_r"  # perceptually uniform, distinguishable with colour blindness
BLOCK_PX = 11  # one arrow per block of pixels, where the channel is widest
SHORTEST = 0.12  # least speed of an arrow, over the largest one
COLUMN_IN, ROW_IN, STRIP_IN = 1.8, 2.1, 2.3  # inches, of a column, of a row and of the strip below
_TICKS = (0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0)


@dataclass(frozen=True, slots=True, eq=False)
class FlowPanels:
    """One case. Velocities are (h, w, 2) in um/s, drawn in mm/s; y points down."""

    name: str
    mask: Bools  # (h, w)
    um_per_px: float
    truth: NDArray[np.floating]
    fields: dict[str, NDArray[np.floating]]  # by method
    position_um: NDArray[np.floating]  # (n, 2) of the observations
    flow_um_s: NDArray[np.floating]  # (n, 2) observed


def median_case(rows: list[dict[str, Any]]) -> str:
    """The case whose error without refinement is the (lower) median; by the first method if fvm was not run."""
    first = "fvm" if any(row["method"] == "fvm" for row in rows) else rows[0]["method"]
    ranked = sorted((row["rmse_v"], row["case"]) for row in rows if row["method"] == first)
    return str(ranked[(len(ranked) - 1) // 2][1])


def draw(path: Path, picture: FlowPanels, rows: list[dict[str, Any]]) -> None:
    """Write the figure: the speed of the truth and of each method, their errors, and the relative RMSE of all cases.

    `rows` are those of `flowrec bench flow`, of all cases. All speeds have one colour scale, and all errors another.
    """
    figure = new_figure(COLUMN_IN * (len(picture.fields) + 1) + 0.9, 2 * ROW_IN + STRIP_IN)
    figure.get_layout_engine().set(w_pad=0.02, h_pad=0.03, wspace=0.01, hspace=0.02)  # type: ignore[union-attr,call-arg]
    above, below = figure.subfigures(2, 1, squeeze=False, height_ratios=[2 * ROW_IN, STRIP_IN], hspace=0.04)[:, 0]
    _case(above, picture, {row["method"]: row["rmse_v"] for row in rows if row["case"] == picture.name})
    _strip(below.subplots(), list(picture.fields), rows, picture.name)
    figure.savefig(path)


def _case(figure: SubFigure, picture: FlowPanels, errors: dict[str, float]) -> None:
    """Two rows of maps: speeds above, the observations and the errors below."""
    axes = figure.subplots(2, len(picture.fields) + 1, squeeze=False)
    speed_top = float(np.percentile(_length(picture.truth)[picture.mask], 99.5))
    misses = {name: _length(field - picture.truth) for name, field in picture.fields.items()}
    # With a scale up to the error of the worst method the others would be all white.
    worst = max(float(np.percentile(miss[picture.mask], 98)) for miss in misses.values())
    error_top = max(min(0.5 * speed_top, worst), 1e-6 * speed_top)
    arrows = _arrow_places(picture.mask)
    for ax in axes.flat:
        report_style.bare(ax)
    for ax, (name, field) in zip(axes[0], {"truth": picture.truth, **picture.fields}.items(), strict=True):
        speeds = _show(ax, _length(field), picture.mask, SPEEDS, speed_top)
        _arrows(ax, field, arrows, speed_top)
        ax.set_title(f"{name}\n{errors[name]:.3f}" if name in errors else name, fontsize=10, color=INK)
    _show(axes[1, 0], np.zeros(picture.mask.shape), picture.mask, "gray_r", 1.0)
    x, y = (picture.position_um / picture.um_per_px).T
    observed = _length(picture.flow_um_s)
    axes[1, 0].scatter(x, y, c=observed, cmap=SPEEDS, vmin=0.0, vmax=speed_top, s=9, linewidths=0.3, edgecolors=INK)
    axes[1, 0].set_title(f"{len(x)} observations", fontsize=9, color=INK)
    for ax, miss in zip(axes[1, 1:], misses.values(), strict=True):
        wrong = _show(ax, miss, picture.mask, ERRORS, error_top)
        ax.scatter(x, y, s=1.2, c=OBSERVED, linewidths=0.0)
    for row, (mappable, label) in enumerate(((speeds, "speed |v| (mm/s)"), (wrong, "error |v − v*| (mm/s)"))):
        bar = figure.colorbar(mappable, ax=list(axes[row]), extend="max", shrink=0.86, aspect=18, pad=0.01)
        bar.set_label(label, fontsize=9, color=INK)
        bar.ax.tick_params(labelsize=8, color=INK, labelcolor=INK)
        bar.outline.set_visible(False)
    text = f"{picture.name}: relative RMSE of v over the fluid; dots: observations"
    figure.suptitle(text, fontsize=10, color=INK, x=0.01, ha="left")


def _strip(ax: Axes, methods: list[str], rows: list[dict[str, Any]], drawn: str) -> None:
    """A column per method: a dot per case, mean and standard deviation beside them."""
    from matplotlib.ticker import NullFormatter, NullLocator

    for at, method in enumerate(methods):
        cases = [row for row in rows if row["method"] == method]
        values = np.array([row["rmse_v"] for row in cases])
        here = np.array([row["case"] == drawn for row in cases])
        # In the order of the cases, so that a case has the same place with every method.
        spread = at + np.linspace(-0.3, 0.08, len(values)) if len(values) > 1 else np.array([at - 0.11])
        ax.scatter(spread, values, s=13, color=QUIET, alpha=0.75, linewidths=0.0)
        ax.scatter(spread[here], values[here], s=26, facecolors="none", edgecolors=INK, linewidths=0.9)
        mean, std = float(values.mean()), float(values.std())
        low = max(mean - std, 0.3 * mean, 1e-4)  # above zero: the axis is logarithmic
        ax.errorbar(at + 0.2, mean, [[max(mean - low, 0.0)], [std]], fmt="o", ms=5, color="#2f6f8f", capsize=3, lw=1.4)
        beside: dict[str, Any] = {"xytext": (4, 0), "textcoords": "offset points", "va": "center"}
        ax.annotate(f"{mean:.3f}\n±{std:.3f}", (at + 0.26, mean), fontsize=7.5, color=INK, **beside)
    count = len({row["case"] for row in rows})
    style(ax, f"{count} cases, a dot each, the case above circled; mean ± standard deviation", y="relative RMSE of v")
    ax.set_yscale("log")
    errors = [max(row["rmse_v"], 1e-3) for row in rows]
    low, high = 0.75 * min(errors), 1.35 * max(errors)
    ax.set_ylim(low, high)
    ax.set_yticks([tick for tick in _TICKS if low <= tick <= high])
    ax.yaxis.set_major_formatter("{x:g}")
    ax.yaxis.set_minor_locator(NullLocator())
    ax.yaxis.set_minor_formatter(NullFormatter())
    ax.set_xticks(range(len(methods)), methods, fontsize=9, color=INK)
    ax.set_xlim(-0.5, len(methods) - 0.2)


def _show(ax: Axes, image: NDArray[np.floating], mask: Bools, colours: str, top: float) -> Any:
    """An image (h, w) of the fluid; solid is grey."""
    ax.set_facecolor(SOLID)
    return ax.imshow(np.ma.masked_array(image, ~mask), cmap=colours, vmin=0.0, vmax=top, interpolation="nearest")


def _arrows(ax: Axes, velocity: NDArray[np.floating], places: Ints, top: float) -> None:
    """Arrows at places (n, 2), row and column, where the flow is not slow; one of speed `top`, mm/s, fills a block."""
    rows, columns = places[_length(velocity[places[:, 0], places[:, 1]]) > SHORTEST * top].T
    shape: dict[str, Any] = {"width": 0.009, "headwidth": 3.6, "headlength": 4.0, "headaxislength": 3.6, "pivot": "mid"}
    scale: dict[str, Any] = {"angles": "xy", "scale_units": "xy", "scale": top / BLOCK_PX}
    ax.quiver(columns, rows, *(MM_PER_UM * velocity[rows, columns]).T, color="white", **scale, **shape)


def _arrow_places(mask: Bools) -> Ints:
    """(n, 2) row and column of the pixel farthest from the walls in each block."""
    depth = distance_transform_edt(np.pad(mask, 1, mode="edge"))[1:-1, 1:-1]
    places = []
    for top in range(0, mask.shape[0], BLOCK_PX):
        for left in range(0, mask.shape[1], BLOCK_PX):
            block = depth[top : top + BLOCK_PX, left : left + BLOCK_PX]
            row, column = np.unravel_index(int(block.argmax()), block.shape)
            if block[row, column] > 1.0:
                places.append((top + int(row), left + int(column)))
    return np.array(places, np.intp).reshape(-1, 2)


def _length(vectors: NDArray[np.floating]) -> NDArray[np.floating]:
    """Magnitude in mm/s of vectors (..., 2) in um/s."""
    return MM_PER_UM * np.linalg.norm(vectors, axis=-1)
