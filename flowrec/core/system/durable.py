"""The two ways in which flowrec writes a file: a line is appended, or the whole file is replaced.

When a call returns, the disk has what was written, and the name of the file. When it raises, for a full disk or any
other reason, the file is as it was before. What is written for minutes, a session, has a name of its own meanwhile
(store/session_file.py) and gets its final one by `put_in_place`.
"""

from __future__ import annotations

import contextlib
import errno
import os
import sys
from collections.abc import Iterator
from pathlib import Path

from flowrec.core.system.leftovers import remove_leftovers_once, temporary_name
from flowrec.core.system.locks import is_at, take_lock

_WITHOUT_LINKS = (errno.EPERM, errno.EMLINK, errno.ENOSYS, errno.ENOTSUP, errno.EOPNOTSUPP, errno.EINVAL)


def append_line(path: Path, line: bytes) -> None:
    """Write a line behind the others; a file that is not there is made.

    Where the last line has no end, because the power failed, the new one begins on a line of its own. Several processes
    may append to one file. Raises OSError: it can not be written; the file is as it was before.
    """
    with _open_locked(path) as descriptor:
        size = os.fstat(descriptor).st_size
        os.lseek(descriptor, max(size - 1, 0), os.SEEK_SET)
        ended = not size or os.read(descriptor, 1) == b"\n"
        try:
            write_all(descriptor, (b"" if ended else b"\n") + line.rstrip(b"\n") + b"\n")
            os.fsync(descriptor)
            sync_directory(path.absolute().parent)  # each time: who made the file may have been killed before this
        except OSError:
            os.ftruncate(descriptor, size)
            if not size:
                path.unlink()
            raise


@contextlib.contextmanager
def _open_locked(path: Path) -> Iterator[int]:
    """A file for appending, made where it is not there, that no other process appends to meanwhile."""
    while True:
        descriptor = os.open(path, os.O_RDWR | os.O_APPEND | os.O_CREAT | getattr(os, "O_BINARY", 0), 0o666)
        try:
            take_lock(descriptor, from_writer=True)
            if is_at(descriptor, path):  # the process before this one may have removed the file that it made
                yield descriptor
                return
        finally:
            os.close(descriptor)


def replace_content(path: Path, data: bytes) -> None:
    """Give a file this content; one that is not there is made. OSError : it is as it was before."""
    with replacing(path) as part:
        part.write_bytes(data)


@contextlib.contextmanager
def replacing(path: Path, *, overwrite: bool = True) -> Iterator[Path]:
    """Yield a new file in the same folder; it gets the name `path` when the block ends without an exception.

    If the block ends with an exception, the new file is removed and `path` is as it was before. Files that killed
    processes have left in the folder are removed, too. `overwrite`: a file of that name may be replaced, whatever it
    holds. Raises FileExistsError: there is one, and `overwrite` is not set; OSError: it can not be written.
    """
    part = path.with_name(temporary_name(path.suffix))
    remove_leftovers_once(part.absolute().parent)
    try:
        part.touch(exist_ok=False)  # fails before any work is done if the folder can not be written to
        yield part
        sync_file(part)
        put_in_place(part, path, overwrite=overwrite)
    finally:
        part.unlink(missing_ok=True)


def write_all(descriptor: int, data: bytes) -> None:
    """Write all bytes: one call of the system may take fewer, as on a disk that becomes full."""
    left = memoryview(data)
    while left.nbytes:
        left = left[os.write(descriptor, left) :]


def put_in_place(part: Path, path: Path, *, overwrite: bool) -> None:
    """Rename a finished file to its final name in one step, and flush the name to the disk.

    Raises FileExistsError: another file has the name by now, and `overwrite` is not set; OSError: the name can not be
    given.
    """
    if overwrite:
        part.replace(path)
    else:
        try:
            os.link(part, path)
        except OSError as error:
            if error.errno not in _WITHOUT_LINKS:
                raise
            path.touch(exist_ok=False)  # keeps others from the name
            try:
                part.replace(path)
            except BaseException:
                path.unlink()
                raise
        else:
            part.unlink()
    sync_directory(path.absolute().parent)


def sync_file(path: Path) -> None:
    """Flush the content of a file to the disk."""
    with path.open("rb") as file:
        os.fsync(file.fileno())


def sync_directory(directory: Path) -> None:
    """Flush the names in a directory to the disk; Windows has no such call."""
    if sys.platform != "win32":
        descriptor = os.open(directory, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)
