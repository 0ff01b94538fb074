"""Locks (flock) that tell which process writes a file: an exclusive one from its first byte to its last.

A process that only asks takes a shared lock for some microseconds; a writer waits for that, and refuses the file of
another writer. On a file system without locks, and on a system without flock (Windows), every lock is granted: no
process can detect there that a file is being written.
"""

from __future__ import annotations

import contextlib
import errno
import os
import sys
import time
from collections.abc import Iterator
from io import FileIO
from pathlib import Path

try:
    import fcntl
except ImportError:  # Windows
    HAS_LOCKS = False
else:
    HAS_LOCKS = True

_TIMEOUT_S = 2.0  # for processes that only ask
_PAUSE_S = 1e-3
_WITHOUT_LOCKS = (errno.ENOSYS, errno.ENOTSUP, errno.EOPNOTSUPP)  # what such a file system answers


def open_new(path: Path, *, overwrite: bool = False) -> FileIO:
    """Make a file that this process alone writes; nothing is ever truncated.

    `overwrite`: remove a file of that name first, which no living process may be writing.

    Raises
    ------
    FileExistsError : the file is there, and `overwrite` is not set.
    BlockingIOError : another process writes the file of that name.
    OSError : the file can not be made, removed or locked.
    """
    while True:
        try:
            file = FileIO(path, "x+")
        except FileExistsError:
            if not overwrite:
                raise
            remove_idle(path)
            continue
        try:
            take_lock(file.fileno())
            if is_at(file.fileno(), path):
                return file
        except BlockingIOError:
            file.close()  # another process was quicker to lock the new file, and has it now
            raise
        except BaseException:
            file.close()
            path.unlink(missing_ok=True)
            raise
        file.close()  # replaced by another process before it was locked: that one has the name now


def remove_idle(path: Path) -> None:
    """Remove a file, unless a living process writes it.

    Raises BlockingIOError: a living process writes it; OSError: it can not be opened, locked or removed.
    """
    try:
        file = FileIO(path, "r+")
    except FileNotFoundError:
        path.unlink(missing_ok=True)  # a symbolic link to nothing
        return
    with file:
        take_lock(file.fileno())
        if is_at(file.fileno(), path):
            path.unlink()


@contextlib.contextmanager
def hold_file(path: Path) -> Iterator[None]:
    """Keep every other process from writing, recovering or removing a file; a file that can not be opened is not held.

    Raises BlockingIOError: another process writes or holds it.
    """
    with contextlib.ExitStack() as stack:
        try:
            file = stack.enter_context(FileIO(path, "r"))
            take_lock(file.fileno())
        except BlockingIOError:
            raise
        except OSError:
            pass  # the next reader reports why; some network file systems lock no file that is opened for reading
        yield


def is_growing(path: Path) -> bool:
    """True if a living process is writing this file."""
    try:
        with FileIO(path, "r") as file:
            return not try_lock(file.fileno(), exclusive=False)
    except OSError:
        return False


def try_lock(descriptor: int, *, exclusive: bool) -> bool:
    """Try to lock an open file or directory; False if another process has a lock that excludes this one.

    Raises OSError: the file can not be locked.
    """
    if sys.platform != "win32" and HAS_LOCKS:
        try:
            fcntl.flock(descriptor, (fcntl.LOCK_EX if exclusive else fcntl.LOCK_SH) | fcntl.LOCK_NB)
        except BlockingIOError:
            return False
        except OSError as error:
            if error.errno not in _WITHOUT_LOCKS:
                raise
    return True


def take_lock(descriptor: int, *, from_writer: bool = False) -> None:
    """Take the exclusive lock of an open file, when those have let go that hold it for moments.

    `from_writer`: whoever holds it exclusively is waited for, too. Raises BlockingIOError: another process writes the
    file, or has held the lock for two seconds.
    """
    end_s = time.monotonic() + _TIMEOUT_S
    while not try_lock(descriptor, exclusive=True):
        # Only a writer refuses a shared lock.
        refused = not from_writer and not try_lock(descriptor, exclusive=False)
        if refused or time.monotonic() > end_s:
            raise BlockingIOError(errno.EWOULDBLOCK, "another process has locked it")
        if sys.platform != "win32":
            fcntl.flock(descriptor, fcntl.LOCK_UN)
        time.sleep(_PAUSE_S)


def is_at(descriptor: int, path: Path) -> bool:
    """True if a path still names an open file."""
    try:
        return os.path.samestat(os.fstat(descriptor), path.stat())
    except FileNotFoundError:
        return False
