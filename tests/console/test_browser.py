"""The console in Chromium: a run is steered by clicks, its recording replays the same, and other pages get nothing."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import tty
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from flowrec.core import OperatorEvent
from flowrec.physics import load_chip
from flowrec.stages import calibration_of, load_config
from flowrec.stages.resolve import resolve
from flowrec.store import Session, SessionReader
from flowrec.verbs import session_replay as again
from tests.conftest import HANG_S
from tests.extras import why
from tests.short_missions import LONG, set_words

pytest.importorskip("playwright", reason=why("playwright"))
CHROMIUM = next(
    (found for name in ("chromium", "chromium-browser", "google-chrome") if (found := shutil.which(name))), ""
)
pytestmark = [
    pytest.mark.skipif(not CHROMIUM, reason="needs chromium"),
    pytest.mark.slow("clicks in a real browser, beside a run in real time"),
]

# The camera is turned and mirrored, so that a click is nowhere where it would be without its calibration.
CAMERA = ["camera.angle_deg=90", "camera.mirror=true", "camera.width_px=256", "camera.height_px=320"]
GOAL_UM = np.array([3140.0, 1220.0])  # in the upper channel
HANG_MS = 1000.0 * HANG_S


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    from playwright.sync_api import sync_playwright

    with sync_playwright() as driver:
        opened = driver.chromium.launch(executable_path=CHROMIUM)
        yield opened
        opened.close()


@contextmanager
def recorded(out: Path, *sets: str) -> Iterator[subprocess.Popen[str]]:
    """A run in real time with a console, while it lasts."""
    words = set_words(sets)
    command = [sys.executable, "-m", "flowrec", "record", "--realtime", "--console", "--out", str(out)]
    with subprocess.Popen([*command, *words], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True) as process:
        try:
            yield process
        finally:  # Popen waits for it, also where the test has failed
            process.kill()


@pytest.fixture
def lamp() -> Iterator[tuple[int, str]]:
    """A pseudo terminal in the place of a lamp's serial port: the end of the lamp, and the name of the port."""
    lamp, port = os.openpty()
    tty.setraw(port)
    yield lamp, os.ttyname(port)
    os.close(lamp)
    os.close(port)


@pytest.fixture
def run(tmp_path: Path, lamp: tuple[int, str]) -> Iterator[subprocess.Popen[str]]:
    device = f'{{port = "{lamp[1]}", lines = ["L {{:.1f}}"], values = [0.2], rest = [0.0], most = [1.0]}}'
    light = ["streams.lamp.kind=serial", 'streams.lamp.channels=["light"]', f"streams.lamp.device={device}"]
    with recorded(tmp_path / "a.mcap", *LONG, *CAMERA, *light) as process:
        yield process


