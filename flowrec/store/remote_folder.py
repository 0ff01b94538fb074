"""Folders and patterns at a URL: the objects of a bucket that they name. Nothing lists the files of an http server."""

from __future__ import annotations

import fnmatch
import glob
from collections.abc import Sequence
from pathlib import Path

from flowrec.core import SessionError
from flowrec.store.object_requests import ListedObject, listing
from flowrec.store.session_path import UrlPath
from flowrec.store.traffic import MissingError, ask_repeatedly

_WEB = ("http://", "https://")


def is_listed(url: Path) -> bool:
    """True if the folders of this server can be listed."""
    return not str(url).startswith(_WEB)


def objects_in(folder: UrlPath, begin: str = "") -> list[tuple[UrlPath, ListedObject]]:
    """The objects of a folder in a bucket, in order of name, and what the listing says of each.

    Parameters
    ----------
    begin : only those whose names begin so.

    Raises
    ------
    SessionError : the folder can not be listed; MissingError if there is no such bucket, or access is refused.
    """
    if not is_listed(folder):
        raise SessionError(f"{folder}: a server of http does not list its files; name the sessions one by one")
    found = ask_repeatedly(folder, lambda limit_s: listing(str(folder), begin, limit_s))
    return [(folder / each.name, each) for each in found]


def files_at(place: UrlPath, suffixes: Sequence[str]) -> list[Path]:
    """The files that a URL names: of a folder, or of a pattern such as `s3://lab/runs/*.mcap`; else itself.

    Parameters
    ----------
    suffixes : of the files that are wanted; a URL that ends so is no folder.

    Raises
    ------
    SessionError : the folder can not be listed, holds nothing, or a pattern is not in the last part of the URL.
    """
    if glob.has_magic(str(place.parent)):
        raise SessionError(f"{place}: a pattern at a URL stands after its last slash, as in s3://lab/runs/*.mcap")
    pattern = place.name if glob.has_magic(place.name) else ""
    if not pattern and place.name.endswith(tuple(suffixes)):
        return [place]
    folder = place.parent if pattern else place
    assert isinstance(folder, UrlPath)
    found = [path for path, _ in objects_in(folder, pattern.partition("*")[0] if "[" not in pattern else "")]
    if not found:
        raise MissingError(f"{place}: no file is there; check the name, or name a folder in it")
    return [
        path
        for path in found
        if path.name.endswith(tuple(suffixes)) and (not pattern or fnmatch.fnmatchcase(path.name, pattern))
    ]
