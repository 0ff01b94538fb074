"""Messages of rigs, the operator and the simulated world: images, the state of the coils, actions, the truth."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np

from flowrec.core.declarations import NOT_STATED, Image, Matrix, Message, NanFloat, PerCoil, Shape, Vector, Vector2
from flowrec.core.enums import Action
from flowrec.core.errors import RigError

PIXEL_BITS = (8, 10, 12, 14, 16)


def pixel_type(bits: int) -> np.dtype[np.uint8 | np.uint16]:
    """The type of the pixels of images of a depth."""
    return np.dtype(np.uint8 if bits <= 8 else np.uint16)


@dataclass(frozen=True, slots=True, eq=False)
class Frame(Message):
    """One camera image. The stamp is the middle of the exposure.

    Raises
    ------
    RigError : the image does not hold grey levels of `bits`: uint8 for 8 bits, for more uint16 in the host's byte order
        and no level above 2^bits - 1. Nothing is converted, because that would change the data.
    """

    stamp_ns: int
    index: Annotated[int, "number of the image by the camera's count"]
    image: Annotated[Image, Shape("h", "w"), "grey levels"]
    bits: Annotated[int, "depth of the camera's pixels: 8, 10, 12, 14 or 16"] = 8

    def __post_init__(self) -> None:
        image = np.asarray(self.image)
        if self.bits not in PIXEL_BITS:
            raise RigError(
                f"frame {self.index}: an image of {self.bits} bit; the depths are {', '.join(map(str, PIXEL_BITS))}"
            )
        expected = pixel_type(self.bits)
        if image.dtype != expected or image.ndim != 2:
            shape = " x ".join(map(str, image.shape))
            raise RigError(
                f"frame {self.index}: an image of {image.dtype} and shape {shape}, where {expected} and shape height x "
                f"width is expected for {self.bits} bit: it can not be kept exactly; set the camera to grey levels "
                "(Mono8 to Mono16) and camera.bits to its depth"
            )
        image = np.ascontiguousarray(image)
        if 8 < self.bits < 16 and image.max(initial=0) >> self.bits:  # 0.2 ms for 5 Mpx
            raise RigError(
                f"frame {self.index}: a grey level of {image.max()} in an image of {self.bits} bit; set camera.bits to "
                "the depth of the camera, or the camera to unpacked pixels aligned to the lowest bit"
            )
        if image.flags.writeable:
            image = image.view()
            image.flags.writeable = False
        object.__setattr__(self, "image", image)


@dataclass(frozen=True, slots=True, eq=False)
class Applied(Message):
    """State of the coils up to this frame, read back from the rig; the command is in `Currents`."""

    stamp_ns: int
    frequency_hz: Annotated[float, "frequency of the rotating field, now"]
    heading_rad: Annotated[float, "heading of the field, now"]
    amplitude_mt: Annotated[float, "amplitude of the field, now"]
    currents_a: Annotated[PerCoil, "current of each coil, now; of three coils x, y, z"]
    turns: Annotated[
        Vector2,
        "Revolutions along x and y since the previous frame: the integral of f (cos phi, sin phi) dt. Multiplied by um "
        "per revolution it is the robot's own displacement, with every delay and switching in between.",
    ]
    image_since_ns: Annotated[
        int | None,
        "Stamp of the first of the consecutive frames that have the same image as this one; this frame's stamp if the "
        "image is new. Images are compared on arrival, because a file may hold them in part or with losses. None: not "
        "compared (older files); then only the number of frames decides on a loss of the robot.",
    ] = None
    absent_until_ns: Annotated[
        int | None,
        "Stamp of the last tick to which the camera had no image to give, because it was absent or had delivered its "
        "last one. None: there was none.",
    ] = None

    @property
    def repeats_image(self) -> bool:
        """True if the camera repeated the image of the previous frame, or gave none."""
        return self.image_since_ns is not None and self.image_since_ns < self.stamp_ns

    @property
    def without_image(self) -> bool:
        """True if the camera had no image to give to this tick."""
        return self.absent_until_ns == self.stamp_ns


@dataclass(frozen=True, slots=True, eq=False)
class Measured(Message):
    """Currents that an amplifier has measured, at the stamp of the measurement."""

    stamp_ns: int
    currents_a: Annotated[PerCoil, "measured current of each coil"]
    put_out_a: Annotated[PerCoil, "current of each coil that the amplifier was to put out at that time"]


@dataclass(frozen=True, slots=True, eq=False)
class OperatorEvent(Message):
    """An action of the operator."""

    stamp_ns: int
    action: Annotated[str, f"action of the operator: {', '.join(Action)}"]
    text: Annotated[str, "text of a mark or a note"]
    goal_um: Annotated[Vector, Shape("n"), "goal (2,) of the action goal; (0,) of others"] = NOT_STATED
    speed_limit_um_s: Annotated[float | None, "limit of the action speed; None: the limit is taken away"] = None


@dataclass(frozen=True, slots=True, eq=False)
class Hand(Message):
    """Steering by hand as a tick used it: one a tick while the button is held, and one that says why this has ended."""

    stamp_ns: int
    held: Annotated[bool, "the button is held: this sample steers the robot on the tick of the stamp, and on no other"]
    share: Annotated[
        Vector2, "demanded velocity over the robot's speed limit, x and y of the chip; its length is at most 1"
    ]
    age_s: Annotated[float, "time from the arrival of the sample to the tick that used it"]
    by: Annotated[str, "what steers: gamepad or keys"]
    why: Annotated[str, "why steering has ended; '' while the button is held"] = ""


@dataclass(frozen=True, slots=True, eq=False)
class Truth(Message):
    """Ground truth of a simulated rig. Recorded for evaluation; no stage reads it."""

    stamp_ns: int
    position_um: Annotated[Vector2, "true position of the robot"]
    flow_um_s: Annotated[Vector2, "true flow at the robot"]
    clearance_um: Annotated[NanFloat, "distance from the robot's surface to the nearest wall"]
    contacts: Annotated[int, "wall contacts so far"]


@dataclass(frozen=True, slots=True, eq=False)
class TracerTruth(Message):
    """Ground truth of the tracers of a simulated rig, a row each. Recorded for evaluation; no stage reads it."""

    stamp_ns: int
    id: Annotated[Vector, Shape("n"), "whole number of the body; one that enters anew has a new number"]
    position_um: Annotated[Matrix, Shape("n", 2), "true position"]
    velocity_um_s: Annotated[Matrix, Shape("n", 2), "true velocity"]
    height_share: Annotated[Vector, Shape("n"), "height of the centre over the floor, of the channel's depth"]
    radius_um: Annotated[Vector, Shape("n"), "radius"]
    stuck: Annotated[Vector, Shape("n"), "1: it sticks to the floor; 0: it floats"]
