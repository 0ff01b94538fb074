"""The figure of `flowrec bench flow`: one case as in the paper's Fig. 4, and the errors of all cases below it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt

if TYPE_CHECKING:
    from matplotlib.axes import Axes

SOLID = "#d4d4d4"
INK = "#262626"
QUIET = "#8c8c8c"
SEEN = "#0a8f9c"
SPEEDS, ERRORS = "viridis", "magma_r"  # uniform in lightness, and told apart by the colour-blind
BLOCK_PX = 11  # one arrow in each block of so many pixels, where the channel is widest
SHORTEST = 0.12  # share of the fastest speed from which on there are arrows
COLUMN_IN, ROW_IN, STRIP_IN = 1.8, 2.1, 2.3
MM_PER_UM = 1e-3
_TICKS = (0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0)


@dataclass(frozen=True, slots=True, eq=False)
class Picture:
    """What is drawn of one case. Velocities (h, w, 2) in um/s, y down."""

    name: str
    mask: NDArray[np.bool_]  # (h, w)
    um_per_px: float
    truth: NDArray[np.floating]
    fields: dict[str, NDArray[np.floating]]  # by method
    position_um: NDArray[np.floating]  # (n, 2) of the observations
    flow_um_s: NDArray[np.floating]  # (n, 2) what was measured there


def median_case(rows: list[dict[str, Any]]) -> str:
    """The case whose error without refinement is the (lower) median; by the first method where fvm was not run."""
    first = "fvm" if any(row["method"] == "fvm" for row in rows) else rows[0]["method"]
    ranked = sorted((row["rmse_v"], row["case"]) for row in rows if row["method"] == first)
    return str(ranked[(len(ranked) - 1) // 2][1])


def draw(path: Path, picture: Picture, rows: list[dict[str, Any]]) -> None:
    """Write a PNG: truth and each method's speed, what each gets wrong, and the relative RMSE of several cases.

    `rows` are those of `flowrec bench flow`, of all cases. One colour scale serves all speeds, one all errors.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    methods = list(picture.fields)
    errors = {row["method"]: row["rmse_v"] for row in rows if row["case"] == picture.name}
    columns = len(methods) + 1
    several = len({row["case"] for row in rows}) > 1
    size = (COLUMN_IN * columns + 0.9, 2 * ROW_IN + STRIP_IN * several)
    figure = Figure(figsize=size, layout="constrained", dpi=160)
    figure.get_layout_engine().set(w_pad=0.02, h_pad=0.03, wspace=0.01, hspace=0.02)  # type: ignore[union-attr,call-arg]
    FigureCanvasAgg(figure)  # no window and no global state, unlike pyplot
    heights = [2 * ROW_IN, STRIP_IN] if several else [1.0]
    above, *below = figure.subfigures(len(heights), 1, squeeze=False, height_ratios=heights, hspace=0.04)[:, 0]
    axes = above.subplots(2, columns, squeeze=False)
    picture, unit = _in_readable_units(picture)
    speed_top = float(np.percentile(_length(picture.truth)[picture.mask], 99.5))
    misses = {name: _length(field - picture.truth) for name, field in picture.fields.items()}
    # A scale that the worst method sets would show nothing of the others.
    worst = max(float(np.percentile(miss[picture.mask], 98)) for miss in misses.values())
    error_top = max(min(0.5 * speed_top, worst), 1e-6 * speed_top)
    arrows = _arrow_places(picture.mask)
    for ax in axes.flat:
        _bare(ax)
    speeds = _show(axes[0, 0], _length(picture.truth), picture.mask, SPEEDS, speed_top)
    _arrows(axes[0, 0], picture.truth, arrows, speed_top)
    axes[0, 0].set_title("truth", fontsize=10, color=INK)
    _show(axes[1, 0], np.zeros(picture.mask.shape), picture.mask, "gray_r", 1.0)
    x, y = (picture.position_um / picture.um_per_px).T
    felt = _length(picture.flow_um_s)
    axes[1, 0].scatter(x, y, c=felt, cmap=SPEEDS, vmin=0.0, vmax=speed_top, s=9, linewidths=0.3, edgecolors=INK)
    axes[1, 0].set_title(f"{len(x)} observations", fontsize=9, color=INK)
    for column, name in enumerate(methods, start=1):
        _show(axes[0, column], _length(picture.fields[name]), picture.mask, SPEEDS, speed_top)
        _arrows(axes[0, column], picture.fields[name], arrows, speed_top)
        axes[0, column].set_title(f"{name}\n{errors[name]:.3f}", fontsize=10, color=INK)
        wrong = _show(axes[1, column], misses[name], picture.mask, ERRORS, error_top)
        axes[1, column].scatter(x, y, s=1.2, c=SEEN, linewidths=0.0)
    for row, (mappable, label) in enumerate(((speeds, f"speed |v| ({unit})"), (wrong, f"error |v − v*| ({unit})"))):
        bar = above.colorbar(mappable, ax=list(axes[row]), extend="max", shrink=0.86, aspect=18, pad=0.01)
        bar.set_label(label, fontsize=9, color=INK)
        bar.ax.tick_params(labelsize=8, color=INK, labelcolor=INK)
        bar.outline.set_visible(False)
    above.suptitle(
        f"{picture.name}: relative RMSE of v over the fluid; dots are where the robot measured",
        fontsize=10,
        color=INK,
        x=0.01,
        ha="left",
    )
    if several:
        _strip(below[0].subplots(), methods, rows, picture.name)
    figure.savefig(path)


