"""`python -m tests.perf.cameras`: cameras at length, against twins that nobody here wrote.

Every row states what became of the blocks that the device has numbered, whether frames and losses add up to the ids,
and whether the library's own counters say the same. The first two rows last `--seconds`, the others a quarter of it. A
camera is then killed and frozen again and again: how long until that is recognised, and until frames come again after
it is back. The times depend on what else the machine does, so the load is stated. Arrivals: 99th percentile and maximum
of the intervals. Slope: time of the host per time of the camera's clock.
"""

from __future__ import annotations

import os
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import mm_test_adapters
import numpy as np
import typer

from flowrec.bench.harness import Results, print_rows, run
from flowrec.core import NS_PER_S, envelope
from flowrec.rigs import Grabbed, Wanted
from flowrec.rigs.lab.cameras.camera import Camera
from flowrec.rigs.lab.cameras.genicam import GenicamCamera
from flowrec.rigs.lab.cameras.grabber import Captured, Grabber
from flowrec.rigs.lab.cameras.mmcore import MmcoreCamera
from flowrec.rigs.lab.cameras.pylon import PylonCamera
from flowrec.store import Session
from tests.perf.camera_killed import trial
from tests.perf.guardian import busy
from tests.rigs.lab.cameras.watching import adds_up
from tests.twins.emulator import emulated, showing
from tests.twins.gige import Aravis, port

WANTED = Wanted(width_px=512, height_px=512, rate_hz=60.0, exposure_s=0.004)


class WatchedGenicam(GenicamCamera):
    """Keeps what the library counts."""

    counters: Any = None

    def grab(self, timeout_s: float) -> Grabbed | None:
        grabbed = super().grab(timeout_s)
        assert self._stream is not None
        self.counters = self._stream.stats()
        return grabbed


def taken(grabber: Grabber, duration_s: float, pause_s: float = 0.0) -> list[Captured]:
    """The frames of some seconds, without their images; a consumer that needs `pause_s` for each."""
    frames: list[Captured] = []
    end_s = time.monotonic() + duration_s
    while time.monotonic() < end_s:
        frame = grabber.next(0.2)
        if frame is not None:
            frames.append(replace(frame, image=frame.image[:1, :1].copy()))
            time.sleep(pause_s)
    return frames


def figures(grabber: Grabber, frames: list[Captured], agree: str = "") -> Results:
    """One row."""
    losses, last = grabber.losses, frames[-1]
    assert losses is not None
    intervals_ms = np.diff([frame.arrival_ns for frame in frames]) / 1e6
    points = tuple((frame.clock.device, frame.clock.arrival_ns) for frame in frames if frame.clock is not None)
    ticks_per_s = grabber.info.ticks_per_s
    return {
        "ids": losses.ids,
        "frames": losses.frames,
        "link": losses.link,
        "incomplete": losses.incomplete,
        "driver": losses.driver,
        "backlog": losses.backlog,
        "adds_up": adds_up(losses) and all(adds_up(frame.losses) for frame in frames),
        "library": agree,
        "hz": (last.index - frames[0].index) / ((last.stamp_ns - frames[0].stamp_ns) / NS_PER_S),
        "arrival_p99_ms": float(np.percentile(intervals_ms, 99)),
        "arrival_max_ms": float(intervals_ms.max()),
        "slope": envelope(points)[1] * ticks_per_s / NS_PER_S if len(points) > 1 and ticks_per_s else 0.0,
    }


def aravis(
    duration_s: float, lost_packets: int = 0, pause_s: float = 0.0, burning: int = 0, wanted: Wanted = WANTED
) -> Results:
    """The fake of Aravis; at the end it is frozen, so that the library's counters can be compared with the ids."""
    made: list[WatchedGenicam] = []

    def make() -> Camera:
        made.append(WatchedGenicam(wanted))
        return made[-1]

    with port(), Aravis(lost_packets) as camera, busy(burning), Grabber(make, wanted) as grabber:
        frames = taken(grabber, duration_s, pause_s)
        camera.freeze()
        frames += taken(grabber, 0.5)
        counters, losses = made[0].counters, grabber.losses
        camera.thaw()
        assert losses is not None
        # After the last frame that was handed on there may be blocks that were lost.
        after = counters.frames_incomplete - losses.incomplete
        same = (
            counters.frames_complete == losses.frames + losses.backlog
            and counters.frames_backpressure + counters.frames_missed - losses.driver - losses.link in (0, after)
            and 0 <= after < 10
        )
        return figures(grabber, frames, "same" if same else f"differs: {counters}")


