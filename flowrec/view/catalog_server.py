"""Rerun's own catalog server over files (.rrd), on the loopback interface only."""

from __future__ import annotations

import contextlib
import importlib.util
from collections.abc import Iterator, Sequence
from pathlib import Path

from flowrec.core import FlowrecError, UsageError
from flowrec.view.viewer import LOOPBACK

DATASET = "sessions"


@contextlib.contextmanager
def serve_recordings(recordings: Sequence[Path], port: int | None = None) -> Iterator[str]:
    """Serve recordings as a dataset for as long as the block runs; yields the URL for Rerun and its clients.

    Raises
    ------
    UsageError : the server's packages are not installed.
    FlowrecError : the server does not start.
    """
    if importlib.util.find_spec("datafusion") is None:
        raise UsageError("--serve needs Rerun's catalog, which is not installed: pip install 'flowrec[catalog]'")
    from rerun.server import Server

    try:
        # Rerun's own default is every interface.
        server = Server(host=LOOPBACK, port=port, datasets={DATASET: [str(path) for path in recordings]})
    except (RuntimeError, ValueError, OSError) as error:
        reason = " ".join(str(error).split())
        raise FlowrecError(f"the server can not be started ({reason}); choose another --port") from error
    try:
        yield server.url()
    finally:
        server.shutdown()
