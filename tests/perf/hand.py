"""`python -m tests.perf.hand`: from a hand that lets go, in a real browser, to coils without current.

`flowrec record --console` runs on the emulated lab: a camera, and the compiled firmware behind a pseudo terminal, whose
outputs are read from its file. Chromium shows the console. The time of an ending is taken before the browser is told of
it, so the way into the browser is part of what is measured.

Keys are real events of the browser. Nothing can press a button of a gamepad in a headless Chromium, so what the page
gets from `navigator.getGamepads` is replaced, and from there on all is real; the same holds for a tab that is hidden.
"""

from __future__ import annotations

import argparse
import math
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from flowrec.core import table
from flowrec.physics import load_chip
from flowrec.rigs import EmulatedCamera, emulated_world
from flowrec.stages import assemble, load_config
from flowrec.stages.resolve import resolve
from flowrec.store import SessionReader
from flowrec.verbs import replay_session
from tests.conftest import HANG_S
from tests.short_missions import set_words
from tests.twins.coils import Device, device
from tests.twins.lab import COMMON, PATIENT

RATE = "camera.rate_hz=25.0"
MISSION = ("mission.check_axes=false", "chip.inlet_speed_um_s=5.0", "mission.wait_at_goal_s=100000")
GAMEPAD = """
window.pad = { connected: true, mapping: "standard", axes: [0, 0, 0, 0],
               buttons: Array.from({ length: 17 }, () => ({ pressed: false })) };
navigator.getGamepads = () => [window.pad];
"""
HIDE = (
    "Object.defineProperty(document, 'hidden', { value: true }); document.dispatchEvent(new Event('visibilitychange'))"
)
_FIELD_S, _AFTER_S, _PATIENCE_S = (0.25, 0.5), 0.6, 20.0


@contextmanager
def lab(folder: Path, out: Path) -> Iterator[tuple[str, Device, subprocess.Popen[str]]]:
    """A recorder on the emulated devices: the address of its console, its coils, and its process."""
    sets = (*COMMON, RATE, *PATIENT, *MISSION)
    config = load_config(None, list(sets))
    chip = load_chip(config.chip)
    resolved = resolve(config, chip)
    camera = resolved.camera
    with (
        device("serial", folder) as on,
        EmulatedCamera(camera.width_px, camera.height_px, camera.rate_hz) as images,
        emulated_world(assemble(resolved, chip), resolved, on, images),
    ):
        sets = (*sets, "lab.camera=opencv", f'lab.device="{images.url}"', *on.sets)
        command = [sys.executable, "-m", "flowrec", "record", "--rig", "lab", "--console", "--out", str(out)]
        with subprocess.Popen(
            [*command, *set_words(sets)], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
        ) as recorder:
            assert recorder.stdout is not None
            said = list[str]()
            url = ""
            for line in recorder.stdout:
                said.append(line)
                if line.startswith("console: "):
                    url = line.split()[1]
                    break
            try:
                if not url:
                    raise RuntimeError("".join(said))
                yield url, on, recorder
            finally:
                recorder.send_signal(signal.SIGINT)
                print("".join(recorder.communicate(timeout=_PATIENCE_S)[0].splitlines(keepends=True)[-8:]))


def hold_keys(page: Any) -> None:
    """Steer by keys: they are pressed in the browser."""
    page.keyboard.down("Shift")
    page.keyboard.down(random.choice(["d", "ArrowLeft"]))


def hold_pad(page: Any) -> None:
    """Steer by the replaced gamepad."""
    page.evaluate(f"pad.axes[0] = {random.choice([-0.9, 0.9])}; pad.buttons[5].pressed = true")


def release_keys(page: Any) -> None:
    """Release the button of the keys."""
    page.keyboard.up("Shift")


def release_pad(page: Any) -> None:
    """Release the button of the replaced gamepad."""
    page.evaluate("pad.buttons[5].pressed = false")


def occupy(page: Any) -> None:
    """Let the page's program compute for a second, in which it sends nothing."""
    page.evaluate("setTimeout(() => { for (const since = Date.now(); Date.now() < since + 1000; ); }, 0)")


