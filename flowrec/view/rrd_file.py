"""A session as one .rrd file: a cache for the viewer; the archive is the MCAP file."""

from __future__ import annotations

import contextlib
import heapq
import os
import secrets
from collections.abc import Callable, Iterable, Iterator
from collections.abc import Set as AbstractSet
from pathlib import Path

import rerun as rr

from flowrec.core import Output, Tick, seconds
from flowrec.view.blueprint import blueprint
from flowrec.view.entities import REPLAY, SUMMARY
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
    output: Output,
    scene: Scene,
    ticks: Iterable[Tick],
    second_ticks: Iterable[Tick] | None = None,
    progress: Callable[[float], None] | None = None,
    prefixes: tuple[str, str] = REPLAY,
    summary: rr.TextDocument | None = None,
) -> None:
    """Write ticks, and those of a second session beside them; a file of this name appears when it is complete.

    Parameters
    ----------
    second_ticks : on the same chip, of a replay or of another session.
    prefixes : of the entities of both.
    summary : shown beside the pictures.
    progress : called from time to time with the session time in s since the first tick.

    Raises
    ------
    SessionError : the file can not be written; OutputError if it may not be.
    """
    with output.new_file() as part:
        stream = open_stream(scene)
        try:
            stream.save(part)
            if summary is not None:
                stream.log(SUMMARY, summary, static=True)
            shown = frozenset({SUMMARY} if summary is not None else ())
            _log_all(stream, scene, ticks, second_ticks, progress, prefixes, shown)
            _flush(stream, part)
        finally:
            stream.disconnect()
        if not _is_whole(part):  # Rerun writes in a thread, whose errors it only prints
            raise OSError("Rerun could not write all of it; is the disk full?")


def _flush(stream: rr.RecordingStream, path: Path) -> None:
    """Wait for as long as the file grows: where Rerun's thread could not write, its own wait may never end."""
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
    ticks: Iterable[Tick],
    second_ticks: Iterable[Tick] | None,
    progress: Callable[[float], None] | None,
    prefixes: tuple[str, str],
    shown: AbstractSet[str],
) -> None:
    describe(stream, scene)
    both = second_ticks is not None
    speeds = SpeedScale()
    first = TickLogger(stream, scene, prefixes[0] if both else "", speeds=speeds)
    second = TickLogger(stream, scene, prefixes[1], images=False, speeds=speeds) if both else None
    first_ns: int | None = None
    stamp_ns = 0
    index: int | None = None
    for count, (stamp_ns, again, tick) in enumerate(_merge(ticks, second_ticks or ())):
        first_ns = stamp_ns if first_ns is None else first_ns
        if again:
            assert second is not None
            # Replayed ticks may have no frame, but belong to a recorded one.
            second.log(tick, frame_index=index)
        else:
            index = tick.frame.index if tick.frame is not None else index
            first.log(tick)
        if progress is not None and count % _PROGRESS_EVERY == 0:
            progress(seconds(stamp_ns - first_ns))
    present = first.present | shown
    if second is not None:
        present |= {f"{prefixes[1]} {what}" for what in second.present}
    phases = [first.phases] if second is None else [first.phases, second.phases]
    # Last, when it is known which views are not empty. Rerun accepts it anywhere in the file.
    stream.send_blueprint(blueprint(scene, prefixes if both else ("",), present, seconds(stamp_ns), phases))


def _merge(ticks: Iterable[Tick], second: Iterable[Tick]) -> Iterator[tuple[int, bool, Tick]]:
    """Both in the order of their stamps, the first session's tick before the second's."""

    def label(source: Iterable[Tick], again: bool) -> Iterator[tuple[int, bool, Tick]]:
        return ((tick.stamp_ns, again, tick) for tick in source)

    return heapq.merge(label(ticks, False), label(second, True), key=lambda item: item[:2])
