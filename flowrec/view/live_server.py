"""The process that serves a live view: `python -m flowrec.view.live_server PORT window|serve`, started by live.py.

It hosts a server on the loopback interface to which any number of viewers connect, so a viewer that was closed can be
opened again. A viewer calls it an error when its server ends, and Rerun 0.41 has no other end of a stream. Therefore
the process stays after the run while a viewer is connected.
"""

from __future__ import annotations

import socket
import subprocess
import sys
import time
from collections.abc import Set as AbstractSet
from dataclasses import replace

from flowrec.core import Tick, seconds
from flowrec.view import viewer
from flowrec.view.feed import Batch, read_feed
from flowrec.view.scene import Scene

ACCEPTS = "flowrec: accepts viewers"  # what the process says to the run
STAYS = "flowrec: stays for its viewers"
ABSENT_S = 2.0  # without a viewer, after which the process ends

_START_S = 10.0  # for the server to accept viewers
_SERVER_MEMORY = "256MB"  # kept for viewers that connect later
_POLL_S = 0.25


def serve() -> None:
    """Show what arrives at stdin, first the scene, then batches; stay for the viewers."""
    import rerun as rr  # here, so that a run does not import it

    from flowrec.view.blueprint import blueprint
    from flowrec.view.entities import SUMMARY
    from flowrec.view.logger import TickLogger
    from flowrec.view.rrd_file import describe, open_stream
    from flowrec.view.summary_text import LiveSummary

    port, window = int(sys.argv[1]), sys.argv[2] == "window"
    source = read_feed()
    scene: Scene = next(source)
    stream = open_stream(scene)
    present: AbstractSet[str] = frozenset({SUMMARY})
    with socket.socket() as trial:  # Rerun reports a taken port only in its log
        trial.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            trial.bind((viewer.LOOPBACK, port))
        except OSError:
            sys.exit(f"port {port} is taken by another program")
    stream.set_sinks(
        rr.GrpcServerSink(bind_ip=viewer.LOOPBACK, port=port, server_memory_limit=_SERVER_MEMORY),
        default_blueprint=blueprint(scene, ("",), present, 0.0, [{}], live=True),
    )
    if not viewer.wait_for_server(port, _START_S):
        sys.exit(f"the server does not accept viewers at port {port}")
    print(ACCEPTS, flush=True)
    describe(stream, scene)
    opened = viewer.open_window("--connect", viewer.url(port)) if window else None
    logger, summary = TickLogger(stream, scene), LiveSummary(scene)
    tick, begun = Tick(), 0
    batch: Batch
    for batch in source:
        logger.image_step = batch.step
        news = False
        for changes in batch.changes:
            tick = replace(tick, **changes)
            news |= summary.add(tick)
            logger.states.doubtful = summary.doubtful
            logger.log(tick)
        if news:
            stream.log(SUMMARY, summary.document(), static=True)
        phases = logger.states.phases
        ended = tick.mission is not None and tick.mission.finished
        if not logger.present <= present or (len(phases) > begun and not ended):
            # What is shown for the first time is added to the layout. At the end it stays as a person has arranged it.
            present, begun = present | logger.present, len(phases)
            stream.send_blueprint(blueprint(scene, ("",), present, seconds(tick.stamp_ns), [phases], live=True))
    stream.log(SUMMARY, summary.document(), static=True)
    _stay(port, opened)
    stream.disconnect()


def _stay(port: int, window: subprocess.Popen[bytes] | None) -> None:
    """Wait until no viewer has been connected for ABSENT_S; not at all if none is connected now."""
    if not _is_watched(port, window):
        return
    print(STAYS, flush=True)
    seen_s = time.monotonic()
    while time.monotonic() - seen_s < ABSENT_S:
        time.sleep(_POLL_S)
        if _is_watched(port, window):
            seen_s = time.monotonic()


def _is_watched(port: int, window: subprocess.Popen[bytes] | None) -> bool:
    """True if the window is open or a viewer connected."""
    import psutil  # type: ignore[import-untyped]

    if window is not None and window.poll() is None:
        return True
    return any(
        each.status == psutil.CONN_ESTABLISHED and each.laddr.port == port
        for each in psutil.Process().net_connections("tcp")
    )


if __name__ == "__main__":
    serve()
