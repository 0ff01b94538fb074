"""Hashes of the files that flowrec has written into a folder: only those are replaced without being asked for.

A hidden file of the folder lists the exports that are single files. An export that is a folder has a list of its own
(output_folder.py).
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from flowrec.core.system.durable import replace_content

LIST = ".flowrec_exports.json"
_SHA256 = "sha256"


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
