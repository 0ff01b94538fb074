"""Recovers a session whose run was killed, or whose file is truncated or damaged."""

from __future__ import annotations

import contextlib
import os
from dataclasses import dataclass, replace
from pathlib import Path

from flowrec.core import (
    MCAP,
    FlowrecError,
    Outcome,
    Output,
    OutputError,
    SessionError,
    hold_file,
    put_in_place,
    refuse_irregular,
)
from flowrec.store.audit import disagreements, edits_of
from flowrec.store.channels import VIEWED, SessionContents, left_out
from flowrec.store.chunk_copies import ChunkCopier, Losses, RecoveryTally
from flowrec.store.file_end import end_file
from flowrec.store.mcap_format import DamageError
from flowrec.store.mcap_reader import McapReader
from flowrec.store.mcap_writer import disk_errors, new_mcap
from flowrec.store.reader import SessionReader
from flowrec.store.run_files import (
    complete_path,
    is_continued,
    is_partial,
    part_number,
    part_path,
    partial_path,
    parts,
    unfinished_of,
)
from flowrec.store.scan import Scan, scan
from flowrec.store.session_file import WriterOptions
from flowrec.store.session_metadata import CHIP_FILE, CHIP_IMAGE_FILE, CONFIG_FILE, PROVENANCE, SESSION, Part
from flowrec.store.session_path import on_this_machine
from flowrec.store.viewer_scene import ChipCamera
from flowrec.store.writer import SessionWriter

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
        """True if nothing was lost."""
        return not self.lost

    @property
    def summary(self) -> str:
        """Length of what was recovered, and the loss, as text."""
        lost = f"; lost: {self.lost}" if self.lost else ""
        return f"{self.ticks} ticks, {self.duration_s:.1f} s{lost}" if self.changed else "is whole; nothing to do"


def recover(path: Path, out: Path | None = None) -> Recovered:
    """Write everything intact of a session to a new file.

    Intact chunks are copied as they are stored, whatever topics they hold; only messages that make no sense are left
    out. A tick is complete when it has both inputs and outputs. The images of a killed run are often ahead of the rest:
    they are kept as ticks with nothing but an image, which a replay skips. The outcome of the new session says what is
    missing. The file `X.mcap.partial` is removed once `X.mcap` is complete. Any other file stays as it is, and so does
    a complete one, which at most gets the name that its run could not give it.

    Parameters
    ----------
    path : the unfinished, cut or damaged file.
    out : file to make; by default X.mcap for X.mcap.partial, else X_recovered.mcap.

    Raises
    ------
    SessionError : nothing can be saved, the run is still going on, or `out` is taken or can not be written.
    """
    refuse_irregular(path, SessionError)
    try:
        with hold_file(path):
            return _recover(path, out)
    except BlockingIOError as error:
        raise SessionError(
            f"{path}: is being recorded just now, or recovered; stop that process with Ctrl-C, which completes the file"
        ) from error
    except DamageError as error:  # its advice is to recover the file
        raise SessionError(f"{path}: nothing can be saved: {error.what}; remove the file") from error


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
            _rename(file, file.with_suffix(_REMAINS_SUFFIX))
    finished = parts(path)
    if finished:
        with SessionReader(finished[-1]) as last:
            if last.part is not None and is_continued(last.outcome):
                done.append(_end_of_run(path, last, last.part))
    if not done:
        with SessionReader(path) as run:
            done = [Recovered(path, run.counts.get("track", 0), run.duration_s, changed=False)]
    return done


