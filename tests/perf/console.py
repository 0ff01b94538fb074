"""What `flowrec record --console` costs the loop: `python -m tests.perf.console [--pairs N, --ticks N]`.

Frames that were rendered before go through the control loop at 60 Hz with real-time priority, as in `flowrec record`,
and are recorded, in turns without and with a console: its process, Rerun's server behind it, and a page that reads all
it gets in a process of its own (a browser would draw on the same cores). The order within a pair alternates.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
from contextlib import ExitStack
from pathlib import Path

import numpy as np

from flowrec.bench.loop import RATE_HZ, paced_run, prepare_inputs
from flowrec.core import realtime_priority
from flowrec.run import RunControl, Sink
from flowrec.stages import load_config
from flowrec.store import SessionWriter, WriterOptions, session_header
from flowrec.verbs import prepare
from flowrec.verbs.watching import Watching

PAGE = """
import sys
from websockets.sync.client import connect
port, token = sys.argv[1:]
cookie = {"Cookie": f"flowrec_console_{port}={token}"}
host = f"127.0.0.1:{port}"
with connect(f"ws://{host}/live", origin=f"http://{host}", additional_headers=cookie, proxy=None) as page:
    sizes = [len(message) for message in page]
print(len(sizes), sum(sizes))
"""
PARTS = ("control_ms", "sinks_ms", "total_ms")


def main() -> None:
    asked = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    asked.add_argument("--pairs", type=int, default=6)
    asked.add_argument("--ticks", type=int, default=600)
    options = asked.parse_args()
    config, chip, pipeline, *_ = prepare(load_config(None, [f"camera.rate_hz={RATE_HZ}"]), aloud=False)
    inputs = prepare_inputs(config, pipeline, options.ticks)
    found: dict[bool, list[dict[str, float]]] = {False: [], True: []}
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "run.mcap"

        def measure(*, console: bool) -> None:
            with ExitStack() as stack:
                header = session_header(config, chip)
                writer = stack.enter_context(SessionWriter(path, header, WriterOptions(block=False, overwrite=True)))
                sinks: list[Sink] = [writer]
                page = None
                if console:
                    watching = Watching("none", (config, chip, pipeline, path), RunControl(), dict)
                    stack.enter_context(watching)
                    served = watching._console
                    assert served is not None
                    words = [sys.executable, "-c", PAGE, str(served.port), served.url.partition("token=")[2]]
                    page = subprocess.Popen(words, stdout=subprocess.PIPE, text=True)
                    sinks += watching.sinks
                with realtime_priority() as first:
                    timings = paced_run(inputs, config, pipeline, sinks)
                writer.close({"outcome": "bench"})
            taken = {part: np.array([getattr(timing, part) for timing in timings]) for part in PARTS}
            found[console].append({part: float(np.percentile(ms, 99)) for part, ms in taken.items()})
            read = page.communicate()[0].split() if page is not None else ()
            heard = f", page: {read[0]} messages, {int(read[1]) / 1e6:.1f} MB" if read else ""
            figures = ", ".join(
                f"{part} median {np.median(ms):.3f} p99 {np.percentile(ms, 99):.3f}" for part, ms in taken.items()
            )
            print(f"{'with' if console else 'without':8}{figures}; real-time priority: {first}{heard}", flush=True)

        for number in range(options.pairs):
            for console in (False, True) if number % 2 == 0 else (True, False):
                measure(console=console)
    for part in PARTS:
        without, with_console = (np.array([row[part] for row in found[console]]) for console in (False, True))
        ratios = with_console / without
        print(
            f"p99 of {part}: {np.median(without):.3f} without, {np.median(with_console):.3f} with; "
            f"ratio of the pairs: median {np.median(ratios):.2f}, {ratios.min():.2f} to {ratios.max():.2f}"
        )


if __name__ == "__main__":
    main()
