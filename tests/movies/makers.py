"""Movies as other programs leave them, made with other people's encoders: PyAV, tifffile, zarr, OpenCV."""

from __future__ import annotations

import struct
from fractions import Fraction
from pathlib import Path

import av
import cv2
import numpy as np
import tifffile
import zarr

CODECS = {  # encoder, pixel format, options, suffix
    "mjpeg": ("mjpeg", "yuvj420p", {"qscale": "4"}, ".avi"),
    "h264": ("libx264", "yuv420p", {"crf": "23"}, ".mp4"),
    "h264_lossless": ("libx264", "yuv420p", {"qp": "0"}, ".mp4"),
    "xvid": ("mpeg4", "yuv420p", {"qscale": "5"}, ".avi"),
    "ffv1": ("ffv1", "gray", {}, ".mkv"),
    "ffv1_12": ("ffv1", "gray12le", {}, ".mkv"),
    "raw": ("rawvideo", "gray", {}, ".avi"),
}


def video(path: Path, codec: str, images, rate_hz: float = 30.0, times_ms=None) -> Path:
    """A movie of grey images; with `times_ms` of unequal intervals. Returns its path."""
    name, pixels, options, _ = CODECS[codec]
    rate = Fraction(rate_hz).limit_denominator(1000)
    with av.open(str(path), "w") as container:
        stream = container.add_stream(name, rate=rate, options=options)
        stream.height, stream.width = images[0].shape
        stream.pix_fmt = pixels
        if times_ms is not None:
            stream.time_base = stream.codec_context.time_base = Fraction(1, 1000)
        for number, image in enumerate(images):
            frame = video_frame(image, pixels)
            if times_ms is not None:
                frame.pts, frame.time_base = times_ms[number], Fraction(1, 1000)
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    return path


