"""A real `flowrec record --rig lab` with its coils on, until something is done to it; and what it leaves on disk.

As a program this is the recorder of the fault `held`: `python -m tests.perf.guardian_record record ...` is `flowrec
record ...`, until a line on stdin; then it says the time, and keeps the interpreter's lock in C from then on.
"""

from __future__ import annotations

import ctypes
import os
import random
import signal
import subprocess
import sys
import threading
import time
from dataclasses import dataclass
from pathlib import Path

from flowrec.core import FlowrecError
from flowrec.store import Session, recover
from flowrec.store.recovery import NothingSavedError
from tests.twins.coils import Device
from tests.twins.lab import COMMON, RATE, recorder

SETS = (*COMMON, RATE, "recording.recover_leftovers=false", "recording.anonymous=true")
_START_S, _END_S, _AFTER_S = 90.0, 30.0, 0.6
_HELD_US = 3_000_000


@dataclass
class Left:
    """What became of one recorder."""

    off_s: float | None  # from the fault to zero; None: never
    stayed_off: bool  # whether the field was still off when the recorder had gone on or ended
    # what it left: 'partial' for an unfinished file, 'nothing saved' where nothing of it can be recovered; else the
    # outcome that the session states
    file: str
    # length of the session that `flowrec recover` makes of the unfinished file; None: it was not tried
    recovered_s: float | None
    said: str  # the last line of the recorder


def trial(on: Device, fault: str, folder: Path, camera: tuple[str, ...], name: str, *, recovers: bool) -> Left | None:
    """Start a recorder, wait until its field is on, and kill, stop or hold it; None: it had no field any more by then.

    Raises AssertionError: what it left is a session that looks whole, or can not be recovered.
    """
    out, begin, errors = folder / f"{name}.mcap", on.end(), folder / f"{name}.stderr"
    module = "tests.perf.guardian_record" if fault == "held" else "flowrec"
    with recorder(out, *SETS, *camera, *on.sets, module=module, errors=errors) as process:
        end_s = time.monotonic() + _START_S
        while not on.energised(begin):
            if process.poll() is not None or time.monotonic() > end_s:
                print(errors.read_text()[-1000:], file=sys.stderr)
                return None
            time.sleep(0.02)
        time.sleep(random.uniform(0.05, 1.0))
        fault_ns = _harm(process, fault)
        time.sleep(_AFTER_S)
        off_ns = on.off_ns(fault_ns, begin)
        if off_ns == fault_ns:  # of a busy computer: the amplifier or the guardian has acted, and the run has ended
            print(errors.read_text()[-500:], file=sys.stderr)
            return None
        if fault == "stop":
            os.kill(process.pid, signal.SIGCONT)
        if fault in ("stop", "held"):
            process.wait(_END_S)
    again_ns = on.off_ns(fault_ns, begin)
    file, recovered_s = _left(out, ended=fault != "kill", recovers=recovers)
    said = (errors.read_text().strip().splitlines() or [""])[-1]
    return Left(None if off_ns is None else 1e-9 * (off_ns - fault_ns), off_ns == again_ns, file, recovered_s, said)


def _harm(process: subprocess.Popen[str], fault: str) -> int:
    if fault == "held":
        assert process.stdin is not None and process.stdout is not None
        process.stdin.write("hold\n")
        process.stdin.flush()
        return int(process.stdout.readline().split()[1])
    fault_ns = time.monotonic_ns()
    os.kill(process.pid, signal.SIGSTOP if fault == "stop" else signal.SIGKILL)
    return fault_ns


def _left(out: Path, *, ended: bool, recovers: bool) -> tuple[str, float | None]:
    partial = out.with_name(f"{out.name}.partial")
    if ended:
        assert out.is_file() and not partial.exists(), f"{out}: the run ended by itself and left no session"
        with Session(out) as session:
            outcome = session.outcome["outcome"]
        assert outcome not in ("reached", "time over"), f"{out}: looks like a good run"
        _remove(out)
        return str(outcome), None
    assert partial.is_file() and not out.exists(), f"{out}: looks whole after a kill"
    try:
        Session(partial).header  # noqa: B018 - it must refuse
        raise AssertionError(f"{partial}: opens as if it were finished")
    except FlowrecError:
        pass
    recovered_s = None
    if recovers:
        try:
            found = recover(partial)
        except NothingSavedError:  # killed before the first messages were on the disk
            _remove(partial)
            return "nothing saved", None
        assert found.ticks > 0 and not partial.exists()
        with Session(out) as session:
            assert session.outcome["outcome"] not in ("reached", "time over"), f"{out}: looks like a good run"
            assert sum(1 for _ in session.ticks()) == found.ticks
            recovered_s = session.duration_s
    _remove(out, partial)
    return "partial", recovered_s


def _remove(*files: Path) -> None:
    for file in files:
        file.unlink(missing_ok=True)


def _hold_when_told() -> None:
    sys.stdin.readline()
    print("fault", time.monotonic_ns(), flush=True)
    ctypes.PyDLL(None).usleep(_HELD_US)


if __name__ == "__main__":
    from flowrec.verbs import main

    threading.Thread(target=_hold_when_told, daemon=True).start()
    main()
