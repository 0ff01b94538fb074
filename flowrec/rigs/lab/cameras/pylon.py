"""Basler cameras by pypylon, whose wheel brings the pylon runtime; also its camera emulator (PYLON_CAMEMU=1)."""

from __future__ import annotations

import time
import warnings
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

with warnings.catch_warnings():
    # SWIG's types; where warnings are errors, the import would crash the interpreter.
    warnings.filterwarnings("ignore", "builtin type .* has no __module__ attribute", DeprecationWarning)
    from pypylon import genicam, pylon

from flowrec.core import NS_PER_S, RigError
from flowrec.rigs.lab.cameras.camera import Camera, CameraInfo, Grabbed, Wanted, find_device
from flowrec.rigs.lab.cameras.features import ABSENT, Feature, Features, Value, configure

_BUFFERS = 32  # for images that wait to be grabbed: 0.3 s at 100 Hz
_EMULATOR = "BaslerCamEmu"
_GIGE = "BaslerGigE"
_READY_MS = 100  # until a camera takes the next trigger
_NO_ID = (1 << 64) - 1  # pylon's number of an image that has none


class PylonCamera(Camera):
    """See camera.Camera. `Wanted.config` is a feature file of pylon (.pfs), which is loaded first.

    Attributes
    ----------
    device : pypylon's camera while it is open.
    """

    def __init__(self, wanted: Wanted) -> None:
        self.device: Any = None
        self._wanted = wanted
        self._bits = 8
        self._emulated = False

    def open(self) -> CameraInfo:
        factory = pylon.TlFactory.GetInstance()
        devices = {_name(each): each for each in factory.EnumerateDevices()}
        about = find_device(devices, self._wanted.device, "pylon")
        name = _name(about)
        self._emulated = about.GetDeviceClass() == _EMULATOR
        try:
            self.device = pylon.InstantCamera(factory.CreateDevice(about))
            self.device.Open()
        except genicam.GenericException as error:
            busy = "it is busy, end the other program" if not factory.IsDeviceAccessible(about) else "no connection"
            raise RigError(f"camera {name}: {busy} ({_line(error)})") from error
        try:
            return self._start(name, about)
        except genicam.GenericException as error:
            raise RigError(f"camera {name}: {_line(error)}") from error

    def _start(self, name: str, about: Any) -> CameraInfo:
        nodes = self.device.GetNodeMap()
        if self._wanted.config:
            if not Path(self._wanted.config).is_file():
                raise RigError(
                    f"lab.device_config = {self._wanted.config}: no such file; save one with the pylon Viewer"
                )
            pylon.FeaturePersistence.Load(self._wanted.config, nodes, True)
        features = _PylonNodes(nodes)
        settled = configure(features, self._wanted)
        self._bits = settled.bits
        self.device.MaxNumBuffer.Value = _BUFFERS
        self.device.StartGrabbing(pylon.GrabStrategy_OneByOne)
        return replace(
            settled,
            model=f"{about.GetVendorName()} {about.GetModelName()}",
            serial=about.GetSerialNumber(),
            id_bits=features.id_bits(about.GetDeviceClass() == _GIGE),
            ticks_per_s=0.0 if self._emulated else float(features.value("GevTimestampTickFrequency") or NS_PER_S),
        )

    def grab(self, timeout_s: float) -> Grabbed | None:
        try:
            result = self.device.RetrieveResult(max(round(1e3 * timeout_s), 1), pylon.TimeoutHandling_Return)
            arrival_ns = time.monotonic_ns()
            if not result.IsValid():
                if self.device.IsCameraDeviceRemoved():
                    raise RigError("the camera is gone: it was unplugged")
                return None
            with result:
                whole = result.GrabSucceeded()
                block_id, ticks = result.GetBlockID(), result.GetTimeStamp()
                image = result.GetArray() if whole else None  # packed formats are unpacked
        except genicam.GenericException as error:
            raise RigError(f"the camera is gone: {_line(error)}") from error
        return Grabbed(
            image,
            self._bits,
            None if block_id == _NO_ID else block_id,
            None if self._emulated else ticks,
            arrival_ns,
            incomplete=not whole,
        )

    def alive(self) -> bool:
        return not self.device.IsCameraDeviceRemoved()

    def discarded(self) -> int:
        node = self.device.GetStreamGrabberNodeMap().GetNode("Statistic_Buffer_Underrun_Count")
        return int(node.GetValue()) if genicam.IsReadable(node) else 0

    def trigger(self) -> None:
        try:
            if self.device.CanWaitForFrameTriggerReady():
                self.device.WaitForFrameTriggerReady(_READY_MS, pylon.TimeoutHandling_Return)
            self.device.TriggerSoftware.Execute()
        except genicam.GenericException as error:
            raise RigError(f"the camera does not take the trigger: {_line(error)}") from error

    def close(self) -> None:
        if self.device is not None:
            with suppress(genicam.GenericException):  # it may be gone; then there is nothing left to close
                self.device.Close()


class _PylonNodes(Features):
    """The settings of a camera; see features.Features."""

    def __init__(self, nodes: Any) -> None:
        self._nodes = nodes
        self._names = frozenset(node.GetNode().GetName() for node in nodes.GetNodes())

    def feature(self, name: str) -> Feature:
        if name not in self._names:
            return ABSENT
        node = self._nodes.GetNode(name)
        if not genicam.IsAvailable(node):
            return ABSENT
        low, high, step = 0.0, 0.0, 0.0
        if hasattr(node, "GetMin"):
            low, high = node.GetMin(), node.GetMax()
            step = node.GetInc() if isinstance(node, pylon.IntegerParameter) else 0.0
        value = node.GetValue() if hasattr(node, "GetValue") and genicam.IsReadable(node) else None
        entries = tuple(node.GetSettableValues()) if hasattr(node, "GetSettableValues") else ()
        return Feature(value, low, high, step, entries, genicam.IsWritable(node))

    def put(self, name: str, value: Value) -> None:
        try:
            self._nodes.GetNode(name).SetValue(value)
        except genicam.GenericException as error:
            raise RigError(f"the camera does not take {name} = {value} ({_line(error)})") from error


def _name(about: Any) -> str:
    return " ".join(filter(None, (about.GetFriendlyName(), about.GetUserDefinedName())))


def _line(error: Exception) -> str:
    """The text of an error of pylon, without the place in its sources."""
    return " ".join(str(error).split()).partition(" : ")[0]
