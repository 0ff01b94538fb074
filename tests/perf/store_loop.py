"""Cost of recording for the control loop, and memory of a long recording."""

from __future__ import annotations

import tempfile
import time
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from flowrec.bench.loop import RATE_HZ, paced_run, prepare_inputs
from flowrec.core import Frame, Image, OperatorEvent, Tick, peak_mb, progress, realtime_priority
from flowrec.run import Sink
from flowrec.stages import load_config
from flowrec.store import SessionWriter, WriterOptions
from flowrec.store.session_file import Snapshot, Split
from flowrec.verbs import prepare
from tests.perf.store_writers import made_up_header, pictures, ticks_of

_WIDTH, _HEIGHT = 2448, 2048
_QUEUE_BYTES = round(2.0 * RATE_HZ * _WIDTH * _HEIGHT)  # as `flowrec record` has it for this camera
_RING = 140  # images, more than the queue holds
_IN_A_THREAD = "raw, in a thread"
_SOAK_RATE_HZ = 100.0
_RING_S = 30.0
_WARM_S = 5.0  # until the queue, the pools and the caches have their size


@dataclass(slots=True)
class LargeCamera:
    """A sink before the writer: the loop gets 640x512 images, the writer 2448x2048 images.

    Each is copied into a ring of buffers that is longer than the writer's queue, as a driver does; also when nothing
    is recorded.
    """

    images: list[Image]
    ring: list[Image]
    writer: Sink | None
    kept: Tick = field(default_factory=Tick)

    def write(self, tick: Tick) -> None:
        if tick.frame is not None:
            image = self.ring[tick.frame.index % len(self.ring)]
            np.copyto(image, self.images[tick.frame.index % len(self.images)])
            tick = replace(tick, frame=Frame(tick.frame.stamp_ns, tick.frame.index, image))
        self.kept = tick
        if self.writer is not None:
            self.writer.write(tick)


def stall(folder: Path, duration_s: float, rounds: int) -> dict[str, Any]:
    """The control step at 60 Hz with recording off and on, which take turns.

    With the priority that `record --realtime` gives the loop. The step is what the loop times: tracking, observing,
    control, and the hand-over to the sinks of the tick before.
    """
    config, _chip, pipeline, *_ = prepare(load_config(None, [f"camera.rate_hz={RATE_HZ}"]))
    prepared = prepare_inputs(config, pipeline, round(duration_s * RATE_HZ))
    images = pictures(_WIDTH, _HEIGHT)
    ring = [np.ones_like(images[0]) for _ in range(_RING)]
    kinds = ("off", "zstd", "delta", "raw", _IN_A_THREAD)
    rows: dict[str, list[Any]] = {kind: [] for kind in kinds}
    path = folder / "stall.mcap"
    with progress("flying", rounds * len(kinds)) as done:
        for number in range(rounds * len(kinds)):
            kind = kinds[number % len(kinds)]
            writer = _writer(kind, path)
            sinks: list[Sink] = [LargeCamera(images, ring, writer)]
            cpu_s = time.process_time()
            with realtime_priority() as first:
                timings = paced_run(prepared, config, pipeline, sinks, partial(_queue_of, writer))
            cpu_s = time.process_time() - cpu_s
            if writer is not None:
                writer.close()
            rows[kind].append((timings, cpu_s))
            done(number + 1)
    return {
        "ticks": len(prepared) * rounds,
        "loop_in_real_time": first,
        "rows": {kind: _row(runs, len(prepared)) for kind, runs in rows.items()},
    }


def _writer(kind: str, path: Path) -> SessionWriter | None:
    if kind == "off":
        return None
    frames, own = ("raw", False) if kind == _IN_A_THREAD else (kind, True)
    options = WriterOptions(frames=frames, overwrite=True, queue_limit_bytes=_QUEUE_BYTES, own_process=own)
    return SessionWriter(path, made_up_header(), options)


def _queue_of(writer: object) -> tuple[float, int]:
    return (writer.queue_bytes / 1e6, writer.dropped_frames) if isinstance(writer, SessionWriter) else (0.0, 0)


def _row(runs: list[Any], ticks: int) -> dict[str, float]:
    timings = [timing for one, _ in runs for timing in one]
    total_ms = [timing.total_ms for timing in timings]
    return {
        "p50_ms": float(np.median(total_ms)),
        "p99_ms": float(np.percentile(total_ms, 99)),
        "max_ms": max(total_ms),
        "hand_over_p50_ms": float(np.median([timing.sinks_ms for timing in timings])),
        "hand_over_p99_ms": float(np.percentile([timing.sinks_ms for timing in timings], 99)),
        "dropped": sum(one[-1].dropped_frames for one, _ in runs),
        "queue_mb": max(timing.queue_mb for timing in timings),
        "cpu_ms_per_frame": 1e3 * sum(cpu_s for _, cpu_s in runs) / len(runs) / ticks,
    }


def soak(minutes: float, folder: Path | None = None, *, keeping: bool = False) -> dict[str, Any]:
    """Memory of this process while 640x512 images are recorded at 100 Hz, once a second.

    `keeping`: in a ring of 30 s, with a mark every minute.
    """
    images = pictures(640, 512)
    mb: list[float] = []
    count = round(minutes * 60 * _SOAK_RATE_HZ)
    with tempfile.TemporaryDirectory(dir=folder) as name:
        path = Path(name) / "soak.mcap"
        pieces = Snapshot(_RING_S) if keeping else Split()
        options = WriterOptions(frames="delta", files=pieces, own_process=True)
        with SessionWriter(path, made_up_header(), options) as writer, progress("soaking", count) as done:
            began = time.perf_counter()
            mark: OperatorEvent | None = None
            for number, tick in enumerate(ticks_of(images, count, _SOAK_RATE_HZ)):
                wait_s = began + number / _SOAK_RATE_HZ - time.perf_counter()
                if wait_s > 0:
                    time.sleep(wait_s)
                assert tick.frame is not None
                if number % (60 * _SOAK_RATE_HZ) == 59 * _SOAK_RATE_HZ:
                    mark = OperatorEvent(tick.stamp_ns, "mark", "")
                writer.write(replace(tick, frame=replace(tick.frame, image=tick.frame.image.copy()), operator=mark))
                if number % _SOAK_RATE_HZ == 0:
                    mb.append(peak_mb("VmRSS"))
                    done(number)
            dropped = writer.dropped_frames
        size = sum(file.stat().st_size for file in writer.files)
    warm = int(_WARM_S + _RING_S if keeping else _WARM_S)
    settled = np.array(mb[warm:]) if len(mb) > 2 * warm else np.array(mb)
    growth = np.polyfit(np.arange(len(settled)), settled, 1)[0] * 60.0 if len(settled) > 1 else 0.0
    return {
        "minutes": minutes,
        "file_mb": size / 1e6,
        "dropped": dropped,
        "memory_mb": mb,
        "highest_mb": float(settled.max()),
        "lowest_mb": float(settled.min()),
        "growth_mb_per_minute": float(growth),
    }