def video_frame(image, pixels: str) -> av.VideoFrame:
    """The image as luma, bit for bit, with grey chroma."""
    if pixels.startswith("gray"):
        return av.VideoFrame.from_ndarray(image, format=pixels)
    height, width = image.shape
    chroma = np.full((height // 2, width), 128, np.uint8)
    return av.VideoFrame.from_ndarray(np.vstack([image, chroma]), format=pixels)


def ome_tiff(path: Path, images, times_s=None, bits: int | None = None, um_per_px: float | None = None) -> Path:
    metadata = {"axes": "TYX"}
    if bits is not None:
        metadata["SignificantBits"] = bits
    if times_s is not None:
        count = len(images)
        metadata["Plane"] = {"DeltaT": [1e3 * float(t) for t in times_s], "DeltaTUnit": ["ms"] * count}
    if um_per_px is not None:
        metadata |= {"PhysicalSizeX": um_per_px, "PhysicalSizeXUnit": "µm"}
    tifffile.imwrite(path, np.stack(images), ome=True, metadata=metadata)
    return path


def ome_zarr(
    path: Path, images, interval_s: float | None, version: str = "0.5", axes: str = "tczyx", chunk: int = 4
) -> Path:
    stack = np.stack(images)
    shape = tuple(stack.shape[0] if a == "t" else stack.shape[1 + "yx".index(a)] if a in "yx" else 1 for a in axes)
    chunks = tuple(chunk if a == "t" else length for a, length in zip(axes, shape, strict=True))
    group = zarr.open_group(str(path), mode="w", zarr_format=2 if version == "0.4" else 3)
    array = group.create_array("0", shape=shape, chunks=chunks, dtype=stack.dtype)
    array[:] = stack.reshape(shape)
    scale = [interval_s or 1.0 if a == "t" else 2.5 if a in "yx" else 1.0 for a in axes]
    kinds = {"t": "time", "c": "channel"}
    listed = [{"name": a, "type": kinds.get(a, "space")} for a in axes]
    for each in listed:
        if each["name"] == "t" and interval_s is not None:
            each["unit"] = "second"
        if each["type"] == "space":
            each["unit"] = "micrometer"
    transform = [{"type": "scale", "scale": scale}]
    multiscales = [
        {"version": version, "axes": listed, "datasets": [{"path": "0", "coordinateTransformations": transform}]}
    ]
    if version == "0.4":
        group.attrs["multiscales"] = multiscales
    else:
        group.attrs["ome"] = {"version": version, "multiscales": multiscales}
    return path


def folder(path: Path, images, name: str = "img_{}.png") -> Path:
    path.mkdir()
    for number, image in enumerate(images):
        ok, data = cv2.imencode(Path(name).suffix, image)
        assert ok
        (path / name.format(number)).write_bytes(data.tobytes())
    return path


def nd2(path: Path, images, times_s, bits: int = 12, um_per_px: float = 0.65, compression: int = 2) -> Path:
    """A minimal ND2 file of version 3: chunks with attributes, planes, time loop, times and images, then their map."""
    height, width = images[0].shape
    step = images[0].dtype.itemsize
    attributes = _level(
        "SLxImageAttributes",
        _uint("uiWidth", width), _uint("uiHeight", height), _uint("uiWidthBytes", width * step), _uint("uiComp", 1),
        _uint("uiBpcInMemory", 8 * step), _uint("uiBpcSignificant", bits), _uint("uiSequenceCount", len(images)),
        _uint("eCompression", compression),
    )  # fmt: skip
    probe = _level("pFluorescentProbe", _bool("m_bIsUsed", False))  # without one the library fails
    plane = _level("a0", _uint("uiCompCount", 1), _uint("uiSampleIndex", 0), probe)
    planes = _level("sPicturePlanes", _uint("uiCount", 1), _level("sPlaneNew", plane))
    metadata = _level("SLxPictureMetadata", _double("dCalibration", um_per_px), _bool("bCalibrated", True), planes)
    loop = _level(
        "uLoopPars", _uint("uiCount", len(images)), *(_double(key, 0.0) for key in ("dStart", "dPeriod", "dDuration"))
    )
    experiment = _level("SLxExperiment", _uint("eType", 1), loop)
    chunks = {
        "ImageAttributesLV!": attributes,
        "ImageMetadataLV!": experiment,
        "ImageMetadataSeqLV|0!": metadata,
        "CustomData|AcqTimesCache!": (1e3 * np.asarray(times_s, np.float64)).tobytes(),
    }
    for number, image in enumerate(images):
        chunks[f"ImageDataSeq|{number}!"] = struct.pack("<d", 1e3 * times_s[number]) + image.tobytes()
    with path.open("wb") as file:
        file.write(_chunk(b"ND2 FILE SIGNATURE CHUNK NAME01!", 32, b"Ver3.0".ljust(64, b"\0")))
        places = b""
        for name, data in chunks.items():
            file.write(bytes(-file.tell() % 4096))
            places += name.encode() + struct.pack("<QQ", file.tell(), len(data))
            # The pixels begin 4096 bytes after the chunk: 16 of its head, its name, 8 of the time.
            file.write(_chunk(name.encode(), 4072 if name.startswith("ImageDataSeq") else 64, data))
        where = file.tell()
        end = b"ND2 CHUNK MAP SIGNATURE 0000001!" + struct.pack("<Q", where)
        file.write(_chunk(b"ND2 FILEMAP SIGNATURE NAME 0001!", 32, places + end))
    return path


def _chunk(name: bytes, length: int, data: bytes) -> bytes:
    return struct.pack("<IIQ", 0x0ABECEDA, length, len(data)) + name.ljust(length, b"\0") + data


def _item(kind: int, name: str, data: bytes) -> bytes:
    return bytes([kind, len(name) + 1]) + (name + "\0").encode("utf-16-le") + data


def _uint(name: str, value: int) -> bytes:
    return _item(3, name, struct.pack("<I", value))


def _double(name: str, value: float) -> bytes:
    return _item(6, name, struct.pack("<d", value))


def _bool(name: str, value: bool) -> bytes:
    return _item(1, name, bytes([value]))


def _level(name: str, *items: bytes) -> bytes:
    head = len(_item(11, name, b"")) + 12
    content = b"".join(items)
    length = struct.pack("<IQ", len(items), head + len(content))
    return _item(11, name, length) + content + bytes(8 * len(items))
