"""A new HDF5 file on a disk that may become full.

After a write that failed HDF5 tries again while it closes its objects, prints a page of errors for each, and often ends
the process by a segmentation fault. Therefore it writes through Python here: the first error is kept, what would be
written after it is dropped, and HDF5 is told that all is well until the error is raised.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import h5py


class _Disk:
    """The file as h5py wants it: a binary file that is read, written, sought and truncated."""

    def __init__(self, path: Path) -> None:
        self._file = path.open("r+b", buffering=0)
        self.error: OSError | None = None
        self.seek, self.tell, self.readinto = self._file.seek, self._file.tell, self._file.readinto
        self.close = self._file.close

    def write(self, data: Any) -> int:
        """Write all of it, or nothing after an error."""
        left = memoryview(data)
        while left.nbytes and self.error is None:
            try:
                left = left[self._file.write(left) :]
            except OSError as error:
                self.error = error
        return len(data)

    def truncate(self, size: int) -> int:
        """Set the size; nothing after an error."""
        if self.error is None:
            try:
                self._file.truncate(size)
            except OSError as error:
                self.error = error
        return size

    def flush(self) -> None:
        """Do nothing: nothing is held back."""

    def read(self, count: int = -1) -> bytes:
        """The next bytes."""
        return self._file.read(count)


class NewHdf5:
    """What `new_hdf5` yields.

    Attributes
    ----------
    file : for pynwb and others that write HDF5.
    """

    def __init__(self, file: h5py.File, disk: _Disk) -> None:
        self.file, self._disk = file, disk

    def check(self) -> None:
        """Raise the OSError that a write has met so far."""
        if self._disk.error is not None:
            raise self._disk.error


@contextmanager
def new_hdf5(path: Path) -> Iterator[NewHdf5]:
    """An HDF5 file in place of an empty file; OSError at a `check`, or at the end, if not all could be written."""
    disk = _Disk(path)
    try:
        with h5py.File(disk, "w") as file:
            made = NewHdf5(file, disk)
            yield made
        made.check()
    finally:
        disk.close()
