"""Ticks to MCAP and back. What is asked for is imported then: `flowrec ls` needs no schema, codec or array."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from flowrec.store.audit import digest_faults
    from flowrec.store.frame_encodings import encoding_for
    from flowrec.store.metadata import SessionHeader
    from flowrec.store.part_continuity import files_of
    from flowrec.store.paths import is_snapshot, taken
    from flowrec.store.reader import SessionReader
    from flowrec.store.recovery import Recovered, recover
    from flowrec.store.ring_buffer import Snapshot
    from flowrec.store.roi import Region, lit
    from flowrec.store.run_recovery import recover_run
    from flowrec.store.split import Split
    from flowrec.store.writer import SessionWriter

_HOME = {
    "Recovered": "recovery",
    "Region": "roi",
    "SessionHeader": "metadata",
    "SessionReader": "reader",
    "SessionWriter": "writer",
    "Snapshot": "ring_buffer",
    "Split": "split",
    "digest_faults": "audit",
    "encoding_for": "frame_encodings",
    "files_of": "part_continuity",
    "is_snapshot": "paths",
    "lit": "roi",
    "recover": "recovery",
    "recover_run": "run_recovery",
    "taken": "paths",
}

__all__ = [
    "Recovered",
    "Region",
    "SessionHeader",
    "SessionReader",
    "SessionWriter",
    "Snapshot",
    "Split",
    "digest_faults",
    "encoding_for",
    "files_of",
    "is_snapshot",
    "lit",
    "recover",
    "recover_run",
    "taken",
]


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    found = globals()[name] = getattr(importlib.import_module(f"{__name__}.{_HOME[name]}"), name)
    return found
