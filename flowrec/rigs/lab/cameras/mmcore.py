"""Any camera of Micro-Manager by pymmcore-plus.

Micro-Manager's drivers are vendors' own, with settings of their own. Pixel size and depth, exposure, gain and region
are set where the device has them; the rest, trigger and rate included, belongs into the configuration file.
"""

from __future__ import annotations

import time
from contextlib import suppress
from datetime import datetime
from pathlib import Path

from pymmcore_plus import CMMCorePlus

from flowrec.core import RigError, nanoseconds
from flowrec.rigs.lab.cameras.camera import Camera, CameraInfo, Grabbed, NoCameraError, Wanted, bits_of, difference

_RATES = ("FrameRate", "Frame Rate", "AcquisitionFrameRate", "FramesPerSecond")  # names of one property
_LABEL = "Camera"
_BUFFER_S = 2.0  # of images in the buffer of Micro-Manager
_POLL_S = 0.0005
_BELIEVED_S = 60.0  # an image that is said to be older than this has another clock


class MmcoreCamera(Camera):
    """See camera.Camera. `Wanted.config` is a configuration file, or "adapter:device" such as DemoCamera:DCam."""

    def __init__(self, wanted: Wanted) -> None:
        self._wanted = wanted
        self._core: CMMCorePlus | None = None
        self._bits = 8
        self._next: int | None = None  # number of the next image
        self._discarded = 0  # missing numbers

    def open(self) -> CameraInfo:
        wanted = self._wanted
        if wanted.trigger:
            raise RigError(f"lab.trigger = {wanted.trigger!r}: with mmcore, set the trigger in the configuration file")
        try:
            self._core = core = CMMCorePlus()
            # Its events are not used. Without them no thread of Micro-Manager runs Python, where a garbage collection
            # that frees another core would end the process.
            super(CMMCorePlus, core).registerCallback(None)
            label = self._load(core)
            notes = self._set(core, label)
            self._bits = core.getImageBitDepth()
            if self._bits not in (8, 10, 12, 14, 16) or core.getNumberOfComponents() != 1:
                raise RigError(
                    f"camera {label}: images of {self._bits} bits and {core.getNumberOfComponents()} colours; set its "
                    "properties to grey levels of 8 to 16 bits in the configuration file"
                )
            size = core.getImageWidth(), core.getImageHeight()
            megabytes = size[0] * size[1] * core.getBytesPerPixel() * wanted.rate_hz * _BUFFER_S / 1e6
            core.setCircularBufferMemoryFootprint(max(round(megabytes), 16))
            core.startContinuousSequenceAcquisition(1e3 / wanted.rate_hz)
            return CameraInfo(
                model=f"{core.getDeviceLibrary(label)} {core.getDeviceName(label)}",
                serial=_property(core, label, "SerialNumber", "CameraID") or "",
                width_px=size[0],
                height_px=size[1],
                bits=self._bits,
                rate_hz=0.0,
                exposure_s=core.getExposure() / 1e3,
                gain=_number(_property(core, label, "Gain")),
                pixel_format=_property(core, label, "PixelType") or "",
                id_bits=64,
                notes=notes,
            )
        except (RuntimeError, ValueError, OSError) as error:
            raise RigError(f"camera of Micro-Manager: {' '.join(str(error).split())}") from error

    def _load(self, core: CMMCorePlus) -> str:
        """Load the devices; the label of the camera."""
        config, device = self._wanted.config, self._wanted.device
        adapter, colon, name = config.partition(":")
        if Path(config).is_file():
            core.loadSystemConfiguration(config)
        elif colon and not Path(adapter).is_absolute() and len(adapter) > 1:
            core.loadDevice(_LABEL, adapter, name)
            core.initializeDevice(_LABEL)
            core.setCameraDevice(_LABEL)
        else:
            raise (RigError if config else NoCameraError)(
                f"lab.device_config = {config!r}: no such file; name a configuration file of Micro-Manager, or "
                f"adapter:device; adapters here: {', '.join(core.getDeviceAdapterNames()) or 'none (mmcore install)'}"
            )
        if device:
            core.setCameraDevice(device)
        label = core.getCameraDevice()
        if not label:
            raise RigError(f"lab.device_config = {config}: no camera in it; set lab.device to the label of one")
        return str(label)

    def _set(self, core: CMMCorePlus, label: str) -> tuple[str, ...]:
        """Set what is wanted; returns the notes."""
        wanted = self._wanted
        bits = bits_of(wanted.pixel_format)
        for key, values in (
            ("PixelType", (f"{bits}bit", "8bit" if bits == 8 else "16bit")),
            ("BitDepth", (str(bits),)),
        ):
            allowed = core.getAllowedPropertyValues(label, key) if core.hasProperty(label, key) else ()
            value = next((value for value in values if value in allowed), None)
            if value is not None:
                core.setProperty(label, key, value)
        if core.getImageBitDepth() != bits:
            raise RigError(
                f"camera.bits = {bits}: camera {label} gives {core.getImageBitDepth()} bits; set that, or its "
                "properties in the configuration file"
            )
        core.clearROI()
        full = core.getImageWidth(), core.getImageHeight()
        size = (wanted.width_px, wanted.height_px) if wanted.width_px else full
        at = wanted.offset_px or (max(full[0] - size[0], 0) // 2, max(full[1] - size[1], 0) // 2)
        if size != full:
            if size[0] + at[0] > full[0] or size[1] + at[1] > full[1]:
                raise RigError(
                    f"camera.width_px x camera.height_px = {size[0]} x {size[1]} at {at[0]}, {at[1]}: the image of "
                    f"camera {label} has {full[0]} x {full[1]} pixels"
                )
            core.setROI(*at, *size)
        got = core.getImageWidth(), core.getImageHeight()
        if got != size:
            raise RigError(
                f"camera.width_px x camera.height_px = {size[0]} x {size[1]}: camera {label} has set {got[0]} x "
                f"{got[1]}; set that"
            )
        for name in filter(lambda name: core.hasProperty(label, name), _RATES):
            if not core.isPropertyReadOnly(label, name):
                core.setProperty(label, name, wanted.rate_hz)
        if wanted.exposure_s:
            core.setExposure(1e3 * wanted.exposure_s)
        notes = difference("camera.exposure_s", wanted.exposure_s or None, core.getExposure() / 1e3, "s")
        if wanted.gain is not None and core.hasProperty(label, "Gain"):
            core.setProperty(label, "Gain", wanted.gain)
        return notes + difference("lab.gain", wanted.gain, _number(_property(core, label, "Gain")), "")

    def grab(self, timeout_s: float) -> Grabbed | None:
        core = self._core
        assert core is not None, "grab() after open()"
        end_s = time.monotonic() + timeout_s
        try:
            while not core.getRemainingImageCount():
                if not core.isSequenceRunning():
                    raise RigError("the camera is gone: its sequence of images has ended")
                if time.monotonic() > end_s:
                    return None
                time.sleep(_POLL_S)
            image, facts = core.popNextImageAndMD()
        except (RuntimeError, IndexError) as error:
            raise RigError(f"the camera is gone: {' '.join(str(error).split())}") from error
        number = int(facts.get("ImageNumber", self._next or 0))
        # Micro-Manager numbers what it puts into its buffer, which it empties when it is full.
        self._discarded += max(number - self._next, 0) if self._next is not None else 0
        self._next = number + 1
        return Grabbed(image, self._bits, number, None, _arrival_ns(facts.get("TimeReceivedByCore")))

    def alive(self) -> bool:
        return self._core is not None and self._core.isSequenceRunning()

    def discarded(self) -> int:
        return self._discarded

    def trigger(self) -> None:
        raise RigError("with mmcore, set the trigger in the configuration file")

    def close(self) -> None:
        core, self._core = self._core, None
        if core is not None:
            with suppress(RuntimeError):  # a device that is gone
                core.stopSequenceAcquisition()
            with suppress(RuntimeError):
                core.unloadAllDevices()


def _property(core: CMMCorePlus, label: str, *names: str) -> str | None:
    """The first of some properties that the device has."""
    return next((str(core.getProperty(label, name)) for name in names if core.hasProperty(label, name)), None)


def _number(text: str | None) -> float | None:
    try:
        return None if text is None else float(text)
    except ValueError:  # some devices name their gains
        return None


def _arrival_ns(received: str | None) -> int:
    """Arrival time of an image in Micro-Manager, on the monotonic clock; it states the local time, without a zone."""
    now_ns = time.monotonic_ns()
    if not received:
        return now_ns
    age_s = time.time() - datetime.fromisoformat(received).timestamp()
    return now_ns - nanoseconds(age_s) if 0.0 <= age_s < _BELIEVED_S else now_ns
