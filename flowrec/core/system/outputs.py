"""Output files of every verb: an existing file is replaced only with --overwrite, and an input file never.

A file gets its name when it is complete and on the disk. Sessions are written by store/, with the same rules. An export
is replaced without being asked for where it still is as flowrec has written it, which its hash says.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from flowrec.core.errors import SessionError
from flowrec.core.system.durable import replace_content, replacing
from flowrec.core.system.leftovers import PREFIX
from flowrec.core.system.locks import is_growing

MCAP = (".mcap",)
RRD = (".rrd",)
RBL = (".rbl",)
PICTURE = (".png",)
FIGURE = (".png", ".pdf", ".svg")
JSON = (".json",)
TOML = (".toml",)
MOVIE_FILES = (".avi", ".mp4", ".mkv", ".mov", ".tif", ".tiff", ".nd2")  # that flowrec import reads, among others
WEIGHTS = (".safetensors",)

# Hidden file of a folder: its exports that are single files. One that is a folder has a list of its own, its marker.
LIST = ".flowrec_exports.json"
_SHA256 = "sha256"


class OutputError(SessionError):
    """A file that may not be written: it exists, is an input of the command, or is named like another format."""

    exit_status = 2


@dataclass(frozen=True, slots=True)
class Output:
    """An output file of a verb, and what it may replace."""

    path: Path  # of the file
    suffixes: tuple[str, ...]  # those of its format, the usual one first
    # files that the command reads; the output must be none of them, even with `overwrite`
    inputs: tuple[Path, ...] = ()
    overwrite: bool = False  # an existing file may be replaced
    replaces: str = ""  # SHA-256 of what flowrec wrote there before; a file that still holds it may be replaced, too

    def check(self, also: Iterable[Path] = ()) -> None:
        """Check the output before any work is done for it.

        `also`: other files that this output replaces or adds to: the parts of a session, and its unfinished files.
        Raises OutputError: it may not be written; the text says why, and what to do.
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
            raise OutputError(named_otherwise(path, suffixes))
        if not path.parent.is_dir():
            there = "is a file, not a directory;" if path.parent.exists() else "no such directory; make it, or"
            raise OutputError(f"{path.parent}: {there} choose another place for {path.name}")
        for file in files:
            if file.is_file() and is_growing(file):
                raise OutputError(
                    f"{file}: is being written by another process just now; let it end or stop it with Ctrl-C, or "
                    "choose another name"
                )
        self._check_existing()
        if not os.access(path.parent, os.W_OK | os.X_OK):
            raise OutputError(f"{path.parent}: can not be written to; choose another place for {path.name}")

    @contextlib.contextmanager
    def new_file(self) -> Iterator[Path]:
        """Yield a temporary file in the same folder; it gets the name `path` when the block ends without an exception.

        If the block ends with an exception, nothing is left. Raises OutputError: the output is refused, see `check`;
        SessionError: it can not be written, in one line.
        """
        self.check()
        path = self.path
        try:
            with replacing(path, overwrite=self.overwrite or bool(self.replaces)) as part:
                yield part
                self._check_existing()  # again: somebody may have used the time
        except FileExistsError as error:
            raise name_taken(path) from error
        except OSError as error:
            named = Path(str(error.filename)) if error.filename is not None else path
            if named != path and not named.name.startswith(PREFIX):
                raise
            raise SessionError(
                f"{path}: can not be written ({error.strerror or error}); choose another place"
            ) from error

    def _check_existing(self) -> None:
        """Refuse a file that is there and may not be replaced."""
        path = self.path
        if self.overwrite or not os.path.lexists(path):
            return
        if not self.replaces:
            raise name_taken(path)
        if path.is_symlink() or sha256_of(path) != self.replaces:
            raise name_taken(path, ", and was changed since flowrec wrote it")


def named_otherwise(path: Path, suffixes: tuple[str, ...]) -> str:
    """Text of the error for a name that is not that of the format."""
    return f"{path}: the name must end in {' or '.join(suffixes)}, its format; name it {path.with_suffix(suffixes[0])}"


def name_taken(path: Path, kept: str = "") -> OutputError:
    """The error for a name that another file has."""
    return OutputError(f"{path}: exists already{kept}; choose another name, or replace it with --overwrite")


def _same(output: Path, other: Path) -> bool:
    """True if two paths name the same file."""
    if "\0" in str(other):  # only a file can have given such a name, and none can have it
        return False
    try:
        return output.samefile(other)
    except OSError:  # one of them is not there
        return output.resolve() == other.resolve()


def sha256_of(path: Path) -> str:
    """The SHA-256 of what a file holds, in hexadecimal digits; OSError if it can not be read."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def written_sha256(path: Path, facts: Mapping[str, str]) -> str:
    """The SHA-256 of the export that flowrec wrote to this path from the same facts; '' if there was none."""
    noted = _read_list(path.parent / LIST).get(path.name)
    if not isinstance(noted, dict) or any(noted.get(key) != value for key, value in facts.items()):
        return ""
    return str(noted.get(_SHA256, ""))


def is_as_written(path: Path, facts: Mapping[str, str]) -> bool:
    """True if flowrec wrote the export from these facts, and nothing in it was changed since, by its hash."""
    sha256 = written_sha256(path, facts)
    return bool(sha256) and path.is_file() and sha256_of(path) == sha256


def note_written(path: Path, facts: Mapping[str, str]) -> None:
    """Keep the hash of an export that was just written; OSError if that is not possible."""
    listed = {name: noted for name, noted in _read_list(path.parent / LIST).items() if path.with_name(name).exists()}
    listed[path.name] = {**facts, _SHA256: sha256_of(path)}
    replace_content(path.parent / LIST, json.dumps(listed, indent=1).encode())


def _read_list(path: Path) -> dict[str, Any]:
    """The list of a folder; one that is missing or damaged is empty."""
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return {}
    return {name: noted for name, noted in found.items() if Path(name).name == name} if isinstance(found, dict) else {}
