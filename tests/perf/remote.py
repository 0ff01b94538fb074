"""Requests, round trips, bytes and time of reading a session at a URL, from a server on this machine that waits first.

    python -m tests.perf.remote [SESSION] [--latency 0.05] [--gb 10]

128 MB, 12.5 s of 640 x 512 at 60 Hz, 50 ms a request, server and reader on the same two cores: opened by 3 requests in
two round trips, 0.7 MB; one second of ticks by 19 in 4, 1.2 MB; one image by 4 in 3, 0.8 MB; all poses by 67 in 7 and
0.7 s; all of it by 244 in 57 and 4 s. Without a session: sparse ones of 10 GB (large.py). 2448 x 2048 at 60 Hz, whose
index fits into the last 256 KiB: opened by 2 requests in one round trip, a second of ticks by 9 in 3, 0.5 MB; 640 x 512
at 100 Hz, whose index has 0.8 MB: opened by 3 in 2, a second of ticks by 10 in 4, 1.1 MB.
"""

from __future__ import annotations

import argparse
import itertools
import tempfile
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import flowrec
from flowrec.core.units import NS_PER_S
from flowrec.store import remote_file
from tests.perf.large import LOADS, write_sparse
from tests.store.range_server import served


def one_second(url: str) -> int:
    """The ticks of a second in the middle, without images."""
    session = flowrec.open(url)
    middle_s = session.duration_s / 2.0
    end_ns = session.stamp_ns(middle_s) + NS_PER_S
    ticks = session.ticks(middle_s, with_frames=False)
    return sum(1 for _ in itertools.takewhile(lambda tick: tick.stamp_ns < end_ns, ticks))


def settings(url: str) -> int:
    """Header, outcome and length, as info asks for them."""
    session = flowrec.open(url)
    assert session.outcome and session.duration_s > 0.0
    return len(session.header.config_toml)


READINGS: dict[str, Callable[[str], Any]] = {
    "open": settings,
    "one second of ticks": one_second,
    "all poses": lambda url: sum(1 for _ in flowrec.open(url).messages("track")),
    "one image": lambda url: flowrec.open(url).frames[0].image.shape,
    "all ticks": lambda url: sum(1 for _ in flowrec.open(url).ticks()),
}


def round_trips(times_s: list[float], latency_s: float) -> int:
    """Requests that come within half the latency of the one before wait beside it."""
    ordered = sorted(times_s)
    return 1 + sum(after - before > latency_s / 2.0 for before, after in itertools.pairwise(ordered))


def measure(path: Path, latency_s: float, readings: Iterable[str]) -> None:
    """Print what some readings of a session take."""
    times_s: list[float] = []

    def wait(*_: Any) -> bool:
        times_s.append(time.monotonic())
        time.sleep(latency_s)
        return False

    with served(path) as server:
        server.fault = wait
        for name in readings:
            remote_file._remembered.clear()
            times_s.clear()
            server.requests.clear()
            began_s = time.perf_counter()
            READINGS[name](server.url)
            took_s = time.perf_counter() - began_s
            megabytes = sum(nbytes for _, nbytes in server.requests) / 1e6
            trips = round_trips(times_s, latency_s)
            print(
                f"{name}: {took_s:.2f} s, {len(times_s)} requests in {trips} round trips, {megabytes:.2f} MB",
                flush=True,
            )
        time.sleep(4.0 * latency_s)  # for what was asked for ahead


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("session", type=Path, nargs="?")
    parser.add_argument("--latency", type=float, default=0.05)
    parser.add_argument("--gb", type=float, default=10.0)
    asked = parser.parse_args()
    if asked.session is not None:
        measure(asked.session, asked.latency, READINGS)
        return
    with tempfile.TemporaryDirectory(prefix="flowrec-remote-") as made:
        for load in LOADS:
            path = Path(made) / f"{load.width_px}.mcap"
            write_sparse(path, load, asked.gb)
            print(f"{load}: {path.stat().st_size / 1e9:.1f} GB")
            measure(path, asked.latency, ("open", "one second of ticks"))


if __name__ == "__main__":
    main()