def test_a_run_is_steered_by_clicks_and_its_recording_replays_the_same(
    run: subprocess.Popen[str], tmp_path: Path, browser: Any, lamp: tuple[int, str]
) -> None:
    out = tmp_path / "a.mcap"
    assert run.stdout is not None
    said = next(line for line in run.stdout if line.startswith("console: "))
    url = said.split()[1]
    address, _, token = url.partition("?token=")
    context = browser.new_context(viewport={"width": 1280, "height": 800})
    context.set_default_timeout(HANG_MS)
    page = context.new_page()
    faults: list[str] = []
    page.on("pageerror", lambda error: faults.append(str(error)))
    page.on("console", lambda line: faults.append(line.text) if line.type == "error" else None)
    page.goto(url)
    page.wait_for_url(address)  # the token has left the address bar
    page.locator("#robot[cx]").wait_for()
    page.locator("#events li").first.wait_for()
    assert token not in page.evaluate("document.cookie + document.documentElement.outerHTML")

    closed, frozen = context.new_page(), context.new_page()
    for other in (closed, frozen):
        other.goto(address)
        other.locator("#robot[cx]").wait_for()
    closed.close()
    context.new_cdp_session(frozen).send("Page.setWebLifecycleState", {"state": "frozen"})

    # A page of another program of this machine has the cookie, but not the origin.
    strange = context.new_page()
    strange.route(
        "http://127.0.0.1:1/", lambda route: route.fulfill(body="<title>strange</title>", content_type="text/html")
    )
    strange.goto("http://127.0.0.1:1/")
    tried = strange.evaluate(
        """(address) => new Promise((done) => {
            const socket = new WebSocket(address.replace("http", "ws") + "live");
            socket.onopen = () => done("open");
            socket.onerror = () => done("refused");
        })""",
        address,
    )
    assert tried == "refused"
    strange.close()

    def event(words: str) -> Any:
        return page.locator("#events li", has_text=words).first

    for width, height in ((1280, 800), (820, 1180), (390, 844)):
        page.set_viewport_size({"width": width, "height": height})
        box = page.locator("#stop").bounding_box()
        assert box["y"] >= 0.0
        assert box["y"] + box["height"] <= height  # without scrolling
        assert page.evaluate("document.documentElement.scrollWidth") <= width
    page.set_viewport_size({"width": 1280, "height": 800})
    page.keyboard.press("m")
    event("mark: 1").wait_for()
    page.get_by_role("button", name="mark (key m)").click()
    event("mark: 2").wait_for()
    page.keyboard.press("Space")  # although the last click was on another button
    event("held by the operator").wait_for()
    page.get_by_role("button", name="hold, go on").click()
    event("goes on after").wait_for()
    page.keyboard.press("n")
    page.get_by_role("textbox", name="Note").fill("m q ! look")  # the keys are letters here
    page.keyboard.press("Enter")
    event("note: m q ! look").wait_for()
    page.get_by_role("spinbutton", name="Speed limit").fill("90")
    page.locator("#speed").get_by_role("button", name="Set", exact=True).click()
    page.locator("#limit", has_text="90 µm/s").wait_for()
    page.get_by_role("combobox", name="Name of the output").select_option("lamp/light")
    page.get_by_role("spinbutton", name="Output").fill("0.7")
    page.locator("#output").get_by_role("button", name="Set", exact=True).click()
    event("note: lamp/light set to 0.7").wait_for()
    asked_for = load_config(None, [*LONG, *CAMERA])
    chip = load_chip(asked_for.chip)
    column, row = calibration_of(resolve(asked_for, chip), chip).to_px(GOAL_UM) + 0.5
    scale = page.locator("#drawing").bounding_box()["width"] / 256.0
    page.locator("#drawing").click(position={"x": column * scale, "y": row * scale})
    event("goal set to").wait_for()
    page.get_by_role("button", name=re.compile("^STOP")).click()
    page.locator("#alert", has_text=str(out)).wait_for()
    assert not page.locator("#alert").get_attribute("class"), "red, as in all pictures: it was not completed"
    assert re.match(r"Stopped after \d+\.\d s\.", page.locator("#alert").inner_text())
    assert page.get_by_role("button", name=re.compile("^STOP")).is_disabled()
    text, _ = run.communicate(timeout=HANG_S)
    assert run.returncode == 0, text
    assert faults == []
    context.close()

    ticks = list(SessionReader(out).ticks(with_frames=False))
    asked: list[OperatorEvent] = []
    for before, tick in pairwise(ticks):
        if tick.operator is None or tick.operator is before.operator:
            continue
        asked.append(tick.operator)
        if tick.operator.action == "zero":  # on that very tick
            assert before.currents.amplitude_mt > 0.0  # type: ignore[union-attr]
            assert tick.currents.amplitude_mt == 0.0  # type: ignore[union-attr]
    assert [each.action for each in asked] == [
        *("mark", "mark", "pause", "resume", "note", "speed", "note", "goal", "zero")
    ]
    speed, _, goal, stop = asked[-4:]
    assert os.read(lamp[0], 100).split(b"\n")[:-1] == [b"L 0.2", b"L 0.7", b"L 0.0"]
    with Session(out) as session:
        light = session.stream("lamp/light").value
    assert light[0] == 0.2 and light[-1] == 0.7 and set(light.tolist()) == {0.2, 0.7}
    assert (speed.speed_limit_um_s, stop.text) == (90.0, "operator: zero field (console)")
    np.testing.assert_allclose(goal.goal_um, GOAL_UM, atol=Session(out).calibration.um_per_px)
    done = again.replay_session(out, again.Change(), verify=True)
    assert done.comparison.identical, str(done.comparison.first)


