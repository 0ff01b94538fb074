from flowrec.store.audit import Audit, audit
from flowrec.store.frames import encoding_for
from flowrec.store.header import SessionHeader
from flowrec.store.joints import files_of
from flowrec.store.mcap_file import is_growing
from flowrec.store.reader import SessionReader
from flowrec.store.recovery import Recovered, recover
from flowrec.store.run_recovery import recover_run
from flowrec.store.shapes import not_finite
from flowrec.store.writer import SessionWriter

__all__ = [
    "Audit",
    "Recovered",
    "SessionHeader",
    "SessionReader",
    "SessionWriter",
    "audit",
    "encoding_for",
    "files_of",
    "is_growing",
    "not_finite",
    "recover",
    "recover_run",
]
