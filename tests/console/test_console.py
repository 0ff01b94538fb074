"""The server of the console: who may ask, what reaches the run, and what frozen pages cost."""

from __future__ import annotations

import asyncio
import http.client
import importlib
import itertools
import json
import os
import signal
import socket
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import psutil
import pytest

from flowrec.console import console as console_module
from flowrec.console.app import application
from flowrec.console.board import MOST_PAGES, NOTHING, Board
from flowrec.console.console import CommandReply, RunEnded
from flowrec.console.page_state import PageState
from flowrec.core.enums import Action
from flowrec.core.errors import UsageError
from flowrec.core.messages import WALLS, Estimate, Event, FlowField, OperatorEvent, RobotWalls, Track
from flowrec.core.topics import Extra, Tick
from flowrec.run.control import RunControl
from flowrec.run.operator_commands import COMMANDS, obey
from flowrec.stages.robot_topics import messages_of
from flowrec.view.feed import Batch
from flowrec.view.live import LiveView
from flowrec.view.scene import Scene
from tests.conftest import HANG_S, until

sync_client = importlib.import_module("websockets.sync.client")
ConnectionClosed, InvalidStatus = (
    getattr(importlib.import_module("websockets.exceptions"), name) for name in ("ConnectionClosed", "InvalidStatus")
)

SERVICE = "/rerun.sdk_comms.v1alpha1.MessageProxyService/"
EMPTY_REQUEST = bytes(5)  # a gRPC message of no bytes
Ticks = Callable[[int], Iterator[Tick]]


class Answer(NamedTuple):
    status: int
    headers: Any
    begin: bytes


def asked(port: int, path: str, method: str, body: bytes | None, headers: dict[str, str | None]) -> Answer:
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=HANG_S)
    try:
        connection.request(method, path, body, {name: value for name, value in headers.items() if value is not None})
        answer = connection.getresponse()
        return Answer(answer.status, answer.headers, answer.read(2000))
    finally:
        connection.close()


