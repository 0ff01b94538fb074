"""Exceptions of flowrec. Each text is one line: what is wrong, where, and what to do next.

The command line prints these without a traceback; anything else is a defect of flowrec.
"""

import re
from collections.abc import Iterator
from contextlib import contextmanager

# C0, DEL and C1 controls, what turns the direction of writing, line separators, halves of characters.
_UNPRINTABLE = re.compile("[\x00-\x1f\x7f-\x9f\u061c\u200e\u200f\u2028-\u202e\u2066-\u2069\ud800-\udfff]")


def printable(text: str) -> str:
    """Text from a file, safe on a terminal: control characters such as ESC are replaced by their escape sequences."""
    return _UNPRINTABLE.sub(lambda found: found[0].encode("unicode_escape").decode(), text)


class FlowrecError(Exception):
    """A failure that the user can fix. Exit status 1."""

    exit_status = 1

    def __init__(self, text: str = "") -> None:
        super().__init__(printable(text))


class UsageError(FlowrecError):
    """A bad argument, option or configuration. Exit status 2."""

    exit_status = 2


class UnreachableError(FlowrecError):
    """No route leads from the start to the goal. Exit status 1, as for a run that finds this out later."""


class ChipError(UsageError):
    """A mask, opening or calibration that no flow can be computed on."""


class MovieError(UsageError):
    """A movie, the times of its images or a log of the coils that can not be read or used."""


class FlowError(FlowrecError):
    """The flow solver has no answer."""


class NotFiniteError(FlowrecError):
    """A message, or what it is made from, would hold NaN or infinity where its declaration excludes them."""


class RigError(FlowrecError):
    """Camera, amplifier or simulated rig refused to work."""


class SessionError(FlowrecError):
    """A session file can not be read or written."""


@contextmanager
def needs(what: str, extra: str, package: str = "") -> Iterator[None]:
    """Import packages of an extra. Raises UsageError: one is not installed; it says what needs it, and the command."""
    try:
        yield
    except ModuleNotFoundError as error:
        missing = package or error.name
        raise UsageError(f"{what} needs {missing}, which is not installed: pip install 'flowrec[{extra}]'") from error
