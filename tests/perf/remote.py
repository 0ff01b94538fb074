"""Requests, round trips, bytes and time of reading a session at a URL, from a server on this machine that waits first.

    python -m tests.perf.remote SESSION [--latency 0.05]

80 MB, 15 s of 640 x 512 at 30 Hz, 50 ms a request, server and reader on the same two cores: opened by 2 requests in one
round trip and 0.11 s; one second of ticks by 19 in 4, 0.9 MB; all poses by 73 in 5 and 0.5 s; all of it by 171 in 6 and
1.0 s.
"""

from __future__ import annotations

import argparse
import itertools
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import flowrec
from flowrec.store import remote_file
from flowrec.units import NS_PER_S
from tests.store.range_server import served


def one_second(url: str) -> int:
    """The ticks of a second in the middle, without images."""
    session = flowrec.open(url)
    middle_s = session.duration_s / 2.0
    end_ns = session.stamp_ns(middle_s) + NS_PER_S
    ticks = session.ticks(middle_s, with_frames=False)
    return sum(1 for _ in itertools.takewhile(lambda tick: tick.stamp_ns < end_ns, ticks))


READINGS: dict[str, Callable[[str], Any]] = {
    "open": lambda url: flowrec.open(url).header.config_toml,
    "one second of ticks": one_second,
    "all poses": lambda url: sum(1 for _ in flowrec.open(url).messages("track")),
    "one image": lambda url: flowrec.open(url).frames[0].image.shape,
    "all ticks": lambda url: sum(1 for _ in flowrec.open(url).ticks()),
}


def round_trips(times_s: list[float], latency_s: float) -> int:
    """Requests that come within half the latency of the one before wait beside it."""
    ordered = sorted(times_s)
    return 1 + sum(after - before > latency_s / 2.0 for before, after in itertools.pairwise(ordered))


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("session", type=Path)
    parser.add_argument("--latency", type=float, default=0.05)
    asked = parser.parse_args()
    times_s: list[float] = []

    def wait(*_: Any) -> bool:
        times_s.append(time.monotonic())
        time.sleep(asked.latency)
        return False

    with served(asked.session) as server:
        server.fault = wait
        for name, read in READINGS.items():
            remote_file._remembered.clear()
            times_s.clear()
            server.requests.clear()
            began_s = time.perf_counter()
            read(server.url)
            took_s = time.perf_counter() - began_s
            megabytes = sum(nbytes for _, nbytes in server.requests) / 1e6
            trips = round_trips(times_s, asked.latency)
            print(
                f"{name}: {took_s:.2f} s, {len(times_s)} requests in {trips} round trips, {megabytes:.2f} MB",
                flush=True,
            )


if __name__ == "__main__":
    main()
