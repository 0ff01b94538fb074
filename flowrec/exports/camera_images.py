"""The camera images of a session for exports: which are shown, with which grey levels, and what is told of them."""

from __future__ import annotations

import base64
from collections.abc import Iterator
from dataclasses import asdict
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import tomli_w
from numpy.typing import NDArray

from flowrec.core import NS_PER_S, Applied, Frame, Image, SessionError, Tick, printable, seconds, without_none
from flowrec.exports.formats import TimeProgress
from flowrec.movies import MovieNotes
from flowrec.store import Session

_SAMPLED = 9  # images that determine the scale of grey levels
_DARKEST, _BRIGHTEST = 0.1, 99.9  # percentiles of grey levels that become black and white
_OF_CAMERA = ("um_per_px", "angle_deg", "mirror", "centre_um", "exposure_s")  # settings that the images do not tell


def with_images(session: Session, progress: TimeProgress = lambda _: None) -> Iterator[tuple[Tick, Frame]]:
    """Ticks with a new image of the camera. Where the camera gave none, or the last one again, there is no row.

    `progress` takes the session time in s since the first tick, of each image that was taken. Raises SessionError: the
    session holds no images.
    """
    last: Frame | None = None
    for tick in session.ticks():
        frame, applied = tick.frame, tick.applied
        if frame is None or frame is last:
            continue
        last = frame
        if frame.image.size and not _repeats(applied, frame.stamp_ns):
            yield tick, frame
            progress(seconds(frame.stamp_ns - session.run.first_ns))
    if last is None:
        raise without_frames(session)


def image_stamps(session: Session) -> list[int]:
    """The stamps of what `with_images` yields, without reading images."""
    applied = (tick.applied for tick in session.ticks(with_frames=False))
    again = {each.stamp_ns for each in applied if each is not None and _repeats(each, each.stamp_ns)}
    return [stamp for stamp in session.reader.frame_stamps if stamp not in again]


def _repeats(applied: Applied | None, stamp_ns: int) -> bool:
    """True if the camera gave the image of that stamp before."""
    return applied is not None and applied.stamp_ns == stamp_ns and applied.repeats_image


def without_frames(session: Session) -> SessionError:
    """The error for a session that has no images to export."""
    parent = printable(Path(session.header.parent.get("file", "")).name)
    advice = f"it replays {parent}: export that" if parent else "flowrec info lists the topics that it holds"
    return SessionError(f"{session.path}: holds no camera images; {advice}")


def refuse_windows(session: Session) -> None:
    """SessionError for a session whose images are black but for a region."""
    if session.config.recording.region != "whole":
        raise SessionError(
            f"{session.path}: its images hold only the region around the robot (recording.region), the rest is black; "
            "use --format mp4 to look at it, tiff to have the images as they are"
        )


def first_frame(session: Session) -> Frame:
    """The first image; SessionError if there is none."""
    if not session.topics.get("/camera/frame", 0):
        raise without_frames(session)
    return next(frame for _, frame in with_images(session))


class GreyScale:
    """Grey levels of the camera to 8 bits: black at `low`, white at `high`, linear between them.

    Images of 8 bits stay as they are. Of deeper ones, `low` and `high` are the extremes over nine images of the session
    of the 0.1 and 99.9 percentiles, because a camera rarely uses all of its levels.
    """

    def __init__(self, bits: int, low: int, high: int) -> None:
        self.low, self.high = low, high
        self._table: NDArray[np.uint8] | None = None
        if bits > 8:
            levels = np.arange(1 << 16, dtype=np.float64)
            self._table = np.clip(np.rint((levels - low) * (255.0 / (high - low))), 0, 255).astype(np.uint8)

    @classmethod
    def of(cls, session: Session, first: Frame) -> GreyScale:
        """That of a session."""
        found = []
        begin, end = session.run.first_ns, session.run.last_ns
        for share in np.linspace(0.0, 1.0, _SAMPLED) if first.bits > 8 else ():
            frame = session.at(seconds(begin + round(share * (end - begin)))).frame
            levels = first.image if frame is None else frame.image
            seen = levels[levels > 0]  # 0 is also what lies outside of a recorded region
            if seen.size:
                found.append(np.percentile(seen, (_DARKEST, _BRIGHTEST)))
        low, high = (int(np.min(found)), int(np.ceil(np.max(found)))) if found else (0, 0)
        return cls(first.bits, low, high) if high > low else cls(first.bits, 0, (1 << first.bits) - 1)

    def __call__(self, image: Image) -> NDArray[np.uint8]:
        """The image (h, w) in 8 bits."""
        return image.astype(np.uint8, copy=False) if self._table is None else self._table[image]

    @staticmethod
    def text_of(notes: MovieNotes) -> str:
        """The scale in one phrase for people."""
        if notes.bits <= 8:
            return "grey levels of the camera"
        return f"grey levels {notes.grey_low} to {notes.grey_high} of {(1 << notes.bits) - 1} are 0 to 255"


def notes_of(session: Session, first: Frame, grey: GreyScale, *, drawn: bool = False, zoom: int = 1) -> MovieNotes:
    """Notes that are written into a movie of a session.

    Parameters
    ----------
    first : its first image.
    zoom : pixels of the movie per pixel of the camera.
    """
    config, header = session.config, session.header
    settings = {"robot": asdict(config.robot), "coils": asdict(config.coils)}
    settings["camera"] = {key: value for key, value in asdict(config.camera).items() if key in _OF_CAMERA}
    height, width = first.image.shape
    return MovieNotes(
        session=session.path.name,
        session_key=session.key,
        started=start_time(session),
        first_stamp_ns=first.stamp_ns,
        um_per_px=config.camera.um_per_px / zoom,
        width_px=width,
        height_px=height,
        bits=first.bits,
        grey_low=grey.low,
        grey_high=grey.high,
        drawn=drawn,
        region=config.recording.region,
        settings=tomli_w.dumps(without_none(settings)),
        chip_png=base64.b64encode(header.chip_png).decode(),
        chip_toml=header.chip_toml,
    )


def start_time(session: Session) -> str:
    """Wall time of the start of the run, ISO 8601 with its zone; '' if the session does not state one."""
    text, taken_ns = session.provenance.get("wall_time", ""), session.header.taken_unix_ns
    if taken_ns != session.header.start_unix_ns:  # an import, whose own time is not that of the movie
        return datetime.fromtimestamp(taken_ns / NS_PER_S, UTC).isoformat() if taken_ns else ""
    try:
        time = datetime.fromisoformat(text)
    except ValueError:
        return ""
    return time.isoformat() if time.tzinfo is not None else ""


def title_of(session: Session) -> str:
    """Name of the session and, where it is stated, of the sample."""
    sample = printable(session.config.recording.sample)[:200]
    return session.path.stem + (f": {sample}" if sample else "")
