"""Creates a session file: the header with configuration, chip and provenance, and the options of the writer.

A stretch of a session becomes a session of its own, which replays exactly from its first tick: it is a snapshot that
begins with a keyframe, the full state at the tick before. So a stage finds in it what it had remembered.
"""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

from flowrec.core import Outcome, Output, TopicTable, pixel_type, provenance, remove_leftovers_once, seconds
from flowrec.physics import Chip, chip_files
from flowrec.stages import SIMULATED, ResolvedConfig, calibration_of, facts_of, to_toml, topics_of
from flowrec.store.frame_encodings import ENCODINGS, encoding_for
from flowrec.store.reader import SessionReader
from flowrec.store.roi import Region
from flowrec.store.run_files import files_behind, files_of, session_sha256
from flowrec.store.session_file import Snapshot, Split, WriterOptions
from flowrec.store.session_metadata import Part, SessionHeader, SessionMetadata
from flowrec.store.writer import SessionWriter

_LOSSLESS = "zstd"  # for images of a lossy encoding, which would change them once more
_QUEUE_S = 4.0  # of images, that wait where the disk stalls
_LARGEST_PICTURE_BYTES = 50_000_000
_LEAST_QUEUE_BYTES, _LARGEST_QUEUE_BYTES = 64_000_000, 1_250_000_000


def cut_session(reader: SessionReader, output: Output, from_ns: int, to_ns: int) -> int:
    """Write the ticks from one stamp to another, both included, and return their number.

    Raises SessionError: damage in the session, or the disk refuses; then there is no file.
    """
    config = reader.header.config().recording
    name = config.frames if config.frames in ENCODINGS and ENCODINGS[config.frames].lossless else _LOSSLESS
    before = reader.tick_before(from_ns - 1)
    begins = from_ns <= reader.first_ns
    why = f"{seconds(from_ns):g} s to {seconds(to_ns):g} s of {reader.path.name}"
    part = Part(os.urandom(8).hex(), 1, "snapshot", None if begins else before.stamp_ns, why)
    options = WriterOptions(
        frames=name,
        overwrite=output.overwrite,
        block=True,
        region=reader.region,
        leave_out=config.leave_out,
        bits=reader.frame_bits,
        keep_failed=False,
        topics=reader.topics,
    )
    with SessionWriter(output.path, replace(reader.header, part=part), options, inputs=output.inputs) as writer:
        if not begins:
            writer.write(before)
        count = 0
        for tick in reader.ticks(from_ns):
            if tick.stamp_ns > to_ns:
                break
            writer.write(tick)
            count += 1
        writer.close({"outcome": Outcome.SNAPSHOT, "note": f"cut from {why}"})
    return count


def session_writer(
    output: Output,
    config: ResolvedConfig,
    chip: Chip,
    *,
    parent: Path | None = None,
    live: bool = False,
    in_pieces: bool = False,
    derived: Mapping[str, float] | None = None,
    facts: Mapping[str, str] | None = None,
    keep_failed: bool = True,
    topics: TopicTable | None = None,
) -> SessionWriter:
    """Create a session file and write its header.

    Parameters
    ----------
    output : the file; neither its inputs nor the files of the parent are replaced.
    parent : the session that it replays; the header names it by its hash.
    live : drop images rather than wait for the disk.
    in_pieces : split the run, or record only around events, as the settings `recording.split_*` and `.snapshot_*` say.
    derived : settings that were derived because they were not given, by key, for the header.
    facts : about devices or files that the session is made of, for the header.
    keep_failed : False: an exception leaves no file.
    topics : those of the run; None: those that the settings name.
    """
    header = session_header(config, chip)
    more = {"derived": json.dumps(dict(derived))} if derived else {}
    more |= {**(facts or {}), **_durability(config, live=live)}
    header = replace(header, provenance={**header.provenance, **more})
    if parent is not None:
        files = files_of(parent)
        with SessionMetadata(files[0]) as first:
            named = {"file": parent.name, "sha256": session_sha256(files)}
            header = replace(header, parent=named, start_unix_ns=first.source.start_unix_ns)
    options = WriterOptions(
        frames=frames_of(config),
        flush_s=config.recording.flush_s,
        sync_s=config.recording.sync_s,
        overwrite=output.overwrite,
        block=not live,
        queue_limit_bytes=queue_bytes_of(config),
        files=_files_of(config) if in_pieces else Split(),
        region=region_of(config, chip, again=parent is not None),
        leave_out=config.recording.leave_out,
        bits=config.camera.bits,
        keep_failed=keep_failed,
        accept_losses=live and config.recording.accept_losses,
        own_process=parent is None and config.recording.own_process,
        start_by_clocks=parent is None,
        topics=topics_of(config) if topics is None else topics,
    )
    remove_leftovers_once(output.path.absolute().parent)
    inputs = (*output.inputs, *(files_behind(parent) if parent is not None else ()))
    return SessionWriter(output.path, header, options, inputs=inputs)


