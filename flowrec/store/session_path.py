"""Location of a session: a path on this machine or a URL."""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING

from flowrec.core import UsageError

# A path keeps one slash of the two after the scheme; `az` is Azure, `gs` Google.
_URL = re.compile(r"(s3|gs|az|https?):/{1,2}(?=[^/])", re.IGNORECASE)
_OTHER_URL = re.compile(r"([a-z][a-z0-9+.-]+):/{1,2}(?=[^/])", re.IGNORECASE)  # of two letters or more: no drive

if TYPE_CHECKING:
    from pathlib import Path as _LocalPath
else:
    _LocalPath = type(Path())


class UrlPath(_LocalPath):
    """A URL with the names and parents of a path. No file of this machine has it, so `exists` is False."""

    def __str__(self) -> str:
        scheme, _, rest = super().__str__().replace("\\", "/").partition(":/")
        return f"{scheme.lower()}://{rest.lstrip('/')}"

    def __fspath__(self) -> str:
        return str(self)


def session_path(named: Path | str) -> Path:
    """The path, or the UrlPath where a URL is named.

    Raises UsageError: the URL holds a query, a user or a password: those may be credentials, and this name is recorded
    and printed.
    """
    text = str(named)
    found = _URL.match(text)
    if found is None:
        if (other := _OTHER_URL.match(text)) and not Path(named).parent.exists():
            raise UsageError(f"{other[1].lower()}://...: sessions are read at https, http, s3, gs and az; copy it here")
        return Path(named)
    rest = text[found.end() :]
    host = rest.partition("/")[0]
    if "?" in rest or "#" in rest or "@" in host:
        raise UsageError(
            f"{found[1].lower()}://{host.rpartition('@')[2].partition('?')[0]}/...: a URL with a query, a user or a "
            "password is not taken, because names of sessions are recorded; give credentials in the environment"
        )
    return UrlPath(f"{found[1].lower()}://{rest}")


def on_this_machine(named: Path, what: str) -> Path:
    """The path; UsageError that tells what is not done at a URL."""
    if isinstance(session_path(named), UrlPath):
        raise UsageError(f"{session_path(named)}: {what} a session at a URL; copy it to this machine")
    return named


def named_beside(session: Path, name: str) -> Path:
    """The path of an output that is named after a session: beside it, or in this folder if the session is at a URL."""
    return Path(name) if isinstance(session_path(session), UrlPath) else session.with_name(name)
