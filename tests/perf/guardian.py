"""`python -m tests.perf.guardian`: how long the coils stay on after the recorder is killed, stopped or stuck.

A real recorder process drives the compiled firmware behind a pseudo terminal, or by NI's client a twin of the gRPC
server; the outputs are read from the twins' files. A row per device and fault: the distribution of the time from the
fault to zero, beside the largest delay of a sleep as long as the guardian's timer, measured meanwhile by processes.
With `--record` the recorder is `flowrec record --rig lab` on a mission, with an emulated camera: guardian_record.py.
"""

from __future__ import annotations

import os
import random
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from multiprocessing import get_context
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from flowrec.bench.harness import Results, print_rows, run
from flowrec.core import progress
from flowrec.rigs import CommandLimits
from tests.perf import guardian_record, guardian_trial
from tests.twins.coils import Device, device
from tests.twins.lab import still_scene

TIMER_S = 0.1
_START_S, _AFTER_S = 90.0, 0.6
_RECOVERED = 10  # of so many unfinished files one is recovered
# Recorders are forked from a process that has loaded all they need.
_CONTEXT = get_context("forkserver")
_CONTEXT.set_forkserver_preload(["tests.perf.guardian_trial", "flowrec.rigs.lab.amplifiers.serial_line"])
_SLEEPER = """
import sys, time
while True:
    begin = time.monotonic()
    time.sleep(float(sys.argv[1]))
    print(time.monotonic() - begin - float(sys.argv[1]), flush=True)
"""


@dataclass
class Ended:
    """What became of one recorder."""

    off_s: float | None  # from the fault to zero
    said: str  # the last line of the recorder
    stayed_off: bool = True


def trial(on: Device, fault: str, silence_s: float = TIMER_S) -> Ended | None:
    """Start a recorder, wait until its field is on, do that to it. None: its field did not come on.

    Faults: kill, stop, hang and spin of the recorder; `kill both`: the process of the NI output with it;
    `guardian`: kill of the guardian alone; `signals`: SIGINT, SIGTERM and SIGHUP to the guardian, then the kill.
    """
    own = fault if fault in ("hang", "spin") else ""
    begin = on.end()
    said, says = _CONTEXT.Pipe(duplex=False)
    recorder = _CONTEXT.Process(target=guardian_trial.main, args=(says, on.kind, on.address, silence_s, own, on.coils))
    recorder.start()
    says.close()
    assert recorder.pid is not None
    try:
        helpers = _wait_on(said)
        if helpers is None:
            return None
        if own:
            fault_ns = int(_line(said, "fault").split()[1])
        else:
            time.sleep(random.uniform(0.05, 0.3))
            fault_ns = _harm(fault, recorder.pid, helpers)
        time.sleep(_AFTER_S)
        off_ns = on.off_ns(fault_ns, begin)
        last = ""
        if fault == "stop":
            os.kill(recorder.pid, signal.SIGCONT)
        if fault in ("stop", "guardian"):
            last = _line(said, "failed")
        again_ns = on.off_ns(fault_ns, begin)
        return Ended(None if off_ns is None else 1e-9 * (off_ns - fault_ns), last, off_ns == again_ns)
    finally:
        recorder.kill()
        recorder.join()
        said.close()


@dataclass
class Blocks:
    """A long output of NI blocks."""

    seconds: float  # until it ran dry, or the end
    largest_step_v: float
    bound_v: float  # largest step of a continuous field within the limits
    ran_dry: str  # what the recorder said; '': it did not run dry
    zero: bool  # whether the outputs ended at zero


