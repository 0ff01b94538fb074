"""The server of the console: who may ask, what a page shows, and what frozen pages cost."""

from __future__ import annotations

import importlib
import json
import os
import signal
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import replace
from typing import Any

import numpy as np
import psutil
import pytest

from flowrec.console import RunEnded
from flowrec.console import console as console_module
from flowrec.console.board import MOST_PAGES
from flowrec.console.page_state import PageState
from flowrec.core import WALLS, CameraLosses, Estimate, Extra, FlowField, RobotWalls, Tick, Timing, Track, UsageError
from flowrec.run import COMMANDS
from flowrec.stages.robot_topics import messages_of
from flowrec.view import Batch, LiveView, Scene
from tests.conftest import until
from tests.console.served import Served, asked

ConnectionClosed, InvalidStatus = (
    getattr(importlib.import_module("websockets.exceptions"), name) for name in ("ConnectionClosed", "InvalidStatus")
)

SERVICE = "/rerun.sdk_comms.v1alpha1.MessageProxyService/"
EMPTY_REQUEST = bytes(5)  # a gRPC message of no bytes
Ticks = Callable[[int], Iterator[Tick]]


@pytest.fixture(scope="module")
def served(scene: Scene) -> Iterator[Served]:
    with (made := Served(scene)).console:
        yield made


def status_of(connect: Callable[[], Any]) -> int:
    """101 for a connection that is accepted, else the status of the refusal."""
    try:
        with connect():
            return 101
    except InvalidStatus as error:
        return error.response.status_code


def test_without_the_token_every_door_is_shut(served: Served) -> None:
    doors = ["/", "/page/console.js", "/rerun/", "/rerun/re_viewer.js", "/nowhere", "/?token=", "/?token=x"]
    name = served.cookie.partition("=")[0]
    wrong = [None, "", f"{name}=", f"{name}={served.token[:-1]}", f"{name}=wrong", "other=; ="]
    for cookie in (*wrong, f"{name[:-1]}={served.token}"):
        for door in doors:
            answer = served.asks(door, Cookie=cookie)
            assert (answer.status, served.token.encode() in answer.begin) == (403, False), (cookie, door)
        own = {"Cookie": cookie, "Origin": f"http://{served.host}"}
        assert served.asks(SERVICE + "ReadMessages", "POST", EMPTY_REQUEST, **own).status == 403, cookie
        if cookie:
            assert status_of(lambda cookie=cookie: served.page(cookie=cookie)) == 403, cookie
    assert status_of(served.page) == 101  # the same with the token


def test_another_host_or_origin_is_refused_although_it_has_the_token(served: Served) -> None:
    port = served.console.port
    for host in ("evil.example", f"evil.example:{port}", f"127.0.0.1.evil.example:{port}", "", f"10.0.0.1:{port}"):
        assert served.asks("/", Host=host, Cookie=served.cookie).status == 403, host
        assert served.asks(f"/?token={served.token}", Host=host).status == 403, host
        if host:
            assert status_of(lambda host=host: served.page(host)) == 403, host
    origins = (
        None,
        "null",
        "http://evil.example",
        f"https://127.0.0.1:{port}",
        "http://127.0.0.1:1",
        "http://127.0.0.1",
    )
    for origin in (*origins, f"http://127.0.0.1:{port}.evil.example", f"http://localhost:{port}"):
        assert status_of(lambda origin=origin: served.page(origin=origin)) == 403, origin
        headers = {"Cookie": served.cookie, "Origin": origin}
        assert served.asks(SERVICE + "ReadMessages", "POST", EMPTY_REQUEST, **headers).status == 403, origin
    assert status_of(lambda: served.page("localhost:9999")) == 101  # through a tunnel with another port


def test_the_token_becomes_a_cookie_that_scripts_and_other_sites_do_not_get(served: Served) -> None:
    answer = served.asks(f"/?token={served.token}")
    assert answer.status == 200
    words = {word.strip().lower() for word in answer.headers["set-cookie"].split(";")}
    assert {"httponly", "samesite=strict", "path=/"} <= words
    page = served.asks("/", Cookie=served.cookie)
    assert "frame-ancestors 'none'" in page.headers["content-security-policy"]
    assert "default-src 'none'" in page.headers["content-security-policy"]
    assert "access-control-allow-origin" not in page.headers
    text = page.begin.decode()
    assert "http:" not in text
    assert "https:" not in text
    listening = {
        each.laddr.ip for each in psutil.Process(served.console.pid).net_connections() if each.status == "LISTEN"
    }
    assert listening == {"127.0.0.1"}
    assert served.token not in " ".join(psutil.Process(served.console.pid).cmdline())


