"""What a page asks of a run: events, numbers, a hand; each is taken by the run, or refused with the reason."""

from __future__ import annotations

import asyncio
import itertools
import json
import time
from typing import Any

import numpy as np
import pytest

from flowrec.console.app import application
from flowrec.console.board import NOTHING, Board
from flowrec.console.console import CommandReply
from flowrec.core import Action, Event
from flowrec.run import RunControl
from flowrec.view import Batch, Scene
from tests.conftest import until
from tests.console.served import Served, answers_to, events_of


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
        for name in ("mark", "note", "hold", "end"):
            assert answer(command=name, text="look\x1b[31m") == ""
        assert answer(command="goal", x_px=10.0, y_px=20.0) == ""
        assert answer(command="speed", limit_um_s=120) == ""
        until(lambda: len(served.control._waiting) >= 4 and all(map(len, served.control._steering.values())))
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


@pytest.mark.slow("steers a run on a page of a browser")
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
