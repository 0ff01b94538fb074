"""Figure: maps of the flow before and after, their standard deviation, and where the flow is not known."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from flowrec.core import MM_PER_UM, Bools, Floats, FlowField
from flowrec.exports.report import style
from flowrec.exports.report.path_figure import scale_bar
from flowrec.exports.report.report_data import ReportData
from flowrec.view import ColourScale, change, scale_of, speed, uncertainty

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.image import AxesImage

NOT_KNOWN = 0.25  # standard deviation over the typical speed, above which the flow counts as not known
_MARGIN_PX = 3
_BAR_MM = 15.0  # for a colour bar with its numbers
_TITLE_MM = 7.0
_TALLEST_MM = 75.0  # of a panel


@dataclass(frozen=True, slots=True, eq=False)
class Panel:
    """One map: a title, values (h, w) and their scale; `hatched` (h, w) where the flow is not known."""

    title: str
    values: Floats
    scale: ColourScale
    hatched: Bools | None = None


def not_known(field: FlowField, mask: Bools) -> Bools:
    """(h, w) fluid where one standard deviation exceeds NOT_KNOWN of the typical speed; all where none is stated."""
    if field.std_um_s is None:
        return mask
    typical = np.sqrt((speed(field, mask)[mask] ** 2).mean()) if mask.any() else 0.0  # root mean square, um/s
    return mask & (uncertainty(field, mask) > NOT_KNOWN * typical)


def known_text(field: FlowField, mask: Bools, name: str) -> str:
    """Description of the standard deviation of a map, in one or two sentences."""
    if field.std_um_s is None:
        return f"The method of the {name} map ({field.method}) states no standard deviation."
    share = float(not_known(field, mask).sum() / max(int(mask.sum()), 1))
    text = f"Uncertainty: one standard deviation of the velocity that the {name} map states for itself."
    if share < 0.001:
        return f"{text} It is nowhere more than {NOT_KNOWN:.0%} of the typical speed."
    return f"{text} Hatched: where it is more than {NOT_KNOWN:.0%} of the typical speed ({share:.0%} of the fluid)."


class MapFigure:
    """The flow that was assumed, the flow after the refinement, and how well it is known."""

    name = "maps"
    title = "Maps of the flow"

    def why_not(self, data: ReportData) -> str:
        return data.no_map

    def caption(self, data: ReportData) -> str:
        mask, refined, assumed = data.scene.chip.mask, data.refined, data.assumed
        parts = []
        if assumed is not None:
            parts.append(f"Assumed: computed from the chip and its stated inflow alone (method {assumed.method}).")
        if refined is not None:
            parts.append(f"Refined: corrected by what the robot experienced (method {refined.method}).")
            if assumed is not None:
                parts.append("Refined - assumed: the difference of the speeds.")
        else:
            parts.append("The flow was not refined in this session: there is no map after a refinement.")
        best = data.history.last.field
        assert best is not None
        parts.append(known_text(best, mask, "refined" if refined is not None else "assumed"))
        if data.truth is not None:
            parts.append(
                "True: the flow of the simulated world, which no stage of the run knew; less it, the error of the map."
            )
        return " ".join(parts)

    def alt(self, data: ReportData) -> str:
        return f"Maps of the flow on the chip {data.scene.chip.name}: {', '.join(p.title for p in _panels(data))}."

    def draw(self, data: ReportData, width_mm: float) -> Figure:
        return draw_panels(_panels(data), data, width_mm)


class ChangeFigure:
    """The maps of a session and of a replay of it."""

    name = "replay"
    title = "Flow map as recorded and as replayed"

    def __init__(self, before: FlowField | None, after: FlowField | None, number: int) -> None:
        self._maps = {"recorded": before, "replayed": after}
        self.name = f"replay_{number}"

    def why_not(self, _story: ReportData) -> str:
        before, after = self._maps.values()
        if before is None or after is None:
            return "one of the two holds no map of the flow"
        if before.same_as(after):
            return "the replay has the map of the recording, unchanged"
        if before.velocity_um_s.shape != after.velocity_um_s.shape:
            return "the two maps have different sizes"
        return ""

    def caption(self, data: ReportData) -> str:
        before, after = self._maps.values()
        assert before is not None and after is not None
        return (
            f"Recorded: the best map of the session (method {before.method}). Replayed: that of the replay "
            f"(method {after.method}). Replayed - recorded: the difference of the speeds. "
            + known_text(after, data.scene.chip.mask, "replayed")
        )

    def alt(self, data: ReportData) -> str:
        return f"Maps of the flow on the chip {data.scene.chip.name}: recorded, replayed, and their difference."

    def draw(self, data: ReportData, width_mm: float) -> Figure:
        mask = data.scene.chip.mask
        largest = max(float(np.nanmax(speed(field, mask))) for field in self._maps.values() if field is not None)
        return draw_panels(_panels_of(self._maps, ColourScale.up_to(largest, "speed"), mask), data, width_mm)


def _panels(data: ReportData) -> list[Panel]:
    mask, scale = data.scene.chip.mask, data.speed_scale()
    panels = _panels_of({"assumed": data.assumed, "refined": data.refined}, scale, mask)
    best = data.history.last.field
    if data.truth is None or best is None:
        return panels
    name, error = "refined" if data.refined is not None else "assumed", change(best, data.truth, mask)
    wrong = Panel(f"{name} - true", error, scale_of(error, "change"))
    return [*panels, Panel("true flow", speed(data.truth, mask), scale), wrong]


def _panels_of(named: Mapping[str, FlowField | None], scale: ColourScale, mask: Bools) -> list[Panel]:
    """The speed of one or two fields, their change, and the deviation that the last one states."""
    known = {name: field for name, field in named.items() if field is not None}
    panels = [Panel(f"{name} flow", speed(field, mask), scale) for name, field in known.items()]
    fields = list(known.values())
    if len(fields) == 2:
        values = change(fields[1], fields[0], mask)
        panels.append(Panel(" - ".join(reversed(known)), values, scale_of(values, "change")))
    if fields and fields[-1].std_um_s is not None:
        values = uncertainty(fields[-1], mask)
        panels.append(Panel("uncertainty, 1 σ", values, scale_of(values, "uncertainty"), not_known(fields[-1], mask)))
    return panels


def draw_panels(panels: list[Panel], data: ReportData, width_mm: float) -> Figure:
    """Maps side by side, each kind of value with its colour bar; several rows where they do not fit in one."""
    mask, um_per_px = data.scene.chip.mask, data.scene.chip.um_per_px
    box = tuple(slice(max(at.min() - _MARGIN_PX, 0), at.max() + _MARGIN_PX + 1) for at in np.nonzero(mask))
    height_px, width_px = mask[box].shape
    beside = 3 if len(panels) == 3 else 2  # no row is half empty
    columns = min(len(panels), beside if width_mm > style.NARROW_MM else 1)
    rows = -(-len(panels) // columns)
    panel_mm = min((width_mm / columns - _BAR_MM) * height_px / width_px, _TALLEST_MM)
    figure = style.new_figure(width_mm, rows * (panel_mm + _TITLE_MM) + 4.0)
    axes = figure.subplots(rows, columns, squeeze=False).ravel()
    for ax in axes[len(panels) :]:
        ax.remove()
    for ax, panel in zip(axes, panels, strict=False):
        shown = _show(ax, panel, box)
        bar = figure.colorbar(shown, ax=ax, shrink=0.9, aspect=16, pad=0.02, ticks=panel.scale.ticks)
        bar.ax.set_yticklabels(panel.scale.labels)
        bar.outline.set_visible(False)
    scale_bar(axes[0], 1.0 / (um_per_px * MM_PER_UM))  # pixels of the mask in a millimetre
    return figure


def _show(ax: Axes, panel: Panel, box: tuple[slice, ...]) -> AxesImage:
    style.bare(ax)
    ax.set_facecolor(style.SOLID)
    shown = ax.imshow(
        panel.values[box],
        cmap=style.colour_map(panel.scale),
        vmin=panel.scale.low,
        vmax=panel.scale.high,
        interpolation="nearest",
    )
    if panel.hatched is not None and panel.hatched.any():
        area = panel.hatched[box].astype(np.float64)
        ax.contourf(area, levels=[0.5, 1.5], colors="none", hatches=["//////"])
        ax.contour(area, levels=[0.5], colors=style.INK, linewidths=0.4)
    ax.set_title(f"{panel.title[:1].upper()}{panel.title[1:]} (µm/s)")
    return shown
