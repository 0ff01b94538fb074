"""Ticks to MCAP and back. What is asked for is imported then: `flowrec ls` needs no schema, codec or array."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from flowrec.store.frames import encoding_for
    from flowrec.store.header import SessionHeader
    from flowrec.store.joints import files_of
    from flowrec.store.mcap_file import is_growing
    from flowrec.store.reader import SessionReader
    from flowrec.store.recovery import Recovered, recover
    from flowrec.store.run_recovery import recover_run
    from flowrec.store.shapes import not_finite
    from flowrec.store.writer import SessionWriter

_HOME = {
    "Recovered": "recovery",
    "SessionHeader": "header",
    "SessionReader": "reader",
    "SessionWriter": "writer",
    "encoding_for": "frames",
    "files_of": "joints",
    "is_growing": "mcap_file",
    "not_finite": "shapes",
    "recover": "recovery",
    "recover_run": "run_recovery",
}

__all__ = [
    "Recovered",
    "SessionHeader",
    "SessionReader",
    "SessionWriter",
    "encoding_for",
    "files_of",
    "is_growing",
    "not_finite",
    "recover",
    "recover_run",
]


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    found = globals()[name] = getattr(importlib.import_module(f"{__name__}.{_HOME[name]}"), name)
    return found
