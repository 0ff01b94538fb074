"""GigE Vision and USB3 Vision cameras by viva-genicam, which needs no software of the manufacturer.

A GigE camera that is unplugged looks at first like a slow one: no frame comes, and the library keeps the session. The
grabber closes it and connects anew.
"""

from __future__ import annotations

import time
from contextlib import ExitStack, suppress
from dataclasses import replace
from typing import Any

import viva_genicam as vg

from flowrec.core import NS_PER_S, RigError
from flowrec.rigs.lab.cameras.camera import Camera, CameraInfo, Grabbed, Wanted, find_device
from flowrec.rigs.lab.cameras.features import ABSENT, Feature, Features, Value, configure

_DISCOVER_MS = 500
_GIGE = "gige"
# Bootstrap registers of GigE Vision: serial number (text), frequency of the clock, and who controls the camera.
_SERIAL, _TICKS_HIGH, _CONTROL = (0x00D8, 16), (0x093C, 8), (0x0A00, 4)


class GenicamCamera(Camera):
    """See camera.Camera."""

    def __init__(self, wanted: Wanted) -> None:
        self._wanted = wanted
        self._stack = ExitStack()
        self._camera: vg.Camera | None = None
        self._stream: vg.FrameStream | None = None
        self._bits = 8

    def open(self) -> CameraInfo:
        name, device = self._device()
        try:
            camera = vg.connect_gige(device) if device.transport == _GIGE else vg.connect_u3v(device)
        except vg.GenicamError as error:
            raise RigError(f"camera {name}: no connection ({error}); see whether another program uses it") from error
        return self.use(camera, name)

    def use(self, camera: vg.Camera, name: str) -> CameraInfo:
        """Set a camera that is connected, and start it; `open` ends so.

        Raises
        ------
        RigError : a setting that it can not take, or it is gone.
        """
        self._camera = camera
        self._stack.callback(_quietly, camera.close)
        try:
            nodes = _GenicamNodes(camera)
            settled = configure(nodes, self._wanted)
            self._bits = settled.bits
            stream = camera.stream(deliver_incomplete=True, auto_packet_size=camera.transport == _GIGE)
            self._stream = stream.__enter__()
            self._stack.callback(_quietly, stream.__exit__, None, None, None)
            return replace(
                settled,
                model=f"{nodes.value('DeviceVendorName') or ''} {nodes.value('DeviceModelName') or name}".strip(),
                serial=str(nodes.value("DeviceSerialNumber") or nodes.value("DeviceID") or ""),
                id_bits=nodes.id_bits(camera.transport == _GIGE),
                ticks_per_s=_ticks_per_s(camera, nodes),
            )
        except vg.GenicamError as error:
            raise RigError(f"camera {name}: {error}; see to its cable, then try again") from error

    def grab(self, timeout_s: float) -> Grabbed | None:
        assert self._stream is not None, "grab() after open()"
        try:
            frame = self._stream.next_frame(timeout_ms=max(round(1e3 * timeout_s), 1))
        except vg.TransportError as error:
            if "timeout" in str(error):
                return None
            raise RigError(f"the camera is gone: {error}") from error
        arrival_ns = time.monotonic_ns()
        if frame is None:
            raise RigError("the camera has ended its stream")
        image = frame.to_numpy() if frame.is_complete else None
        if image is not None and image.ndim != 2:
            raise RigError(f"the camera sends {frame.pixel_format} where {self._wanted.pixel_format} was set")
        return Grabbed(image, self._bits, frame.block_id, frame.ts_dev, arrival_ns, incomplete=image is None)

    def alive(self) -> bool:
        assert self._camera is not None, "alive() after open()"
        try:
            if self._camera.transport == _GIGE:
                return any(self._camera.read_register(*_CONTROL))  # somebody controls it: so far, only this program
            self._camera.invalidate("DeviceModelName")
            self._camera.get("DeviceModelName")
        except vg.GenicamError:
            return False
        return True

    def discarded(self) -> int:
        return int(self._stream.stats().frames_backpressure) if self._stream is not None else 0

    def trigger(self) -> None:
        assert self._camera is not None, "trigger() after open()"
        try:
            self._camera.trigger_software()
        except vg.GenicamError as error:
            raise RigError(f"the camera does not take the trigger: {error}") from error

    def close(self) -> None:
        self._stack.close()

    def _device(self) -> tuple[str, Any]:
        """The camera that is wanted, and its name for people."""
        wanted = self._wanted.device
        devices: dict[str, Any] = {}
        for each in vg.discover(timeout_ms=_DISCOVER_MS, all=True):
            serial, controlled = _look(each)
            name = " ".join(filter(None, (each.manufacturer, each.model, serial, each.ip)))
            devices[name] = (name, each, controlled)
        with suppress(vg.GenicamError):  # a system without USB
            for usb in vg.discover_u3v():
                name = " ".join(filter(None, (usb.manufacturer, usb.model, usb.serial, f"USB {usb.bus}")))
                devices[name] = (name, usb, False)
        name, device, controlled = find_device(devices, wanted, "genicam")
        if controlled:
            raise RigError(
                f"camera {name} is busy: another program controls it; end that one (a program that was killed lets go "
                "of the camera after some seconds)"
            )
        return name, device


class _GenicamNodes(Features):
    """The settings of a camera; see features.Features."""

    def __init__(self, camera: vg.Camera) -> None:
        self._camera = camera
        self._names = frozenset(camera.nodes())

    def feature(self, name: str) -> Feature:
        if name not in self._names:
            return ABSENT
        state = self._camera.feature_state(name)
        if not (state.is_implemented and state.is_available):
            return ABSENT
        low, high, step = (state.range.min, state.range.max, state.range.inc) if state.range else (0.0, 0.0, 0.0)
        writable = state.access in ("RW", "WO")
        return Feature(state.value, low, high, step or 0.0, tuple(state.enum_entries or ()), writable)

    def put(self, name: str, value: Value) -> None:
        try:
            self._camera.set(name, str(value).lower() if isinstance(value, bool) else str(value))
        except vg.GenicamError as error:
            raise RigError(f"the camera does not take {name} = {value} ({error})") from error


def _look(device: vg.GigeDeviceInfo) -> tuple[str, bool]:
    """Serial number of a camera, and whether a program controls it; read only, so that it disturbs nobody."""
    try:
        camera = vg.connect_gige(device, monitor=True)
    except vg.GenicamError:
        return "", False  # it may be in another network; connecting to it says so
    try:
        serial = camera.read_register(*_SERIAL).split(b"\0")[0].decode("ascii", "replace")
        return serial, any(camera.read_register(*_CONTROL))
    except vg.GenicamError:
        return "", False
    finally:
        _quietly(camera.close)


def _ticks_per_s(camera: vg.Camera, nodes: _GenicamNodes) -> float:
    """Frequency of the camera's clock, as it states it."""
    if camera.transport != _GIGE:
        return NS_PER_S  # the clock of a USB3 Vision camera
    stated = nodes.value("GevTimestampTickFrequency")
    if isinstance(stated, int) and stated > 0:
        return float(stated)
    return float(int.from_bytes(camera.read_register(*_TICKS_HIGH), "big"))


def _quietly(call: Any, *arguments: Any) -> None:
    """Close something of a camera that may be gone; then there is nothing left to close."""
    with suppress(vg.GenicamError):
        call(*arguments)
