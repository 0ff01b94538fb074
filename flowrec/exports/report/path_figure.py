"""Figure: the way of the robot over the flow, on the camera's picture or the mask of the chip."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from flowrec.core import MM_PER_UM, Floats
from flowrec.exports.report import style
from flowrec.exports.report.report_data import ReportData
from flowrec.view import Box, arrow_grid, flow_arrows, goal_of, length_text, place_on_chip, round_below, speed, way_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.image import AxesImage

_MARGIN = 0.06  # around the fluid, of its width
_OVER_PICTURE = 0.72  # opacity of the flow over the camera's picture
_TALLEST_MM = 200.0
_AROUND_TRACK_RADII = 4.0  # of the robot, around its track: room for the names of the ends
_BAR_MM, _BELOW_MM = 17.0, 6.0  # beside the picture: the colour bar; below it: the scale bar
_SAME_PLACE = 4.0  # radii of the robot: an end this near to the goal has no name of its own
_NEAR_EDGE = 0.08  # of the width: a name beside the edge begins or ends at its place
_HEAD_SHARE = 0.004  # of the path, half of what an arrow head points along
_HEADS = 7  # arrow heads on the path
_PT_PER_INCH = 72.0  # of a font's size: DTP points
_BAR_SHARE = 0.25  # longest scale bar, of the width


class PathFigure:
    """Path of the robot over the map of the flow."""

    name = "path"

    def __init__(self, title: str = "Path of the robot over the flow") -> None:
        self.title = title

    def why_not(self, data: ReportData) -> str:
        return data.no_position

    def caption(self, data: ReportData) -> str:
        parts = ["Line: the way of the robot (estimated position)."]
        if len(way_of(data.history.last.route)):
            parts.append("Dashes: the route that was planned last.")
        if data.field is not None:
            kind = "refined" if data.refined is not None else "assumed"
            parts.append(f"Colours and arrows: speed and direction of the flow by the {kind} map.")
        if data.picture is None:
            parts.append("The session holds no camera image: the mask of the chip is shown, walls in grey.")
        elif data.picture.images > 1:
            parts.append(
                f"Beneath: the camera's picture, median of {data.picture.images} images, in which what moves is not "
                "visible."
            )
        else:
            parts.append("Beneath: the one image of the camera that was found whole.")
        return " ".join(parts)

    def alt(self, data: ReportData) -> str:
        path = data.path_um
        length_mm = float(np.nansum(np.hypot(*np.diff(path, axis=0).T))) * MM_PER_UM
        return f"Map of the chip {data.scene.chip.name} with the robot's path of {length_mm:.1f} mm."

    def draw(self, data: ReportData, width_mm: float) -> Figure:
        left, top, right, bottom = _bounds(data)
        aspect = (bottom - top) / (right - left)
        picture_mm = width_mm - (_BAR_MM if data.field is not None else 2.0)
        figure = style.new_figure(width_mm, min(picture_mm * aspect + _BELOW_MM, _TALLEST_MM))
        ax = figure.subplots()
        style.bare(ax)
        _background(ax, data)
        _flow(figure, ax, data)
        for outline in data.scene.outlines():
            ax.plot(*outline.T, color=style.QUIET, lw=0.5, zorder=2)
        ax.set_xlim(left, right)
        ax.set_ylim(bottom, top)
        ax.set_aspect("equal")
        ax.autoscale(False)
        _paths(ax, data)
        scale_bar(ax, data.scene.length_px(1e3))
        return figure


def scale_bar(ax: Axes, per_mm: float) -> None:
    """A bar of a round length below the lower left corner; `per_mm` units of the axis are a millimetre."""
    from matplotlib.transforms import ScaledTranslation

    left, right = ax.get_xlim()
    length_mm = round_below(_BAR_SHARE * abs(right - left) / per_mm)
    share = length_mm * per_mm / abs(right - left)
    figure = ax.get_figure()
    assert figure is not None
    below = ax.transAxes + ScaledTranslation(0.0, -5.0 / _PT_PER_INCH, figure.dpi_scale_trans)
    ax.plot([0.0, share], [0.0, 0.0], transform=below, color=style.INK, lw=1.6, clip_on=False)
    ax.text(share + 0.01, 0.0, length_text(1e3 * length_mm), transform=below, va="center", ha="left")


def _bounds(data: ReportData) -> Box:
    """Left, top, right, bottom of the fluid with a margin, within the chip, in the picture plane."""
    if not data.tells_flow:
        return _track_bounds(data)
    left, top, right, bottom = data.scene.fluid_bounds()
    margin = _MARGIN * (right - left)
    chip_left, chip_top, chip_right, chip_bottom = data.scene.chip_bounds()
    return (
        max(left - margin, chip_left),
        max(top - margin, chip_top),
        min(right + margin, chip_right),
        min(bottom + margin, chip_bottom),
    )


def _track_bounds(data: ReportData) -> Box:
    """Bounds of the robot's way, which may be small in a dish, with room for the names of its ends."""
    path = data.scene.to_plane(place_on_chip(data.history.last, data.path_um))
    margin = _AROUND_TRACK_RADII * data.scene.length_px(data.scene.robot.radius_um)
    (left, top), (right, bottom) = np.nanmin(path, axis=0) - margin, np.nanmax(path, axis=0) + margin
    width, height = right - left, bottom - top
    # Not flatter than 1 : 2, for the picture to be readable.
    wider, higher = max(0.25 * height - 0.5 * width, 0.0), max(0.25 * width - 0.5 * height, 0.0)
    return left - wider, top - higher, right + wider, bottom + higher


