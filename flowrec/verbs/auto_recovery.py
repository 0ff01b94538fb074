"""Automatic recovery, before a run begins, of unfinished sessions in its folder."""

from __future__ import annotations

import contextlib
import os
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from flowrec.core import PREFIX, BoundedProcess, FlowrecError, is_growing, remove_idle, say, shell_word, try_lock, warn
from flowrec.store import PARTIAL_SUFFIX, SESSION_SUFFIX, recover

_UNFINISHED = SESSION_SUFFIX + PARTIAL_SUFFIX
_DRAFT = ".recovering" + _UNFINISHED
_LARGEST_BYTES = 100_000_000  # recovering that much takes one second, with tiny images five
_TIMEOUT_S = 5.0  # for all of them together: a run is unfinished
_NAMED = 3  # are reported by name, the others by number


class _PostponedError(FlowrecError):
    """A recovery that takes longer, or more memory, than a run that is about to begin has for it."""


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
    """Recover small unfinished sessions, and print the command for larger ones; a failure is a printed line, too.

    `excluded`: files that are left as they are, because the run overwrites them. Returns the recovered sessions, each
    with a summary.
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
                # In a process of its own: the run starts even if an old file makes that hang.
                with BoundedProcess(str(path), left_s, error=_PostponedError, by_clock=True) as process:
                    done = process.call(recover, path)
            except _PostponedError:
                postponed.append(path)
            except FlowrecError as error:
                warn(f"left from a run that did not finish: {error}")
            else:
                recovered[done.path] = done.summary
                say(f"recovered {done.path} from a run that did not finish: {done.summary}")
        _remove_drafts(folder)
    for path in postponed[:_NAMED]:
        warn(
            f"{path} ({_size(path) / 1e6:.0f} MB) is left from a run that did not finish; "
            f"flowrec recover {shell_word(path)} makes a session of it"
        )
    if len(postponed) > _NAMED:
        warn(f"{len(postponed) - _NAMED} more like it in {folder}; flowrec ls {shell_word(folder)} names them")
    return recovered


def _remove_drafts(folder: Path) -> None:
    """Remove what recoveries that were ended have left."""
    for draft in folder.glob(f"*{_DRAFT}"):
        with contextlib.suppress(OSError):  # another process writes it, or it is of another user
            remove_idle(draft)


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
