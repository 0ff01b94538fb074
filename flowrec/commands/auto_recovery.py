"""Automatic recovery: unfinished sessions that killed runs left in the folder of the next run."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from flowrec.errors import FlowrecError
from flowrec.store.recovery import recover
from flowrec.store.run_files import PARTIAL_SUFFIX, SUFFIX
from flowrec.system.locks import is_growing, try_lock
from flowrec.system.processes import child_command, child_environment
from flowrec.terminal import say, warn

_REMAINS = SUFFIX + PARTIAL_SUFFIX
_DRAFT = ".recovering" + _REMAINS
_LARGEST_BYTES = 100_000_000  # takes two to four seconds
_TIMEOUT_S = 5.0  # for all of them together: a run is waiting
_CLEANUP_TIMEOUT_S = 1.0  # for an abandoned recovery to remove its draft
_REFUSED = 3  # exit status of that process where it says in one line why nothing can be recovered
_OFFERED = 3  # by name, the others by number


def leftovers(folder: Path) -> list[Path]:
    """Unfinished sessions in a folder that no process is writing, the latest first."""
    try:
        found = [path for path in folder.iterdir() if path.name.endswith(_REMAINS) and path.is_file()]
        # A recovery that was killed left the draft and what it was to be made of; the latter is all there is to save.
        found = [path for path in found if not path.name.endswith(_DRAFT)]
        waiting = [path for path in found if not is_growing(path)]
        return sorted(waiting, key=lambda path: path.stat().st_mtime_ns, reverse=True)
    except OSError:
        return []  # whoever makes the new session there will say what is wrong


def look_after(folder: Path, besides: frozenset[Path] = frozenset()) -> dict[Path, str]:
    """Recover small remains, name the command for larger ones, with a line about each; raises for none of them.

    Parameters
    ----------
    besides : remains to leave alone, because they will be overwritten.

    Returns
    -------
    The recovered sessions, each with a summary.
    """
    waiting = [path for path in leftovers(folder) if path.resolve() not in besides]
    if not waiting:
        return {}
    made: dict[Path, str] = {}
    offered: list[Path] = []
    end_s = time.monotonic() + _TIMEOUT_S
    with _alone_in(folder) as alone:
        for path in waiting:
            left_s = end_s - time.monotonic()
            if not alone or left_s <= 0.0 or _size(path) > _LARGEST_BYTES:
                offered.append(path)
                continue
            try:
                done, came = _recover_apart(path, left_s)
            except subprocess.TimeoutExpired:
                offered.append(path)
            except FlowrecError as error:
                warn(f"left from a run that did not finish: {error}")
            else:
                made[done] = came
                say(f"recovered {done} from a run that did not finish: {came}")
    for path in offered[:_OFFERED]:
        warn(
            f"{path} ({_size(path) / 1e6:.0f} MB) is left from a run that did not finish; "
            f"flowrec recover {path} makes a session of it"
        )
    if len(offered) > _OFFERED:
        warn(f"{len(offered) - _OFFERED} more like it in {folder}; flowrec ls {folder} names them")
    return made


def _recover_apart(path: Path, limit_s: float) -> tuple[Path, str]:
    """Recover in a process of its own; returns the session and a summary.

    Whatever an old file does to that process (threads that hang, memory that runs out), the live run starts.

    Raises
    ------
    TimeoutExpired : it took longer; that process has ended, the remains are as they were.
    FlowrecError : nothing could be recovered.
    """
    try:
        process = subprocess.Popen(  # noqa: S603 - our own module
            child_command("flowrec.commands.auto_recovery", str(path.resolve())),
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            start_new_session=True,  # Ctrl-C ends this process, and then this one ends that one
            env=child_environment(),
        )
    except OSError as error:
        raise FlowrecError(f"{path}: recovering it does not start ({error.strerror or error})") from error
    try:
        out, said = process.communicate(timeout=limit_s)
    finally:
        if process.poll() is None:
            process.terminate()
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(_CLEANUP_TIMEOUT_S)
            process.kill()
            process.communicate()
    if process.returncode:
        last = (said.strip().splitlines() or [f"exit status {process.returncode}"])[-1]
        raise FlowrecError(last if process.returncode == _REFUSED else f"{path}: recovering it failed ({last})")
    name, came = json.loads(out)
    return path.with_name(name), came


def _main(path: Path) -> None:
    """The process that recovers one file."""
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(1))  # so that the draft is removed on the way out
    try:
        done = recover(path)
    except FlowrecError as error:
        sys.stderr.write(f"{error}\n")
        sys.exit(_REFUSED)
    lost = f"; lost: {done.lost}" if done.lost else ""
    json.dump([done.path.name, f"{done.ticks} ticks, {done.duration_s:.1f} s{lost}"], sys.stdout)


def _size(path: Path) -> int:
    with contextlib.suppress(OSError):
        return path.stat().st_size
    return 0


@contextmanager
def _alone_in(folder: Path) -> Iterator[bool]:
    """Whether no other process recovers in this folder; after a power cut several rigs start at once."""
    try:
        descriptor = os.open(folder, os.O_RDONLY)
    except OSError:
        yield False
        return
    try:
        try:
            alone = try_lock(descriptor, exclusive=True)
        except OSError:  # a file system that can not lock folders
            alone = True
        yield alone
    finally:
        os.close(descriptor)


if __name__ == "__main__":
    _main(Path(sys.argv[1]))
