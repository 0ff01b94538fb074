"""Output folders: written beside their name and renamed as a whole; only what flowrec wrote is replaced unasked.

The marker, a JSON file in the folder, lists every file with its hash.
"""

from __future__ import annotations

import contextlib
import json
import os
import shutil
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from flowrec.core.errors import SessionError
from flowrec.core.system.durable import sync_directory, sync_file
from flowrec.core.system.leftovers import MARKER, OLD, remove_leftovers_once, temporary_name
from flowrec.core.system.outputs import OutputError, name_taken, sha256_of

_WRITTEN = "sha256"  # of the files of a folder, by name


@dataclass(frozen=True, slots=True)
class OutputFolder:
    """An output folder of a verb, and what it may replace.

    An existing folder is replaced if it is an earlier output with the same `facts` in which nothing was changed; with
    `overwrite` if it is an output of flowrec at all. A folder with a file that flowrec did not write into it always
    stays as it is.
    """

    path: Path  # of the folder
    facts: Mapping[str, str]  # what it is made from; kept in its marker
    suffixes: tuple[str, ...] = ("",)  # that the name must end in, the usual one first; "" allows any name
    inputs: tuple[Path, ...] = ()  # files that the command reads; the folder must contain none of them
    # a folder with other facts, or with files that were changed, may be replaced
    overwrite: bool = field(default=False)

    def check(self) -> None:
        """Check the output before any work is done for it.

        Raises OutputError: it may not be written; the text says why, and what to do.
        """
        path, parent = self.path, self.path.absolute().parent
        if not path.name.endswith(self.suffixes):
            raise OutputError(
                f"{path}: the name must end in {' or '.join(self.suffixes)}, its format; "
                f"name it {path.with_name(path.name + self.suffixes[0])}"
            )
        if not parent.is_dir():
            raise OutputError(f"{path.parent}: no such directory; make it, or choose another place for {path.name}")
        if not os.access(parent, os.W_OK | os.X_OK):
            raise OutputError(f"{path.parent}: can not be written to; choose another place for {path.name}")
        if os.path.lexists(path):
            self._check_existing()

    @contextlib.contextmanager
    def new_folder(self) -> Iterator[Path]:
        """Yield a temporary empty folder beside `path`; it gets that name when the block ends without an exception.

        If the block ends with an exception, nothing is left and an existing folder is as before. Raises OutputError:
        the output is refused, see `check`; SessionError: it can not be written, in one line.
        """
        self.check()
        path = self.path.absolute()
        part = path.with_name(temporary_name())
        old = part.with_name(part.name + OLD)
        remove_leftovers_once(path.parent)
        try:
            part.mkdir()
            yield part
            written = {name: sha256_of(part / name) for name in _files_in(part)}
            entries = sorted({name.partition("/")[0] for name in written})
            marker = {
                "made_by": "flowrec export",
                **self.facts,
                "name": path.name,
                "entries": entries,
                _WRITTEN: written,
            }
            (part / MARKER).write_text(json.dumps(marker, indent=1), encoding="utf-8")
            _sync(part)
            if os.path.lexists(path):
                self._check_existing()  # again: somebody may have used the time
                path.rename(old)
            try:
                part.rename(path)
            except BaseException:
                if old.exists():
                    old.rename(path)
                raise
            sync_directory(path.parent)
        except OSError as error:
            named = Path(str(error.filename)) if error.filename is not None else path
            if not any(named.is_relative_to(place) for place in (part, path, old)):
                raise
            reason = error.strerror or str(error)
            raise SessionError(f"{self.path}: can not be written ({reason}); choose another place") from error
        finally:
            for folder in (part, old):
                shutil.rmtree(folder, ignore_errors=True)

    def _check_existing(self) -> None:
        path = self.path
        if path.is_symlink() or not path.is_dir():
            raise OutputError(f"{path}: is a file, where a folder is to be made; choose another name")
        marker = marker_of(path)
        if not any(path.iterdir()):
            return
        if marker is None:
            raise OutputError(f"{path}: is a folder that flowrec export did not make, and stays; choose another name")
        found, written = set(_files_in(path)), marker[_WRITTEN]
        if foreign := sorted(found - written.keys()):
            raise OutputError(
                f"{path}: holds {foreign[0]}, which flowrec export did not write; move it, or choose another name"
            )
        whole = path.resolve()
        for file in self.inputs:
            if file.resolve().is_relative_to(whole):
                raise OutputError(f"{file}: is read by this command and stays; choose another name for the output")
        if self.overwrite:
            return
        if any(marker.get(key) != value for key, value in self.facts.items()):
            raise name_taken(path, ", an export of another session or format")
        if changed := [name for name in sorted(found) if sha256_of(path / name) != written[name]]:
            raise name_taken(path, f", and {changed[0]} was changed since flowrec wrote it")


def marker_of(folder: Path) -> dict[str, Any] | None:
    """The marker of an output folder; None if flowrec did not make the folder."""
    try:
        marker = json.loads((folder / MARKER).read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return None
    return marker if isinstance(marker, dict) and isinstance(marker.get(_WRITTEN), dict) else None


def _files_in(folder: Path) -> list[str]:
    """The files of an output folder and of all folders in it, as `a/b`, and links to folders; without its marker."""
    found = []
    for root, folders, names in os.walk(folder):
        links = [name for name in folders if Path(root, name).is_symlink()]
        found += [Path(root, name).relative_to(folder).as_posix() for name in (*names, *links)]
    return sorted(set(found) - {MARKER})


def _sync(folder: Path) -> None:
    """Flush all files of a folder to the disk."""
    for root, _, names in os.walk(folder):
        for name in names:
            sync_file(Path(root, name))
        sync_directory(Path(root))