def _strip(ax: Axes, methods: list[str], rows: list[dict[str, Any]], drawn: str) -> None:
    """One column per method: a dot per case, mean and standard deviation beside them."""
    from matplotlib.ticker import NullFormatter, NullLocator

    for at, method in enumerate(methods):
        cases = [row for row in rows if row["method"] == method]
        values = np.array([row["rmse_v"] for row in cases])
        here = np.array([row["case"] == drawn for row in cases])
        # Side by side in the order of the cases, so that a case keeps its place from method to method.
        spread = at + np.linspace(-0.3, 0.08, len(values)) if len(values) > 1 else np.array([at - 0.11])
        ax.scatter(spread, values, s=13, color=QUIET, alpha=0.75, linewidths=0.0)
        ax.scatter(spread[here], values[here], s=26, facecolors="none", edgecolors=INK, linewidths=0.9)
        mean, std = float(values.mean()), float(values.std())
        # On a logarithmic axis a bar may not reach zero.
        low = max(mean - std, 0.3 * mean, 1e-4)
        ax.errorbar(at + 0.2, mean, [[max(mean - low, 0.0)], [std]], fmt="o", ms=5, color="#2f6f8f", capsize=3, lw=1.4)
        ax.annotate(
            f"{mean:.3f}\n±{std:.3f}",
            (at + 0.26, mean),
            xytext=(4, 0),
            textcoords="offset points",
            va="center",
            fontsize=7.5,
            color=INK,
        )
    ax.set_yscale("log")
    everything = [max(row["rmse_v"], 1e-3) for row in rows]
    ax.set_ylim(0.75 * min(everything), 1.35 * max(everything))
    ax.set_yticks([tick for tick in _TICKS if ax.get_ylim()[0] <= tick <= ax.get_ylim()[1]])
    ax.yaxis.set_major_formatter("{x:g}")
    ax.yaxis.set_minor_locator(NullLocator())
    ax.yaxis.set_minor_formatter(NullFormatter())
    ax.set_xticks(range(len(methods)), methods, fontsize=9, color=INK)
    ax.set_xlim(-0.5, len(methods) - 0.2)
    ax.set_ylabel("relative RMSE of v", fontsize=9, color=INK)
    ax.tick_params(labelsize=8.5, colors=INK, length=0)
    ax.grid(axis="y", color="#e6e6e6", lw=0.7)
    ax.set_axisbelow(True)
    ax.spines[["top", "right", "left"]].set_visible(False)
    ax.spines["bottom"].set_color(QUIET)
    count = len({row["case"] for row in rows})
    ax.set_title(
        f"{count} cases: a dot each, the one above circled; mean ± standard deviation",
        fontsize=9,
        color=INK,
        loc="left",
    )


def _in_readable_units(picture: Picture) -> tuple[Picture, str]:
    """mm/s where um/s would have four digits."""
    if float(_length(picture.truth).max()) < 2000.0:
        return picture, "µm/s"
    fields = {name: field * MM_PER_UM for name, field in picture.fields.items()}
    truth, felt = picture.truth * MM_PER_UM, picture.flow_um_s * MM_PER_UM
    return replace(picture, truth=truth, fields=fields, flow_um_s=felt), "mm/s"


def _show(ax: Axes, image: NDArray[np.floating], mask: NDArray[np.bool_], colours: str, top: float) -> Any:
    """An image (h, w) in the fluid, solid in grey."""
    ax.set_facecolor(SOLID)
    return ax.imshow(np.ma.masked_array(image, ~mask), cmap=colours, vmin=0.0, vmax=top, interpolation="nearest")


def _arrows(ax: Axes, velocity: NDArray[np.floating], places: NDArray[np.intp], top: float) -> None:
    """Arrows at places (n, 2) of row and column, where it is not slow; the fastest is as long as a block."""
    # A short arrow is but a speck, and the colour says already that it is slow there.
    rows, columns = places[_length(velocity[places[:, 0], places[:, 1]]) > SHORTEST * top].T
    vx, vy = velocity[rows, columns].T
    ax.quiver(
        columns,
        rows,
        vx,
        vy,
        color="white",
        angles="xy",
        scale_units="xy",
        scale=top / BLOCK_PX,
        width=0.009,
        headwidth=3.6,
        headlength=4.0,
        headaxislength=3.6,
        pivot="mid",
    )


def _arrow_places(mask: NDArray[np.bool_]) -> NDArray[np.intp]:
    """(n, 2) rows and columns: in each block of pixels the one farthest from the walls."""
    depth = distance_transform_edt(np.pad(mask, 1, mode="edge"))[1:-1, 1:-1]
    places = []
    for top in range(0, mask.shape[0], BLOCK_PX):
        for left in range(0, mask.shape[1], BLOCK_PX):
            block = depth[top : top + BLOCK_PX, left : left + BLOCK_PX]
            row, column = np.unravel_index(int(block.argmax()), block.shape)
            if block[row, column] > 1.0:
                places.append((top + int(row), left + int(column)))
    return np.array(places, np.intp).reshape(-1, 2)


def _bare(ax: Axes) -> None:
    """Neither ticks nor frame."""
    ax.set_xticks([])
    ax.set_yticks([])
    ax.spines[:].set_visible(False)


def _length(vectors: NDArray[np.floating]) -> NDArray[np.floating]:
    """Of (..., 2)."""
    return np.asarray(np.linalg.norm(vectors, axis=-1))
