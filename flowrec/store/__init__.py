from flowrec.store.header import SessionHeader
from flowrec.store.reader import SessionReader
from flowrec.store.writer import SessionWriter

__all__ = ["SessionHeader", "SessionReader", "SessionWriter"]
