"""Sessions put together wrongly: the MCAP builder that `flowrec bench fuzz` is made with, independent of the writer.

The only import of the bench outside tests/bench.
"""

from flowrec.bench.draft import (
    ATTACHMENT,
    CHANNEL,
    CHUNK_INDEX,
    MESSAGE,
    METADATA,
    PERIOD_NS,
    SCHEMA,
    STATISTICS,
    TICKS,
    made_up,
    record,
    small_draft,
    text,
)

__all__ = [
    "ATTACHMENT",
    "CHANNEL",
    "CHUNK_INDEX",
    "MESSAGE",
    "METADATA",
    "PERIOD_NS",
    "SCHEMA",
    "STATISTICS",
    "TICKS",
    "made_up",
    "record",
    "small_draft",
    "text",
]
