"""A live view must never make a run wait, whatever becomes of the viewer."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import threading
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from rerun.chunk import RrdReader

from flowrec.messages import Frame
from flowrec.topics import Tick
from flowrec.view import viewer
from flowrec.view.live import LiveView
from flowrec.view.scene import Scene
from tests.conftest import HANG_S, until

LISTENING, CONNECTED = "0A", "01"
LOOPBACK = "0100007F"


@pytest.fixture(autouse=True)
def no_screen(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)


def sockets(pid: int, state: str = LISTENING) -> list[tuple[str, int]]:
    """Address, as the kernel writes it, and port of each socket of a process in that state."""
    inodes = set()
    for link in Path(f"/proc/{pid}/fd").iterdir():
        try:
            target = str(link.readlink())
        except OSError:
            continue
        if target.startswith("socket:["):
            inodes.add(target[8:-1])
    rows = [
        line.split()
        for table in ("tcp", "tcp6")
        if Path("/proc/net", table).exists()
        for line in Path("/proc/net", table).read_text().splitlines()[1:]
    ]
    found = [row[1].split(":") for row in rows if row[3] == state and row[9] in inodes]
    return [(address, int(port, 16)) for address, port in found]


def returns(call: Callable[[], object]) -> bool:
    """Whether a call returns at all: one that waits for a viewer that is stopped never does."""
    thread = threading.Thread(target=call, daemon=True)
    thread.start()
    thread.join(HANG_S)
    return not thread.is_alive()


@pytest.mark.parametrize("blow", [signal.SIGSTOP, signal.SIGKILL])
def test_a_viewer_that_is_stopped_or_killed_does_not_slow_the_run(
    scene: Scene, ticks: list[Tick], blow: signal.Signals
) -> None:
    live = LiveView(scene, "serve", max_hz=50)
    assert live.pid is not None
    until(lambda: sockets(live.pid or 0))
    live.write(ticks[0])
    os.kill(live.pid, blow)
    # More than the queue and the pipe hold.
    assert returns(lambda: [live.write(replace(ticks[i % len(ticks)], stamp_ns=i)) for i in range(4000)])
    assert live.dropped > 1000
    if blow == signal.SIGKILL:
        until(lambda: "the run goes on without" in live.message)  # the thread that sends finds it out
    assert returns(live.close)


def test_a_live_view_listens_on_this_machine_only_and_ends_with_the_run(scene: Scene, ticks: list[Tick]) -> None:
    with LiveView(scene, "spawn") as live:
        pid = live.pid
        assert pid is not None
        until(lambda: sockets(pid))
        for tick in ticks[:30]:
            live.write(tick)
        assert {address for address, _ in sockets(pid)} == {LOOPBACK}
        assert live.url in live.message
        assert "no screen" in live.message
        live.close(HANG_S)
    assert live.dropped == 0
    assert not Path(f"/proc/{pid}").exists()
    live.write(ticks[0])  # late, and no error
    live.close()


def test_what_a_viewer_receives_is_every_tick_and_a_smaller_image(
    tmp_path: Path, scene: Scene, ticks: list[Tick]
) -> None:
    image = cv2.resize(ticks[0].frame.image, (1600, 1280))  # type: ignore[union-attr]
    program = viewer.executable()
    assert program is not None
    with LiveView(scene, "serve", max_hz=20) as live:
        until(lambda: sockets(live.pid or 0))
        received = tmp_path / "received.rrd"
        listener = subprocess.Popen(
            [program, live.url, "--save", received], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        )
        until(lambda: sockets(live.pid or 0, CONNECTED))
        for i, tick in enumerate(ticks[:60]):
            live.write(replace(tick, frame=Frame(tick.stamp_ns, i, image)))
        live.close(HANG_S)
    until(lambda: listener.poll() is not None)
    robot, images, scale = [], [], []
    for chunk in RrdReader(received).stream():
        batch = chunk.to_record_batch()
        if chunk.entity_path == "/camera/robot" and not chunk.is_static:
            robot += batch.column("frame").to_pylist()
        if chunk.entity_path == "/camera/measured/image":
            if chunk.is_static:
                scale += batch.column("Transform3D:mat3x3").to_pylist()
            else:
                images += batch.column("EncodedImage:blob").to_pylist()
    assert robot == list(range(60))
    assert 1 <= len(images) < 60  # only the last image of what is handed over together
    preview = cv2.imdecode(np.array(images[-1][0], np.uint8), cv2.IMREAD_GRAYSCALE)
    assert preview.shape == (427, 534)
    assert scale[-1] == [list(np.diag([3.0, 3.0, 1.0]).ravel())]


def test_without_a_viewer_the_run_goes_on_and_says_so(
    scene: Scene, ticks: list[Tick], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv("RERUN_CLI_PATH", str(tmp_path / "missing"))
    with LiveView(scene) as live:
        live.write(ticks[0])
        assert "not installed" in live.message
        assert live.dropped == 1


def test_a_port_that_is_taken_is_said(scene: Scene, ticks: list[Tick]) -> None:
    with socket.socket() as other:
        other.bind((viewer.LOOPBACK, 0))
        other.listen()
        port = other.getsockname()[1]
        with LiveView(scene, "serve", port=port) as live:
            until(lambda: "the run goes on without" in live.message)
            assert f"port {port} is taken" in live.message
            live.write(ticks[0])


def test_a_window_keeps_its_server_after_the_run_because_a_viewer_calls_its_end_an_error(
    scene: Scene, ticks: list[Tick], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    program, closed = tmp_path / "rerun", tmp_path / "closed"
    program.write_text(f"#!/bin/sh\nuntil [ -e {closed} ]; do sleep 0.05; done\n")
    program.chmod(0o755)
    monkeypatch.setenv("RERUN_CLI_PATH", str(program))
    monkeypatch.setenv("DISPLAY", ":0")
    with LiveView(scene, "spawn") as live:
        pid = live.pid
        assert pid is not None
        assert {address for address, _ in sockets(pid)} == {LOOPBACK}  # it accepts when its address is said
        live.write(ticks[0])
        live.close(HANG_S)
    assert sockets(pid)
    closed.touch()
    until(lambda: "State:\tZ" in Path(f"/proc/{pid}/status").read_text())
    os.waitpid(pid, 0)
