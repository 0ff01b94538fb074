"""`python -m tests.perf.store --equal`: flowrec's MCAP writer and encoder and those of the libraries.

The writers are given the same bytes and pack them into chunks of 1 MiB with zstd at level 1, in one thread. The
encoders are given the same messages and must give the same bytes. Speed is measured alone. The stall is measured at a
camera's rate: how late a thread wakes that sleeps 1 ms at a time, while another thread of the process writes.
"""

from __future__ import annotations

import sys
import tempfile
import threading
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple

import mcap.writer
import numpy as np
import zstandard
from foxglove.mcap import MCAPCompression

from flowrec.bench.harness import print_rows
from flowrec.core import FlowField, Message, Track, message_fields, progress, realtime_priority
from flowrec.run.loop import SWITCH_S
from flowrec.store.channels import message_codec
from flowrec.store.schema import Schema
from tests.perf.store_writers import (
    CHUNK_BYTES,
    Open,
    Start,
    foxglove_file,
    frames_given,
    mcap_file,
    own_file,
    poses_given,
)
from tests.store.made_up import encode

_STEP_NS = 1_000_000
_PERIOD_S = 1e-3


class Load(NamedTuple):
    """Payloads of one topic: the number at full speed, and the rate while the stall is measured."""

    name: str
    field: str
    schema: Schema
    payloads: list[bytes]
    messages: int
    rate_hz: float


def _mcap(path: Path, field: str, schema: Schema) -> Open:
    # mcap packs at level 3 and has no setting for it.
    vars(mcap.writer)["zstandard"] = SimpleNamespace(compress=partial(zstandard.compress, level=1))
    file = mcap_file(path, field, schema, enable_data_crcs=True)

    def close() -> None:
        file.close()
        vars(mcap.writer)["zstandard"] = zstandard

    return Open(file.put, close)


WRITERS: dict[str, Start] = {
    "flowrec": own_file,
    "foxglove-sdk": partial(
        foxglove_file,
        compression=MCAPCompression.Zstd,
        compression_level=1,
        compression_threads=0,
        chunk_size=CHUNK_BYTES,
    ),
    "mcap": _mcap,
}


def protobuf_encoder(message_type: type[Any]) -> Callable[[Any], bytes]:
    """An encoder of messages with protobuf's own runtime."""
    wire, forms = message_codec(message_type).schema.wire, message_fields(message_type)

    def by_protobuf(message: Any) -> bytes:
        made = wire()
        for form in forms:
            value = getattr(message, form.name)
            if value is None:
                continue
            if form.kind == "vector":
                getattr(made, form.name).extend(value.tolist())
            elif form.kind == "array":
                part = getattr(made, form.name)
                part.shape.extend(value.shape)
                part.dtype, part.data = value.dtype.str, value.tobytes()
            else:
                setattr(made, form.name, value)
        done: bytes = made.SerializeToString()
        return done

    return by_protobuf


def our_encoder(message_type: type[Any]) -> Callable[[Any], bytes]:
    """The encoder of flowrec, its parts joined."""
    parts_of = message_codec(message_type).encode
    return lambda message: b"".join(parts_of(message))


ENCODERS: dict[str, Callable[[type[Any]], Callable[[Any], bytes]]] = {
    "protobuf, ours": our_encoder,
    "protobuf, its own": protobuf_encoder,
}


def loads(share: float = 1.0) -> list[Load]:
    """Poses of 1 kB and images of two cameras as foxglove.RawImage; `share` scales their number."""
    rows = [
        ("poses of 1 kB", poses_given(), 60_000, 1000.0),
        ("images 640x512", frames_given(640, 512), 600, 200.0),
        ("images 2448x2048", frames_given(2448, 2048), 100, 60.0),
    ]
    return [
        Load(name, given[0].field, message_codec(type(given[0].message)).schema, [one.payload for one in given], n, hz)
        for name, given, count, hz in rows
        if (n := max(round(count * share), 20))
    ]


def messages() -> dict[str, tuple[list[Message], int, float]]:
    """By name: messages to encode in turn, the number at full speed, the rate for the stall."""
    rng = np.random.default_rng(0)
    stamps = [10**9 + number * _STEP_NS for number in range(256)]
    tracks = [Track(now, True, rng.normal(size=2), 0.9, 0, 4.5, rng.normal(size=4), now) for now in stamps]
    poses = [given.message for given in poses_given()[:256]]
    size = (512, 512)
    speed, pressure = rng.normal(size=(*size, 2)).astype(np.float32), rng.normal(size=size).astype(np.float32)
    field = FlowField(10**9, 1, "fvm", 5.0, speed, pressure, speed, rng.normal(size=4), 1.0, 1000.0, "")
    return {
        "tracks of 0.1 kB": (list(tracks), 60_000, 2000.0),
        "poses of 1 kB": (poses, 60_000, 2000.0),
        "flow fields 512x512": ([field], 100, 20.0),
    }