def blocks(on: Device, seconds: float, silence_s: float = TIMER_S) -> Blocks:
    """Put out a field for so long, with another frequency and heading in each frame; what the outputs did meanwhile."""
    begin = on.end()
    said, says = _CONTEXT.Pipe(duplex=False)
    recorder = _CONTEXT.Process(target=guardian_trial.main, args=(says, on.kind, on.address, silence_s, "", on.coils))
    recorder.start()
    says.close()
    try:
        if _wait_on(said) is None:
            raise RuntimeError("the recorder did not start")
        begin_ns = time.monotonic_ns()
        ran_dry = said.recv() if said.poll(seconds) else ""
        end_ns = time.monotonic_ns()
    finally:
        recorder.kill()
        recorder.join()
        said.close()
    time.sleep(_AFTER_S)
    times, outputs = on.outputs(begin)
    off_ns = on.off_ns(begin_ns, begin)
    kept = outputs[(times >= begin_ns) & (times < min(end_ns, off_ns or end_ns) - 10_000_000)]
    limits = CommandLimits(guardian_trial.coils_of(on.coils), guardian_trial.ROBOT, guardian_trial.OUTPUT)
    bound = limits.slew_a_s / limits.coils.amplifier.output_hz * limits.coils.amplifier.ohm.max()
    step = float(np.abs(np.diff(kept, axis=0)).max())
    return Blocks(1e-9 * (end_ns - begin_ns), step, bound, ran_dry, off_ns is not None)


def _harm(fault: str, recorder: int, helpers: dict[str, int]) -> int:
    if fault == "signals":
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            os.kill(helpers["guardian"], number)
    fault_ns = time.monotonic_ns()
    victim = helpers["guardian"] if fault == "guardian" else recorder
    os.kill(victim, signal.SIGSTOP if fault == "stop" else signal.SIGKILL)
    if fault == "kill both" and "process" in helpers:
        os.kill(helpers["process"], signal.SIGKILL)
    return fault_ns


def _wait_on(said: Connection) -> dict[str, int] | None:
    helpers: dict[str, int] = {}
    while (line := _line(said)) != "on":
        name, _, number = line.partition(" ")
        if name not in ("guardian", "process"):
            print(line, file=sys.stderr)
            return None
        helpers[name] = int(number)
    return helpers


def _line(said: Connection, word: str = "") -> str:
    """The next line of the recorder that begins with a word."""
    try:
        while said.poll(_START_S):
            line: str = said.recv()
            if line.startswith(word):
                return line
    except EOFError:
        return "it has ended"
    return "it says nothing"


@contextmanager
def sleeper(timer_s: float = TIMER_S) -> Iterator[list[float]]:
    """Context in which other processes, as many as a trip takes, measure sleeps; the list holds their delays in s."""
    delays: list[float] = []
    command = [sys.executable, "-c", _SLEEPER, str(timer_s)]
    processes = [subprocess.Popen(command, stdout=subprocess.PIPE, text=True) for _ in range(3)]

    def collect(process: subprocess.Popen[str]) -> None:
        assert process.stdout is not None
        with process.stdout:
            delays.extend(float(line) for line in process.stdout)

    threads = [threading.Thread(target=collect, args=(process,), daemon=True) for process in processes]
    for thread in threads:
        thread.start()
    try:
        yield delays
    finally:
        for process, thread in zip(processes, threads, strict=True):
            process.kill()
            process.wait()
            thread.join()


@contextmanager
def busy(count: int) -> Iterator[None]:
    """Context in which so many processes compute."""
    load = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(count)]
    try:
        yield
    finally:
        for one in load:
            one.kill()
            one.wait()


