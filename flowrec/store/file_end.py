"""The end of a recorded file: outcome, viewer topics, copies for lookups, digest and index, behind all messages."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from mcap.records import Metadata

from flowrec.store.channels import VIEWED
from flowrec.store.chunk import ChunkEncoder
from flowrec.store.codec import Encoded
from flowrec.store.file_reader import FileReader
from flowrec.store.frame_encodings import ENCODINGS
from flowrec.store.lookup import gather
from flowrec.store.mcap_writer import McapWriter
from flowrec.store.session_metadata import OUTCOME
from flowrec.store.viewer_scene import ChipCamera, ViewerScene
from flowrec.store.viewer_topics import INPUTS, ViewerTopics


def end_file(
    path: Path,
    out: McapWriter,
    outcome: Mapping[str, str],
    camera: ChipCamera | None,
    start_unix_ns: int,
    left_out: frozenset[str],
) -> None:
    """Complete a file that holds all of its messages, and sync it.

    Raises SessionError: the file can not be read back. OSError : the disk refuses.

    Parameters
    ----------
    path, out : the file, and what writes it.
    outcome : of the run.
    camera : of the session; None if its settings are not known.
    start_unix_ns : Unix time of stamp 0.
    left_out : viewer topics that are not wanted.
    """
    out.add(Metadata(OUTCOME, dict(outcome)))  # before the drawings: without them nothing is lost
    if path.exists():  # else its folder was renamed: recovery draws
        _draw(path, out, outcome, ViewerScene(camera, start_unix_ns), left_out)
        for copies in gather(path, out.summary(), start_unix_ns):
            out.add(copies)
    out.add_digest()
    out.finish()
    out.sync()


def _draw(
    path: Path, out: McapWriter, outcome: Mapping[str, str], scene: ViewerScene, left_out: frozenset[str]
) -> None:
    """Add the viewer topics, in one pass over the messages."""
    if left_out >= VIEWED:
        return
    summary = out.summary()
    if not summary.chunks:
        return
    summary.to_session_clock(scene.start_unix_ns)
    encoder = ChunkEncoder(ENCODINGS["raw"], out.add_chunks, scene.start_unix_ns)
    with FileReader(path, summary=summary) as file:
        views = ViewerTopics(scene, left_out)
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