def test_other_robots_are_shown_with_their_numbers_where_the_image_shows_them(scene: Scene) -> None:
    state = PageState(scene)
    assert state.state()["others"] == []
    places = {1: np.array([400.0, 500.0]), 2: np.array([700.0, 480.0])}
    extra: dict[str, Any] = {WALLS: RobotWalls(5, np.array([3.0, 40.0]), np.array([1.0, 0.0]), np.zeros(2))}
    for number, at in places.items():
        nothing = Track(5, number == 1, at, 0.9, 0, 8.0, np.zeros(4))
        extra |= messages_of(number, nothing, Estimate(5, at, np.zeros(2), np.eye(4), 2.0, at, seen=number == 1))
    state.take(Batch(1, [{"extra": Extra(extra)}], {}))
    first, second = state.state()["others"]
    assert [(each["number"], each["seen"], each["near"]) for each in (first, second)] == [
        (1, True, True),
        (2, False, False),
    ]
    for each, at in zip((first, second), places.values(), strict=True):
        np.testing.assert_allclose(state.chip_um(*each["at"]), at, atol=0.08 * scene.calibration.um_per_px)
    assert first["colour"] != second["colour"]


@pytest.mark.parametrize("angle_deg", [0.0, 90.0, 33.0])
@pytest.mark.parametrize("mirror", [False, True])
@pytest.mark.parametrize("found", [False, True])
def test_a_click_is_where_the_image_shows_the_chip(scene: Scene, angle_deg: float, mirror: bool, found: bool) -> None:
    calibration = replace(scene.calibration, angle_deg=angle_deg, mirror=mirror)
    state = PageState(replace(scene, calibration=calibration))
    chip_um = np.array([700.0, 500.0])
    measured_um = chip_um
    if found:  # the camera is turned by 3 degrees and shifted
        turn = np.deg2rad(3.0)
        matrix = np.array([[np.cos(turn), -np.sin(turn), 40.0], [np.sin(turn), np.cos(turn), -25.0]])
        nothing: Any = np.zeros((2, 2, 2))
        field = FlowField(0, 1, "fvm", 10.0, nothing, nothing[..., 0], None, np.zeros(2), 1.0, 998.0, "")
        state.take(Batch(1, [{"refined": replace(field, registration=matrix)}], {}))
        measured_um = np.linalg.solve(matrix[:, :2], chip_um - matrix[:, 2])
    column, row = calibration.to_px(measured_um) + 0.5
    np.testing.assert_allclose(state.chip_um(column, row), chip_um, atol=1e-6)
    drawn_um = [state.chip_um(x, y) for x, y in state.drawing()["walls"][0]]
    np.testing.assert_allclose(drawn_um, state._walls_um[0], atol=0.08 * calibration.um_per_px)  # drawn to 0.1 px


