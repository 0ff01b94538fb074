"""Files and folders that may be trusted.

Only regular files are read: a pipe would be waited for, and a device may never end. Folders of which this process runs
the content belong to the user alone.
"""

from __future__ import annotations

import os
import stat
import sys
import tempfile
from pathlib import Path

from flowrec.core.errors import FlowrecError, UsageError

_KINDS = (
    (stat.S_ISFIFO, "a pipe"),
    (stat.S_ISCHR, "a device"),
    (stat.S_ISBLK, "a device"),
    (stat.S_ISSOCK, "a socket"),
    (stat.S_ISDIR, "a folder"),
)


def refuse_irregular(path: Path, error: type[FlowrecError] = UsageError) -> None:
    """Raise `error` before anything is read where a path, or what its link leads to, is no regular file.

    A path that does not exist, or can not be looked at, is left to whoever opens it.
    """
    try:
        mode = path.stat().st_mode
    except (OSError, ValueError):  # ValueError: a name with a NUL
        return
    kind = next((words for is_kind, words in _KINDS if is_kind(mode)), None)
    if kind is not None:
        link = f"leads to {path.resolve()}, which is" if path.is_symlink() else "is"
        raise error(f"{path}: {link} {kind}, and only files are read; save what it holds as a file and name that")


def make_own_folder(folder: Path) -> None:
    """Make a folder in which no other user can write, with its parents; it may be there already.

    Raises OSError: it can not be made, or belongs to another user, or others can write in it.
    """
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    found = folder.lstat()
    if not stat.S_ISDIR(found.st_mode) or found.st_uid != _user_id() or found.st_mode & 0o022:
        raise PermissionError(f"{folder}: is not a folder in which this user alone can write")


def own_temporary_folder() -> Path:
    """Path for temporary files that outlive a process of this user; `make_own_folder` makes it."""
    return Path(tempfile.gettempdir(), f"flowrec-{_user_id()}")


def _user_id() -> int:
    """Number of the user; 0 on Windows, where files have none."""
    number = 0
    if sys.platform != "win32":
        number = os.getuid()
    return number