def measure(
    kills: Annotated[int, typer.Option(help="of the recorder by SIGKILL, for each device")] = 100,
    stops: Annotated[int, typer.Option(help="of the recorder by SIGSTOP, for each device")] = 20,
    others: Annotated[int, typer.Option(help="trials of each other fault")] = 5,
    load: Annotated[int, typer.Option(help="processes that compute meanwhile")] = 0,
    kinds: Annotated[str, typer.Option(help="devices, separated by commas")] = "serial,serial+timer,ni",
    blocks_s: Annotated[float, typer.Option(help="time of NI blocks with every core busy; 0: none")] = 60.0,
    coils: Annotated[int, typer.Option(help="coils of each device: 3 or 6; with --record 3")] = 3,
    record: Annotated[bool, typer.Option(help="the recorder is a mission of `flowrec record --rig lab`")] = False,
) -> Results:
    """Times from the fault to zero, by device and fault; the output of NI blocks on a busy machine."""
    rows, long = [], None
    with tempfile.TemporaryDirectory() as name, busy(load):
        folder = Path(name)
        camera = still_scene(folder) if record else ()
        for kind in kinds.split(","):
            if record:
                faults = {"kill": kills, "stop": stops, "held": others}
            else:
                faults = {"kill": kills, "stop": stops, "hang": others, "spin": others, "signals": others}
                faults |= {"guardian": others} | ({"kill both": others} if kind == "ni" else {})
            with device(kind, folder, coils=coils) as on:
                if kind == "ni" and blocks_s and not record:
                    with busy(os.cpu_count() or 1):
                        long = asdict(blocks(on, blocks_s))
                for fault, count in faults.items():
                    rows.append(_row(on, kind, fault, count, folder, camera))
    return {"rows": rows, "load": os.getloadavg()[0], "blocks": long}


def _row(on: Device, kind: str, fault: str, count: int, folder: Path, camera: tuple[str, ...]) -> Results:
    """All trials of a fault on a device; with settings of a camera, those of a real recorder."""
    ends: list[Ended | guardian_record.Left] = []
    refused = 0
    with sleeper() as worst, progress(f"{kind} {fault}", count) as done:
        while len(ends) < count:
            name, recovers = f"{kind}-{fault}-{len(ends)}-{refused}", len(ends) % _RECOVERED == 0
            if camera:
                ended = guardian_record.trial(on, fault, folder, camera, name, recovers=recovers)
            else:
                ended = trial(on, fault)
            if ended is None:
                refused += 1  # it lost its coils, and they were at zero, before its field was up
                continue
            ends.append(ended)
            done(len(ends))
    jitter_s = max(worst, default=0.0)
    off_s = sorted(one.off_s if one.off_s is not None and one.stayed_off else np.inf for one in ends)
    row = {
        "device": kind,
        "fault": fault,
        "off_s": off_s,
        "sleep_s": jitter_s,
        "late": sum(one > TIMER_S + jitter_s for one in off_s),
        "not_started": refused,
        "said": ends[-1].said if ends else "",
        "load": os.getloadavg()[0],
    }
    if camera:
        recovered_s = [one.recovered_s for one in ends if one.recovered_s is not None]
        row |= {"files": sorted({one.file for one in ends}), "recovered": len(recovered_s)}
    print(f"{row | {'off_s': np.round(1e3 * np.array(off_s), 1).tolist()}}", file=sys.stderr)
    return row


def show(results: Results) -> None:
    """Print the tables."""
    if results["blocks"] is not None:
        print("NI blocks, every core busy:", results["blocks"])
    print_rows(
        f"time from the fault to zero; the timer is {1e3 * TIMER_S:.0f} ms; load {results['load']:.1f}",
        [
            {"files": "-", "recovered": "-"}
            | row
            | {"trials": len(row["off_s"]), "ms": 1e3 * np.percentile(row["off_s"], (0, 50, 90, 100))}
            for row in results["rows"]
            if row["off_s"]
        ],
        {
            "device": "{device}",
            "fault": "{fault}",
            "trials": "{trials}",
            **{name: f"{{ms[{n}]:.1f}}" for n, name in enumerate(("least, ms", "median", "90 %", "most"))},
            "sleep late by, s": "{sleep_s:.4f}",
            "late or on": "{late}",
            "not started": "{not_started}",
            "load": "{load:.1f}",
            "left": "{files}",
            "recovered": "{recovered}",
        },
    )


if __name__ == "__main__":
    run(measure, show)
