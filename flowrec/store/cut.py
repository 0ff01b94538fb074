"""A stretch of a session as a session of its own, which replays exactly from its first tick.

The file is a snapshot: it begins with a keyframe, the full state at the tick before the stretch. So a stage finds in it
what it had remembered, and any tick replays from the one before.
"""

from __future__ import annotations

import os
from dataclasses import replace

from flowrec.core import Outcome, Output, seconds
from flowrec.store.frame_encodings import ENCODINGS
from flowrec.store.reader import SessionReader
from flowrec.store.session_file import WriterOptions
from flowrec.store.session_metadata import Part
from flowrec.store.writer import SessionWriter

_LOSSLESS = "zstd"  # for images of a lossy encoding: once more through it they would be others


def cut_session(reader: SessionReader, output: Output, from_ns: int, to_ns: int) -> int:
    """Write the ticks from one stamp to another, both included, and return their number.

    Raises
    ------
    SessionError : damage in the session, or the disk refuses; then there is no file.
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
