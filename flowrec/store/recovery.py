"""Recovers a session whose run was killed, or whose file is truncated or damaged."""

from __future__ import annotations

import contextlib
import os
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

from flowrec.enums import Outcome
from flowrec.errors import SessionError
from flowrec.store.audit import disagreements
from flowrec.store.channels import SessionContents
from flowrec.store.digest import FileDigest
from flowrec.store.frame_encodings import ENCODINGS
from flowrec.store.image_chunks import ImageChunk, ImageChunks, stored, with_images
from flowrec.store.mcap_reader import DamageError, McapReader
from flowrec.store.reader import SessionReader
from flowrec.store.run_files import (
    PARTIAL_SUFFIX,
    is_continued,
    part_number,
    part_path,
    partial_path,
    parts,
    unfinished_of,
)
from flowrec.store.scan import Scan, scan
from flowrec.store.session_file import WriterOptions
from flowrec.store.session_metadata import (
    CHIP_FILE,
    CHIP_IMAGE_FILE,
    CONFIG_FILE,
    PROVENANCE,
    SESSION,
    Part,
)
from flowrec.store.session_path import on_this_machine
from flowrec.store.writer import SessionWriter
from flowrec.system.durable import put_in_place
from flowrec.system.locks import held
from flowrec.system.outputs import MCAP, Output, OutputError
from flowrec.system.regular_file import refuse_irregular
from flowrec.topics import BY_PATH, Tick
from flowrec.units import seconds

_POLL_S = 1e-3
_QUEUE_BYTES = 32 << 20  # nothing is gained by reading far ahead of the writer
_REMAINS_SUFFIX = ".remains"
_HEAD = frozenset({SESSION, PROVENANCE, CONFIG_FILE, CHIP_IMAGE_FILE, CHIP_FILE})


class NothingSavedError(SessionError):
    """The file of a killed run holds no complete tick."""


@dataclass(frozen=True, slots=True)
class Recovered:
    """The result of a recovery.

    Attributes
    ----------
    path : the complete session.
    ticks, duration_s : of its content, without the keyframe of a part.
    lost_bytes : of the old file, unusable.
    lost : what was lost, as text; empty when nothing was.
    changed : False where the file was complete already.
    """

    path: Path
    ticks: int
    duration_s: float
    lost_bytes: int = 0
    lost: str = ""
    changed: bool = True

    @property
    def complete(self) -> bool:
        """Whether nothing was lost."""
        return not self.lost


@dataclass(slots=True)
class _Skipped:
    """Messages that were skipped because they can not be decoded."""

    count: int = 0
    first: str = ""

    def add(self, fault: str) -> None:
        self.count += 1
        self.first = self.first or fault


def recover(path: Path, out: Path | None = None, *, copy_images: bool = True) -> Recovered:
    """Write everything intact of a session to a new file.

    A tick is complete when it has both inputs and outputs. The images of a killed run are often ahead of the rest: they
    are kept as ticks with nothing but an image, which a replay skips. Viewer topics are derived again. The outcome of
    the new session says what is missing. The file `X.mcap.partial` is removed once `X.mcap` is complete, unless it has
    topics that this flowrec does not know. Any other file stays as it is, and so does a complete one, which at most
    gets the name that its run could not give it.

    Parameters
    ----------
    path : the unfinished, cut or damaged file.
    out : file to make; by default X.mcap for X.mcap.partial, else X_recovered.mcap.
    copy_images : take over the images of an undamaged beginning in the chunks in which they are stored. False: encode
        each image again, which takes several times as long and makes a file of the same messages.

    Raises
    ------
    SessionError : nothing can be saved, the run is still going on, or `out` is taken or can not be written.
    """
    refuse_irregular(path, SessionError)
    try:
        with held(path):
            return _recover(path, out, copy_images)
    except BlockingIOError as error:
        raise SessionError(
            f"{path}: is being recorded just now, or recovered; stop that process with Ctrl-C, which completes the file"
        ) from error


