from flowrec.store.audit import Audit, audit
from flowrec.store.frames import encoding_for
from flowrec.store.header import SessionHeader
from flowrec.store.mcap_file import is_growing
from flowrec.store.reader import SessionReader
from flowrec.store.recovery import Recovered, recover
from flowrec.store.region import Region, lit
from flowrec.store.shapes import not_finite
from flowrec.store.writer import SessionWriter

__all__ = [
    "Audit",
    "Recovered",
    "Region",
    "SessionHeader",
    "SessionReader",
    "SessionWriter",
    "audit",
    "encoding_for",
    "is_growing",
    "lit",
    "not_finite",
    "recover",
]
