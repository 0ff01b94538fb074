"""Camera drivers: the protocol of the rows of CAMERAS, and the messages between driver and grabber.

A driver opens one device with the settings that are wanted, and hands on what the device delivers. It neither queues,
nor counts, nor reconnects: `grabber.Grabber` does that, in a thread, for every driver alike. The rig uses the grabber
only.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Any, Protocol, Self

from flowrec.core import Image, RigError
from flowrec.stages import CAMERAS, CameraSettings, Lab

SOFTWARE = "software"  # value of Wanted.trigger
_NOTABLE = 0.01  # relative difference between what was asked and what is


@dataclass(frozen=True, slots=True)
class Wanted:
    """Settings requested from a camera.

    Attributes
    ----------
    device : serial number, model, address or name; for opencv a number, a file or a URL. '': the only one there is.
    width_px, height_px : the region of interest; 0: the whole image.
    offset_px : (x, y) of its upper left pixel; None: the region lies in the middle of the sensor.
    rate_hz : of the frames; with a hardware trigger, of the triggers.
    exposure_s : 0: as the camera has it.
    delay_s : constant time from the end of an exposure to the arrival of its image.
    gain : in the unit of the camera, dB for most; None: as the camera has it.
    pixel_format : Mono8, Mono10, Mono12, Mono14, Mono16, or a packed one (Mono12p, Mono12Packed).
    trigger : '': the camera runs freely; 'software': a frame per call of `trigger`; else the name of the line, for
        instance 'Line1'.
    config : configuration file of Micro-Manager (mmcore), or "adapter:device", for instance DemoCamera:DCam.
    settings : of a camera of another package: its `Settings`, section [lab.NAME] of the configuration.
    """

    device: str = ""
    width_px: int = 640
    height_px: int = 512
    offset_px: tuple[int, int] | None = None
    rate_hz: float = 30.0
    exposure_s: float = 0.0
    delay_s: float = 0.0
    gain: float | None = None
    pixel_format: str = "Mono8"
    trigger: str = ""
    config: str = ""
    settings: Any = None


@dataclass(frozen=True, slots=True)
class CameraInfo:
    """Properties that the device reports after it has been set, and opened.

    Attributes
    ----------
    model, serial : '' where it does not say.
    width_px, height_px, bits : of the images that come; values are below 2**bits.
    rate_hz : the rate that is reached by the device's own account; 0: it does not say.
    exposure_s, gain : as read back; 0 and None: it does not say.
    pixel_format : as the device names it.
    id_bits : of its block ids: 16 (0 is skipped when they wrap), 32, 64; 0: it has none.
    ticks_per_s : of its clock, as stated; 0: it has no clock, and arrival times are used.
    notes : one line for each setting that differs from what was asked, or that the camera does not have.
    """

    model: str
    serial: str
    width_px: int
    height_px: int
    bits: int
    rate_hz: float
    exposure_s: float = 0.0
    gain: float | None = None
    pixel_format: str = ""
    id_bits: int = 0
    ticks_per_s: float = 0.0
    notes: tuple[str, ...] = ()

    @property
    def name(self) -> str:
        """Model and serial number, for people."""
        return " ".join(filter(None, (self.model, self.serial))) or "camera"


@dataclass(frozen=True, slots=True)
class Grabbed:
    """Result of one call of `grab`.

    Attributes
    ----------
    image : (height, width), uint8 or uint16; None if the image is incomplete.
    bits : depth of the image; values are below 2**bits.
    block_id : as the device counts, not unwrapped; None: it does not count.
    device_ticks : of the device's clock; None: it has none.
    arrival_ns : monotonic clock of the host when the driver had the whole image.
    incomplete : parts of the image are missing, or the device marks it as bad. It is counted and never handed on.
    """

    image: Image | None
    bits: int
    block_id: int | None
    device_ticks: int | None
    arrival_ns: int
    incomplete: bool = False


class Camera(Protocol):
    """One device. All methods but `trigger` are called in one thread; `open` again after `close` connects anew.

    `of(wanted)` of a row's class in CAMERAS makes one; nothing is touched before `open`.
    """

    def __init__(self, wanted: Wanted) -> None:
        """Keep the settings."""

    @classmethod
    def of(cls, wanted: Wanted) -> Self:
        """The camera that is to be opened with these settings."""
        return cls(wanted)

    def open(self) -> CameraInfo:
        """Find the device, connect, set what is wanted, read it back, and start to acquire.

        Raises
        ------
        RigError : no device, more than one and none is named, busy, or a setting that it can not take; one line.
        """

    def grab(self, timeout_s: float) -> Grabbed | None:
        """The next image, whole or not; None after the timeout: the device is slow, waits for a trigger, or is gone.

        Raises
        ------
        RigError : the device is gone.
        """

    def alive(self) -> bool:
        """True if the device still answers. It is asked when no image comes; it may take up to half a second."""

    def discarded(self) -> int:
        """Whole images that the driver has thrown away since `open`, because `grab` was not called soon enough."""
        return 0

    def trigger(self) -> None:
        """Expose one frame, with trigger = 'software'; any thread.

        Raises
        ------
        RigError : the device refuses.
        """

    def close(self) -> None:
        """Stop and disconnect; never raises, also when the device is gone."""


def wanted_of(camera: CameraSettings, lab: Lab) -> Wanted:
    """Camera settings from the sections [camera] and [lab] of a configuration; the rate must be resolved.

    Raises
    ------
    RigError : only one of the two offsets is set.
    """
    if (lab.offset_x_px is None) != (lab.offset_y_px is None):
        raise RigError("lab.offset_x_px and lab.offset_y_px: set both, or none for the middle of the sensor")
    assert camera.rate_hz is not None, "a resolved configuration"
    return Wanted(
        device=lab.device,
        width_px=camera.width_px,
        height_px=camera.height_px,
        offset_px=None if lab.offset_x_px is None or lab.offset_y_px is None else (lab.offset_x_px, lab.offset_y_px),
        rate_hz=camera.rate_hz,
        exposure_s=camera.exposure_s,
        delay_s=lab.camera_delay_s,
        gain=lab.gain,
        pixel_format=lab.pixel_format or f"Mono{camera.bits}",
        trigger=lab.trigger,
        config=lab.device_config,
        settings=getattr(lab, lab.camera, None) if not CAMERAS.own(lab.camera) else None,
    )


def bits_of(pixel_format: str) -> int:
    """Depth of a monochrome pixel format.

    Raises
    ------
    RigError : it is another one.
    """
    found = re.fullmatch(r"Mono(8|10|12|14|16)(p|Packed)?", pixel_format)
    if found is None:
        raise RigError(
            f"lab.pixel_format = {pixel_format!r}: must be one of Mono8, Mono10, Mono12, Mono14, Mono16, or a packed "
            "one (Mono10p, Mono12p, Mono12Packed)"
        )
    return int(found[1])


def difference(key: str, asked: float | None, got: float | None, unit: str) -> tuple[str, ...]:
    """A note, if a setting is not what was asked; None: nothing was asked, or the camera does not have it."""
    if asked is None:
        return ()
    unit = f" {unit}" if unit else ""
    if got is None:
        return (f"{key} = {asked:g}{unit}: the camera has no such setting; set it on the camera itself",)
    if abs(got - asked) <= _NOTABLE * abs(asked):
        return ()
    return (f"{key} = {asked:g}{unit} asked, {got:.4g}{unit} reached",)


class NoCameraError(RigError):
    """A driver finds no camera at all; another one may."""


def find_device(devices: dict[str, Any], wanted: str, where: str) -> Any:
    """The device that is wanted among those that were found, by name, or by a unique part of its description.

    Raises
    ------
    NoCameraError : none.
    RigError : none that is wanted, or several.
    """
    if not devices:
        text = "no camera found; see to its power and cable, and whether another program uses it"
        raise NoCameraError(f"{where}: {text}")
    names = [name for name in devices if not wanted or wanted.lower() in name.lower()]
    listed = "; ".join(devices)
    if not names:
        raise RigError(f"{where}: no camera matches lab.device = {wanted!r}; found: {listed}")
    if len(names) > 1:
        raise RigError(f"{where}: {len(names)} cameras found; set lab.device to part of one of: {listed}")
    return devices[names[0]]
