"""What killed runs have left in the folder of the next one: small remains are made whole on the spot."""

from __future__ import annotations

import contextlib
import fcntl
import os
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from flowrec.desk import Interrupted, at_most
from flowrec.errors import FlowrecError
from flowrec.status import say, warn
from flowrec.store import is_growing, recover
from flowrec.store.names import PARTIAL_SUFFIX, SUFFIX

_REMAINS = SUFFIX + PARTIAL_SUFFIX
_DRAFT = ".recovering" + _REMAINS
_AT_ONCE_BYTES = 100_000_000  # two to four seconds' work
_PATIENCE_S = 5.0  # for all of them together: a run is waiting
_OFFERED = 3  # by name, the others by number


def leftovers(folder: Path) -> list[Path]:
    """Unfinished sessions in a folder that nobody is writing, the latest first."""
    try:
        found = [path for path in folder.iterdir() if path.name.endswith(_REMAINS) and path.is_file()]
        # A recovery that was killed left the draft and what it was to be made of; the latter is all there is to save.
        found = [path for path in found if not path.name.endswith(_DRAFT)]
        waiting = [path for path in found if not is_growing(path)]
        return sorted(waiting, key=lambda path: path.stat().st_mtime_ns, reverse=True)
    except OSError:
        return []  # whoever makes the new session there will say what is wrong


def look_after(folder: Path, besides: frozenset[Path] = frozenset()) -> dict[Path, str]:
    """Recover what is small, offer what is not, with a line about each; never raises for what it finds.

    Parameters
    ----------
    besides : remains that are none of our business, because they will be overwritten.

    Returns
    -------
    The sessions that were made, and what came of each.
    """
    waiting = [path for path in leftovers(folder) if path.resolve() not in besides]
    if not waiting:
        return {}
    made: dict[Path, str] = {}
    offered: list[Path] = []
    end_s = time.monotonic() + _PATIENCE_S
    with _alone_in(folder) as alone:
        for path in waiting:
            left_s = end_s - time.monotonic()
            if not alone or left_s <= 0.0 or _size(path) > _AT_ONCE_BYTES:
                offered.append(path)
                continue
            try:
                with at_most(left_s):
                    done = recover(path)
            except Interrupted:
                offered.append(path)
            except FlowrecError as error:
                warn(f"left from a run that did not finish: {error}")
            except Exception as error:  # noqa: BLE001  nothing in an old file may keep a new run from beginning
                warn(f"{path}: left from a run that did not finish, and recovering it failed ({error!r})")
            else:
                made[done.path] = f"{done.ticks} ticks, {done.duration_s:.1f} s" + (
                    f"; lost: {done.lost}" if done.lost else ""
                )
                say(f"recovered {done.path} from a run that did not finish: {made[done.path]}")
    for path in offered[:_OFFERED]:
        warn(
            f"{path} ({_size(path) / 1e6:.0f} MB) is left from a run that did not finish; "
            f"flowrec recover {path} makes a session of it"
        )
    if len(offered) > _OFFERED:
        warn(f"{len(offered) - _OFFERED} more like it in {folder}; flowrec ls {folder} names them")
    return made


def _size(path: Path) -> int:
    with contextlib.suppress(OSError):
        return path.stat().st_size
    return 0


@contextmanager
def _alone_in(folder: Path) -> Iterator[bool]:
    """Whether nobody else looks after this folder just now: after a power cut several rigs begin at once."""
    try:
        descriptor = os.open(folder, os.O_RDONLY)
    except OSError:
        yield False
        return
    try:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            alone = True
        except BlockingIOError:
            alone = False
        except OSError:  # a file system without locks
            alone = True
        yield alone
    finally:
        os.close(descriptor)
