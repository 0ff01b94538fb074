"""Messages of the stages that read the image: tracks of robot and tracers, the robot's look, the image's shift."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from flowrec.core.declarations import NOT_STATED, Matrix, Message, Raster, Shape, Vector, Vector2


@dataclass(frozen=True, slots=True, eq=False)
class Track(Message):
    """Position of the robot in one image; the last known one if it was not seen."""

    stamp_ns: int
    seen: Annotated[bool, "the robot was seen in this image"]
    position_um: Annotated[Vector2, "position of the robot; the last known one if it was not seen"]
    score: Annotated[float, "0 to 1, similarity to the robot's appearance"]
    lost_frames: Annotated[int, "number of images in a row without the robot"]
    radius_px: Annotated[float, "radius of the robot's image, low-pass filtered"]
    roi_px: Annotated[Vector, Shape(4), "x0, y0, x1, y1 of the searched region"]
    seen_ns: Annotated[int | None, "stamp of the latest frame in which it was seen; None: never, or not recorded"] = (
        None
    )
    velocity_px_s: Annotated[
        Vector, Shape("n"), "mean velocity (2,) of a robot that is tracked by its learned appearance; (0,): none"
    ] = NOT_STATED
    spread_px: Annotated[float, "mean distance from where it was expected"] = 0.0
    energy: Annotated[float, "mean of its squared foreground, in units of the noise's variance"] = 0.0
    neighbours_px: Annotated[Vector, Shape("m"), "x, y and energy of each object nearby, (3 k,)"] = NOT_STATED


@dataclass(frozen=True, slots=True, eq=False)
class Appearance(Message):
    """Appearance of the robot, as far as the tracker has found out."""

    stamp_ns: int
    polarity: Annotated[str, "dark, bright or mixed, relative to the background"]
    noise: Annotated[float, "noise of a pixel, one standard deviation in grey levels"]
    foreground_noise: Annotated[
        float, "noise of the foreground (stages/vision/foreground.py), one standard deviation in grey levels"
    ]
    radius_px: Annotated[float, "radius of the object in `views`, in camera px"]
    centre_px: Annotated[Vector2, "place of the object when it was learned"]
    views: Annotated[
        Raster,
        Shape("n", "p", "p"),
        "Foreground around the centre, in blocks of whole camera pixels: the first look, a slow mean, other looks. n = "
        "0: nothing was learned, the robot is a disc.",
    ]
    note: Annotated[str, "reason why nothing was found at the given place"] = ""


@dataclass(frozen=True, slots=True, eq=False)
class Background(Message):
    """Image of the solid of the chip, to which later images are registered."""

    stamp_ns: int
    pixels: Annotated[
        Matrix,
        Shape("n", 5),
        "Column, row, grey level, and the change of the grey level per pixel along columns and rows. n = 0: the image "
        "shows no structure of the solid, so no shift can be measured.",
    ]
    noise: Annotated[float, "noise of a pixel, one standard deviation in grey levels"]


@dataclass(frozen=True, slots=True, eq=False)
class Shift(Message):
    """Displacement of the image from the registration of the chip, because the stage or the camera shakes."""

    stamp_ns: int
    shift_px: Annotated[Vector2, "columns, rows: what the registration puts at p is seen at p + shift"]
    found: Annotated[bool, "False: the image is not like the background, and the shift is the one before"]
    alike: Annotated[float, "share of the background that agrees, 0 to 1"]
    rests: Annotated[bool, "the image rests: it did not move for a second, and small shifts are noise"] = False


@dataclass(frozen=True, slots=True, eq=False)
class Tracers(Message):
    """Tracks of all bodies in view but the robot, an element of each array a body: a constant-velocity filter's state.

    The covariance of position and velocity is the same along x and y.
    """

    stamp_ns: int
    id: Annotated[Vector, Shape("n"), "whole number of the body, the same for as long as it is followed"]
    position_um: Annotated[Matrix, Shape("n", 2), "position"]
    velocity_um_s: Annotated[Matrix, Shape("n", 2), "velocity"]
    std_um: Annotated[Vector, Shape("n"), "one standard deviation of the position, per component"]
    velocity_std_um_s: Annotated[Vector, Shape("n"), "one standard deviation of the velocity, per component"]
    shared_um2_s: Annotated[Vector, Shape("n"), "covariance of position and velocity, per component"]
    age_frames: Annotated[Vector, Shape("n"), "number of images that showed it"]
    lost_frames: Annotated[Vector, Shape("n"), "number of images in a row without it; 0: this one shows it"]
    entered: Annotated[Vector, Shape("n"), "1: it came in through an opening or the edge of the image; 0: it was there"]
    from_um: Annotated[Matrix, Shape("n", 2), "place at which the present stretch of its way begins"]
    from_s: Annotated[Vector, Shape("n"), "time of that on the session clock"]
    next_id: Annotated[int, "number of the next body"]
    missed_s: Annotated[
        Vector | None, Shape("n"), "time of that stretch over which no image showed it; None: not known, an older file"
    ] = None

    @property
    def count(self) -> int:
        """Number of bodies."""
        return len(self.id)


def shift_px(shift: Shift | None) -> tuple[float, float]:
    """The shift of an image (columns, rows); (0, 0) where none is measured."""
    return (0.0, 0.0) if shift is None else (float(shift.shift_px[0]), float(shift.shift_px[1]))
