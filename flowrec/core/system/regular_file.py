"""Only regular files are read: a pipe would be waited for, and a device may never end."""

from __future__ import annotations

import stat
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
