"""The interface of a rig, and the checks of every frame that a camera delivers, before any stage sees it.

The table of rigs is in rig_settings.py, because the configuration names one.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Iterator
from contextlib import AbstractContextManager
from dataclasses import replace
from typing import Protocol, Self, runtime_checkable

import numpy as np

from flowrec.core import Currents, Frame, Image, RigError, seconds
from flowrec.rigs.streams.stream import SampleStream
from flowrec.stages import Inputs, StreamSettings

_ROW_STEP = 16  # a camera's noise changes some pixel of these rows in every image
_REJECTED_LIMIT = 50  # frames in a row, then the robot is out of control


class Rig(Protocol):
    """Camera and coils. Leaving the context zeroes the coils.

    `zero` is for emergencies. The watchdog calls it in another thread than the one that calls the other methods, at any
    time from before the context is entered until the process ends, also while `inputs` or `apply` is at work or stuck
    in a driver.
    """

    def __enter__(self) -> Self: ...

    def __exit__(self, *error: object) -> None: ...

    def inputs(self) -> Iterator[Inputs]:
        """The inputs of each frame."""

    def apply(self, currents: Currents) -> None:
        """Send a command to the coils."""

    def zero(self) -> None:
        """Take the field away now; until the rig is entered again `apply` lets none back. A second call is harmless.

        Raises RigError: the hardware has refused; it is called again.
        """


@runtime_checkable
class Connecting(Protocol):
    """A rig with devices. They are found before the file of a run is made."""

    tell: Callable[[str], None]  # called with one line for a person; to be set by who makes the rig

    def connected(self) -> AbstractContextManager[None]:
        """Context in which the devices are open. Nothing is energised before the rig itself is entered, inside of it.

        Raises
        ------
        RigError, UsageError : on entering; one line says which device is missing, busy or not as configured.
        """


@runtime_checkable
class Clocked(Protocol):
    """A rig in real time: its stamps count from a moment of the host's monotonic clock."""

    epoch_ns: int | None  # that moment; None before the first frame, and where the rig does not keep to a clock


@runtime_checkable
class Resting(Protocol):
    """A rig that takes the field away between two ticks, and gives it back with the next command."""

    def rest(self) -> None:
        """Take the field away until the next command. Any thread, at any time; returns at once."""


@runtime_checkable
class Measuring(Protocol):
    """A simulated rig, which has sensors of its own."""

    def stream(self, name: str, settings: StreamSettings) -> SampleStream:
        """The stream of a section [streams.NAME] of the kind `simulated`."""


@runtime_checkable
class Tried(Protocol):
    """A rig whose images can be had before a run, to measure whether the machine keeps up with them."""

    def tried(self) -> Generator[Inputs]:
        """The inputs of a run that gives no command, as often as asked; once connected, before the rig is entered."""


@runtime_checkable
class Picturing(Protocol):
    """A rig that can show the chip before a run."""

    def picture(self) -> Image:
        """An image of the camera; of a rig with devices while they are connected. Raises RigError: no image comes."""


def increasing_stamps(inputs: Iterator[Inputs], after_ns: int, rejected: Callable[[], None]) -> Iterator[Inputs]:
    """Inputs whose stamps increase; `rejected` is called for every other one.

    The turns of a rejected frame are added to those of the next one, so that no rotation of the field is lost; its
    messages of extra topics come with the next one. Raises RigError: 50 frames in a row are rejected: the robot is out
    of control.
    """
    lost: list[Inputs] = []
    for arrived in inputs:
        if arrived.stamp_ns > after_ns:
            yield _with_lost(arrived, lost) if lost else arrived
            after_ns = arrived.stamp_ns
            lost.clear()
            continue
        lost.append(arrived)
        rejected()
        if len(lost) == _REJECTED_LIMIT:
            raise RigError(
                f"the rig's frames have gone back in time by {seconds(after_ns - arrived.stamp_ns):.3f} s, {len(lost)}"
                " in a row; see to the camera's clock, then record again"
            )


def _with_lost(arrived: Inputs, lost: list[Inputs]) -> Inputs:
    turns = sum((one.applied.turns for one in lost), arrived.applied.turns)
    extra = {path: message for one in (*lost, arrived) for path, message in one.extra.items()}
    return replace(arrived, applied=replace(arrived.applied, turns=turns), extra=extra)


def checked_images(inputs: Iterator[Inputs], image_shape: tuple[int, int], bits: int = 8) -> Iterator[Inputs]:
    """The inputs with `applied.image_since_ns` filled in; images must be (height, width) pixels of `image_shape`.

    Raises RigError: an image has another size, or another depth than `bits`.
    """
    last: Frame | None = None
    since_ns = 0
    for arrived in inputs:
        frame = arrived.frame
        if frame is not None:  # else the camera is absent
            if frame.image.shape != image_shape:
                height, width = frame.image.shape
                raise RigError(
                    f"frame {frame.index}: an image of {width} x {height} pixels, where camera.width_px x "
                    f"camera.height_px = {image_shape[1]} x {image_shape[0]} is expected; set them, or the camera's "
                    "region of interest"
                )
            if frame.bits != bits:
                raise RigError(
                    f"frame {frame.index}: an image of {frame.bits} bit, where camera.bits = {bits} is expected; set "
                    "it, or the camera's pixel format"
                )
            if last is None or not _same(last, frame):
                since_ns = arrived.stamp_ns
            last = frame
        yield replace(arrived, applied=replace(arrived.applied, image_since_ns=since_ns)) if last else arrived


def _same(one: Frame, other: Frame) -> bool:
    """True if two images are equal. A few rows are compared first, so that a new image costs microseconds."""
    a, b = one.image, other.image
    return np.array_equal(a[::_ROW_STEP], b[::_ROW_STEP]) and np.array_equal(a, b)
