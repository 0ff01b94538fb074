"""datapackage.json: what the tables of an exported folder hold, by the Data Package standard.

Each column has its name, type, unit and meaning; they come from the metadata of the Arrow schema, so from the
declarations of the messages. https://datapackage.org/standard/data-package/
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pyarrow as pa

from flowrec.core import __version__
from flowrec.store import Session

FILE = "datapackage.json"
_TYPES = (
    (pa.types.is_boolean, "boolean"),
    (pa.types.is_integer, "integer"),
    (pa.types.is_floating, "number"),
    (pa.types.is_timestamp, "datetime"),
    (pa.types.is_string, "string"),
)
_MARKED = (
    " A text that begins with = + - @, a tab, a return or an apostrophe has one more apostrophe before it, so that no "
    "spreadsheet runs it."
)
_MEDIA_TYPES = {".parquet": "application/vnd.apache.parquet", ".csv": "text/csv"}


def write_datapackage(folder: Path, session: Session, tables: Mapping[str, tuple[pa.Schema, str]]) -> None:
    """Write the description of a folder of tables, and beside it the settings and the chip of the session.

    Parameters
    ----------
    tables : schema and description of each file, by its name in the folder.
    """
    header = session.header
    (folder / "config.toml").write_text(header.config_toml, encoding="utf-8")
    (folder / "chip.toml").write_text(header.chip_toml, encoding="utf-8")
    (folder / "chip.png").write_bytes(header.chip_png)
    resources: list[dict[str, Any]] = [_resource(name, *about) for name, about in tables.items()]
    resources += [
        {"name": "config", "path": "config.toml", "description": "settings of the run"},
        {"name": "chip", "path": "chip.png", "description": "mask of the chip: white is fluid"},
        {"name": "chip_openings", "path": "chip.toml", "description": "scale, openings and fluid of the chip"},
    ]
    package = {
        "$schema": "https://datapackage.org/profiles/2.0/datapackage.json",
        "name": re.sub(r"[^a-z0-9._-]", "_", session.path.stem.lower()) or "session",
        "title": f"flowrec session {session.path.name}",
        "description": (
            "Chip frame: origin at the centre of the mask's pixel (0, 0), x right, y down. stamp_ns and time_s are "
            "times on the session clock."
        )
        + (_MARKED if any(name.endswith(".csv") for name in tables) else ""),
        "sources": [{"title": session.path.name, "path": session.path.name}],
        "provenance": dict(session.provenance),
        "outcome": dict(session.outcome),
        "exported_by": f"flowrec {__version__}",
        "resources": resources,
    }
    (folder / FILE).write_text(json.dumps(package, indent=1), encoding="utf-8")


def _resource(name: str, schema: pa.Schema, description: str) -> dict[str, Any]:
    path = Path(name)
    return {
        "name": path.stem,
        "path": name,
        "format": path.suffix[1:],
        "mediatype": _MEDIA_TYPES[path.suffix],
        "description": description,
        "schema": {"fields": [_field(each) for each in schema]},
    }


def _field(field: pa.Field) -> dict[str, str]:
    kind = next((name for is_kind, name in _TYPES if is_kind(field.type)), "array")
    metadata = field.metadata or {}
    found = {"name": field.name, "type": kind}
    found |= {"unit": metadata[b"unit"].decode()} if metadata.get(b"unit") else {}
    return found | {"description": metadata.get(b"meaning", b"").decode()}
