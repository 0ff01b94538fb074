"""AVI, MP4, MKV, MOV by PyAV. Grey levels are the luma plane as it is stored, without a conversion of its range.

A decoder reports damaged data where it can tell: FFV1 has a checksum of each slice. The other codecs have none, so
damage that decodes is not noticed: of single bytes flipped in H.264, XviD and MJPEG about one in eight.
"""

from __future__ import annotations

from collections.abc import Generator, Iterator
from contextlib import closing, contextmanager
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import av.logging
import numpy as np
from numpy.typing import NDArray

from flowrec.core import MCAP, NS_PER_S, Image, Ints, MovieError, pixel_type, shell_word
from flowrec.movies.grey import CHANNELS, refuse_colour
from flowrec.movies.movie import Movie, MovieFacts, MovieFrame, checked_size
from flowrec.movies.notes import notes_in, refuse_drawn

_LOSSLESS = {
    "ffv1",
    "huffyuv",
    "ffvhuff",
    "rawvideo",
    "utvideo",
    "png",
    "qtrle",
    "zlib",
    "lagarith",
    "magicyuv",
    "tiff",
}
_LOSSLESS |= {"v210", "v410", "r210", "flashsv", "bmp", "cscd", "msrle", "rle", "y41p", "yuv4", "zmbv", "targa", "sgi"}
_ONLY_LOGS = ("ffv1",)  # decoders that replace a damaged part by that of the image before, and only log it
_NOMINAL = ("avi",)  # containers that state a rate only, not the time of each image
_RANGES = {1: "limited range, 16 to 235 as stored", 2: "full range"}
_ROUNDED_MS = 1.1  # difference of equal intervals in a container that rounds times to whole ms
_GREY_CHROMA = 4  # largest deviation of a chroma sample from its middle in a grey movie, in 8-bit levels
_COLOURED_SHARE = 1e-3  # fraction of chroma samples beyond it from which on the movie is in colour
_PLANAR_LUMA = (
    "gray",
    "yuv",
    "nv12",
    "nv16",
    "nv21",
    "nv24",
    "p010",
    "p012",
    "p016",
    "p210",
    "p216",
    "p410",
    "p416",
    "ya",
)
_PACKED_LUMA = {"yuyv422": 0, "yvyu422": 0, "uyvy422": 1}  # byte of the first luma sample
_HIGH_BITS = ("p010", "p012", "p210")  # samples are in the upper bits of 16


