"""Scan of a catalog's places: sessions with all their files, and the fingerprints that show whether they have changed.

Folders are searched with all folders below them. Hidden folders are left out: file servers keep old versions there.
Nothing is opened, so ten thousand files take a fraction of a second. A folder in a bucket is listed without those below
it, a thousand objects a request.
"""

from __future__ import annotations

import fnmatch
import glob
import hashlib
import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from flowrec.archive.catalog.format import PARQUET
from flowrec.core import SessionError, UsageError
from flowrec.store import NOTES_SUFFIX as NOTES
from flowrec.store import UrlPath, run_files, run_path, session_path
from flowrec.verbs import NAMES, runs_of


@dataclass(frozen=True, slots=True)
class Found:
    """A session, or a run with all its parts."""

    path: Path
    files: Sequence[Path]  # its own, as `verbs.ls.runs_of` returns them
    signature: str  # text that changes where size or time, at a URL the version, of a file or of its notes does


def contents_of(places: Iterable[Path], without: Path) -> tuple[list[Found], list[Path]]:
    """List the sessions in folders, and those that are named, in order of name; and tables that may be of sweeps.

    `without`: the catalog itself. Raises SessionError: a place is not there, or can not be listed; UsageError: a place
    is neither a folder nor a session.
    """
    marks: dict[Path, str] = {}
    for place in places:
        marks.update(_file_versions(session_path(place)))
    tables = [path for path in marks if path.name.endswith(PARQUET) and path != without]
    noted = any(path.name.endswith(NOTES) for path in marks)
    found = []
    for path, files in runs_of(path for path in marks if path.name.endswith(NAMES)).items():
        marked = [f"{file.name} {marks[file]}" for file in files]
        if noted and (notes := path.with_name(path.name + NOTES)) in marks:
            marked.append(marks[notes])
        signature = hashlib.sha256("\n".join(marked).encode(errors="surrogateescape")).hexdigest()[:32]
        found.append(Found(path, files, signature))
    return found, sorted(tables)


def _file_versions(place: Path) -> Mapping[Path, str]:
    """Size and time, or version, of the files of a place: sessions, notes and tables."""
    if isinstance(place, UrlPath):
        return _versions(place)
    place = place.absolute()
    if place.is_dir():
        return {Path(entry.path): _mark(entry.stat()) for entry in _entries(str(place))}
    files = [place] if place.is_file() else run_files(place)
    if not files:
        raise SessionError(f"{place}: no such directory or session; flowrec catalog takes directories and sessions")
    if not all(_is_wanted(file.name) for file in files):
        raise UsageError(f"{place}: is no session and no table of flowrec sweep; name .mcap files and directories")
    notes = [file for file in (place.with_name(place.name + NOTES),) if file.is_file()]
    return {file: _mark(file.stat()) for file in (*files, *notes)}


def _versions(place: UrlPath) -> Mapping[Path, str]:
    """Size and version of what a URL names: a folder in a bucket without those below it, a pattern, or a session."""
    from flowrec.store import RemoteFile, is_listed, objects_in

    if not is_listed(place):
        with RemoteFile(place) as file:
            return {place: f"{file.size} {file.version}"}
    pattern = place.name if glob.has_magic(place.name) else ""
    single = not pattern and place.name.endswith((*NAMES, *PARQUET))
    folder = place.parent if pattern or single else place
    assert isinstance(folder, UrlPath)
    found: dict[Path, str] = {}
    for path, listed in objects_in(folder, place.stem if single else ""):
        session = path.name.removesuffix(NOTES)
        named = not single or path.with_name(session) == place or run_path(path) == place
        if _is_wanted(path.name) and named and (not pattern or fnmatch.fnmatchcase(session, pattern)):
            found[path] = f"{listed.size} {listed.version}"
    if single and not found:
        raise SessionError(f"{place}: is not there (404); check the name")
    return found


def _entries(folder: str) -> Iterator[os.DirEntry[str]]:
    """The files of a folder and of all below it; a link to a folder is not followed, it may lead in a circle."""
    try:
        with os.scandir(folder) as listing:
            entries = list(listing)
    except OSError as error:
        raise SessionError(f"{folder}: can not be listed ({error.strerror}); check its permissions") from error
    for entry in entries:
        if entry.name.startswith("."):
            continue
        if entry.is_dir(follow_symlinks=False):
            yield from _entries(entry.path)
        elif _is_wanted(entry.name) and entry.is_file():
            yield entry


def _is_wanted(name: str) -> bool:
    return name.endswith((*NAMES, NOTES, *PARQUET))


def _mark(stat: os.stat_result) -> str:
    return f"{stat.st_size} {stat.st_mtime_ns}"
