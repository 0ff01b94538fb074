"""Reading poses from a large session in a fresh process (`python -m`), for its time, its memory and what it reads."""

from __future__ import annotations

import json
import re
import sys
import time
from pathlib import Path

from flowrec.core import nanoseconds, peak_mb
from flowrec.store import SessionReader


def read(what: str, path: Path) -> dict[str, float]:
    """`second`: one second of poses from the middle; `poses`: all of them."""
    before_mb, before_bytes = peak_mb(), _bytes_read()
    began, began_cpu = time.perf_counter(), time.process_time()
    with SessionReader(path) as reader:
        open_s, open_cpu_s = time.perf_counter() - began, time.process_time() - began_cpu
        began, began_cpu = time.perf_counter(), time.process_time()
        count = 0
        if what == "second":
            start_ns = (reader.first_ns + reader.last_ns) // 2
            for tick in reader.ticks(start_ns, with_frames=False):
                if tick.stamp_ns >= start_ns + nanoseconds(1.0):
                    break
                count += tick.estimate is not None
        else:
            count = sum(1 for _ in reader.messages("estimate"))
        took_s, took_cpu_s = time.perf_counter() - began, time.process_time() - began_cpu
    return {
        "open_s": open_s,
        "open_cpu_s": open_cpu_s,
        f"{what}_s": took_s,
        f"{what}_cpu_s": took_cpu_s,
        f"{what}_count": count,
        f"{what}_mb": peak_mb() - before_mb,
        f"{what}_peak_mb": peak_mb(),
        f"{what}_read_mb": (_bytes_read() - before_bytes) / 1e6,
    }


def _bytes_read() -> int:
    """Bytes that this process has read so far (Linux); 0 elsewhere."""
    told = Path("/proc/self/io")
    found = re.search(r"rchar: (\d+)", told.read_text(encoding="ascii")) if told.exists() else None
    return int(found[1]) if found else 0


if __name__ == "__main__":
    sys.stdout.write(json.dumps(read(sys.argv[1], Path(sys.argv[2]))))
