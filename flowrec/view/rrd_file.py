"""A session as one .rrd file: a cache for the viewer; the archive is the MCAP file."""

from __future__ import annotations

import contextlib
import heapq
import itertools
import os
import secrets
from collections.abc import Callable, Iterable, Mapping
from collections.abc import Set as AbstractSet
from pathlib import Path

import rerun as rr

from flowrec.core import Tick, seconds
from flowrec.view.blueprint import blueprint
from flowrec.view.entities import SUMMARY, ColumnBuffer
from flowrec.view.logger import TickLogger
from flowrec.view.maps import SpeedScale
from flowrec.view.scene import Scene

APPLICATION = "flowrec"
_PROGRESS_EVERY = 20  # ticks
_MAGIC = b"RRF"
_END, _END_BYTES = b"RRF2FOOT", 12  # a number follows
_PATIENCE_S = 10.0  # for the file to grow
_HEAD_BYTES = 1024  # contains the names of application and recording as plain text


def write_rrd(
    path: Path,
    scene: Scene,
    ticks: Mapping[str, Iterable[Tick]],
    progress: Callable[[float], None] = lambda _: None,
    summary: rr.TextDocument | None = None,
) -> None:
    """Write the ticks of a session, or of two in one view. Raises OSError: the file can not be written.

    Parameters
    ----------
    ticks : of each session by its prefix, see entities.py; the second one is on the same chip, of a replay or of
        another session.
    progress : called from time to time with the session time in s since the first tick.
    summary : shown beside the pictures.
    """
    stream = open_stream(scene)
    try:
        stream.save(path)
        if summary is not None:
            stream.log(SUMMARY, summary, static=True)
        _log_all(stream, scene, ticks, progress, frozenset() if summary is None else frozenset({SUMMARY}))
        _flush(stream, path)
    finally:
        stream.disconnect()
    if not _is_whole(path):  # Rerun writes in a thread, whose errors it only prints
        raise OSError("Rerun could not write all of it; is the disk full?")


def _flush(stream: rr.RecordingStream, path: Path) -> None:
    """Wait while the file grows: Rerun's own wait may never end if its thread could not write."""
    written = -1
    while (size := path.stat().st_size) != written:
        written = size
        with contextlib.suppress(RuntimeError):  # could not write, or not within this time
            stream.flush(timeout_sec=_PATIENCE_S)
            return


def _is_whole(path: Path) -> bool:
    """True if a file has the end that Rerun writes last."""
    with path.open("rb") as file:
        file.seek(-min(_END_BYTES, path.stat().st_size), os.SEEK_END)
        return _END in file.read()


def is_made_from(path: Path, key: str) -> bool:
    """True if a file is an .rrd that flowrec made from the session with this key (see Scene)."""
    try:
        with path.open("rb") as file:
            head = file.read(_HEAD_BYTES)
    except OSError:
        return False
    return bool(key) and head.startswith(_MAGIC) and APPLICATION.encode() in head and key.encode() in head


def open_stream(scene: Scene) -> rr.RecordingStream:
    """A stream that carries the title and properties of a scene and flowrec's own timelines only."""
    # A viewer merges recordings of the same name, so the name is unique; its first half identifies the session.
    stream = rr.RecordingStream(APPLICATION, recording_id=f"{scene.key}-{secrets.token_hex(8)}")
    rr.set_log_time_enabled(False, recording=stream)
    rr.set_log_tick_enabled(False, recording=stream)
    return stream


def describe(stream: rr.RecordingStream, scene: Scene) -> None:
    """Send the name and the properties that the viewer lists with a recording."""
    stream.send_recording_name(scene.title)
    if scene.properties:
        stream.send_property("session", rr.AnyValues(drop_untyped_nones=True, **scene.properties))


def _log_all(
    stream: rr.RecordingStream,
    scene: Scene,
    ticks: Mapping[str, Iterable[Tick]],
    progress: Callable[[float], None],
    present: AbstractSet[str],
) -> None:
    describe(stream, scene)
    speeds = SpeedScale()
    first_ns: int | None = None
    stamp_ns = 0
    index: int | None = None
    with ColumnBuffer(stream) as columns:
        loggers = {prefix: TickLogger(stream, scene, prefix, speeds=speeds, columns=columns) for prefix in ticks}
        first = next(iter(loggers.values()))
        each = [zip(itertools.repeat(loggers[prefix]), found) for prefix, found in ticks.items()]
        # In the order of stamps; of equal ones the first session's comes first.
        for count, (logger, tick) in enumerate(heapq.merge(*each, key=lambda item: item[1].stamp_ns)):
            stamp_ns = tick.stamp_ns if not tick.is_afterwards else stamp_ns
            first_ns = stamp_ns if first_ns is None else first_ns
            if logger is first and tick.frame is not None:
                index = tick.frame.index
            # Replayed ticks may have no frame, but belong to a recorded one.
            logger.log(tick, frame_index=index)
            if count % _PROGRESS_EVERY == 0:
                progress(seconds(stamp_ns - first_ns))
        columns.flush()
    for prefix, logger in loggers.items():
        present |= {what if logger is first else f"{prefix} {what}" for what in logger.present}
    # Last, when it is known which views are not empty. Rerun accepts it anywhere in the file.
    phases = [logger.states.phases for logger in loggers.values()]
    stream.send_blueprint(blueprint(scene, tuple(loggers), present, seconds(stamp_ns), phases))
