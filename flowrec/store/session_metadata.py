"""What a session file says about itself, whether or not its messages can be read: enough to list and describe it.

Light to import: no numpy, no schemas. contents.py adds what reading needs.
"""

from __future__ import annotations

import functools
from collections import Counter
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Self

from mcap.records import ChunkIndex, Statistics

from flowrec.errors import SessionError
from flowrec.store.mcap_index import Summary
from flowrec.store.mcap_reader import ForeignError, Source
from flowrec.store.metadata import (
    CONFIG_FILE,
    DIGEST,
    FORMAT_VERSION,
    OUTCOME,
    PROFILE,
    SESSION,
    SessionHeader,
    belongs,
    header_from,
    part_from,
)
from flowrec.version import __version__

_METADATA_LIMIT_BYTES = 16 << 20
_ATTACHMENTS_LIMIT_BYTES = 256 << 20
_SHOWN = 40  # characters of a version; int() refuses thousands of digits


class Head:
    """The index of a session file and what it says of the run.

    Parameters
    ----------
    path : the file.
    summary : its index where the file's own is not to be used (scan.py makes one).

    Attributes
    ----------
    source : the file.
    chunks : where the messages are.
    statistics : how many there are.
    outcome : how the run ended.
    part : which piece of a run the file is; None where the run is in one file.
    flowrec_version : of the program that wrote it.
    digest : of the content, as it was recorded (digest.py); None in files of the first release.
    channels, attachments, metadata : what else is listed.

    Raises
    ------
    SessionError : it is none, or not for this flowrec.
    """

    def __init__(self, path: Path, summary: Summary | None = None) -> None:
        self.source = Source(path)
        try:
            self._open(summary)
        except BaseException:
            self.source.close()
            raise

    def _open(self, summary: Summary | None) -> None:
        path, header = self.source.path, self.source.header
        if header.profile != PROFILE:
            raise ForeignError(
                f"{path}: is an MCAP file of another program (profile {header.profile!r}, library {header.library!r});"
                " flowrec reads what `flowrec record` has written"
            )
        self._summary = summary if summary is not None else self.source.read_summary()
        metadata = self._metadata()
        if SESSION not in metadata:
            raise ForeignError(
                f"{path}: is an MCAP file without the record {SESSION!r}, so not a session;"
                " flowrec reads what `flowrec record` has written"
            )
        self.flowrec_version = metadata[SESSION].get("flowrec_version", "?")[:_SHOWN]
        self._check_version(metadata[SESSION].get("format_version", ""))
        self.outcome = metadata.get(OUTCOME, {})
        self.digest = metadata.get(DIGEST)
        with self.source.parsing(0):
            self.part = part_from(metadata)
            for index in self._summary.attachments:
                if index.name == CONFIG_FILE:
                    self.source.start_at(index.log_time)
            if summary is None:  # what scan.py has made is on the session clock
                self._summary.set_back(self.source.start_unix_ns)
        self.chunks: list[ChunkIndex] = self._summary.chunks
        self.channels, self.attachments = self._summary.channels, self._summary.attachments
        self.metadata = self._summary.metadata
        assert self._summary.statistics is not None  # Source or Scan has seen to it
        self.statistics: Statistics = self._summary.statistics

    @property
    def counts(self) -> dict[str, int]:
        """Number of messages by topic, for the topics that have any; the views for other programs left out."""
        return self._by_topic(self.statistics.channel_message_counts)

    def counts_until(self, stamp_ns: int) -> dict[str, int]:
        """The same of messages at or before a stamp; reads the chunks that begin by then."""
        counts: Counter[int] = Counter()
        for chunk in self.chunks:
            if chunk.message_start_time <= stamp_ns:
                counts.update(record.channel for record in self.source.messages(chunk) if record.log_ns <= stamp_ns)
        return self._by_topic(counts)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.source.close()

    @functools.cached_property
    def header(self) -> SessionHeader:
        """Read when asked for: the network's weights may be large."""
        # Only what a session is made of: whatever else is attached is not even read.
        wanted = [index for index in self._summary.attachments if belongs(index.name)]
        self._bound("attachments", (index.length for index in wanted), _ATTACHMENTS_LIMIT_BYTES)
        attachments = {index.name: self.source.attachment(index) for index in wanted}
        try:
            return header_from(self._metadata(), attachments, self.source.start_unix_ns)
        except KeyError as error:
            raise self.source.damaged(0, f"the record {error} is missing") from error
        except ValueError as error:
            raise self.source.damaged(0, error) from error

    def _metadata(self) -> dict[str, dict[str, str]]:
        self._bound("metadata", (index.length for index in self._summary.metadata), _METADATA_LIMIT_BYTES)
        return {index.name: self.source.metadata(index) for index in self._summary.metadata}

    def _bound(self, what: str, lengths: Iterable[int], limit: int) -> None:
        total = sum(lengths)
        if total > limit:
            raise self.source.damaged(0, f"{total} bytes of {what}, more than {limit}")

    def _check_version(self, version: str) -> None:
        if version == str(FORMAT_VERSION):
            return
        version = version[:_SHOWN]
        what = f"{self.source.path}: is a session of format {version!r}, written by flowrec {self.flowrec_version}"
        newer = version.isdecimal() and int(version) > FORMAT_VERSION
        need = f"install flowrec {self.flowrec_version} or later" if newer else "it is damaged or was edited"
        raise SessionError(f"{what}; this is flowrec {__version__} with format {FORMAT_VERSION}: {need}")

    def _by_topic(self, counts: Mapping[int, int]) -> dict[str, int]:
        found: Counter[str] = Counter()
        for number, count in counts.items():
            channel = self.channels.get(number)
            if count and channel is not None and channel.metadata.get("role") != "view":
                found[channel.topic] += count
        return dict(found)
