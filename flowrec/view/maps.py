"""Coloured maps for Rerun. All maps of speed share one scale, so adjacent maps are comparable."""

from __future__ import annotations

import cv2
import numpy as np
import rerun as rr
from numpy.typing import NDArray

from flowrec.core import Bools, Matrix
from flowrec.view import colours
from flowrec.view.colours import ColourScale
from flowrec.view.entities import points
from flowrec.view.scene import Scene

_BAR_ROWS = 256
_BAR_SHARE = 0.74  # of the height of the channels: words need room above and below
_LEAST_BAR = 0.3  # height of a colour bar over the width of the channels


class SpeedScale:
    """The scale of all maps of speed, also of a recorded and a replayed session in one view."""

    scale: ColourScale | None = None  # another one when maps must be painted again

    def include(self, peak_um_s: float) -> None:
        """Extend the scale to a speed."""
        if self.scale is None or peak_um_s > self.scale.high:
            self.scale = ColourScale.up_to(peak_um_s, "speed")


def wave_fronts(time_s: NDArray[np.float32], mask: Bools, scale: ColourScale) -> rr.EncodedImage:
    """A time to go (h, w) with darker isochrones, two for each tick; red where the goal can not be reached."""
    known = mask & np.isfinite(time_s)
    pixels = scale.paint(np.where(known, time_s, np.nan))
    interval = np.floor(np.where(known, time_s, 0.0) / (0.5 * scale.step))
    front = np.zeros(mask.shape, np.bool_)
    front[:, :-1] |= (interval[:, :-1] != interval[:, 1:]) & known[:, 1:]
    front[:-1] |= (interval[:-1] != interval[1:]) & known[1:]
    pixels[front & known] = (0.6 * pixels[front & known]).astype(np.uint8)
    pixels[mask & ~known] = colours.UNREACHABLE
    return encode_png(pixels)


def encode_png(pixels: NDArray[np.uint8]) -> rr.EncodedImage:
    """An image (h, w, 3) in RGB as PNG."""
    done, png = cv2.imencode(".png", pixels[..., ::-1], [cv2.IMWRITE_PNG_COMPRESSION, 1])
    assert done
    return rr.EncodedImage(contents=png.tobytes(), media_type="image/png")


def transform_of(matrix: Matrix) -> rr.Transform3D:
    """The transform of an image into the picture plane: `matrix` (2, 3) says where a point (x, y, 1) of it lies."""
    turned = np.eye(3)
    turned[:2, :2] = matrix[:, :2]
    return rr.Transform3D(translation=[*matrix[:, 2], 0.0], mat3x3=turned)


class ColourBar:
    """Position of the colour bar beside a map, in the picture plane.

    It is to the right of the channels, a little lower; of a very flat chip not shorter than a third of its width.

    Attributes
    ----------
    bounds : left, top, right, bottom of the channels together with the bar and its numbers.
    """

    def __init__(self, scene: Scene) -> None:
        left, top, right, bottom = scene.fluid_bounds()
        size = max(bottom - top, _LEAST_BAR * (right - left))
        top = 0.5 * (top + bottom) - 0.5 * size
        self.left, self.top = right + 0.06 * size, top + 0.16 * size
        self.width, self.height = 0.05 * size, _BAR_SHARE * size
        right = self.left + self.width
        self.bounds = left - 0.03 * size, top - 0.02 * size, right + 0.34 * size, top + 1.02 * size

    def strip(self, scale: ColourScale) -> tuple[rr.Image, rr.Transform3D]:
        """The colours, the highest value on top."""
        values = np.linspace(scale.high, scale.low, _BAR_ROWS)[:, None]
        size = [self.width, self.height / _BAR_ROWS, 1.0]
        return rr.Image(scale.paint(values)), rr.Transform3D(translation=[self.left, self.top, 0.0], scale=size)

    def ticks(self, scale: ColourScale) -> tuple[rr.LineStrips2D, rr.Points2D]:
        """The ticks with their values to the right of them, and the unit above the bar."""
        fraction = (np.array(scale.ticks) - scale.low) / (scale.high - scale.low)
        y = self.top + self.height * (1.0 - fraction)
        right = self.left + self.width
        dash = 0.25 * self.width
        marks = rr.LineStrips2D(
            [[[right, at], [right + dash, at]] for at in y], colors=colours.WHITE, radii=points(0.8)
        )
        labels = [*scale.labels, "s" if scale.table == "time" else "µm/s"]
        # Rerun centres a label below its point: a little up and half a label to the right puts it beside its tick.
        positions = [(right + 3.2 * self.width, row - 0.045 * self.height) for row in y]
        positions.append((self.left + 0.5 * self.width, self.top - 0.2 * self.height))
        numbers = rr.Points2D(positions, labels=labels, show_labels=True, colors=colours.WHITE, radii=points(0))
        return marks, numbers