ENDINGS: dict[str, tuple[Callable[[Any], None], Callable[[Any], None], bool]] = {  # press, end, the page is done with
    "key released": (hold_keys, release_keys, False),
    "gamepad's button released": (hold_pad, release_pad, False),
    "page closed": (hold_keys, lambda page: page.close(), True),
    "tab hidden": (hold_keys, lambda page: page.evaluate(HIDE), True),
    "connection closed": (hold_keys, lambda page: page.evaluate("socket.close()"), True),
    "page busy": (hold_keys, occupy, True),
}


def measure(driver: Any, url: str, on: Device, trials: dict[str, int], found: dict[str, list[float | None]]) -> None:
    """Find times in ms from each ending to no current, by ending; None: the field did not end, or never came."""
    browser = driver.chromium.launch(executable_path=shutil.which("chromium"))
    context = browser.new_context(viewport={"width": 900, "height": 700})
    context.set_default_timeout(1000.0 * HANG_S)
    for name, count in trials.items():
        press, end, once = ENDINGS[name]
        page = opened(context, url)
        for _ in range(count):
            page = opened(context, url) if page is None else page
            found.setdefault(name, []).append(off_ms := trial(page, on, press, end))
            print(f"{name}: {'not measured' if off_ms is None else f'{off_ms:.1f} ms'}", flush=True)
            if once and not page.is_closed():
                page.close()
            if once:
                page = None
            else:
                for key in ("Shift", "d", "ArrowLeft"):
                    page.keyboard.up(key)
        if page is not None:
            page.close()
    browser.close()


def opened(context: Any, url: str) -> Any:
    """A page that shows the run."""
    page = context.new_page()
    page.add_init_script(GAMEPAD)
    page.goto(url)
    page.locator("#robot[cx]").wait_for()
    return page


def trial(page: Any, on: Device, press: Callable[[Any], None], end: Callable[[Any], None]) -> float | None:
    """Steer for a moment, and end it."""
    begin = on.end()
    press(page)
    until_s = time.monotonic() + _PATIENCE_S
    while not on.energised(begin):
        if time.monotonic() > until_s:
            return None
        time.sleep(0.01)
    time.sleep(random.uniform(*_FIELD_S))
    if on.off_ns(0, begin) is not None:
        return None  # ended before: the browser had no time for samples
    end_ns = time.monotonic_ns()
    end(page)
    time.sleep(_AFTER_S)
    off_ns = on.off_ns(0, begin)
    return None if off_ns is None else 1e-6 * (off_ns - end_ns)


def main() -> None:
    """Measure, and print a row for each ending."""
    from playwright.sync_api import Error, sync_playwright

    parser = argparse.ArgumentParser()
    parser.add_argument("--trials", type=int, default=20)
    parser.add_argument("--only", default="", help="endings that contain this word")
    given = parser.parse_args()
    trials = {name: given.trials for name in ENDINGS if given.only in name}
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "hand.mcap"
        found: dict[str, list[float | None]] = {}
        # A computer that is all of it, and busy, may end the run: the guardian is quicker than a hand.
        with sync_playwright() as driver, lab(Path(folder), out) as (url, on, _recorder):
            try:
                measure(driver, url, on, trials, found)
            except Error as error:
                print(error)
        rows = []
        for name, times in found.items():
            ms = np.array([each for each in times if each is not None])
            figures = [f"{figure(ms):.1f}" if len(ms) else "-" for figure in (np.median, np.max)]
            rows.append([name, f"{len(ms)} of {len(times)}", *figures])
        table("From a hand that lets go to no current", ["ending", "measured", "median, ms", "worst, ms"], rows)
        ticks = list(SessionReader(out).ticks(with_frames=False))
        ages = [1e3 * tick.hand.age_s for tick in ticks if tick.hand is not None and tick.hand.held]
        print(
            f"age of the samples as used: median {np.median(ages):.1f} ms, worst {max(ages, default=math.nan):.1f} ms"
        )
        print(f"replay: {'identical' if replay_session(out, verify=True).identical else 'DIFFERS'}")


if __name__ == "__main__":
    main()
