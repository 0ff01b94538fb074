"""Name and metadata of a catalog's Parquet file. It imports no pyarrow, so that `flowrec find` starts quickly."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from flowrec.core import UsageError
from flowrec.store import UrlPath, session_path

NAME = "flowrec-catalog.parquet"  # in the folder that is catalogued
PARQUET = (".parquet",)
KEY = "flowrec_catalog"  # of the file's metadata: About, as JSON
FORMAT = 2  # of the columns and what they mean
# Lists of structures. Where an expression of `find` names a member, each element of the list has a row.
EVENTS, SWEEP = "events", "sweep"
RELATIONS = {EVENTS: "no event states", SWEEP: "no replay states"}
SIGNATURE = "signature"  # column of the value that differs once a session has changed
PLACE = "path_bytes"  # column that identifies a session, in bytes: a file's name need not be valid text


@dataclass(frozen=True, slots=True)
class About:
    """Metadata of a catalog."""

    # what is catalogued; folders and files relative to the folder of the catalog, where they are below it
    places: Sequence[str]
    sessions: int  # how many
    made: str  # time in UTC, ISO 8601
    flowrec: str  # version that made it
    left: int = 0  # sessions that were not read before it was interrupted
    format: int = FORMAT

    def to_json(self) -> str:
        """As text for the file."""
        return json.dumps(asdict(self))

    @classmethod
    def of(cls, text: str) -> About | None:
        """From the text of a file; None if it is of another format."""
        try:
            found: Any = json.loads(text)
            return cls(**found) if found["format"] == FORMAT else None
        except (ValueError, TypeError, KeyError, RecursionError):
            return None


def path_text(path: Path, base: Path) -> str:
    """A path as the catalog in the folder `base` states it: relative below that folder, so that both can be moved."""
    if isinstance(path, UrlPath):
        return str(path)
    text, above = path.absolute().as_posix(), base.as_posix().rstrip("/") + "/"
    return text.removeprefix(above) if path != base else "."


def path_of(text: str, base: Path) -> Path:
    """The path that the catalog in the folder `base` states so."""
    path = session_path(text)
    return path if isinstance(path, UrlPath) else base / path


def catalog_above(named: Path | None) -> Path:
    """The catalog that is named, or in the folder that is; None: the one in this folder, or the next one above.

    Raises UsageError: there is none.
    """
    if named is not None:
        path = named / NAME if named.is_dir() else named
        if not path.is_file():
            raise UsageError(f"{path}: no such catalog; flowrec catalog DIR makes one")
        return path
    here = Path().absolute()
    for folder in (here, *here.parents):
        if (folder / NAME).is_file():
            return folder / NAME
    raise UsageError(f"no {NAME} is here or above; flowrec catalog makes one of this folder, --catalog names another")