def _background(ax: Axes, data: ReportData) -> None:
    """The camera's picture, else the mask: walls grey, fluid white."""
    scene, picture = data.scene, data.picture
    if picture is not None:
        height, width = (size * picture.step for size in picture.image.shape)
        # Brightened: the path is dark.
        shown = ax.imshow(picture.image, cmap="gray", vmin=-90, vmax=255, extent=(0.0, width, height, 0.0), zorder=0)
        # As in the viewer, image and path lie where the registration that the refinement found puts them.
        _place(shown, ax, scene.image_to_plane(replace(data.history.last, shift=None)))
    else:
        _on_mask(ax, data, np.where(scene.chip.mask, 255.0, 200.0), cmap="gray", vmin=0, vmax=255, zorder=0)


def _on_mask(ax: Axes, data: ReportData, values: Floats, **how: Any) -> AxesImage:
    """Values (h, w) of the mask's pixels, where the camera sees them."""
    height, width = values.shape
    shown = ax.imshow(values, extent=(0.0, width, height, 0.0), interpolation="nearest", **how)
    _place(shown, ax, data.scene.mask_to_plane())
    return shown


def _place(shown: AxesImage, ax: Axes, to_plane: Floats) -> None:
    """Move an image by (2, 3) into the picture plane."""
    from matplotlib.transforms import Affine2D

    shown.set_transform(Affine2D(np.vstack((to_plane, (0.0, 0.0, 1.0)))) + ax.transData)


def _flow(figure: Figure, ax: Axes, data: ReportData) -> None:
    """The speed of the best map in colours, its direction as arrows."""
    field, scene = data.field, data.scene
    if field is None:
        return
    scale = data.speed_scale()
    opacity = _OVER_PICTURE if data.picture is not None else 1.0
    values = speed(field, scene.chip.mask)
    how = {"cmap": style.colour_map(scale), "vmin": 0.0, "vmax": scale.high, "alpha": opacity, "zorder": 1}
    speeds = _on_mask(ax, data, values, **how)
    bar = figure.colorbar(speeds, ax=ax, shrink=0.85, aspect=22, pad=0.01, ticks=scale.ticks)
    bar.set_label("speed of the flow (µm/s)")
    bar.outline.set_visible(False)
    origins, vectors, _ = flow_arrows(scene, field, arrow_grid(scene))
    if len(origins):
        ax.quiver(
            *origins.T,
            *vectors.T,
            angles="xy",
            scale_units="xy",
            scale=1.0,
            color="white",
            edgecolor=style.INK,
            lw=0.25,
            width=0.0022,
            headwidth=4.5,
            headlength=5.0,
            headaxislength=4.0,
            zorder=3,
        )


def _paths(ax: Axes, data: ReportData) -> None:
    """The route, the way of the robot, and where both begin and end."""
    scene = data.scene
    white: dict[str, Any] = {"color": "white", "solid_capstyle": "round"}
    route = scene.to_plane(way_of(data.history.last.route))
    if len(route):
        ax.plot(*route.T, lw=1.8, zorder=4, **white)
        ax.plot(*route.T, color=style.INK, lw=0.9, ls=(0, (4, 2)), zorder=5)
    path = scene.to_plane(place_on_chip(data.history.last, data.path_um))
    ax.plot(*path.T, lw=2.4, zorder=6, **white)
    ax.plot(*path.T, color=style.VERMILLION, lw=1.3, zorder=7)
    _directions(ax, path)
    known = path[np.isfinite(path[:, 0])]
    radius_px = scene.length_px(scene.robot.radius_um)
    goal_um = goal_of(data.history.last.mission)
    goal = None if goal_um is None else scene.to_plane(goal_um)
    at_goal = goal is not None and float(np.hypot(*(known[-1] - goal))) < _SAME_PLACE * radius_px
    _mark(ax, known[0], radius_px, "start", style.INK, below=goal is not None)
    if goal is not None:
        _mark(ax, goal, 1.6 * radius_px, "goal", style.GREEN)
    _mark(ax, known[-1], radius_px, "" if at_goal else "end", style.VERMILLION)


def _directions(ax: Axes, path: Floats) -> None:
    """Arrow heads on the path, evenly spread over its length."""
    way = path[np.isfinite(path[:, 0])]
    along = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(way, axis=0).T))])
    if along[-1] <= 0.0:
        return
    for share in (np.arange(_HEADS) + 0.5) / _HEADS:
        middle = share * along[-1]
        around = middle + along[-1] * np.array([-_HEAD_SHARE, _HEAD_SHARE])
        begin, end = zip(*(np.interp(around, along, axis) for axis in way.T), strict=True)
        arrow = {
            "arrowstyle": "-|>,head_length=0.35,head_width=0.22",
            "color": style.VERMILLION,
            "lw": 0.0,
            "shrinkA": 0.0,
            "shrinkB": 0.0,
            "mutation_scale": 11.0,
        }
        ax.annotate("", end, begin, arrowprops=arrow, zorder=8)


def _mark(ax: Axes, at: Floats, radius: float, name: str, colour: str, *, below: bool = False) -> None:
    """A circle with a name, which stays within the axis."""
    from matplotlib.patches import Circle

    ax.add_patch(Circle((at[0], at[1]), radius, facecolor="white", edgecolor=colour, lw=1.2, zorder=9))
    if name:
        share = (at[0] - ax.get_xlim()[0]) / np.ptp(ax.get_xlim())
        ax.annotate(
            name,
            (at[0], at[1] + (radius if below else -radius)),
            (0, -4 if below else 4),
            textcoords="offset points",
            ha="left" if share < _NEAR_EDGE else "right" if share > 1.0 - _NEAR_EDGE else "center",
            va="top" if below else "bottom",
            color=colour,
            fontweight="bold",
            bbox={"boxstyle": "round,pad=0.2", "facecolor": "white", "edgecolor": "none", "alpha": 0.85},
            zorder=10,
        )