def recover_run(path: Path, out: Path | None = None) -> list[Recovered]:
    """Recover a file as `recover` does or, where X.mcap is no file, every unfinished file of that run.

    Where there is no complete tick in the last part, it is replaced by one with nothing but the keyframe, so that the
    run has an end; the old file is renamed to NAME.remains.

    Raises
    ------
    SessionError : as `recover`; `out` where there are several files; parts that are no run.
    """
    left = unfinished_of(on_this_machine(path, "nothing is recovered from"))
    if path.exists() or not (left or parts(path)):
        return [recover(path, out)]
    if out is not None and len(left) != 1:
        raise SessionError(f"{path}: is a run with {len(left)} unfinished files; recover it without --out, or name one")
    done = []
    for file in left:
        try:
            done.append(recover(file, out))
        except NothingSavedError:
            number = part_number(file)
            if number < 2 or number <= len(parts(path)):
                raise
            _rename(file, file.with_name(file.name.removesuffix(PARTIAL_SUFFIX) + _REMAINS_SUFFIX))
    finished = parts(path)
    if finished:
        with SessionReader(finished[-1]) as last:
            if last.part is not None and is_continued(last.outcome):
                done.append(_end_of_run(path, last, last.part))
    if not done:
        with SessionReader(path) as run:
            done = [Recovered(path, run.counts.get("track", 0), run.duration_s, changed=False)]
    return done


def _recover(path: Path, out: Path | None, copy_images: bool) -> Recovered:
    partial = path.name.endswith(PARTIAL_SUFFIX)
    final = path.with_name(path.name.removesuffix(PARTIAL_SUFFIX))
    target = out or (final if partial else path.with_name(f"{path.stem}_recovered.mcap"))
    growing = partial_path(target)  # a run that will want the name at its end
    Output(target, MCAP, (path,), overwrite=True).check((growing,) if growing != path else ())
    if out is not None:
        _refuse_if_taken(target)
    if partial and path.is_file() and not path.stat().st_size:
        raise NothingSavedError(f"{path}: is empty; nothing was recorded into it; remove the file")
    with _without_circular_advice(path):
        intact = _checked(path)
        if intact is not None:
            if not partial:
                return intact
            _refuse_if_taken(target)
            _rename(path, target)
            return Recovered(target, intact.ticks, intact.duration_s)
        with contextlib.closing(McapReader(path)) as source:
            images = ImageChunks(source, found := Scan())
            scan(source, images.visit if copy_images else None, found=found)
        if partial and not found.summary.chunks:
            raise NothingSavedError(f"{path}: nothing can be saved: no message was on the disk; remove the file")
        skipped = _Skipped()
        contents = SessionContents(path, found.summary)
        reader = SessionReader(path, contents, skipped.add)
        _require_head(path, found)
        # Pixels decoded from JPEG are stored losslessly: encoding them again would change them.
        known = ENCODINGS.get(contents.frame_encoding)
        frames = known.name if known is not None and known.lossless else "zstd"
        end_ns = _last_whole_ns(path, reader, found)
        copied = images.copyable(contents, ENCODINGS[frames].of(reader.frame_bits)) if copy_images else []
    _refuse_if_taken(target)
    draft = target.with_name(f"{target.stem}.recovering{target.suffix}")
    try:
        ticks, lost = _rewrite(reader, found, end_ns, draft, frames, skipped, contents.source, copied)
        done = _verified(draft)
        if done is None:
            raise SessionError(f"{draft}: can not be read back; is the disk sound?")
        _refuse_if_taken(target)
        _rename(draft, target)
    except SessionError as error:
        # The advice of the error is about the draft, which is removed.
        raise SessionError(f"{path}: is left as it was; {str(error).split('; ')[0]}") from error
    finally:
        reader.close()
        for remains in (draft, partial_path(draft)):
            with contextlib.suppress(OSError):  # a read-only disk has raised an error above
                remains.unlink(missing_ok=True)
    if partial and target == final and not _unknown_topics(found):
        path.unlink()
    return Recovered(target, ticks, done.duration_s, found.lost_bytes, lost)


