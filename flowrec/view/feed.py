"""The process behind a live view: ticks from the pipe into Rerun. Runs as `python -m flowrec.view.feed`.

It hosts a server on the loopback, to which any number of viewers connect, so one that is closed can be opened again.
It ends when the pipe does, so it never outlives the run, however that ends.
"""

from __future__ import annotations

import pickle
import socket
import sys
import time
from collections.abc import Set as AbstractSet
from dataclasses import replace

import rerun as rr

from flowrec.messages import Tick
from flowrec.view import viewer
from flowrec.view.blueprint import blueprint
from flowrec.view.logger import TickLogger
from flowrec.view.rrd_file import describe, open_stream
from flowrec.view.scene import Scene

_MEMORY = "256MB"  # kept for viewers that come later
_FAREWELL_S = 0.5  # for the last ticks to reach the viewers


def main() -> None:
    """Show what comes through stdin: first the scene, then batches of changes."""
    port, window = int(sys.argv[1]), sys.argv[2] == "window"
    source = sys.stdin.buffer
    scene: Scene = pickle.load(source)  # noqa: S301 - from our own parent
    stream = open_stream(scene)
    present: AbstractSet[str] = frozenset()
    with socket.socket() as trial:  # Rerun tells of a taken port only in its log
        trial.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            trial.bind((viewer.LOOPBACK, port))
        except OSError:
            sys.exit(f"port {port} is taken by another program")
    stream.set_sinks(
        rr.GrpcServerSink(bind_ip=viewer.LOOPBACK, port=port, server_memory_limit=_MEMORY),
        default_blueprint=blueprint(scene, present=present),
    )
    describe(stream, scene)
    if window:
        url = f"rerun+http://{viewer.LOOPBACK}:{port}/proxy"
        viewer.start(["--port", "auto", "--hide-welcome-screen", "--connect", url]).returncode = 0  # outlives us
    logger = TickLogger(stream, scene)
    tick = Tick()
    while True:
        try:
            step, batch = pickle.load(source)  # noqa: S301
        except (EOFError, pickle.UnpicklingError):  # the run ended, or died in the middle of a word
            break
        logger.image_step = step
        for changes in batch:
            tick = replace(tick, **changes)
            logger.log(tick)
        if logger.present != present:
            # Something is shown for the first time, so its view is worth its place now.
            present = frozenset(logger.present)
            stream.send_blueprint(blueprint(scene, present=present))
    stream.flush(timeout_sec=1.0)
    time.sleep(_FAREWELL_S)
    stream.disconnect()


if __name__ == "__main__":
    main()
