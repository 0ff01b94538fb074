"""Output files of every verb: an existing file is replaced only with --overwrite, and an input file never.

A file gets its name when it is complete and on the disk. Sessions are written by store/, with the same rules.
"""

from __future__ import annotations

import contextlib
import errno
import os
import sys
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

from flowrec.errors import SessionError
from flowrec.system.locks import is_growing

MCAP = (".mcap",)
RRD = (".rrd",)
RBL = (".rbl",)
PICTURE = (".png",)
FIGURE = (".png", ".pdf", ".svg")
JSON = (".json",)
TOML = (".toml",)
WEIGHTS = (".safetensors",)

_WITHOUT_LINKS = (errno.EPERM, errno.EMLINK, errno.ENOSYS, errno.ENOTSUP, errno.EOPNOTSUPP, errno.EINVAL)


class OutputError(SessionError):
    """A file that may not be written: it exists, is an input of the command, or is named like another format."""

    exit_status = 2


@dataclass(frozen=True, slots=True)
class Output:
    """An output file of a verb, and what it may replace.

    Attributes
    ----------
    path : of the file.
    suffixes : those of its format, the usual one first.
    inputs : files that the command reads; the output must be none of them, even with `overwrite`.
    overwrite : an existing file may be replaced.
    """

    path: Path
    suffixes: tuple[str, ...]
    inputs: tuple[Path, ...] = ()
    overwrite: bool = False

    def check(self, also: Iterable[Path] = ()) -> None:
        """Check the output before any work is done for it.

        Parameters
        ----------
        also : other files that this output replaces or adds to: the parts of a session, and its unfinished files.

        Raises
        ------
        OutputError : it may not be written; the text says why, and what to do.
        """
        path, suffixes, files = self.path, self.suffixes, (self.path, *also)
        if path.is_dir():
            raise OutputError(f"{path}: is a directory; name a file, as in {path / ('NAME' + suffixes[0])}")
        for file in files:
            if any(_same(file, other) for other in self.inputs):
                raise OutputError(
                    f"{file}: is read by this command and stays as it is; choose another name for the output"
                )
        if path.suffix not in suffixes:
            formats = " or ".join(suffixes)
            raise OutputError(
                f"{path}: the name must end in {formats}, its format; name it {path.with_suffix(suffixes[0])}"
            )
        if not path.parent.is_dir():
            raise OutputError(f"{path.parent}: no such directory; make it, or choose another place for {path.name}")
        for file in files:
            if file.is_file() and is_growing(file):
                raise OutputError(
                    f"{file}: is being written by another process just now; let it end or stop it with Ctrl-C, or "
                    "choose another name"
                )
        if not self.overwrite and os.path.lexists(path):
            raise taken(path)
        if not os.access(path.parent, os.W_OK | os.X_OK):
            raise OutputError(f"{path.parent}: can not be written to; choose another place for {path.name}")

    @contextlib.contextmanager
    def new_file(self) -> Iterator[Path]:
        """Yield a temporary file in the same folder; it gets the name `path` when the block ends without an exception.

        If the block ends with an exception, nothing is left.

        Raises
        ------
        OutputError : the output is refused, see `check`.
        SessionError : it can not be written, in one line.
        """
        self.check()
        path = self.path
        part = path.with_name(f".flowrec-{os.urandom(6).hex()}{path.suffix}")
        try:
            part.touch(exist_ok=False)  # fails before any work is done if the folder can not be written to
            yield part
            with part.open("rb") as file:
                os.fsync(file.fileno())
            put_in_place(part, path, overwrite=self.overwrite)
        except FileExistsError as error:
            raise taken(path) from error
        except OSError as error:
            if error.filename not in (None, str(part), str(path)):
                raise
            raise SessionError(
                f"{path}: can not be written ({error.strerror or error}); choose another place"
            ) from error
        finally:
            part.unlink(missing_ok=True)


def taken(path: Path, kept: str = "") -> OutputError:
    """The error for a name that another file has."""
    return OutputError(f"{path}: exists already{kept}; choose another name, or replace it with --overwrite")


def put_in_place(part: Path, path: Path, *, overwrite: bool) -> None:
    """Rename a finished file to its final name in one step, and flush the name to the disk.

    Raises
    ------
    FileExistsError : another file has the name by now, and `overwrite` is not set.
    OSError : the name can not be given.
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
    sync_directory(path.parent)


def sync_directory(directory: Path) -> None:
    """Flush the names in a directory to the disk; Windows has no such call."""
    if sys.platform != "win32":
        descriptor = os.open(directory, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)


def _same(output: Path, other: Path) -> bool:
    """Whether two paths name the same file."""
    if "\0" in str(other):  # only a file can have given such a name, and none can have it
        return False
    try:
        return output.samefile(other)
    except OSError:  # one of them is not there
        return output.resolve() == other.resolve()
