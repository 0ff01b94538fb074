"""Ticks to MCAP and back. Names are imported on demand: `flowrec ls` needs no schema, codec or array."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from flowrec.store.audit import digest_faults
    from flowrec.store.frame_encodings import encoding_for
    from flowrec.store.part_continuity import files_of
    from flowrec.store.paths import is_snapshot, runs_in
    from flowrec.store.reader import SessionReader
    from flowrec.store.recovery import Recovered, recover, recover_run
    from flowrec.store.roi import Region, nonzero_window
    from flowrec.store.session_file import Snapshot, Split, WriterOptions
    from flowrec.store.session_metadata import SessionHeader
    from flowrec.store.writer import SessionWriter

_MODULES = {
    "Recovered": "recovery",
    "Region": "roi",
    "SessionHeader": "session_metadata",
    "SessionReader": "reader",
    "SessionWriter": "writer",
    "Snapshot": "session_file",
    "Split": "session_file",
    "WriterOptions": "session_file",
    "digest_faults": "audit",
    "encoding_for": "frame_encodings",
    "files_of": "part_continuity",
    "is_snapshot": "paths",
    "nonzero_window": "roi",
    "recover": "recovery",
    "recover_run": "recovery",
    "runs_in": "paths",
}

__all__ = [
    "Recovered",
    "Region",
    "SessionHeader",
    "SessionReader",
    "SessionWriter",
    "Snapshot",
    "Split",
    "WriterOptions",
    "digest_faults",
    "encoding_for",
    "files_of",
    "is_snapshot",
    "nonzero_window",
    "recover",
    "recover_run",
    "runs_in",
]


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    found = globals()[name] = getattr(importlib.import_module(f"{__name__}.{_MODULES[name]}"), name)
    return found