def _checked(path: Path) -> Recovered | None:
    """A file of which every chunk is intact; None for any other."""
    try:
        with SessionReader(path, contents := SessionContents(path)) as reader:
            _ = reader.header
            for _tick in reader.ticks():
                pass
            for chunk in contents.chunks:  # the rest: viewer topics
                if contents.fields.keys().isdisjoint(chunk.message_index_offsets):
                    contents.source.messages(chunk)
            repeated = reader.keyframe_ns is not None
            return Recovered(path, reader.counts.get("track", 0) - repeated, reader.duration_s, changed=False)
    except SessionError:
        return None


def _verified(draft: Path) -> Recovered | None:
    """A file that was just written; None unless every message is as it was meant, and the index agrees with them."""
    try:
        with SessionReader(draft, contents := SessionContents(draft)) as reader:
            _ = reader.header
            digest = FileDigest(contents.source.start_unix_ns)
            scanned = scan(contents.source, digest.add)
            if scanned.lost_bytes or digest.faults(contents) != [] or any(disagreements(contents, scanned)):
                return None
            return Recovered(draft, reader.counts.get("track", 0), reader.duration_s)
    except SessionError:
        return None


def _require_head(path: Path, found: Scan) -> None:
    present = {metadata.name for metadata in found.summary.metadata}
    present |= {attachment.name for attachment in found.summary.attachments}
    missing = sorted(_HEAD - present)
    if missing:
        raise SessionError(
            f"{path}: nothing can be saved: {', '.join(missing)} of its header is missing or damaged,"
            " without which the session can not be interpreted; remove the file"
        )


def _last_whole_ns(path: Path, reader: SessionReader, found: Scan) -> int:
    """Stamp of the last tick with inputs and outputs, which are always in the same chunk."""
    ends = [found.last_ns.get(_channel(found, topic)) for topic in ("/coils/applied", "/robot/track")]
    if any(end is None for end in ends):
        raise NothingSavedError(
            f"{path}: nothing can be saved: the run ended before its first whole tick was on the disk; remove the file"
        )
    return min(end for end in ends if end is not None)


def _channel(found: Scan, topic: str) -> int:
    return next((number for number, channel in found.summary.channels.items() if channel.topic == topic), -1)


def _unknown_topics(found: Scan) -> list[str]:
    """Topics of another flowrec or program, which can not be written again."""
    channels = found.summary.channels.values()
    return sorted({c.topic for c in channels if c.topic not in BY_PATH and c.metadata.get("role") != "view"})


def _rewrite(
    reader: SessionReader,
    found: Scan,
    end_ns: int,
    draft: Path,
    frames: str,
    skipped: _Skipped,
    source: McapReader,
    copied: list[ImageChunk],
) -> tuple[int, str]:
    """Write all ticks, of which those after `end_ns` are incomplete; the number of complete ones and what was lost.

    Where there are chunks to be `copied`, they hold the images.
    """
    before = Tick()
    complete = images_missing = images_ahead = dropped = 0
    # Only replays are written without images.
    has_images = "frame" in reader.counts or not reader.header.parent
    options = WriterOptions(
        frames=frames,
        overwrite=True,
        block=True,
        queue_limit_bytes=_QUEUE_BYTES,
        region=reader.region,
        bits=reader.frame_bits,
        copied_images=bool(copied),
    )
    ticks = (
        with_images(reader.ticks(with_frames=False), copied) if copied else ((tick, None) for tick in reader.ticks())
    )
    with SessionWriter(draft, reader.header, options) as writer:
        for tick, images in ticks:
            if tick.stamp_ns > end_ns:
                images_ahead += tick.frame is not before.frame
            elif tick.stamp_ns == reader.keyframe_ns:
                pass  # the keyframe was counted where it was recorded
            elif tick.applied is not before.applied and tick.track is not before.track:
                complete += 1
                lacks = has_images and tick.frame is before.frame
                images_missing += lacks and not (tick.applied is not None and tick.applied.without_image)
                dropped = tick.timing.dropped_frames if tick.timing is not None else dropped
            writer.write(tick)
            if images is not None:
                writer.add_chunk(stored(source, images))
            before = tick
            while writer.queue_bytes > _QUEUE_BYTES:  # a large message must not wait while the next one is read
                time.sleep(_POLL_S)
        lost = "; ".join(_losses(reader, found, images_missing - dropped, images_ahead, skipped))
        writer.close(_outcome(reader, lost, end_ns, dropped))
    return complete, lost


