"""Flow fields as coloured maps. All maps of speed share one scale, so maps beside each other compare."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import rerun as rr
from numpy.typing import NDArray

from flowrec.messages import FlowField
from flowrec.view import colours
from flowrec.view.colours import Scale
from flowrec.view.scene import Placement, Scene

_HEADROOM = 1.3  # of the scale above the first field: a refined one is often faster


@dataclass(slots=True)
class SpeedScale:
    """The scale of all maps of speed, also of a recorded and a replayed session beside each other."""

    scale: Scale | None = None
    version: int = 0  # grows when maps must be painted again

    def hold(self, peak_um_s: float) -> None:
        """Make room for a field."""
        if self.scale is None or peak_um_s > self.scale.high:
            self.scale = Scale.up_to(peak_um_s * (_HEADROOM if self.scale is None else 1.0), "speed")
            self.version += 1


def speed(field: FlowField, mask: NDArray[np.bool_]) -> NDArray[np.float64]:
    """(h, w) um/s, NaN in solid."""
    return np.where(mask, np.hypot(field.velocity_um_s[..., 0], field.velocity_um_s[..., 1]), np.nan)


def peak(field: FlowField) -> float:
    """The fastest flow, um/s."""
    return float(np.hypot(field.velocity_um_s[..., 0], field.velocity_um_s[..., 1]).max())


def uncertainty(field: FlowField, mask: NDArray[np.bool_]) -> NDArray[np.float64]:
    """(h, w) one standard deviation of the velocity vector, um/s, NaN in solid."""
    assert field.std_um_s is not None
    return np.where(mask, np.hypot(field.std_um_s[..., 0], field.std_um_s[..., 1]), np.nan)


def change(refined: FlowField, assumed: FlowField, mask: NDArray[np.bool_]) -> NDArray[np.float64]:
    """(h, w) how much faster the refined flow is than the assumed one, um/s, NaN in solid."""
    return speed(refined, mask) - speed(assumed, mask)


def scale_of(values: NDArray[np.float64], colours: colours.Colours) -> Scale:
    """A scale that holds nearly all of a map; the last half percent is corners and may saturate."""
    known = np.abs(values[np.isfinite(values)])
    return Scale.up_to(float(np.quantile(known, 0.995)) if known.size else 1.0, colours)


def wave_fronts(time_s: NDArray[np.float32], mask: NDArray[np.bool_], scale: Scale) -> rr.EncodedImage:
    """A time to go (h, w), darker where a front passes it, twice between two ticks; red where there is no way."""
    known = mask & np.isfinite(time_s)
    pixels = scale.paint(np.where(known, time_s, np.nan))
    front = np.floor(np.where(known, time_s, 0.0) / (0.5 * scale.step))
    crossed = np.zeros(mask.shape, np.bool_)
    crossed[:, :-1] |= (front[:, :-1] != front[:, 1:]) & known[:, 1:]
    crossed[:-1] |= (front[:-1] != front[1:]) & known[1:]
    pixels[crossed & known] = (0.6 * pixels[crossed & known]).astype(np.uint8)
    pixels[mask & ~known] = colours.NO_WAY
    return _encoded(pixels)


def picture(values: NDArray[np.float64], scale: Scale) -> rr.EncodedImage:
    """A map (h, w) in the colours of its scale."""
    return _encoded(scale.paint(values))


def _encoded(colours: NDArray[np.uint8]) -> rr.EncodedImage:
    done, png = cv2.imencode(".png", colours[..., ::-1], [cv2.IMWRITE_PNG_COMPRESSION, 1])
    assert done
    return rr.EncodedImage(contents=png.tobytes(), media_type="image/png")


def placed(placement: Placement) -> rr.Transform3D:
    """Puts an image where it belongs in the picture plane."""
    return rr.Transform3D(translation=[*placement.offset, 0.0], scale=[placement.scale, placement.scale, 1.0])


@dataclass(frozen=True, slots=True)
class ColourBar:
    """Where the bar stands beside a map, in the picture plane."""

    left: float
    top: float
    width: float
    height: float

    @classmethod
    def beside(cls, scene: Scene) -> ColourBar:
        """To the right of the chip, a little lower than it."""
        _, top, right, bottom = scene.chip_bounds()
        height = bottom - top
        return cls(right + 0.035 * height, top + 0.13 * height, 0.045 * height, 0.82 * height)

    def bounds_with(self, scene: Scene) -> tuple[float, float, float, float]:
        """Left, top, right, bottom of the chip together with its bar and the numbers at it."""
        left, top, _, bottom = scene.chip_bounds()
        margin = 0.02 * (bottom - top)
        return left - margin, top - margin, self.left + self.width + 0.26 * (bottom - top), bottom + margin

    def strip(self, scale: Scale) -> tuple[rr.Image, rr.Transform3D]:
        """The colours, highest on top."""
        rows = 256
        values = np.linspace(scale.high, scale.low, rows)[:, None]
        where = rr.Transform3D(translation=[self.left, self.top, 0.0], scale=[self.width, self.height / rows, 1.0])
        return rr.Image(scale.paint(values)), where

    def ticks(self, scale: Scale) -> tuple[rr.LineStrips2D, rr.Points2D]:
        """The ticks with their values to the right of them, and the unit above the bar."""
        share = (np.array(scale.ticks) - scale.low) / (scale.high - scale.low)
        y = self.top + self.height * (1.0 - share)
        right = self.left + self.width
        dash = 0.25 * self.width
        marks = rr.LineStrips2D(
            [[[right, at], [right + dash, at]] for at in y], colors=colours.WHITE, radii=rr.Radius.ui_points(0.8)
        )
        sign = "+" if scale.colours == "change" else ""
        labels = [f"{value:{sign}g}" if abs(value) > 1e-9 * scale.high else "0" for value in scale.ticks]
        labels.append(scale.unit)
        # Rerun centres a label below its point: a little up and half a label to the right puts it beside its tick.
        at = [(right + 2.0 * self.width, row - 0.045 * self.height) for row in y]
        at.append((self.left + 0.5 * self.width, self.top - 0.14 * self.height))
        numbers = rr.Points2D(at, labels=labels, show_labels=True, colors=colours.WHITE, radii=rr.Radius.ui_points(0))
        return marks, numbers
