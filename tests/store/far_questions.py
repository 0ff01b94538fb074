"""Questions about a session at a URL, and how many requests in how many round trips the answers take."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

import flowrec
from flowrec.core import Outcome
from flowrec.store import TRAFFIC, SessionWriter, WriterOptions, remote_file
from tests.perf.store_writers import pictures, ticks_of

_HEAD = Path(__file__).parents[2] / "sessions" / "golden_moderate.mcap"
MOST_REQUESTS, MOST_TRIPS = 3, 2


def _second(url: str, *, with_frames: bool) -> int:
    session = flowrec.open(url)
    middle_s = session.duration_s / 2.0
    return sum(1 for _ in session.ticks(middle_s, middle_s + 1.0, with_frames=with_frames))


def _image(url: str) -> Any:
    frames = flowrec.open(url).frames
    return frames[len(frames) // 2].image.shape


def _open(url: str) -> int:
    """Header, outcome and length."""
    session = flowrec.open(url)
    assert session.outcome and session.duration_s > 0.0
    return len(session.header.config_toml)


def _state(url: str) -> Any:
    session = flowrec.open(url)
    return session.at(session.duration_s / 2.0, with_frames=False).track


QUESTIONS: dict[str, Callable[[str], Any]] = {
    "open": _open,
    "one image": _image,
    "one second of everything": lambda url: _second(url, with_frames=True),
    "one second without images": lambda url: _second(url, with_frames=False),
    "all poses": lambda url: sum(1 for _ in flowrec.open(url).messages("track")),
    "times of all images": lambda url: len(flowrec.open(url).frames.stamps_ns),
    "the state in the middle": _state,
    "one field": lambda url: flowrec.open(url).fields,
    "info": lambda url: flowrec.info(url),
}


@dataclass(slots=True)
class Trips:
    """Round trips: requests that arrive while none waits; each waits for the latency."""

    latency_s: float
    count: int = 0
    _waiting: int = 0
    _lock: threading.Lock = field(default_factory=threading.Lock)

    def arrive(self) -> None:
        """Wait as a request does."""
        with self._lock:
            self.count += not self._waiting
            self._waiting += 1
        time.sleep(self.latency_s)
        with self._lock:
            self._waiting -= 1


@dataclass(frozen=True, slots=True)
class Cost:
    """Price of an answer."""

    requests: int
    trips: int
    megabytes: float
    seconds: float
    answer: Any

    def __str__(self) -> str:
        return f"{self.requests} requests in {self.trips} round trips, {self.megabytes:.2f} MB, {self.seconds:.2f} s"


def ask(question: str, url: str, trips: Trips) -> Cost:
    """Ask as somebody does who knows nothing of the session yet."""
    remote_file._remembered.clear()
    trips.count = 0
    requests, nbytes, began_s = TRAFFIC.requests, TRAFFIC.nbytes, time.perf_counter()
    answer = QUESTIONS[question](url)
    took_s = time.perf_counter() - began_s
    time.sleep(2.0 * trips.latency_s)  # for what was asked for ahead
    return Cost(TRAFFIC.requests - requests, trips.count, (TRAFFIC.nbytes - nbytes) / 1e6, took_s, answer)


def write_session(path: Path, seconds: float = 5.0, rate_hz: float = 20.0) -> None:
    """A session of images that do not compress, with state between them every quarter of a second."""
    rng = np.random.default_rng(0)
    images = [rng.integers(0, 255, image.shape, np.uint8) for image in pictures(320, 256)]
    with SessionWriter(path, flowrec.open(_HEAD).header, WriterOptions(block=True)) as writer:
        for tick in ticks_of(images, round(seconds * rate_hz), rate_hz):
            writer.write(tick)
        writer.close({"outcome": Outcome.REACHED})