class VideoMovie(Movie):
    """A movie in a container. Packets are listed when it is opened; images are decoded when they are asked for."""

    def _open(self) -> MovieFacts:
        path = self.path
        self._container, self._stream = container, stream = self._opened.enter_context(_open_stream(path))
        codec = stream.codec_context
        notes = notes_in(container.metadata.get("description", ""), path)
        refuse_drawn(notes, path)
        width, height = checked_size(path, codec.width, codec.height)
        if notes is not None and width - notes.width_px in (0, 1) and height - notes.height_px in (0, 1):
            width, height = notes.width_px, notes.height_px  # without the padding to even sizes
        self._first_ns = notes.first_stamp_ns if notes is not None else 0
        if codec.pix_fmt is None:
            raise MovieError(f"{path}: no pixel format is known of {codec.name}; the file is damaged or was cut short")
        pts, damaged = self._packets()
        if not pts:
            raise MovieError(f"{path}: holds no image; the file is damaged or was cut short")
        self._pts = sorted(p for p in pts if p is not None)
        times, text = self._times(all_timed=len(self._pts) == len(pts))
        promised = self._header_frames(times)
        if promised > len(pts) or damaged:
            why = f"breaks off: its header promises {max(promised, len(pts))} images, {len(pts) - damaged} are there"
            self.broken_off(len(pts) - damaged, why)
            pts = pts[: len(pts) - damaged]
            self._pts = sorted(p for p in pts if p is not None)
            times = times[: len(pts)] if times is not None else None
        bits = av.VideoFormat(codec.pix_fmt).components[0].bits
        levels = _RANGES.get(2 if codec.pix_fmt.startswith("yuvj") else int(codec.color_range), "")
        self._note_unusual()
        return MovieFacts(
            reader="video",
            library=f"PyAV {av.__version__} (libavcodec {'.'.join(map(str, av.library_versions['libavcodec']))})",
            codec=f"{codec.name} {codec.pix_fmt}" + (f", luma of {levels}" if levels else ""),
            lossy=codec.name not in _LOSSLESS,
            width_px=width,
            height_px=height,
            bits=self._depth(bits, bits),
            frames=len(pts),
            counted=False,
            times_ns=times,
            times=text,
            um_per_px=notes.um_per_px if notes is not None else None,
            notes=notes,
        )

    def _packets(self) -> tuple[list[int | None], int]:
        """Presentation times of all packets with an image, in file order, and how many at the end are cut off."""
        pts: list[int | None] = []
        damaged = 0
        try:
            for packet in self._container.demux(self._stream):
                if packet.size:
                    pts.append(packet.pts)
                    damaged = damaged + 1 if packet.is_corrupt else 0
        except av.FFmpegError as error:
            self.broken_off(len(pts), f"breaks off after {len(pts)} images ({_text(error)})", error)
        return pts, damaged

    def _header_frames(self, times: Ints | None) -> int:
        """Number of images that the header states; 0 if it states none."""
        if self._stream.frames:
            return int(self._stream.frames)
        # Matroska states a duration, which ends with the last image or, of unequal intervals, within 3.5 of them.
        duration = self._container.duration
        if times is None or len(times) < 3 or duration is None or len(self._container.streams) > 1:
            return 0
        interval = float(np.diff(times).mean())
        missing = (duration * (NS_PER_S / av.time_base) - float(times[-1])) / interval
        return len(times) + round(missing) - 1 if missing > 3.5 else 0

    def _note_unusual(self) -> None:
        aspect, streams = self._stream.sample_aspect_ratio, len(self._container.streams.video)
        if aspect is not None and aspect not in (0, 1):
            pixels = f"{aspect.numerator}:{aspect.denominator}"
            self._assumed.append(f"its pixels are said to be {pixels}; they are taken as square")
        if streams > 1:
            self._assumed.append(f"it has {streams} video streams; the best one is read")

    def _times(self, *, all_timed: bool) -> tuple[Ints | None, str]:
        """Times of the images, and where they come from."""
        rate = self._stream.average_rate or self._stream.guessed_rate
        nominal = self._container.format.name in _NOMINAL
        if not all_timed or (nominal and not rate):
            return None, ""
        times = np.array([self._time_ns(p) for p in self._pts], np.int64)
        if nominal:
            return times, f"the file's nominal rate, {float(rate):g} Hz; it does not say when each image was taken"
        steps_ms = np.diff(times) / 1e6
        if not len(steps_ms):
            return times, "presentation times"
        low, high = steps_ms.min(), steps_ms.max()
        if high - low > _ROUNDED_MS:
            return times, f"presentation times, intervals of {low:.4g} to {high:.4g} ms"
        return times, f"presentation times, every {steps_ms.mean():.4g} ms"

    def _time_ns(self, pts: int) -> int:
        """A presentation time since the first image: containers begin at times that the encoder's delay determines.

        In a movie of a session it is the session stamp.
        """
        base: Fraction = self._stream.time_base
        since_ns = round(Fraction((pts - self._pts[0]) * base.numerator * NS_PER_S, base.denominator))
        return self._first_ns + since_ns

    def frames(self) -> Iterator[MovieFrame]:
        count, timed = 0, self.facts.times_ns is not None
        try:
            with closing(self._decode()) as decoded:
                for frame in decoded:
                    if count == self.facts.frames:
                        break  # what follows is cut off
                    time_ns = self._time_ns(frame.pts) if frame.pts is not None and timed else None
                    yield MovieFrame(count, self._levels(frame, count), time_ns)
                    count += 1
        except av.FFmpegError as error:
            self.broken_off(count, f"image {count} can not be decoded ({_text(error)})", error)
        if self.options.partial and count < self.facts.frames:
            self.broken_off(count, "the rest can not be decoded")
        if not count:
            raise MovieError(f"{self.path}: no image of it can be decoded; the file is damaged")

    def _decode(self, first: int | None = None) -> Generator[Any]:
        """The images in order, from the beginning, or from one before a presentation time on."""
        with _open_stream(self.path) as (container, stream):
            if first is not None:
                container.seek(first, stream=stream, backward=True)
            frames = container.decode(stream)
            while True:
                with _complaints(stream) as complaints:
                    frame = next(frames, None)
                if frame is None:
                    return
                if frame.is_corrupt or complaints:
                    raise av.InvalidDataError(0, "its data is damaged")
                yield frame

    def image(self, index: int) -> Image:
        if not self._pts:
            return next(each.image for each in self.frames() if each.index == index)
        target = self._pts[index]
        try:
            with closing(self._decode(target)) as decoded:
                for frame in decoded:
                    if frame.pts is not None and frame.pts >= target:
                        return self._levels(frame, index)
        except av.FFmpegError as error:
            raise MovieError(f"{self.path}: image {index} can not be decoded ({_text(error)})") from error
        raise MovieError(f"{self.path}: image {index} is not there; the movie ends before it")

    def _levels(self, frame: Any, index: int) -> Image:
        """Grey levels (h, w) of a decoded image."""
        facts, channel, name = self.facts, self.options.channel, frame.format.name
        padded = facts.notes is not None and frame.width - facts.width_px in (0, 1)
        if (frame.width, frame.height) != (facts.width_px, facts.height_px) and not padded:
            raise MovieError(
                f"{self.path}: image {index} has {frame.width} x {frame.height} pixels, the first one "
                f"{facts.width_px} x {facts.height_px}; cut the movie where its size changes"
            )
        if channel in CHANNELS[:3] and not name.startswith("gray"):
            return self._grey(frame.to_ndarray(format="rgb24"), index)
        luma = _luma(frame)
        if luma is None:
            array = frame.to_ndarray(format="rgb24" if frame.format.components[0].bits <= 8 else "rgb48le")
            return self._grey(array, index)
        if channel is None and _has_colour(frame):
            raise refuse_colour(self.path, index)
        return self._grey(luma[: facts.height_px, : facts.width_px], index)