def _recover(path: Path, out: Path | None) -> Recovered:
    partial, final = is_partial(path), complete_path(path)
    target = out or (final if partial else path.with_name(f"{path.stem}_recovered.mcap"))
    growing = partial_path(target)  # a run that will want the name at its end
    Output(target, MCAP, (path,), overwrite=True).check((growing,) if growing != path else ())
    if out is not None:
        _refuse_if_taken(target)
    if partial and path.is_file() and not path.stat().st_size:
        raise NothingSavedError(f"{path}: is empty; nothing was recorded into it; remove the file")
    intact = _check_intact(path)
    if intact is not None:
        if not partial:
            return intact
        _refuse_if_taken(target)
        _rename(path, target)
        return Recovered(target, intact.ticks, intact.duration_s)
    with McapReader(path) as source:
        declared = scan(source, heads_only=True)
    if partial and not declared.chunks_passed:
        raise _nothing_on_disk(path)
    _require_head(path, declared)
    contents = SessionContents(path, declared.summary)
    _refuse_if_taken(target)
    draft = partial_path(target.with_name(f"{target.stem}.recovering{target.suffix}"))
    try:
        with contents:
            kept = _copy_intact(contents, draft)
        duration_s = _verify(draft)
        if duration_s is None:
            raise SessionError(f"{draft}: can not be read back; is the disk sound?")
        _refuse_if_taken(target)
        _rename(draft, target)
    except NothingSavedError:
        raise
    except SessionError as error:
        # The advice of the error is about the draft, which is removed.
        raise SessionError(f"{path}: is left as it was; {str(error).split('; ')[0]}") from error
    finally:
        with contextlib.suppress(OSError):  # a read-only disk has raised an error above
            draft.unlink(missing_ok=True)
    if partial and target == final:
        path.unlink()
    return Recovered(target, kept.ticks, duration_s, kept.lost_bytes, kept.lost)


def _copy_intact(contents: SessionContents, draft: Path) -> Losses:
    """Copy everything intact of a file into a new one, and complete that."""
    path = contents.source.path
    tally = RecoveryTally(contents)
    with new_mcap(draft, overwrite=True) as out, disk_errors(draft):
        copier = ChunkCopier(contents, out, tally)
        found = scan(contents.source, copier.visit)
        if not found.summary.chunks and is_partial(path):
            raise _nothing_on_disk(path)
        kept = tally.losses(found)
        if kept is None:
            raise NothingSavedError(
                f"{path}: nothing can be saved: the run ended before its first whole tick was on the disk; "
                "remove the file"
            )
        unwanted = _left_out(contents) if copier.draws else VIEWED
        start_unix_ns = contents.source.start_unix_ns
        end_file(draft, out, kept.outcome, ChipCamera.of(contents.header), start_unix_ns, unwanted)
    return kept


def _left_out(contents: SessionContents) -> frozenset[str]:
    """The topics that the run was not to record; none where its settings can not be read."""
    try:
        return left_out(contents.header.config().recording.leave_out, contents.topics)
    except FlowrecError:
        return frozenset()


def _nothing_on_disk(path: Path) -> NothingSavedError:
    return NothingSavedError(f"{path}: nothing can be saved: no message was on the disk; remove the file")


def _check_intact(path: Path) -> Recovered | None:
    """A file of which every chunk is intact; None for any other."""
    try:
        with SessionReader(path) as reader:
            file, _ = reader.file(0), reader.header
            for _tick in reader.ticks():
                pass
            for chunk in file.chunks:  # the rest: viewer topics
                if file.fields.keys().isdisjoint(chunk.message_index_offsets):
                    file.source.messages(chunk)
            repeated = reader.keyframe_ns is not None
            return Recovered(path, reader.counts.get("track", 0) - repeated, reader.duration_s, changed=False)
    except SessionError:
        return None


def _verify(draft: Path) -> float | None:
    """Length in s of a new file; None unless every message is as it was meant, and the index agrees with them."""
    try:
        with SessionReader(draft) as reader:
            file, _ = reader.file(0), reader.header
            scanned = scan(file.source, digests=True)
            if scanned.lost_bytes or edits_of(file, scanned) != [] or any(disagreements(file, scanned)):
                return None
            return reader.duration_s
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


def _refuse_if_taken(target: Path) -> None:
    if os.path.lexists(target):
        raise OutputError(f"{target}: exists already; choose another name with --out")


def _rename(source: Path, target: Path) -> None:
    try:
        put_in_place(source, target, overwrite=False)
    except OSError as error:
        raise SessionError(f"{target}: can not be made ({error.strerror}); choose another --out") from error


def _end_of_run(path: Path, last: SessionReader, part: Part) -> Recovered:
    """Write the part after `last`, of which nothing is left."""
    target = part_path(path, part.number + 1)
    header = replace(last.header, part=Part(part.run, part.number + 1, keyframe_ns=last.last_ns))
    lost = f"everything after {last.path.name}"
    with SessionWriter(target, header, WriterOptions(block=True, bits=last.frame_bits, topics=last.topics)) as writer:
        writer.write(replace(last.tick_before(last.last_ns), stamp_ns=last.last_ns))
        writer.close({"outcome": Outcome.CUT, "note": f"lost: {lost}", "recovered_from": last.path.name})
    return Recovered(target, 0, 0.0, lost=lost)
