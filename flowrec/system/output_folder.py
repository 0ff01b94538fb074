"""Output folders: written beside their name and renamed as a whole; only an export of flowrec is ever replaced."""

from __future__ import annotations

import contextlib
import json
import os
import shutil
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from flowrec.errors import SessionError
from flowrec.system.outputs import OutputError, sync_directory, taken

MARKER = "flowrec_export.json"


@dataclass(frozen=True, slots=True)
class OutputFolder:
    """An output folder of a verb, and what it may replace.

    An existing folder is replaced if it is an earlier output with the same `facts`; with `overwrite` if it is an output
    of flowrec at all. A folder with anything that flowrec did not write into it always stays as it is.

    Attributes
    ----------
    path : of the folder.
    facts : what it is made from; kept in its marker, a JSON file that also lists what flowrec wrote.
    suffixes : that the name must end in, the usual one first; "" allows any name.
    inputs : files that the command reads; the folder must contain none of them.
    overwrite : a folder with other facts may be replaced.
    """

    path: Path
    facts: Mapping[str, str]
    suffixes: tuple[str, ...] = ("",)
    inputs: tuple[Path, ...] = ()
    overwrite: bool = field(default=False)

    def check(self) -> None:
        """Check the output before any work is done for it.

        Raises
        ------
        OutputError : it may not be written; the text says why, and what to do.
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

        If the block ends with an exception, nothing is left and an existing folder is as before.

        Raises
        ------
        OutputError : the output is refused, see `check`.
        SessionError : it can not be written, in one line.
        """
        self.check()
        path = self.path.absolute()
        name = f".flowrec-{os.urandom(6).hex()}"
        part, old = path.with_name(name), path.with_name(name + "-old")
        try:
            part.mkdir()
            yield part
            entries = sorted(entry.name for entry in part.iterdir())
            marker = {"made_by": "flowrec export"} | dict(self.facts) | {"entries": entries}
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
        found = {entry.name for entry in path.iterdir()}
        if not found:
            return
        if marker is None:
            raise OutputError(f"{path}: is a folder that flowrec export did not make, and stays; choose another name")
        foreign = sorted(found - set(marker["entries"]) - {MARKER})
        if foreign:
            raise OutputError(
                f"{path}: holds {foreign[0]}, which flowrec export did not write; move it, or choose another name"
            )
        whole = path.resolve()
        for file in self.inputs:
            if file.resolve().is_relative_to(whole):
                raise OutputError(f"{file}: is read by this command and stays; choose another name for the output")
        if not self.overwrite and any(marker.get(key) != value for key, value in self.facts.items()):
            raise taken(path, ", an export of another session or format")


def marker_of(folder: Path) -> dict[str, Any] | None:
    """The marker of an output folder; None if flowrec did not make the folder."""
    try:
        marker = json.loads((folder / MARKER).read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return None
    entries = marker.get("entries") if isinstance(marker, dict) else None
    named = isinstance(entries, list) and all(isinstance(entry, str) for entry in entries)
    return marker if named else None


def _sync(folder: Path) -> None:
    """Flush all files of a folder to the disk."""
    for root, _, names in os.walk(folder):
        for name in names:
            with Path(root, name).open("rb") as file:
                os.fsync(file.fileno())
        sync_directory(Path(root))