# Nothing can press a button of a gamepad in a headless browser: what the page gets from the API is replaced.
GAMEPAD = """
window.pad = { connected: true, mapping: "standard", axes: [0, 0], buttons: Array(17).fill({ pressed: false }) };
navigator.getGamepads = () => [null, window.pad];
"""
HELD = "pad.axes = [0, -0.56]; pad.buttons[5] = { pressed: true }"


def test_a_robot_is_steered_by_keys_and_gamepad_of_one_page_and_the_recording_replays_the_same(
    tmp_path: Path, browser: Any
) -> None:
    out = tmp_path / "hand.mcap"
    goal = ("mission.phases=navigate", "mission.wait_at_goal_s=1000", "mission.goal=[3140.0,1220.0]")
    context = browser.new_context(viewport={"width": 1280, "height": 800})
    context.set_default_timeout(HANG_MS)
    with recorded(out, *LONG[:-2], *CAMERA, *goal, "safety.guard_timeout_s=20") as process:
        assert process.stdout is not None
        url = next(line for line in process.stdout if line.startswith("console: ")).split()[1]

        def opened() -> Any:
            page = context.new_page()
            page.add_init_script(GAMEPAD)
            page.goto(url)
            page.locator("#robot[cx]").wait_for()
            return page

        def event(words: str, count: int = 1) -> None:
            page.locator("#events li", has_text=words).nth(count - 1).wait_for()

        page, second = opened(), opened()
        event("mission: navigate")
        page.keyboard.press("d")  # without the dead-man's button
        page.keyboard.down("Shift")
        page.keyboard.down("d")
        event("steered by hand (keys)")
        second.evaluate(HELD)
        second.locator("#alert", has_text="another page steers by hand").wait_for()
        second.evaluate("pad.buttons[5] = { pressed: false }")
        page.keyboard.up("Shift")
        event("the hand has let go")
        page.locator("#field", has_text="off").wait_for()
        page.evaluate(HELD)
        event("steered by hand (gamepad)")
        page.evaluate("pad.buttons[5] = { pressed: false }")
        event("the hand has let go", 2)
        page.keyboard.press("Space")
        event("goes on after")
        page.evaluate(HELD)
        event("steered by hand (gamepad)", 2)
        page.evaluate("socket.close()")
        page.locator("#state", has_text="no connection").wait_for()
        event("the hand has let go", 3)  # and the page, which is connected again, does not steer: the button is held
        page.wait_for_timeout(300.0)
        assert "on" not in (page.locator("#hand").get_attribute("class") or "")
        page.evaluate("pad.buttons[5] = { pressed: false }")
        page.wait_for_timeout(100.0)
        page.evaluate(HELD)
        event("steered by hand (gamepad)", 3)
        page.close()
        page = second
        event("the hand has let go (the page was closed)")
        page.locator("#stop").click()
        text, _ = process.communicate(timeout=HANG_S)
        assert process.returncode == 0, text
    context.close()
    ticks = list(SessionReader(out).ticks(with_frames=False))
    hands = [tick.hand for last, tick in pairwise(ticks) if tick.hand is not None and tick.hand is not last.hand]
    for tick in ticks:
        held = tick.hand is not None and tick.hand.held and tick.hand.stamp_ns == tick.stamp_ns
        assert tick.mission is not None and tick.currents is not None
        assert held or not tick.mission.by_hand or tick.currents.amplitude_mt == 0.0
    shares = {each.by: each.share for each in hands if each.held and each.share.any()}
    # To the right of the image, and by a half upwards: the camera is turned by 90 degrees and mirrored.
    camera = Session(out).calibration
    for by, way in (("keys", (1.0, 0.0)), ("gamepad", (0.0, -0.5))):
        across = camera.to_um(np.array(way)) - camera.to_um(np.zeros(2))
        share = np.hypot(*way) * across / np.linalg.norm(across)
        np.testing.assert_allclose(shares[by], share, atol=1e-6)
    assert again.replay_session(out, again.Change(), verify=True).comparison.identical