def test_a_frozen_page_costs_nothing_and_the_others_go_on(
    scene: Scene, ticks: Ticks, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(console_module, "_MAX_HZ", 500.0)
    made = list(ticks(100))  # 0.3 MB each as a picture
    with (served := Served(scene)).console, served.page() as awake, served.page():  # the other one takes 16 messages
        process = psutil.Process(served.console.pid)

        def shows(tick: Tick) -> None:
            served.console.write(tick)
            while True:
                words = awake.recv()
                if isinstance(words, str) and json.loads(words)["state"].get("time_s") == tick.stamp_ns / 1e9:
                    return

        for tick in made[:30]:
            served.console.write(tick)
            time.sleep(0.005)
        shows(made[30])
        before_bytes = process.memory_info().rss
        for tick in made[31:-1]:
            served.console.write(tick)
            time.sleep(0.005)  # so that each is a picture of its own
        shows(made[-1])
        assert process.memory_info().rss - before_bytes < 5e6  # of 14 MB, or 9 on a busy machine
        awake.send(json.dumps({"command": "mark"}))
        until(lambda: served.control.pending)
    assert served.console.dropped == 0


def test_a_ninth_page_is_told_so_and_a_closed_one_makes_room(scene: Scene) -> None:
    with (served := Served(scene)).console, ExitStack() as others:

        def enters(page: Any) -> bool:
            page.send("{}")
            return bool(page.recv())

        def one_more() -> bool:
            try:
                with served.page() as page:
                    return enters(page)
            except ConnectionClosed as closed:
                assert "open already" in str(closed)  # noqa: PT017
                return False

        with served.page() as one:
            assert enters(one)
            assert all(enters(others.enter_context(served.page())) for _ in range(MOST_PAGES - 1))
            assert not one_more()
        until(one_more)


def test_the_end_is_shown_and_the_server_ends(scene: Scene, ticks: Ticks) -> None:
    with (served := Served(scene)).console, served.page() as page:
        pid = served.console.pid
        for tick in ticks(3):
            served.console.write(tick)
        told = ("Reached after 35.1 s, doubtful", "Doubtful: axes")
        figures = {"outcome": "reached", "duration_s": 35.1, "doubts": "axes"}
        served.console.close(RunEnded.of(figures, None, "a.mcap (1 MB)"))
        words = json.loads([each for each in page if isinstance(each, str)][-1])
        ended = {"outcome": "reached", "files": "a.mcap (1 MB)", "good": True, "told": [*told], "doubtful": True}
        assert words["ended"] == ended
        assert words["state"]["time_s"] == 0.03
    until(lambda: not psutil.pid_exists(pid or 0))
    assert served.told == []
    stopped = RunEnded.of({"outcome": "stopped"}, None, "a.mcap")
    assert (stopped.good, stopped.doubtful, stopped.told) == (False, False, ("Stopped",))


@pytest.mark.parametrize("blow", [signal.SIGKILL, signal.SIGSTOP])
def test_a_console_that_is_killed_or_stopped_does_not_slow_the_run_which_says_so(
    scene: Scene, ticks: Ticks, blow: signal.Signals
) -> None:
    served = Served(scene)
    pid = served.console.pid
    assert pid is not None
    os.kill(pid, blow)
    tick = next(ticks(1))
    for i in range(3000):  # more than the queue and the pipe hold; this ends
        served.console.write(replace(tick, stamp_ns=i))
    if blow == signal.SIGKILL:
        until(lambda: served.told)
        assert len(served.told) == 1 and "killed" in served.told[0]
    served.console.close(timeout_s=0.3)
    assert served.console.dropped > 1000
    until(lambda: not psutil.pid_exists(pid))


@pytest.mark.slow("serves Rerun's viewer from a process of its own")
def test_reruns_viewer_and_its_stream_are_behind_the_same_door_and_can_only_be_read(scene: Scene, ticks: Ticks) -> None:
    with LiveView(scene, "serve") as live, (served := Served(scene, live.port)).console:
        live.write(next(ticks(1)))
        program = served.asks("/rerun/re_viewer_bg.wasm", Cookie=served.cookie)
        assert (program.status, program.begin[:4]) == (200, b"\0asm")
        assert "'wasm-unsafe-eval'" in served.asks("/rerun/", Cookie=served.cookie).headers["content-security-policy"]
        own = {"Cookie": served.cookie, "Origin": f"http://{served.host}", "Content-Type": "application/grpc-web+proto"}
        stream = served.asks(SERVICE + "ReadMessages", "POST", EMPTY_REQUEST, **own)
        assert (stream.status, len(stream.begin)) == (200, 2000)
        assert served.asks(SERVICE + "WriteMessages", "POST", EMPTY_REQUEST, **own).status == 403
        # Rerun's own server, which has no token, lets pages of this machine read it, and no others.
        elsewhere = own | {"Origin": "http://evil.example"}
        answer = asked(live.port, SERVICE + "ReadMessages", "POST", EMPTY_REQUEST, {**elsewhere})
        assert answer.headers["access-control-allow-origin"] is None


def test_keys_and_buttons_are_one_table() -> None:
    keys = [row.key for row in COMMANDS.values()]
    assert len(set(keys)) == len(keys) == 6


def test_without_its_packages_the_console_is_refused_in_a_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(console_module, "PACKAGES", ("no_such_package",))
    with pytest.raises(UsageError, match=r"pip install 'flowrec\[console\]'"):
        console_module.refuse_without_packages()


def test_the_page_counts_the_images_that_are_lost_by_each_cause(scene: Scene) -> None:
    state = PageState(scene)
    told = {"stamp_ns": 1, "losses": CameraLosses(1, 967, 950, 2, 3, 5, 7, 0, 0)}
    state.take(Batch(1, [told | {"timing": Timing(1, 1.1, 0.3, 0.5, 0.2, 4.7, 5.9, 11)}], {}))
    assert set(state.state()["losses"]) == {"11 not written", "2 link", "3 incomplete", "5 driver", "7 too late"}
