"""The formats mp4 and mp4_plain: the camera's images as H.264, with what happens drawn over them, or as they are.

The time base is 1 us. The presentation time of an image is its session stamp less that of the first image, which is 0
in most sessions, rounded to 1 us. Intervals are as they were: where the camera delivered no image, or the same once
more, the one before is shown longer. Without B-frames the file needs no edit list, and all players see the same times.

`python -m tests.perf.movie_export` compares the frame rate with that of PyAV alone.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from fractions import Fraction
from pathlib import Path
from typing import Any, Self

import av
import cv2
import numpy as np
from numpy.typing import NDArray

from flowrec.core import DOUBTS, NS_PER_S, Frame, Tick, printable, seconds, verdict_lines
from flowrec.exports.camera_images import GreyScale, first_frame, notes_of, refuse_windows, title_of, with_images
from flowrec.exports.formats import TimeProgress
from flowrec.movies import MovieNotes
from flowrec.store import Session
from flowrec.view import Overlay, Scene, WindowCompleter

TIME_BASE = Fraction(1, 1_000_000)
PRESET = "fast"
DRAWN_CRF, PLAIN_CRF = 20, 8  # quality; the tracker is to find in plain images what it found in the camera's
_NS_PER_PTS = NS_PER_S // TIME_BASE.denominator
_WAITING = 8  # pictures that wait for the encoder
_KEY_S = 2.0  # between images that a player can jump to
_LIMITED, _FULL = 1, 2  # AVCOL_RANGE: luma of 16 to 235, and of 0 to 255
_BT601 = 6  # AVCOL_SPC, AVCOL_PRI and AVCOL_TRC_SMPTE170M, as cv2.COLOR_BGR2YUV_I420 converts

Planes = NDArray[np.uint8]  # I420: (3/2 h, w)


class Mp4Export:
    """Implements flowrec.exports.formats.Exporter. Memory does not grow with the length of the session."""

    suffixes = (".mp4",)
    folder = False
    advice = "open it with any player:"

    def write(self, session: Session, part: Path, progress: TimeProgress) -> None:
        first = first_frame(session)
        grey = GreyScale.of(session, first)
        size_px = first.image.shape[1], first.image.shape[0]
        windows = WindowCompleter() if session.config.recording.region != "whole" else None
        scene = Scene(
            session.chip,
            session.calibration,
            session.config.robot,
            "",
            image_px=size_px,
            doubts=str(session.outcome.get(DOUBTS) or ""),
        )
        overlay = Overlay(scene, size_px)
        notes = notes_of(session, first, grey, drawn=True, zoom=overlay.zoom)
        with Mp4Writer(part, overlay.size_px, notes, session, full_range=False) as writer:
            ended = str(session.outcome.get("outcome") or "")
            for (tick, frame), is_last in _with_last(with_images(session, progress)):
                image = frame.image if windows is None else windows.complete(frame.image)
                picture = overlay.draw(grey(image), tick, ended if is_last else "")
                planes = np.asarray(cv2.cvtColor(picture, cv2.COLOR_BGR2YUV_I420), np.uint8)
                writer.write(frame.stamp_ns - first.stamp_ns, planes)


def _with_last(images: Iterator[tuple[Tick, Frame]]) -> Iterator[tuple[tuple[Tick, Frame], bool]]:
    """Each image, and whether it is the last one."""
    now = next(images, None)
    while now is not None:
        after = next(images, None)
        yield now, after is None
        now = after


class PlainMp4Export:
    """Implements flowrec.exports.formats.Exporter: luma is the grey level of the camera, 0 to 255."""

    suffixes = (".mp4",)
    folder = False
    advice = "any player opens it; to make a session of it: flowrec import"

    def write(self, session: Session, part: Path, progress: TimeProgress) -> None:
        refuse_windows(session)
        first = first_frame(session)
        grey = GreyScale.of(session, first)
        height, width = first.image.shape
        padding = (0, height % 2), (0, width % 2)
        size_px = width + width % 2, height + height % 2
        chroma = np.full((size_px[1] // 2, size_px[0]), 128, np.uint8)
        with Mp4Writer(part, size_px, notes_of(session, first, grey), session, full_range=True) as writer:
            for _, frame in with_images(session, progress):
                luma = np.pad(grey(frame.image), padding, mode="edge")
                writer.write(frame.stamp_ns - first.stamp_ns, np.vstack((luma, chroma)))


class Mp4Writer:
    """Encodes pictures in a thread of its own, while the next ones are drawn.

    Raises OSError: the file can not be written.

    Parameters
    ----------
    path : of the file; it is whole when the context is left without an exception.
    size_px : width and height, both even.
    full_range : luma is 0 to 255; else 16 to 235, which more players show right.
    """

    def __init__(
        self, path: Path, size_px: tuple[int, int], notes: MovieNotes, session: Session, *, full_range: bool
    ) -> None:
        self._encoder = ThreadPoolExecutor(1, "flowrec-mp4")
        self._waiting: deque[Future[None]] = deque()
        rate = Fraction(session.config.camera.rate_hz).limit_denominator(1000)
        self._last: tuple[int, int] = (0, round(1 / rate / TIME_BASE))  # time of the last image, and its interval
        self._container = av.open(str(path), "w", format="mp4", options={"movflags": "+faststart"})
        try:
            self._container.metadata.update(_metadata(notes, session))
            crf = PLAIN_CRF if full_range else DRAWN_CRF
            options = {"preset": PRESET, "crf": str(crf), "bf": "0", "g": str(max(round(_KEY_S * rate), 1))}
            self._stream = self._container.add_stream("libx264", rate=rate, options=options)
            codec = self._stream.codec_context
            codec.width, codec.height = size_px
            codec.pix_fmt, codec.time_base = "yuv420p", TIME_BASE
            codec.color_range = _FULL if full_range else _LIMITED
            codec.colorspace = codec.color_primaries = codec.color_trc = _BT601
            self._stream.time_base = TIME_BASE
        except BaseException:
            self._abandon()
            raise

    def __enter__(self) -> Self:
        return self

    def write(self, time_ns: int, planes: Planes) -> None:
        """Encode a picture that is shown from a time on; the planes must not change any more."""
        if len(self._waiting) == _WAITING:
            self._waiting.popleft().result()
        self._waiting.append(self._encoder.submit(self._encode, round(time_ns / _NS_PER_PTS), planes))

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: object) -> None:
        try:
            if error is None:
                for each in self._waiting:
                    each.result()
                self._mux(self._stream.encode(None))
                self._container.close()
        except BaseException:
            self._abandon()
            raise
        if error is not None:
            self._abandon()
        self._encoder.shutdown()

    def _encode(self, pts: int, planes: Planes) -> None:
        frame = av.VideoFrame.from_ndarray(planes, "yuv420p")
        frame.pts, frame.time_base = pts, TIME_BASE
        self._mux(self._stream.encode(frame))

    def _mux(self, packets: list[Any]) -> None:
        for packet in packets:
            last, interval = self._last
            self._last = packet.pts, packet.pts - last if packet.pts > last else interval
            packet.duration = self._last[1]  # of the last image only this is used
            self._container.mux(packet)

    def _abandon(self) -> None:
        """Close the file after a failure; whoever asked for it removes it."""
        self._encoder.shutdown(cancel_futures=True)
        with suppress(av.FFmpegError, OSError):  # the failure itself is what is reported
            self._container.close()


def _metadata(notes: MovieNotes, session: Session) -> dict[str, str]:
    """For people and players; the description is for `flowrec import`."""
    facts = [
        f"{notes.um_per_px:.6g} um per pixel",
        GreyScale.text_of(notes),
        f"session {notes.session_key}",
        f"recorded {notes.started or 'at an unknown time'}",
    ]
    if notes.first_stamp_ns:
        facts.append(f"begins {seconds(notes.first_stamp_ns):.9g} s after the start of the session")
    facts += map(printable, verdict_lines(session.outcome, session.last.refined))
    texts = {"title": title_of(session), "comment": "; ".join(facts), "description": notes.text()}
    return texts | ({"creation_time": notes.started, "date": notes.started} if notes.started else {})
