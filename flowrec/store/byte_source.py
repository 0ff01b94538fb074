"""Sources of the bytes of a session. mcap_reader.py reads byte ranges from one of them."""

from __future__ import annotations

import os
import sys
import threading
import weakref
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING

from flowrec.core import Closing, SessionError, refuse_irregular, shell_word
from flowrec.store.session_path import UrlPath
from flowrec.store.traffic import MissingError

if TYPE_CHECKING:
    from flowrec.store.remote_file import RemoteFile


class LocalFile(Closing):
    """A file on this machine, whose bytes are read by range, from several threads at a time; see RemoteFile, too.

    Raises SessionError: it can not be opened.

    Attributes
    ----------
    path : its name, for messages.
    size : number of bytes when it was opened.
    is_far : a request for each range takes a round trip, so ranges next to each other are worth an effort.
    """

    is_far = False

    def __init__(self, path: Path) -> None:
        self.path = path
        if path.is_dir():
            raise SessionError(
                f"{path}: is a directory, not a session; name a .mcap file in it (`flowrec ls {shell_word(path)}`)"
            )
        try:
            refuse_irregular(path, SessionError)
            self._descriptor = os.open(path, os.O_RDONLY | getattr(os, "O_BINARY", 0))
        except FileNotFoundError as error:
            raise MissingError(
                f"{path}: no such file; `flowrec ls {shell_word(path.parent)}` shows the sessions there"
            ) from error
        except ValueError as error:  # a name with a NUL, which only another file can have given
            raise SessionError(f"{path}: is not the name of a file") from error
        except OSError as error:
            raise SessionError(f"{path}: can not be opened ({error.strerror}); check its permissions") from error
        self._closer = weakref.finalize(self, os.close, self._descriptor)
        self._seeking = threading.Lock()
        self.size = os.fstat(self._descriptor).st_size

    def read(self, offset: int, length: int) -> bytes:
        """The bytes of a range that lies within `size`; fewer where the file has become shorter.

        Raises SessionError: it can not be read, or has been closed.
        """
        if not self._closer.alive:
            raise SessionError(f"{self.path}: has been closed; open the session again")
        data = b""
        try:
            while len(data) < length:  # one call reads 2 GiB at most
                more = self._read_once(offset + len(data), length - len(data))
                if not more:
                    break
                data = data + more if data else more
        except OSError as error:
            raise SessionError(f"{self.path}: can not be read at byte {offset} ({error.strerror})") from error
        return data

    def _read_once(self, offset: int, length: int) -> bytes:
        if sys.platform != "win32":
            data = os.pread(self._descriptor, length, offset)
        else:
            with self._seeking:  # there is no pread, and all threads share the position in the file
                os.lseek(self._descriptor, offset, os.SEEK_SET)
                data = os.read(self._descriptor, length)
        return data

    def prefetch(self, ranges: Iterable[tuple[int, int]], gap_bytes: int | None = None) -> None:
        """Ranges (offset, length) that will be read soon, each once: the operating system reads ahead by itself."""

    def close(self) -> None:
        """Release it; garbage collection releases it, too."""
        self._closer()


def open_bytes(path: Path) -> LocalFile | RemoteFile:
    """The bytes that a path or URL names. Raises SessionError: they can not be opened."""
    if not isinstance(path, UrlPath):
        return LocalFile(path)
    from flowrec.store.remote_file import RemoteFile

    return RemoteFile(path)


def is_there(path: Path) -> bool:
    """True if a path or URL names a file, which is not opened if it is on this machine.

    Raises SessionError: a server does not say.
    """
    if not isinstance(path, UrlPath):
        return path.exists()
    from flowrec.store.remote_file import are_there

    return are_there([path])[0]


def size_of(path: Path) -> int:
    """Number of bytes of a file; errors as of `open_bytes`."""
    with open_bytes(path) as source:
        return source.size
