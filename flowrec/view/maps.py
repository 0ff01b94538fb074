"""Flow fields as coloured maps and as arrows. All maps of speed share one scale, so adjacent maps are comparable."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import rerun as rr
from numpy.typing import NDArray

from flowrec.flow import sample
from flowrec.messages import FlowField
from flowrec.view import colours
from flowrec.view.colours import Scale, Table
from flowrec.view.entities import points
from flowrec.view.scene import Placement, Scene

Floats = NDArray[np.float64]
_HEADROOM = 1.3  # of the scale above the first field: a refined one is often faster
# Lengths in arrow spacings, unless stated otherwise.
_ARROWS_ACROSS_IMAGE = (28.0, 45.0)  # along its width: for wide channels, and for narrow ones
_ARROWS_ACROSS_CHANNEL = 2.5  # in a typical channel, within these limits
_LONGEST = 0.9  # the fastest arrow: a row of longer ones would look like one line
_FROM_WALL = 0.3  # least distance of an arrow from a wall, except in the middle of a narrow channel
_WELL_AWAY = 0.45  # from the wall
_PITCH = 0.2  # of the points that may carry an arrow
_BAR_ROWS = 256


@dataclass(slots=True)
class SpeedScale:
    """The scale of all maps of speed, also of a recorded and a replayed session in one view."""

    scale: Scale | None = None
    version: int = 0  # incremented when maps must be painted again

    def include(self, peak_um_s: float) -> None:
        """Extend the scale to a speed."""
        if self.scale is None or peak_um_s > self.scale.high:
            self.scale = Scale.up_to(peak_um_s * (_HEADROOM if self.scale is None else 1.0), "speed")
            self.version += 1


def speed(field: FlowField, mask: NDArray[np.bool_]) -> Floats:
    """(h, w) um/s, NaN in solid."""
    return np.where(mask, np.hypot(field.velocity_um_s[..., 0], field.velocity_um_s[..., 1]), np.nan)


def peak(field: FlowField) -> float:
    """The largest speed, um/s."""
    return float(np.hypot(field.velocity_um_s[..., 0], field.velocity_um_s[..., 1]).max())


def uncertainty(field: FlowField, mask: NDArray[np.bool_]) -> Floats:
    """(h, w) one standard deviation of the velocity vector, um/s, NaN in solid."""
    assert field.std_um_s is not None
    return np.where(mask, np.hypot(field.std_um_s[..., 0], field.std_um_s[..., 1]), np.nan)


def change(refined: FlowField, assumed: FlowField, mask: NDArray[np.bool_]) -> Floats:
    """(h, w) speed of the refined flow minus that of the assumed one, um/s, NaN in solid."""
    return speed(refined, mask) - speed(assumed, mask)


def scale_of(values: Floats, table: Table) -> Scale:
    """A scale for nearly all of a map; the largest half percent are corners and may saturate."""
    known = np.abs(values[np.isfinite(values)])
    return Scale.up_to(float(np.quantile(known, 0.995)) if known.size else 1.0, table)


def wave_fronts(time_s: NDArray[np.float32], mask: NDArray[np.bool_], scale: Scale) -> rr.EncodedImage:
    """A time to go (h, w) with darker isochrones, two for each tick; red where the goal can not be reached."""
    known = mask & np.isfinite(time_s)
    pixels = scale.paint(np.where(known, time_s, np.nan))
    interval = np.floor(np.where(known, time_s, 0.0) / (0.5 * scale.step))
    front = np.zeros(mask.shape, np.bool_)
    front[:, :-1] |= (interval[:, :-1] != interval[:, 1:]) & known[:, 1:]
    front[:-1] |= (interval[:-1] != interval[1:]) & known[1:]
    pixels[front & known] = (0.6 * pixels[front & known]).astype(np.uint8)
    pixels[mask & ~known] = colours.UNREACHABLE
    return encoded(pixels)


def encoded(pixels: NDArray[np.uint8]) -> rr.EncodedImage:
    """An image (h, w, 3) in RGB as PNG."""
    done, png = cv2.imencode(".png", pixels[..., ::-1], [cv2.IMWRITE_PNG_COMPRESSION, 1])
    assert done
    return rr.EncodedImage(contents=png.tobytes(), media_type="image/png")


def placed(placement: Placement) -> rr.Transform3D:
    """The transform of an image into the picture plane."""
    matrix = np.diag([placement.scale, placement.scale, 1.0])
    matrix[:2, :2] = placement.scale * placement.axes
    return rr.Transform3D(translation=[*placement.offset, 0.0], mat3x3=matrix)


@dataclass(frozen=True, slots=True)
class ColourBar:
    """Position of the colour bar beside a map, in the picture plane."""

    left: float
    top: float
    width: float
    height: float

    @classmethod
    def beside(cls, scene: Scene) -> ColourBar:
        """To the right of the chip, a little lower."""
        _, top, right, bottom = scene.chip_bounds()
        height = bottom - top
        return cls(right + 0.035 * height, top + 0.13 * height, 0.045 * height, 0.82 * height)

    def bounds_with(self, scene: Scene) -> tuple[float, float, float, float]:
        """Left, top, right, bottom of the chip together with its bar and numbers."""
        left, top, _, bottom = scene.chip_bounds()
        margin = 0.02 * (bottom - top)
        return left - margin, top - margin, self.left + self.width + 0.26 * (bottom - top), bottom + margin

    def strip(self, scale: Scale) -> tuple[rr.Image, rr.Transform3D]:
        """The colours, the highest value on top."""
        values = np.linspace(scale.high, scale.low, _BAR_ROWS)[:, None]
        size = [self.width, self.height / _BAR_ROWS, 1.0]
        return rr.Image(scale.paint(values)), rr.Transform3D(translation=[self.left, self.top, 0.0], scale=size)

    def ticks(self, scale: Scale) -> tuple[rr.LineStrips2D, rr.Points2D]:
        """The ticks with their values to the right of them, and the unit above the bar."""
        fraction = (np.array(scale.ticks) - scale.low) / (scale.high - scale.low)
        y = self.top + self.height * (1.0 - fraction)
        right = self.left + self.width
        dash = 0.25 * self.width
        marks = rr.LineStrips2D(
            [[[right, at], [right + dash, at]] for at in y], colors=colours.WHITE, radii=points(0.8)
        )
        sign = "+" if scale.table == "change" else ""
        labels = [f"{value:{sign}g}" if abs(value) > 1e-9 * scale.high else "0" for value in scale.ticks]
        labels.append(scale.unit)
        # Rerun centres a label below its point: a little up and half a label to the right puts it beside its tick.
        positions = [(right + 2.0 * self.width, row - 0.045 * self.height) for row in y]
        positions.append((self.left + 0.5 * self.width, self.top - 0.14 * self.height))
        numbers = rr.Points2D(positions, labels=labels, show_labels=True, colors=colours.WHITE, radii=points(0))
        return marks, numbers


def arrow_grid(scene: Scene) -> tuple[Floats, float]:
    """Points (n, 2) in um inside the fluid, at least one spacing apart, and the spacing in um.

    Points well away from the walls are chosen first, so a narrow channel has a row of arrows along its middle and a
    wide one several, rather than only the points of a regular grid that happen to lie in it.
    """
    chip, (image_left, _, image_right, _) = scene.chip, scene.image_bounds()
    # A border of solid makes the image's border a wall, so that no arrow extends beyond it.
    wall_px = cv2.distanceTransform(np.pad(chip.mask, 1).astype(np.uint8), cv2.DIST_L2, 5)[1:-1, 1:-1]
    ridge = (wall_px >= cv2.dilate(wall_px, np.ones((5, 5), np.uint8))) & (wall_px > 1.5)
    width_px = 2.0 * float(np.median(wall_px[ridge])) if ridge.any() else 1.0
    image_px = (image_right - image_left) * scene.calibration.um_per_px / chip.um_per_px  # of the mask
    few, many = _ARROWS_ACROSS_IMAGE
    spacing = float(np.clip(width_px / _ARROWS_ACROSS_CHANNEL, image_px / many, image_px / few))
    allowed = ridge | (wall_px >= _FROM_WALL * spacing)
    pitch = max(1, int(_PITCH * spacing))
    row, column = np.nonzero(allowed & chip.mask)
    candidate = (row % pitch == 0) & (column % pitch == 0) | ridge[row, column]
    row, column = row[candidate], column[candidate]
    free = np.ones_like(chip.mask, np.uint8)
    chosen = []
    for at in np.lexsort((row, column, -np.round(np.minimum(wall_px[row, column], _WELL_AWAY * spacing)))):
        y, x = int(row[at]), int(column[at])
        if free[y, x]:
            chosen.append((x, y))
            cv2.circle(free, (x, y), max(round(spacing) - 1, 1), 0, -1)
    return np.array(chosen, np.float64).reshape(-1, 2) * chip.um_per_px, spacing * chip.um_per_px


def flow_arrows(scene: Scene, field: FlowField, grid: tuple[Floats, float]) -> tuple[Floats, Floats, Floats]:
    """Origins (n, 2) and vectors (n, 2) in the picture plane, and speeds (n,) in um/s.

    Each arrow is centred on its point of the grid. Its length is proportional to the square root of the speed, so that
    slow branches of a network still show their direction; the colour shows the speed.
    """
    points_um, spacing_um = grid
    velocity = sample(field, points_um)
    magnitude = np.hypot(velocity[:, 0], velocity[:, 1])
    fastest = float(np.quantile(magnitude, 0.99)) if len(magnitude) else 0.0
    longest = _LONGEST * scene.length_px(spacing_um)
    # Limited, so that a jet through a narrow spot does not cover its neighbours.
    relative = np.minimum(magnitude / fastest, 1.0) if fastest > 0.0 else np.zeros_like(magnitude)
    vectors = scene.directions(velocity * (longest * np.sqrt(relative) / np.maximum(magnitude, 1e-12))[:, None])
    return scene.to_plane(points_um) - 0.5 * vectors, vectors, magnitude