def two_aravis(duration_s: float) -> Results:
    """Two cameras at once, at two addresses of the loopback; the row is that of both together, at the worse of two."""
    rows: list[Results] = []
    with port(), ExitStack() as stack:
        for number in (1, 2):
            stack.enter_context(Aravis(10, f"C{number}", f"127.0.0.{number}"))
        each = [replace(WANTED, device=f"C{number}") for number in (1, 2)]
        grabbers = [stack.enter_context(Grabber(lambda one=one: GenicamCamera.of(one), one)) for one in each]  # type: ignore[misc]

        def one(grabber: Grabber) -> None:
            rows.append(figures(grabber, taken(grabber, duration_s)))

        threads = [threading.Thread(target=one, args=(grabber,)) for grabber in grabbers]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
    sums = ("ids", "frames", "link", "incomplete", "driver", "backlog")
    return (
        rows[0]
        | {key: rows[0][key] + rows[1][key] for key in sums}
        | {"adds_up": rows[0]["adds_up"] and rows[1]["adds_up"], "hz": min(row["hz"] for row in rows)}
    )


def pylon_emulator(duration_s: float) -> Results:
    """Images bit for bit as they are shown, and some bad buffers a second."""
    rng = np.random.default_rng(1)
    shown = [rng.integers(0, 256, (512, 640)).astype(np.uint8) for _ in range(16)]
    made: list[PylonCamera] = []
    with emulated(), tempfile.TemporaryDirectory() as folder:
        wanted = replace(WANTED, width_px=640, config=str(showing(Path(folder), shown)))

        def make() -> Camera:
            made.append(PylonCamera.of(wanted))
            return made[-1]

        with Grabber(make, wanted) as grabber:
            frames: list[Captured] = []
            forced = equal = 0
            end_s = time.monotonic() + duration_s
            while time.monotonic() < end_s:
                frame = grabber.next(0.5)
                if frame is None:
                    continue
                equal += any(np.array_equal(frame.image, image) for image in shown)
                frames.append(replace(frame, image=frame.image[:1, :1].copy()))
                if len(frames) % 50 == 25:
                    made[0].device.ForceFailedBufferCount.Value = 3
                    made[0].device.ForceFailedBuffer.Execute()
                    forced += 3
            assert grabber.losses is not None
            same = equal == len(frames) and 0 <= forced - grabber.losses.incomplete <= 3
            return figures(
                grabber, frames, f"{equal} of {len(frames)} bit-equal" if same else f"{forced} forced, {equal} equal"
            )


def micro_manager(duration_s: float) -> Results:
    """The demonstration camera, 12 bits."""
    os.environ["MICROMANAGER_PATH"] = str(mm_test_adapters.device_adapter_path())
    wanted = replace(WANTED, config="DemoCamera:DCam", pixel_format="Mono12", exposure_s=0.016)
    with Grabber(lambda: MmcoreCamera.of(wanted), wanted) as grabber:
        return figures(grabber, taken(grabber, duration_s))


def unplugged(trials: int, *, kill: bool) -> Results:
    """Time in s until a camera is recognised as absent, and from its return to the next frame."""
    seen, back = [], []
    with port(), Aravis() as camera, Grabber(lambda: GenicamCamera.of(WANTED), WANTED) as grabber:
        for _ in range(trials):
            taken(grabber, 1.0)
            (camera.unplug if kill else camera.freeze)()
            at_s = time.monotonic()
            while not grabber.absent:
                grabber.next(0.005)
            seen.append(time.monotonic() - at_s)
            taken(grabber, 1.5)
            at_s = time.monotonic()
            (camera.plug_in if kill else camera.thaw)()
            while grabber.next(0.005) is None:
                pass
            back.append(time.monotonic() - at_s)
        losses = grabber.losses
    assert losses is not None and adds_up(losses) and losses.reconnections == trials
    return {"trials": trials, "recognised_s": [min(seen), max(seen)], "resumed_s": [min(back), max(back)]}


