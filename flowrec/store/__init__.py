"""Ticks to MCAP and back. What is asked for is imported then: `flowrec ls` needs no schema, codec or array."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from flowrec.store.audit import digest_faults
    from flowrec.store.frames import encoding_for
    from flowrec.store.header import SessionHeader
    from flowrec.store.joints import files_of
    from flowrec.store.names import is_snapshot, taken
    from flowrec.store.parts import Split
    from flowrec.store.reader import SessionReader
    from flowrec.store.recovery import Recovered, recover
    from flowrec.store.region import Region, lit
    from flowrec.store.run_recovery import recover_run
    from flowrec.store.shapes import not_finite
    from flowrec.store.snapshots import Snapshot
    from flowrec.store.writer import SessionWriter

_HOME = {
    "Recovered": "recovery",
    "Region": "region",
    "SessionHeader": "header",
    "SessionReader": "reader",
    "SessionWriter": "writer",
    "Snapshot": "snapshots",
    "Split": "parts",
    "digest_faults": "audit",
    "encoding_for": "frames",
    "files_of": "joints",
    "is_snapshot": "names",
    "lit": "region",
    "not_finite": "shapes",
    "recover": "recovery",
    "recover_run": "run_recovery",
    "taken": "names",
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
    "not_finite",
    "recover",
    "recover_run",
    "taken",
]


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    found = globals()[name] = getattr(importlib.import_module(f"{__name__}.{_HOME[name]}"), name)
    return found
