"""Rerun's viewer and its catalog server: whether they are here, and their start, bound to this machine only."""

from __future__ import annotations

import contextlib
import importlib.util
import os
import platform
import shutil
import socket
import subprocess
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TypeVar

from flowrec.core import FlowrecError, UsageError

DATASET = "sessions"
LOOPBACK = "127.0.0.1"  # Rerun's own default is every interface
_POLL_S = 0.05
_T = TypeVar("_T")
_ENVIRONMENT = {
    "RERUN_APP_ONLY": "true",  # no questions on its first run
    # No report of its use to tel.rerun.io: CI turns the analytics off, whatever the user's own setting is.
    "CI": "true",
    "FORCE_RERUN_ANALYTICS": "false",
    "TELEMETRY_ENABLED": "false",
    # No variable turns off its request to api.github.com for a newer version. A proxy that does not exist does; files
    # and the loopback interface need none.
    "ALL_PROXY": f"http://{LOOPBACK}:9",
    "NO_PROXY": "",
}


def executable() -> Path | None:
    """The viewer itself, not the Python wrapper around it, which leaves an orphan behind when it is killed."""
    named = os.environ.get("RERUN_CLI_PATH")
    if named:
        return Path(named) if Path(named).exists() else None
    try:
        import rerun_cli  # type: ignore[import-untyped]
    except ImportError:
        found = shutil.which("rerun")
        return Path(found) if found else None
    folder = Path(rerun_cli.__file__).parent
    for name in ("Rerun.app/Contents/MacOS/Rerun", "rerun.exe", "rerun"):
        if (folder / name).exists():
            return folder / name
    return None


def has_display() -> bool:
    """True if a window can open."""
    if platform.system() in ("Darwin", "Windows"):
        return True
    return bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


def free_port() -> int:
    """A port on which nothing listens at present."""
    with socket.socket() as trial:
        trial.bind((LOOPBACK, 0))
        return int(trial.getsockname()[1])


def wait_for_server(port: int, limit_s: float, given_up: Callable[[], bool] = lambda: False) -> bool:
    """Wait until a server on this machine accepts connections; False if it does not within the time limit."""

    def accepts() -> bool | None:
        if given_up():
            return False
        with contextlib.suppress(OSError), socket.create_connection((LOOPBACK, port), timeout=1.0):
            return True
        return None

    return bool(until(accepts, limit_s))


def until(done: Callable[[], _T | None], limit_s: float) -> _T | None:
    """The first result that is not None, within a time limit."""
    end = time.monotonic() + limit_s
    while time.monotonic() < end:
        result = done()
        if result is not None:
            return result
        time.sleep(_POLL_S)
    return None


def url(port: int) -> str:
    """Address for a viewer on this machine."""
    return f"rerun+http://{LOOPBACK}:{port}/proxy"


def start(arguments: list[str], log: Path | None = None) -> subprocess.Popen[bytes]:
    """Start the viewer with its server on the loopback interface only, in a session of its own.

    Ctrl-C in the terminal does not reach it, so it can outlive the run and show its end. Raises OSError: there is no
    viewer, or it does not start.
    """
    program = executable()
    if program is None:
        raise FileNotFoundError("Rerun's viewer is not installed")
    output = log.open("wb") if log is not None else subprocess.DEVNULL
    try:
        return subprocess.Popen(  # noqa: S603 - Rerun's own program, arguments are ours
            [str(program), "--bind", LOOPBACK, *arguments],
            stdin=subprocess.DEVNULL,
            stdout=output,
            stderr=output,
            start_new_session=True,
            env=os.environ | _ENVIRONMENT,
        )
    finally:
        if not isinstance(output, int):
            output.close()


def open_window(*arguments: str) -> subprocess.Popen[bytes]:
    """Start the viewer with a window that may outlive this process; raises OSError as `start`."""
    return start(["--port", "auto", "--hide-welcome-screen", *arguments])


def last_line(log: str) -> str:
    """The last line of a log that is not blank; '' if there is none."""
    return next((line for line in reversed(log.splitlines()) if line.strip()), "")


def leave(process: subprocess.Popen[bytes]) -> None:
    """Let a process outlive this one; if it ends earlier, its exit status is collected."""
    threading.Thread(target=process.wait, name="outlives", daemon=True).start()


def open_viewer(path: Path | str) -> str:
    """Open a file in the viewer's window; '' on success, else one line that says how to see it."""
    path = Path(path)
    if executable() is None:
        return f"{path}: Rerun's viewer is not installed here; `pip install rerun-sdk`, then `rerun {path}`"
    if not has_display():
        return f"{path}: no screen here; copy the file and open it with `rerun {path.name}`"
    try:
        process = open_window(str(path.resolve()))
    except OSError as error:
        return f"{path}: Rerun's viewer does not start ({error.strerror or error}); try `rerun {path}`"
    leave(process)
    return ""


@contextlib.contextmanager
def serve_recordings(recordings: Sequence[Path], port: int | None = None) -> Iterator[str]:
    """Serve recordings as a dataset for as long as the block runs; yields the URL for Rerun and its clients.

    Raises UsageError: the server's packages are not installed; FlowrecError: the server does not start.
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