def killed_in_a_mission() -> Results:
    """A mission of `flowrec record --rig lab` whose camera is killed while the coils are on: see camera_killed.py."""
    with tempfile.TemporaryDirectory() as folder:
        killed = trial(Path(folder))
        with Session(killed.session) as session:
            outcome = session.outcome["outcome"]
        row = {"off_s": killed.off_s, "back_s": killed.back_s, "status": killed.status, "outcome": outcome}
        sys.stderr.write(f"{row}\n")
        return row


def measure(
    seconds: Annotated[float, typer.Option(min=2.0, help="Length of the two long rows.")] = 60.0,
    trials: Annotated[int, typer.Option(min=1, help="How often the camera is killed, and how often frozen.")] = 10,
    recorded: Annotated[int, typer.Option(help="Only missions of flowrec record, so many, with a killed camera.")] = 0,
) -> Results:
    """Run all rows."""
    short_s = seconds / 4.0
    load = os.getloadavg()[0]
    if recorded:
        return {"recorded": [killed_in_a_mission() for _ in range(recorded)], "load": [load, os.getloadavg()[0]]}
    campaigns: dict[str, Callable[[], Results]] = {
        "Aravis": lambda: aravis(seconds),
        "Aravis, 5 % of packets lost": lambda: aravis(seconds, 50),
        "Aravis, 16 bits": lambda: aravis(short_s, wanted=replace(WANTED, pixel_format="Mono16")),
        "Aravis, 2 busy processes": lambda: aravis(short_s, burning=2),
        "Aravis, loop at 40 Hz": lambda: aravis(short_s, 10, pause_s=0.025),
        "Aravis, two cameras": lambda: two_aravis(short_s),
        "pylon emulator, bad buffers": lambda: pylon_emulator(short_s),
        "Micro-Manager, 12 bits": lambda: micro_manager(short_s),
    }
    rows = {}
    for name, campaign in campaigns.items():
        try:
            rows[name] = campaign()
        except AssertionError as error:  # a second address of the loopback needs root: ip addr add 127.0.0.2/8 dev lo
            sys.stderr.write(f"{name}: left out: {error}\n")
    return {
        "rows": rows,
        "killed": unplugged(trials, kill=True),
        "frozen": unplugged(max(trials // 2, 1), kill=False),
        "load": [load, os.getloadavg()[0]],
        "fault_count": sum(not row["adds_up"] or row["library"].startswith("differs") for row in rows.values()),
    }


def show(results: Results) -> None:
    """Print the tables."""
    load = "load {:.1f} to {:.1f} on {} cores".format(*results["load"], os.cpu_count())
    if "recorded" in results:
        print_rows(
            f"A camera killed in a mission with its coils on ({load})",
            results["recorded"],
            {
                "field off s after it": "{off_s:.2f}",
                "field on s after the camera's start": "{back_s:.2f}",
                "outcome": "{outcome}",
            },
        )
        return
    print_rows(
        f"What became of the blocks ({load})",
        [{"name": name, **row} for name, row in results["rows"].items()],
        {
            "": "{name}",
            "ids": "{ids}",
            "frames": "{frames}",
            "link, incomplete, driver, queue": "{link}, {incomplete}, {driver}, {backlog}",
            "adds up": "{adds_up}",
            "library": "{library}",
            "Hz": "{hz:.1f}",
            "arrival ms": "{arrival_p99_ms:.0f} {arrival_max_ms:.0f}",
            "slope": "{slope:.5f}",
        },
    )
    names = {"killed": "killed (kill -9)", "frozen": "cable pulled (SIGSTOP)"}
    print_rows(
        "A camera that is gone",
        [{"name": name, **results[key]} for key, name in names.items()],
        {
            "": "{name}",
            "trials": "{trials}",
            "recognised s": "{recognised_s[0]:.2f} to {recognised_s[1]:.2f}",
            "resumed s after it is back": "{resumed_s[0]:.2f} to {resumed_s[1]:.2f}",
        },
    )


if __name__ == "__main__":
    run(measure, show)