class Served:
    """A console, its run's control, and what it has told the operator."""

    def __init__(
        self, scene: Scene, rerun_port: int | None = None, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self.control, self.told = RunControl(clock), list[str]()
        self.console = console_module.Console(
            partial(obey, self.control), scene, "a.mcap", rerun_port, dict, self.told.append
        )
        self.host = f"127.0.0.1:{self.console.port}"
        self.token = self.console.url.partition("=")[2]
        self.cookie = f"flowrec_console_{self.console.port}={self.token}"

    def asks(self, path: str, method: str = "GET", body: bytes | None = None, **headers: str | None) -> Answer:
        """The answer, and the first bytes of it; a header that is None is left out."""
        given = {"Host": self.host, **headers}
        return asked(self.console.port, path, method, body, given)

    def page(self, host: str = "", origin: str | None = "", cookie: str = "") -> Any:
        """The connection of a page."""
        origin = f"http://{host or self.host}" if origin == "" else origin
        return sync_client.connect(
            f"ws://{host or self.host}/live",
            sock=None if not host else _socket(self.console.port),
            origin=origin,
            additional_headers={"Cookie": cookie or self.cookie},
            compression=None,
            proxy=None,
        )


def _socket(port: int) -> Any:
    return socket.create_connection(("127.0.0.1", port))


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


def events_of(control: RunControl) -> Iterator[OperatorEvent]:
    """What the run would record, tick by tick."""
    stamp_ns = 0
    while True:
        stamp_ns += 10**9
        event = control.next_event(stamp_ns, held=False)
        if event is None:
            return
        yield event


def answers_to(page: Any) -> Iterator[dict[str, Any]]:
    """The answers that a page receives, without all else."""
    while True:
        words = json.loads(page.recv())
        if "answers" in words:
            yield words


def test_what_a_page_asks_becomes_an_event_and_nonsense_is_refused(scene: Scene) -> None:
    with (served := Served(scene)).console, served.page() as page:

        def answer(**asked: Any) -> str:
            page.send(json.dumps({"number": 7, **asked}))
            words = next(answers_to(page))
            assert words["answers"] == 7
            return str(words["refusal"])

        for words in ({"command": "jump"}, {"command": "goal", "x_px": "NaN", "y_px": 1}, {"command": "goal"}, {}):
            assert answer(**words), words
        page.send("[]")
        assert json.loads(page.recv())["refusal"]
        time.sleep(1.1)  # refused ones count, too
        for name in ("mark", "note", "hold", "end"):
            assert answer(command=name, text="look\x1b[31m") == ""
        assert answer(command="goal", x_px=10.0, y_px=20.0) == ""
        assert answer(command="speed", limit_um_s=120) == ""
        told: list[str] = []
        for _ in range(10):  # on a busy machine a dozen may take more than the second in which they are counted
            for _ in range(12):
                page.send(json.dumps({"number": 7, "command": "mark"}))
            told += [words["refusal"] for words in itertools.islice(answers_to(page), 12)]
            if any("too many at once" in refusal for refusal in told):
                break
        assert any("too many at once" in refusal for refusal in told)
        until(lambda: len(served.control._waiting) >= 5 and all(map(len, served.control._steering.values())))
        # The stop is never one too many, and it is before all that waits.
        assert answer(command="zero") == ""
        until(lambda: served.control.reason)
        events = list(events_of(served.control))
    assert [event.action for event in events[:5]] == ["zero", "mark", "note", "pause", "end"]
    assert events[0].text == "operator: zero field (console)"
    assert events[1].text == "1"
    assert all("console" in event.text for event in (events[0], events[4]))


def test_pages_that_flood_the_run_are_refused_after_ten_commands_in_a_second(
    scene: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The clock stands still; the page is an ASGI client in this process."""
    monkeypatch.setattr(time, "monotonic", lambda: 5.0)
    given, answers = list[dict[str, Any]](), list[str]()
    headers = [("host", "localhost:1"), ("origin", "http://localhost:1"), ("cookie", "flowrec_console_1=secret")]
    scope = {
        "type": "websocket",
        "path": "/live",
        "query_string": b"",
        "subprotocols": [],
        "headers": [(name.encode(), value.encode()) for name, value in headers],
    }
    marks = ({"type": "websocket.receive", "text": json.dumps({"number": 1, "command": "mark"})} for _ in range(40))
    messages = itertools.chain([{"type": "websocket.connect"}], marks, [{"type": "websocket.disconnect", "code": 1000}])

    async def receive() -> Any:
        for _ in range(5):  # turns of the loop, in which what came before is answered
            await asyncio.sleep(0)
        return next(messages)

    async def send(message: Any) -> None:
        if "refusal" in (words := json.loads(message.get("text", "{}"))):
            answers.append(words["refusal"])

    board = Board(scene, "a.mcap")

    def take(words: dict[str, Any]) -> None:
        given.append(words)
        board.settle(CommandReply(words["ticket"], ""))

    async def page() -> None:
        board.loop = asyncio.get_running_loop()
        await application(board, "secret", 1, None, take)(scope, receive, send)

    asyncio.run(page())
    assert len(given) == 10 and len(answers) == 40 and all("too many" in text for text in answers[10:])


def test_an_event_is_sent_to_a_page_once(scene: Scene) -> None:
    async def seen() -> list[list[str]]:
        board, shown, told = Board(scene, "a.mcap"), NOTHING, []
        for text in ("first", None, "second", None):
            changes = {} if text is None else {"event": Event(1, "info", text)}
            board.take(Batch(1, [changes], {}))
            shown, words, _ = await board.news(shown)
            told.append([event["text"] for event in json.loads(words)["events"]])
        return told

    assert asyncio.run(seen()) == [["first"], [], ["second"], []]


def test_a_goal_and_a_limit_reach_the_run_as_numbers(scene: Scene) -> None:
    with (served := Served(scene)).console, served.page() as page:
        for asked in ({"command": "goal", "x_px": 100.5, "y_px": 60.5}, {"command": "speed", "limit_um_s": 120}):
            page.send(json.dumps(asked))
        until(lambda: all(map(len, served.control._steering.values())))
        goal, limit = events_of(served.control)
    np.testing.assert_allclose(goal.goal_um, scene.calibration.to_um((100.0, 60.0)))
    assert limit.speed_limit_um_s == 120.0


def sample(**more: Any) -> str:
    """A sample of a hand, as a page sends it: at 60 % to the right of the image."""
    words = {"command": "hand", "number": "hand", "held": True, "x": 0.6, "y": 0.0, "by": "gamepad", "press": 1}
    return json.dumps({**words, **more})


def why_ended(control: RunControl) -> str:
    """Wait for the end of steering: what the run records of it."""
    taken: list[Any] = []

    def ended() -> bool:
        taken.append(control.hand.message(1))
        return taken[-1] is not None and not taken[-1].held

    until(ended)
    return str(taken[-1].why)


def test_a_hand_steers_where_the_image_shows_and_lets_go_when_its_page_is_closed(scene: Scene) -> None:
    with (served := Served(scene, clock=lambda: 0.0)).console:  # no sample is late, however busy the machine is
        hand = served.control.hand
        with served.page() as page:
            for _ in range(30):  # more than there may be other commands
                page.send(sample())
                time.sleep(0.01)
            steering = hand.message(1)
            assert steering is not None and steering.held
            across = scene.calibration.to_um((1.0, 0.0)) - scene.calibration.to_um((0.0, 0.0))
            np.testing.assert_allclose(steering.share, 0.6 * across / np.linalg.norm(across), atol=1e-9)
            with served.page() as other:
                other.send(sample())
                page.send(sample())
                assert next(answers_to(other))["refusal"] == "another page steers by hand"
            page.send(sample())
        assert why_ended(served.control) == "the page was closed"
        assert not any("another page" in line for line in served.told), "50 times a second"


@pytest.mark.parametrize(
    ("sent", "why"),
    [
        (sample(held=False, why="the button was released (keys)"), "the button was released (keys)"),
        (sample(x=float("nan")), "a sample that is no number"),
        (sample(x=3.0), "a sample with impossible numbers"),
        ("", "no sample for 0.15 s"),
    ],
)
def test_steering_ends_by_release_by_nonsense_and_by_silence(scene: Scene, sent: str, why: str) -> None:
    served = Served(scene, clock=(lambda: 0.0) if sent else time.monotonic)
    hand = served.control.hand
    with served.console, served.page() as page, hand.connection(lambda: None, lambda: None):
        page.send(sample())
        until(lambda: hand.check() is not None)
        if sent:
            time.sleep(0.01)
            page.send(sent)
        assert why_ended(served.control) == why
        time.sleep(0.01)  # a sample that follows the one before at once is passed over
        page.send(sample())
        refused = [words["refusal"] for words in itertools.islice(answers_to(page), 3 if sent else 2)]
        assert any("let go of the button" in refusal for refusal in refused), refused


REFUSED = {
    "a negative speed": ({"command": "speed", "limit_um_s": -5}, "speed limit -5 um/s"),
    "a speed of no robot": ({"command": "speed", "limit_um_s": 1e300}, "speed limit 1e+300 um/s"),
    "a goal off every chip": ({"command": "goal", "x_px": 1e308, "y_px": 0}, "goal "),
    "a goal that is no number": ({"command": "goal", "x_px": float("nan"), "y_px": 0}, "not a number"),
    "a speed without end": ({"command": "speed", "limit_um_s": float("inf")}, "not a number"),
    "a note without text": ({"command": "note", "text": "  "}, "a note without a text"),
}


def test_the_page_is_told_accepted_only_by_the_run_and_otherwise_why_not(scene: Scene) -> None:
    with (served := Served(scene)).console, served.page() as page:

        def refusal(**asked: Any) -> str:
            page.send(json.dumps(asked))
            while "answers" not in (words := json.loads(page.recv())):
                pass
            return str(words["refusal"])

        for what, (asked, why) in REFUSED.items():
            assert why in refusal(**asked), what
        assert not any(map(len, served.control._steering.values()))
        assert refusal(command="speed", limit_um_s=5) == ""
        assert len(served.control._steering[Action.SPEED]) == 1  # the run has it by the time that the page is told
        while served.control.request("mark"):  # keys and scripts ask, too
            pass
        assert "too many" in refusal(command="mark")
        assert refusal(command="stop") == ""
        assert "the run ends: stopped by the operator" in refusal(command="goal", x_px=10.0, y_px=20.0)


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
        assert served.told == ["the console ended (it was killed); the run goes on without"]
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
