"""Automatic recovery, before a run begins, of unfinished sessions in its folder."""

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

from flowrec.core import PREFIX, FlowrecError, child_command, child_environment, is_growing, say, try_lock, warn
from flowrec.store import PARTIAL_SUFFIX, SESSION_SUFFIX, recover

_UNFINISHED = SESSION_SUFFIX + PARTIAL_SUFFIX
_DRAFT = ".recovering" + _UNFINISHED
_LARGEST_BYTES = 100_000_000  # recovering that much takes one second, with tiny images five
_TIMEOUT_S = 5.0  # for all of them together: a run is unfinished
_CLEANUP_TIMEOUT_S = 1.0  # for a terminated recovery to remove its draft
_REFUSED = 3  # exit status of the recovery process if it reports in one line why nothing can be recovered
_NAMED = 3  # are reported by name, the others by number


def leftovers(folder: Path) -> list[Path]:
    """Unfinished sessions in a folder that no process is writing, the latest first."""
    try:
        found = [path for path in folder.iterdir() if path.name.endswith(_UNFINISHED) and path.is_file()]
        # A recovery that was killed leaves its draft and its input. Only the input is worth recovering.
        found = [path for path in found if not path.name.endswith(_DRAFT) and not path.name.startswith(PREFIX)]
        unfinished = [path for path in found if not is_growing(path)]
        return sorted(unfinished, key=lambda path: path.stat().st_mtime_ns, reverse=True)
    except OSError:
        return []  # the writer of the new session reports what is wrong with the folder


def recover_leftovers(folder: Path, excluded: frozenset[Path] = frozenset()) -> dict[Path, str]:
    """Recover small unfinished sessions and print the command for larger ones, a line for each; never raises for one.

    Parameters
    ----------
    excluded : remains to leave locked, because they will be overwritten.

    Returns
    -------
    The recovered sessions, each with a summary.
    """
    unfinished = [path for path in leftovers(folder) if path.resolve() not in excluded]
    if not unfinished:
        return {}
    recovered: dict[Path, str] = {}
    postponed: list[Path] = []
    end_s = time.monotonic() + _TIMEOUT_S
    with _folder_lock(folder) as locked:
        for path in unfinished:
            left_s = end_s - time.monotonic()
            if not locked or left_s <= 0.0 or _size(path) > _LARGEST_BYTES:
                postponed.append(path)
                continue
            try:
                done, summary = _recover_in_process(path, left_s)
            except subprocess.TimeoutExpired:
                postponed.append(path)
            except FlowrecError as error:
                warn(f"left from a run that did not finish: {error}")
            else:
                recovered[done] = summary
                say(f"recovered {done} from a run that did not finish: {summary}")
    for path in postponed[:_NAMED]:
        warn(
            f"{path} ({_size(path) / 1e6:.0f} MB) is left from a run that did not finish; "
            f"flowrec recover {path} makes a session of it"
        )
    if len(postponed) > _NAMED:
        warn(f"{len(postponed) - _NAMED} more like it in {folder}; flowrec ls {folder} names them")
    return recovered


def _recover_in_process(path: Path, limit_s: float) -> tuple[Path, str]:
    """Recover in a separate process; return the session and a summary.

    The live run starts even if an old file makes that process hang or run out of memory.

    Raises
    ------
    TimeoutExpired : it took longer than `limit_s`; the process has ended, the old file is unchanged.
    FlowrecError : nothing could be recovered.
    """
    try:
        process = subprocess.Popen(  # noqa: S603 - a module of flowrec
            child_command("flowrec.verbs.auto_recovery", str(path.resolve())),
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            start_new_session=True,  # Ctrl-C reaches this process only, which then ends the other one
            env=child_environment(),
        )
    except OSError as error:
        raise FlowrecError(f"{path}: recovering it does not start ({error.strerror or error})") from error
    try:
        out, errors = process.communicate(timeout=limit_s)
    finally:
        if process.poll() is None:
            process.terminate()
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(_CLEANUP_TIMEOUT_S)
            process.kill()
            process.communicate()
    if process.returncode:
        last = (errors.strip().splitlines() or [f"exit status {process.returncode}"])[-1]
        raise FlowrecError(last if process.returncode == _REFUSED else f"{path}: recovering it failed ({last})")
    name, summary = json.loads(out)
    return path.with_name(name), summary


def _main(path: Path) -> None:
    """Main function of the process that recovers one file."""
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
def _folder_lock(folder: Path) -> Iterator[bool]:
    """Lock a folder; yield whether no other process recovers in it. After a power cut several rigs start at once."""
    try:
        descriptor = os.open(folder, os.O_RDONLY)
    except OSError:
        yield False
        return
    try:
        try:
            locked = try_lock(descriptor, exclusive=True)
        except OSError:  # a file system that can not lock folders
            locked = True
        yield locked
    finally:
        os.close(descriptor)


if __name__ == "__main__":
    _main(Path(sys.argv[1]))
