"""Draws a recorded file: its viewer topics, made in one pass from the messages in it, and written behind them."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from flowrec.store.channels import VIEWED
from flowrec.store.chunk import ChunkEncoder
from flowrec.store.codec import Encoded
from flowrec.store.file_reader import FileReader
from flowrec.store.frame_encodings import ENCODINGS
from flowrec.store.mcap_writer import McapWriter
from flowrec.store.viewer_scene import ChipCamera, ViewerScene
from flowrec.store.viewer_topics import INPUTS, ViewerTopics


def draw(
    path: Path,
    out: McapWriter,
    camera: ChipCamera | None,
    start_unix_ns: int,
    left_out: frozenset[str],
    outcome: Mapping[str, str],
) -> None:
    """Add the viewer topics to a file that holds all of its messages, and none of these topics.

    Raises SessionError: the file can not be read back. OSError : the disk refuses.

    Parameters
    ----------
    path, out : the file, and what writes it.
    camera : of the session; None if its settings are not known.
    start_unix_ns : Unix time of stamp 0.
    left_out : viewer topics that are not wanted.
    outcome : of the run.
    """
    if left_out >= VIEWED:
        return
    summary = out.summary()
    if not summary.chunks:
        return
    summary.to_session_clock(start_unix_ns)
    encoder = ChunkEncoder(ENCODINGS["raw"], out.add_chunks, start_unix_ns)
    with FileReader(path, summary=summary) as file:
        views = ViewerTopics(ViewerScene(camera, start_unix_ns), left_out)
        first_ns: int | None = None
        for log_ns, messages in file.new_messages(None, fields=INPUTS):
            first_ns = log_ns if first_ns is None else first_ns
            for topic, stamp_ns, payload in views.of(messages):
                encoder.append(topic, log_ns, Encoded(stamp_ns, None, payload))
            encoder.seal_full()
        if first_ns is not None:
            encoder.seal()  # a chunk of its own: in one, times increase
            for topic, stamp_ns, payload in views.of_end(outcome, first_ns):
                encoder.append(topic, first_ns, Encoded(stamp_ns, None, payload))
    encoder.seal()