def measure(rounds: int = 3, share: float = 1.0, stall_s: float = 3.0) -> list[dict[str, Any]]:
    """A row per load and writer or encoder, which take turns; least and median of the rounds."""
    jobs: list[tuple[str, str, int, float, Callable[[Path], tuple[Callable[[int], Any], Callable[[], Any]]]]] = []
    sizes: dict[str, int] = {}
    for load in loads(share):
        sizes[load.name] = len(load.payloads[0])
        jobs += [(load.name, name, load.messages, load.rate_hz, partial(_writing, load, name)) for name in WRITERS]
    for what, (given, count, rate_hz) in messages().items():
        sizes[what] = len(encode(given[0]))
        for name in ENCODERS:
            jobs.append((what, name, max(round(count * share), 20), rate_hz, partial(_encoding, given, name)))
    rows: dict[tuple[str, str], list[dict[str, float]]] = {}
    memory = Path("/dev/shm")
    with (
        tempfile.TemporaryDirectory(dir=memory if memory.is_dir() else None) as folder,
        progress("at equal terms", rounds * (len(jobs) + 1)) as done,
    ):
        path = Path(folder, "bench.mcap")
        for turn in range(rounds):
            rows.setdefault(("nothing", ""), []).append(_stall_ms(lambda _number: None, 1.0, stall_s))
            done(turn * (len(jobs) + 1) + 1)
            for number, (what, name, count, rate_hz, start) in enumerate(jobs):
                found = _speed(start, path, count)
                put, close = start(path)
                found |= _stall_ms(put, rate_hz, stall_s)
                close()
                path.unlink(missing_ok=True)
                rows.setdefault((what, name), []).append(found)
                done(turn * (len(jobs) + 1) + number + 2)
    return [
        {"load": what, "name": name, "nbytes": sizes.get(what, 0)}
        | {key: [float(np.min(column)), float(np.median(column))] for key in found[0] for column in [_of(found, key)]}
        for (what, name), found in rows.items()
    ]


def _of(rounds: list[dict[str, float]], key: str) -> list[float]:
    return [found[key] for found in rounds]


def _writing(load: Load, name: str, path: Path) -> tuple[Callable[[int], Any], Callable[[], Any]]:
    file = WRITERS[name](path, load.field, load.schema)
    payloads = load.payloads
    return lambda number: file.put(payloads[number % len(payloads)], 10**9 + number * _STEP_NS), file.close


def _encoding(given: list[Message], name: str, _path: Path) -> tuple[Callable[[int], Any], Callable[[], Any]]:
    make = ENCODERS[name](type(given[0]))
    return lambda number: make(given[number % len(given)]), lambda: None


def _speed(
    start: Callable[[Path], tuple[Callable[[int], Any], Callable[[], Any]]], path: Path, count: int
) -> dict[str, float]:
    put, close = start(path)
    began, began_cpu = time.perf_counter(), time.process_time()
    for number in range(count):
        put(number)
    close()
    wall_s, cpu_s = time.perf_counter() - began, time.process_time() - began_cpu
    size = path.stat().st_size if path.exists() else 0
    path.unlink(missing_ok=True)
    return {"us": 1e6 * wall_s / count, "cpu_us": 1e6 * cpu_s / count, "file_bytes": size / count}


def _stall_ms(put: Callable[[int], Any], rate_hz: float, duration_s: float) -> dict[str, float]:
    """Delay of a thread with the loop's priority while another thread writes messages at a rate, ms."""
    over = threading.Event()

    def work() -> None:
        due, number = time.perf_counter(), 0
        while not over.wait(max(due - time.perf_counter(), 0.0)):
            put(number)
            number += 1
            due = max(due + 1.0 / rate_hz, time.perf_counter() - 1.0)

    thread = threading.Thread(target=work)
    before = sys.getswitchinterval()
    sys.setswitchinterval(SWITCH_S)
    thread.start()
    late_s = []
    try:
        with realtime_priority():
            end = time.perf_counter() + duration_s
            due = time.perf_counter() + _PERIOD_S
            while due < end:
                time.sleep(max(due - time.perf_counter(), 0.0))
                now = time.perf_counter()
                late_s.append(now - due)
                due = max(due, now) + _PERIOD_S
    finally:
        over.set()
        thread.join()
        sys.setswitchinterval(before)
    p50, p99 = np.percentile(late_s, (50, 99))
    return {"p50_ms": 1e3 * float(p50), "p99_ms": 1e3 * float(p99), "max_ms": 1e3 * max(late_s)}


def show(rows: list[dict[str, Any]]) -> None:
    """Print the medians of the rounds."""
    print_rows(
        "At equal terms: same bytes or messages in, chunks of 1 MiB, zstd level 1; median of the rounds",
        [{"us": None, "cpu_us": None} | row | {"mb_s": "us" in row and row["nbytes"] / row["us"][1]} for row in rows],
        {
            "load": "{load}",
            "by": "{name}",
            "us each": "{us[1]:.1f}",
            "MB/s": "{mb_s:.0f}",
            "CPU us each": "{cpu_us[1]:.1f}",
            "late p50 ms": "{p50_ms[1]:.2f}",
            "p99": "{p99_ms[1]:.2f}",
            "max": "{max_ms[1]:.2f}",
        },
    )
