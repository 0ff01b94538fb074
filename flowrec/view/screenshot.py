"""A picture of the viewer without a screen: for people without one, and for tests."""

from __future__ import annotations

import contextlib
import subprocess
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from rerun.experimental import ViewerClient, ViewerState

from flowrec.core import PICTURE, FlowrecError, Output, nanoseconds
from flowrec.store import ForeignError, SessionMetadata
from flowrec.view import viewer
from flowrec.view.entities import LOG_TIME, SESSION_TIME

_START_S = 20.0
_LOAD_S = 60.0
_SETTLE_S = 1.0  # images are decoded and plots laid out over some frames
_NOTICES_S = 4.5  # until the viewer's notices have disappeared


def screenshot(
    path: Path | str,
    out_png: Path | str,
    time_s: float | None = None,
    size: tuple[int, int] = (1920, 1080),
    *,
    overwrite: bool = False,
) -> list[str]:
    """Save what the viewer shows of a file (.rrd or .mcap) at a session time, by default at its end.

    Returns the problems that the views report, one line each; normally none. Raises FlowrecError: there is no viewer,
    no graphics driver, or the viewer does not read the file; OutputError if the picture may not be written.
    """
    path = Path(path).resolve()
    if not path.exists():
        raise FlowrecError(f"{path}: no such file")
    with Output(Path(out_png), PICTURE, (path,), overwrite).new_file() as part, _headless(size) as (client, began):
        client.open(path.as_uri())
        state = viewer.until(lambda: _wait_loaded(client), _LOAD_S)
        if state is None:
            raise FlowrecError(f"{path}: the viewer shows nothing of it; `rerun rrd verify {path}` says more")
        ends_ns = {line.name: line.end for recording in state.recordings for line in recording.timelines}
        if SESSION_TIME in ends_ns:
            at_ns = (ends_ns[SESSION_TIME] or 0) if time_s is None else nanoseconds(time_s)
            client.set_time(SESSION_TIME, duration=np.timedelta64(at_ns, "ns"), play_state="paused")
        elif LOG_TIME in ends_ns and time_s is not None:
            at_ns = _start_unix_ns(path) + nanoseconds(time_s)
            client.set_time(LOG_TIME, timestamp=np.datetime64(at_ns, "ns"), play_state="paused")
        time.sleep(max(_SETTLE_S, began + _NOTICES_S - time.monotonic()))
        part.write_bytes(client.take_screenshot())
        return [
            f"{view.name}: {report.severity}: {report.summary}"
            for view in client.get_state().views
            for report in view.reports
        ]


def _start_unix_ns(path: Path) -> int:
    """Unix time of session time 0; 0 for a file of another program, whose times are not changed."""
    try:
        with SessionMetadata(path) as head:
            return head.source.start_unix_ns
    except ForeignError:
        return 0


@contextlib.contextmanager
def _headless(size: tuple[int, int]) -> Iterator[tuple[ViewerClient, float]]:
    """A viewer without a window, and the time at which it was started."""
    with tempfile.TemporaryDirectory(prefix="flowrec-view-") as folder:
        log = Path(folder, "viewer.log")
        port = viewer.free_port()
        arguments = ["--headless", "--port", str(port), "--window-size", f"{size[0]}x{size[1]}"]
        try:
            process = viewer.start([*arguments, "--hide-welcome-screen"], log)
        except OSError as error:
            raise FlowrecError(f"no screenshot: {error.strerror or error}; `pip install rerun-sdk`") from error
        try:
            began = time.monotonic()
            client = viewer.until(lambda: _connect(port, process), _START_S)
            if client is None:
                raise FlowrecError(f"no screenshot: the viewer does not start; {_why(log)}")
            yield client, began
        except ConnectionError as error:
            process.poll()
            raise FlowrecError(f"no screenshot: the viewer ended; {_why(log)}") from error
        finally:
            process.kill()
            process.wait()


def _connect(port: int, process: subprocess.Popen[bytes]) -> ViewerClient | None:
    """A client, once the viewer responds."""
    if process.poll() is not None:
        raise ConnectionError
    try:
        client = ViewerClient.connect(viewer.url(port))
        client.get_state()
    except ConnectionError:
        return None
    return client


def _wait_loaded(client: ViewerClient) -> ViewerState | None:
    """The state of the viewer, once nothing is loading."""
    state = client.get_state()
    return state if not state.loading and any(recording.timelines for recording in state.recordings) else None


def _why(log: Path) -> str:
    """The reason that the viewer's log states."""
    text = log.read_text(errors="replace")
    if "No glyph for" in text:
        return "without a window it can not draw a character of the file that its font lacks; in a window it does"
    if "render context" in text or "adapter" in text:
        return (
            "it has no graphics to draw with: install a driver, or `apt install mesa-vulkan-drivers` for a software one"
        )
    return viewer.last_line(text) or "its log is empty"