@contextmanager
def _open_stream(path: Path) -> Iterator[tuple[Any, Any]]:
    """The container and its video stream, with a decoder that reports damaged data instead of concealing it."""
    try:
        container = av.open(str(path), options={"err_detect": "explode"})
    except (av.FFmpegError, OSError) as error:
        remedy = "if it was cut short, ffmpeg may repair it"
        if path.suffix == MCAP[0]:
            remedy = f"a session is replayed: flowrec replay {shell_word(path)} --refine"
        raise MovieError(f"{path}: is no movie that can be read ({_text(error)}); {remedy}") from error
    with container:
        stream = container.streams.best("video")
        if stream is None:
            raise MovieError(f"{path}: has no video stream")
        stream.thread_type = "NONE" if stream.codec_context.name in _ONLY_LOGS else "AUTO"
        stream.codec_context.options = {"err_detect": "explode"}
        yield container, stream


@contextmanager
def _complaints(stream: Any) -> Iterator[list[str]]:
    """Collect what a decoder of _ONLY_LOGS logs as an error. It decodes in this thread: libav logs under the GIL."""
    complaints: list[str] = []
    if stream.codec_context.name not in _ONLY_LOGS:
        yield complaints
        return
    level = av.logging.get_level()
    av.logging.set_level(av.logging.ERROR)
    try:
        with av.logging.Capture() as logged:
            yield complaints
            complaints += [text for _, _, text in logged]
    finally:
        av.logging.set_level(level)


def _samples(plane: Any) -> NDArray[np.uint8]:
    """(rows, bytes of a line) of a plane."""
    return np.frombuffer(plane, np.uint8).reshape(-1, plane.line_size)


def _luma(frame: Any) -> NDArray[Any] | None:
    """The luma samples (h, w) as they are stored; None for other formats, such as RGB."""
    name, width, height = frame.format.name, frame.width, frame.height
    if name.endswith("be"):
        frame = frame.reformat(format=name[:-2] + "le")
    dtype = pixel_type(frame.format.components[0].bits)
    rows = _samples(frame.planes[0])[:height]
    if name in _PACKED_LUMA:
        return rows[:, _PACKED_LUMA[name] : 2 * width : 2]
    if not name.startswith(_PLANAR_LUMA) or name.startswith(("ya8", "ya16")):
        return None
    samples: NDArray[Any] = rows[:, : width * dtype.itemsize].view(dtype)
    return samples >> (16 - frame.format.components[0].bits) if name.startswith(_HIGH_BITS) else samples


def _has_colour(frame: Any) -> bool:
    """True if chroma samples differ from grey by more than the noise of a lossy codec."""
    name, bits = frame.format.name, frame.format.components[0].bits
    if name.startswith("gray"):
        return False
    if name in _PACKED_LUMA:
        samples = [_samples(frame.planes[0])[: frame.height, 1 - _PACKED_LUMA[name] : 2 * frame.width : 2]]
    else:
        if bits > 8 or name.endswith("be"):  # compared with 8 bit
            frame = frame.reformat(format="yuv444p")
        pair = 2 if name.startswith("nv") else 1
        samples = [_samples(plane)[: plane.height, : pair * plane.width] for plane in frame.planes[1:3]]
    return any(float((np.abs(each.astype(np.int16) - 128) > _GREY_CHROMA).mean()) > _COLOURED_SHARE for each in samples)


def _text(error: Exception) -> str:
    return (getattr(error, "strerror", "") or str(error)).strip().lower()
