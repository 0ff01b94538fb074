"""A live view must never make a run wait, whatever becomes of the viewer."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import rerun as rr
from rerun.chunk import RrdReader

from flowrec.core import Frame, Tick
from flowrec.exports import scene_of
from flowrec.store import Session
from flowrec.view import LiveView, Scene, document_of_run, viewer
from flowrec.view.feed import Feed
from flowrec.view.live import ABSENT_S
from flowrec.view.summary_text import LiveSummary
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


@pytest.mark.parametrize(
    "blow", [signal.SIGSTOP, pytest.param(signal.SIGKILL, marks=pytest.mark.slow("a run beside a viewer, once more"))]
)
def test_a_viewer_that_is_stopped_or_killed_does_not_slow_the_run(
    scene: Scene, ticks: list[Tick], blow: signal.Signals
) -> None:
    live = LiveView(scene, "serve")
    assert live.pid is not None
    live.write(ticks[0])
    os.kill(live.pid, blow)
    # More than the queue and the pipe hold.
    assert returns(lambda: [live.write(replace(ticks[i % len(ticks)], stamp_ns=i)) for i in range(4000)])
    assert live.dropped > 1000
    if blow == signal.SIGKILL:
        until(lambda: "the run goes on without" in live.message)  # the thread that sends finds it out
    assert returns(lambda: live.close(0.5))


@pytest.mark.slow("a run and a server of Rerun in processes of their own")
def test_a_live_view_listens_on_this_machine_only_and_ends_with_the_run(scene: Scene, ticks: list[Tick]) -> None:
    with LiveView(scene, "spawn") as live:
        pid = live.pid
        assert pid is not None
        for tick in ticks[:30]:
            live.write(tick)
        assert {address for address, _ in sockets(pid)} == {LOOPBACK}  # it accepts when its address is said
        assert live.url in live.message
        assert "no screen" in live.message
        live.close(HANG_S)
    assert live.dropped == 0
    assert live.afterwards == ""
    assert not Path(f"/proc/{pid}").exists()
    live.write(ticks[0])  # late, and no error
    live.close()


@pytest.mark.slow("starts a viewer's server and a listener, and waits until it has sent all")
@pytest.mark.filterwarnings("ignore:RRD file has no footer")  # the listener is interrupted
def test_a_viewer_receives_every_tick_and_a_smaller_image_and_its_server_stays_until_it_has_left(
    tmp_path: Path, scene: Scene, ticks: list[Tick]
) -> None:
    image = cv2.resize(ticks[0].frame.image, (1600, 1280))  # type: ignore[union-attr]
    program = viewer.executable()
    assert program is not None
    with LiveView(scene, "serve") as live:
        received = tmp_path / "received.rrd"
        listener = subprocess.Popen(
            [program, live.url, "--save", received], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        )
        until(lambda: sockets(live.pid or 0, CONNECTED))
        for i, tick in enumerate(ticks[:60]):
            live.write(replace(tick, frame=Frame(tick.stamp_ns, i, image)))
        live.close(HANG_S)
    # A viewer calls the end of its server an error: the server stays until the last one has left.
    assert f"its server (process {live.pid}) stays" in live.afterwards
    time.sleep(1.5 * ABSENT_S)
    assert sockets(live.pid or 0)  # it accepts viewers still
    assert listener.poll() is None
    listener.send_signal(signal.SIGINT)
    until(lambda: listener.poll() is not None)
    until(lambda: not Path(f"/proc/{live.pid}").exists())
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


@pytest.mark.slow("a run and a server of Rerun in processes of their own")
def test_a_window_keeps_its_server_after_the_run(
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
        live.write(ticks[0])
        live.close(HANG_S)
    assert sockets(pid)
    closed.touch()
    until(lambda: not Path(f"/proc/{pid}").exists())


def test_the_summary_tells_what_is_known_and_ends_as_that_of_the_session(session: Path) -> None:
    stored = Session(session)
    live = LiveSummary(scene_of(stored.config, stored.chip, session))
    texts = []
    for tick in stored.ticks(with_frames=False):
        if live.add(tick):
            texts.append(text_of(live.document()))
    assert len(set(texts)) >= 5
    assert texts[0].startswith("### Under way: start")
    assert "Flow error" not in texts[0]
    surveyed = next(text for text in texts if "refined" in text)
    assert surveyed.startswith(("### Under way: refine", "### Under way: plan"))
    # The shortest way is planned after the end.
    known = {key: value for key, value in stored.outcome.items() if not key.startswith("shortest_way")}
    assert text_of(live.document()) == text_of(document_of_run(session.stem, stored.last, known))


def text_of(document: rr.TextDocument) -> str:
    assert document.text is not None
    (text,) = document.text.as_arrow_array().to_pylist()
    return str(text)


def test_an_image_is_sent_with_the_tick_that_it_belongs_to_and_with_no_other() -> None:
    feed, newest = Feed.__new__(Feed), Frame(3, 2, np.full((720, 1800), 7, np.uint8))
    feed._shown, feed._remarks, feed._frame = ("frame",), dict, newest
    for index, image in ((1, None), (2, newest.image[::3, ::3])):
        tick = Tick(index, frame=Frame(index, index, np.zeros((0, 0), np.uint8)))
        feed._queue = deque([tick])
        batch, _ = feed._batch(Tick())
        sent = batch.changes[-1]["frame"].image
        np.testing.assert_array_equal(sent, np.zeros((0, 0)) if image is None else image)
        assert batch.step == (1 if image is None else 3), "the longer side has at most 720 pixels"