def _durability(config: ResolvedConfig, *, live: bool) -> dict[str, str]:
    """Largest loss if the process is killed, in s of stamps; of a snapshot, counted from its event."""
    bytes_s, flush_s = image_bytes_s(config), config.recording.flush_s
    waiting_s = queue_bytes_of(config) / bytes_s if live and bytes_s else 0.0  # only if the disk is too slow
    return {"durability_state_s": f"{flush_s:g}", "durability_images_s": f"{flush_s + waiting_s:.3g}"}


def _files_of(config: ResolvedConfig) -> Split | Snapshot:
    recording = config.recording
    if recording.snapshot_before_s:
        return Snapshot(recording.snapshot_before_s, recording.snapshot_after_s, recording.snapshot_mb)
    return Split(recording.split_mb, recording.split_s)


def region_of(config: ResolvedConfig, chip: Chip, again: bool = False) -> Region | None:
    """The region of most images that is recorded, by the settings and the tracker; None: whole images.

    `again`: the images were cropped when they were recorded, and are not cropped again.
    """
    recording, camera = config.recording, config.camera
    if recording.region == "whole":
        return None
    shape = camera.shape
    footprint = config.tracker.footprint(chip, calibration_of(config, chip), config.robot, shape)
    pad_px = footprint.pad_px + recording.region_pad_px
    return Region(pad_px, footprint.everywhere_px, recording.full_every_s, cut=not again)


def queue_bytes_of(config: ResolvedConfig) -> int:
    """Largest size of the write queue, in bytes."""
    chosen_mb = config.recording.queue_mb
    if chosen_mb is not None:
        return int(chosen_mb * 1e6)
    images = int(_QUEUE_S * image_bytes_s(config))
    return min(max(images, _LEAST_QUEUE_BYTES), _LARGEST_QUEUE_BYTES)


def image_bytes_s(config: ResolvedConfig) -> float:
    """Bytes of the camera's images per second, before they are compressed."""
    camera = config.camera
    return camera.width_px * camera.height_px * pixel_type(camera.bits).itemsize * camera.rate_hz


def frames_of(config: ResolvedConfig) -> str:
    """Encoding of the images of a run, a name of store/frame_encodings.py."""
    camera, chosen = config.camera, config.recording.frames
    if chosen != "auto":
        return chosen
    if config.recording.region == "robot":
        return "zstd"  # compresses black better than delta in a fifth of its time (python -m tests.perf.store)
    return encoding_for(camera.width_px, camera.height_px, camera.rate_hz, camera.bits)


def session_header(config: ResolvedConfig, chip: Chip) -> SessionHeader:
    """The header of a new session: configuration, chip and provenance. The session clock starts now."""
    png, toml = chip_files(chip)
    facts = provenance(config.recording.anonymous) | {
        "operator": config.recording.operator,
        "sample": config.recording.sample,
        "notes": config.recording.notes,
    }
    facts |= facts_of(config)
    if config.rig == SIMULATED:
        facts |= {"seed": str(config.simulated.seed), "world": config.simulated.world}
    if config.refine.weights_sha256:
        facts[f"weights.{config.refine.method}"] = config.refine.weights_sha256
    pictures = _pictures(config)
    return SessionHeader(to_toml(config), png, toml, facts, start_unix_ns=int(facts["wall_ns"]), pictures=pictures)


def _pictures(config: ResolvedConfig) -> dict[str, bytes]:
    """The picture of the registration, if the file that is named has one beside it."""
    named = Path(config.camera.registration)
    if not named.name:
        return {}
    overlay = named.with_suffix(".png")
    if not overlay.is_file() or overlay.stat().st_size > _LARGEST_PICTURE_BYTES:
        return {}
    return {"registration.png": overlay.read_bytes()}
