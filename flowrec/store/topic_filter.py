"""Which topics are left out of a recording, when somebody wants less of it."""

from __future__ import annotations

from collections.abc import Iterable
from fnmatch import fnmatchcase

from flowrec.declarations import Role
from flowrec.errors import UsageError
from flowrec.store.channels import FRAME_PATH
from flowrec.store.viewer_topics import MIRRORS
from flowrec.topics import TOPICS

# A replay goes on from what the stages said; without images it takes the tracks as they were recorded.
_NEEDED = {topic.path for topic in TOPICS if topic.role in (Role.INPUT, Role.OUTPUT)} - {FRAME_PATH}
_PATHS = [*(topic.path for topic in TOPICS), *(mirror.path for mirror in MIRRORS)]


def is_left_out(path: str, patterns: Iterable[str]) -> bool:
    """Whether one of the patterns stands for a topic."""
    return any(fnmatchcase(path, pattern) for pattern in patterns)


def left_out(patterns: Iterable[str]) -> frozenset[str]:
    """The topics, views for other programs among them, that names or patterns such as `/view/*` stand for.

    Raises
    ------
    UsageError : one stands for none, or for a topic without which the session could not be replayed.
    """
    chosen: set[str] = set()
    for pattern in patterns:
        found = {path for path in _PATHS if is_left_out(path, [pattern])}
        if not found:
            raise UsageError(
                f"recording.leave_out: no topic is called {pattern!r}; flowrec info lists those of a session"
            )
        if needed := sorted(found & _NEEDED):
            free = ", ".join(path for path in _PATHS if path not in _NEEDED and not path.startswith("/view/"))
            raise UsageError(
                f"recording.leave_out: a replay needs {needed[0]}; what can be left out is {free} and /view/*"
            )
        chosen |= found
    return frozenset(chosen)
