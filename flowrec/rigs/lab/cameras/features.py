"""Settings of a GenICam camera by their standard names, and by those of older cameras (SFNC, and before it).

What was asked is set, read back, and compared. Image size, pixel format and trigger must be as asked, because the rest
of a run depends on them (RigError); a difference of exposure, gain or rate is a note.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

from flowrec.core import RigError
from flowrec.rigs.lab.cameras.camera import SOFTWARE, CameraInfo, Wanted, bits_of, difference

_US = 1e-6
Value = int | float | bool | str


@dataclass(frozen=True, slots=True)
class Feature:
    """One setting as the device has it now.

    Attributes
    ----------
    value : None if it can not be read, as a command.
    low, high, step : of a number; step 0: any.
    entries : what an enumeration takes now.
    """

    value: Value | None
    low: float = 0.0
    high: float = 0.0
    step: float = 0.0
    entries: tuple[str, ...] = ()
    writable: bool = True


ABSENT = Feature(None, writable=False)  # of a setting that the device does not have, or not now


class Features(Protocol):
    """The settings of one device."""

    def feature(self, name: str) -> Feature:
        """The setting of this name; ABSENT if the device does not have it, or not now."""

    def put(self, name: str, value: Value) -> None:
        """Set it.

        Raises
        ------
        RigError : the device refuses.
        """

    def value(self, name: str) -> Value | None:
        """Its value; None if the device does not have it, or it can not be read."""
        return self.feature(name).value

    def id_bits(self, gige: bool) -> int:
        """Length of the block ids: GigE Vision has short ones, unless the extended ones are switched on."""
        return 16 if gige and self.value("GevGVSPExtendedIDMode") != "On" else 64


def configure(device: Features, wanted: Wanted) -> CameraInfo:
    """Set a device that does not acquire; what it has then. The driver adds what the settings do not tell.

    Raises
    ------
    RigError : image size, pixel format or trigger can not be as asked.
    """
    notes: list[str] = []
    pixel_format = _pixel_format(device, wanted.pixel_format)
    width_px, height_px = _region(device, wanted)
    _choose(device, "AcquisitionMode", "Continuous")
    _trigger(device, wanted.trigger)
    _choose(device, "ExposureAuto", "Off")
    _choose(device, "ExposureMode", "Timed")
    exposures, asked_s = ("ExposureTime", "ExposureTimeAbs"), wanted.exposure_s or None
    exposure_s = _set_number(device, exposures, "camera.exposure_s", asked_s, "s", notes, _US) or 0.0
    if wanted.gain is not None:
        _choose(device, "GainAuto", "Off")
    gain = _set_number(device, ("Gain", "GainRaw", "GainAbs"), "lab.gain", wanted.gain, "", notes)
    rate_hz = _rate(device, wanted, notes)
    return CameraInfo(
        model="",
        serial="",
        width_px=width_px,
        height_px=height_px,
        bits=bits_of(pixel_format),
        rate_hz=rate_hz,
        exposure_s=exposure_s,
        gain=gain,
        pixel_format=pixel_format,
        notes=tuple(notes),
    )


def _pixel_format(device: Features, asked: str) -> str:
    """Set the pixel format, or another one of the same depth: packed or not, it holds the same data."""
    plain = f"Mono{bits_of(asked)}"
    have = device.feature("PixelFormat")
    if have is ABSENT:
        raise RigError("the camera has no setting PixelFormat; it is no area camera by GenICam")
    same = [name for name in (asked, plain, f"{plain}p", f"{plain}Packed") if name in have.entries]
    if not same:
        grey = [name for name in have.entries if name.startswith("Mono")]
        raise RigError(f"lab.pixel_format: the camera has no {plain}; it has {', '.join(grey) or 'no grey levels'}")
    device.put("PixelFormat", same[0])
    return same[0]


def _region(device: Features, wanted: Wanted) -> tuple[int, int]:
    """Set the region of interest. The offset is taken away first, because it limits the size."""
    axes = (("Width", "OffsetX", "width_px", wanted.width_px), ("Height", "OffsetY", "height_px", wanted.height_px))
    sizes = []
    for axis, (size, offset, key, size_px) in enumerate(axes):
        if device.feature(offset).writable:
            device.put(offset, 0)
        have = device.feature(size)
        asked = size_px or round(have.high)
        if have.value != asked:
            if not have.writable:
                raise RigError(
                    f"camera.{key} = {asked}: the size of the camera's image can not be set; it is {have.value}"
                )
            step = have.step or 1
            if not have.low <= asked <= have.high or (asked - have.low) % step:
                nearest = have.low + round((min(max(asked, have.low), have.high) - have.low) / step) * step
                raise RigError(
                    f"camera.{key} = {asked}: the camera takes {have.low:g} to {have.high:g} in steps of {step:g}; the "
                    f"nearest is {min(nearest, have.high):g}"
                )
            device.put(size, asked)
        place = device.feature(offset)
        if place.writable:
            middle = place.high / 2 // (place.step or 1) * (place.step or 1)
            at = int(middle) if wanted.offset_px is None else wanted.offset_px[axis]
            device.put(offset, at)
        elif wanted.offset_px is not None and wanted.offset_px[axis] != (0 if place is ABSENT else place.value):
            setting = ("lab.offset_x_px", "lab.offset_y_px")[axis]
            raise RigError(f"{setting}: the camera has no {offset} that can be set")
        got = device.feature(size)
        if got.value != asked:
            raise RigError(f"camera.{key} = {asked}: the camera has set {got.value}; set that, or see to its binning")
        sizes.append(asked)
    return sizes[0], sizes[1]


def _trigger(device: Features, asked: str) -> None:
    """Switch the triggers off, or the one of the frame on."""
    selector, mode = device.feature("TriggerSelector"), device.feature("TriggerMode")
    if mode is ABSENT:
        if asked:
            raise RigError(f"lab.trigger = {asked!r}: the camera has no trigger")
        return
    for each in selector.entries:
        if selector.writable:
            device.put("TriggerSelector", each)
        now = device.feature("TriggerMode")
        if now.writable and now.value != "Off":
            device.put("TriggerMode", "Off")
    if selector is ABSENT:
        device.put("TriggerMode", "Off")
    if not asked:
        return
    if "FrameStart" in selector.entries:
        device.put("TriggerSelector", "FrameStart")
    source = device.feature("TriggerSource")
    name = "Software" if asked == SOFTWARE else asked
    if name not in source.entries:
        entries = "none" if source is ABSENT else ", ".join(source.entries)
        raise RigError(f"lab.trigger = {asked!r}: the camera has no such source of a trigger; it has {entries}")
    device.put("TriggerSource", name)
    device.put("TriggerMode", "On")


def _set_number(
    device: Features,
    names: tuple[str, ...],
    key: str,
    asked: float | None,
    unit: str,
    notes: list[str],
    scale: float = 1.0,
) -> float | None:
    """Set a number that is asked for in `scale` units of the device; what it is, None if the device does not say."""
    name = _first(device, *names)
    if name is not None and asked is not None:
        _put_clipped(device, name, asked / scale)
    got = None if name is None else _number(device, name) * scale
    notes.extend(difference(key, asked, got, unit))
    return got


def _rate(device: Features, wanted: Wanted, notes: list[str]) -> float:
    """Set the rate in Hz; returns the one that is reached, 0 if the device does not say."""
    free = not wanted.trigger
    for switch in ("AcquisitionFrameRateEnable", "AcquisitionFrameRateControlEnabled"):
        if device.feature(switch).writable:
            device.put(switch, free)
    name = _first(device, "AcquisitionFrameRate", "AcquisitionFrameRateAbs")
    if free and name is not None:
        _put_clipped(device, name, wanted.rate_hz)
    reached = _first(device, "ResultingFrameRate", "ResultingFrameRateAbs", "AcquisitionResultingFrameRate", name or "")
    if reached is None:
        notes.extend(difference("camera.rate_hz", wanted.rate_hz, None, "Hz"))
        return 0.0
    rate_hz = _number(device, reached)
    if free or rate_hz < wanted.rate_hz:
        notes.extend(difference("camera.rate_hz", wanted.rate_hz, rate_hz, "Hz"))
    return rate_hz if free else wanted.rate_hz


def _first(device: Features, *names: str) -> str | None:
    """The first of some names that the device has and that can be read."""
    return next((name for name in names if device.value(name) is not None), None)


def _number(device: Features, name: str) -> float:
    return float(device.value(name) or 0.0)


def _put_clipped(device: Features, name: str, value: float) -> None:
    """Set a number to the nearest one that the device takes."""
    have = device.feature(name)
    if not have.writable:
        return
    value = min(max(value, have.low), have.high) if have.low < have.high else value
    if isinstance(have.value, int):
        step = have.step or 1
        value = int(have.low + round((value - have.low) / step) * step)
    device.put(name, value)


def _choose(device: Features, name: str, entry: str) -> None:
    """Set an enumeration, where the device has it and it has the entry."""
    have = device.feature(name)
    if have.writable and entry in have.entries and have.value != entry:
        device.put(name, entry)