def _losses(
    reader: SessionReader, found: Scan, images_missing: int, images_ahead: int, skipped: _Skipped
) -> Iterator[str]:
    if not found.ended:
        yield "the last moments, which were not on the disk"
    if found.lost_bytes:
        yield f"{found.lost_bytes} damaged or cut-off bytes, the first at {found.first_lost}"
    # The sequence numbers of a part may continue those of the part before.
    begin_ns = -1 if reader.keyframe_ns is None else reader.keyframe_ns
    gaps = [gap for gap in found.gaps.get(_channel(found, "/coils/applied"), []) if gap.before_ns > begin_ns]
    if gaps:
        from_s = seconds(gaps[0].before_ns - reader.first_ns)
        yield f"{sum(gap.messages for gap in gaps)} ticks on the way (from {from_s:.2f} s on a replay is not exact)"
    # A topic that the file does not declare was not recorded, unless there are messages that belong to none.
    if found.undeclared:
        absent = sorted(set(BY_PATH) - {channel.topic for channel in found.summary.channels.values()})
        yield f"{found.undeclared} messages of topics whose declaration is damaged ({', '.join(absent) or 'unknown'})"
    if unknown := _unknown_topics(found):
        yield f"{', '.join(unknown)}, which this flowrec does not know (the old file is kept)"
    if images_missing > 0:
        yield f"{images_missing} images"
    if images_ahead:
        yield f"all but the image of the last {images_ahead} ticks, which a replay passes over"
    if skipped.count:
        yield f"{skipped.count} messages that make no sense, the first is {skipped.first}"


def _outcome(reader: SessionReader, lost: str, end_ns: int, dropped: int) -> Mapping[str, str]:
    counted = ("ticks", "dropped_frames", "frames_dropped")  # the last one in older files
    recorded = {key: value for key, value in reader.outcome.items() if key not in counted}
    marks = {"recovered_from": reader.path.name, "dropped_frames": str(dropped)}
    if not lost:
        return {"outcome": Outcome.ENDED, **recorded, **marks}
    if "outcome" in recorded:
        marks["ended_as"] = recorded["outcome"]
    until_s = seconds(end_ns - reader.first_ns)
    return {**recorded, **marks, "outcome": Outcome.CUT, "note": f"recovered up to {until_s:.2f} s; lost: {lost}"}


def _refuse_if_taken(target: Path) -> None:
    if os.path.lexists(target):
        raise OutputError(f"{target}: exists already; choose another name with --out")


def _rename(source: Path, target: Path) -> None:
    try:
        put_in_place(source, target, overwrite=False)
    except OSError as error:
        raise SessionError(f"{target}: can not be made ({error.strerror}); choose another --out") from error


@contextlib.contextmanager
def _without_circular_advice(path: Path) -> Iterator[None]:
    """Replaces the advice of a DamageError, which is to recover the file."""
    try:
        yield
    except DamageError as error:
        raise SessionError(f"{path}: nothing can be saved: {error.what}; remove the file") from error


def _end_of_run(path: Path, last: SessionReader, part: Part) -> Recovered:
    """Write the part after `last`, of which nothing is left."""
    target = part_path(path, part.number + 1)
    header = replace(last.header, part=Part(part.run, part.number + 1, keyframe_ns=last.last_ns))
    lost = f"everything after {last.path.name}"
    with SessionWriter(target, header, WriterOptions(block=True, bits=last.frame_bits)) as writer:
        writer.write(replace(last.tick_before(last.last_ns), stamp_ns=last.last_ns))
        writer.close({"outcome": Outcome.CUT, "note": f"lost: {lost}", "recovered_from": last.path.name})
    return Recovered(target, 0, 0.0, lost=lost)
