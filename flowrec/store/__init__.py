from flowrec.store.audit import Audit, audit
from flowrec.store.frames import encoding_for
from flowrec.store.header import SessionHeader
from flowrec.store.mcap_file import is_growing
from flowrec.store.names import is_snapshot, taken
from flowrec.store.parts import Split
from flowrec.store.reader import SessionReader
from flowrec.store.recovery import Recovered, recover
from flowrec.store.shapes import not_finite
from flowrec.store.snapshots import Snapshot
from flowrec.store.writer import SessionWriter

__all__ = [
    "Audit",
    "Recovered",
    "SessionHeader",
    "SessionReader",
    "SessionWriter",
    "Snapshot",
    "Split",
    "audit",
    "encoding_for",
    "is_growing",
    "is_snapshot",
    "not_finite",
    "recover",
    "taken",
]
