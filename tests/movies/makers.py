"""Movies as other programs leave them, made with other people's encoders: PyAV, tifffile, zarr, OpenCV."""

from __future__ import annotations

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
