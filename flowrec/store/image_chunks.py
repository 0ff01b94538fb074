"""The chunks of images of an unfinished file, which recovery copies as they are: no image is encoded again."""

from __future__ import annotations

import itertools
from array import array
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace

import numpy as np
from mcap.opcode import Opcode

from flowrec.declarations import shape_error
from flowrec.errors import SessionError
from flowrec.messages import Frame
from flowrec.store.channels import FRAME_PATH, SLOTS, SessionContents, bits_from, declarations
from flowrec.store.chunk import index_record
from flowrec.store.codec import decode, encode_record
from flowrec.store.digest import message_digest
from flowrec.store.frame_encodings import ENCODINGS, FrameEncoding
from flowrec.store.mcap_format import CHUNK_HEAD, LONG, MESSAGE_HEAD, RECORD_HEAD, ChannelIndex, Record, SealedChunk
from flowrec.store.mcap_reader import McapReader
from flowrec.store.scan import Scan
from flowrec.topics import Tick

_FRAMES = SLOTS[FRAME_PATH].channel
_EMPTY = np.zeros((0, 0), np.uint8)
_MESSAGE_BYTES = RECORD_HEAD.size + MESSAGE_HEAD.size  # of a record besides its payload


@dataclass(slots=True)
class ImageChunk:
    """One chunk with nothing but images.

    Attributes
    ----------
    offset, nbytes : place of the chunk's record in the file, its head included; `nbytes` is set by `copyable`.
    start_unix_ns : Unix time of stamp 0.
    stamps_ns : of the images.
    places : Unix time in ns and place in the decompressed content of each message in turn, as in a MessageIndex.
    content_bytes : of its messages, one after the other.
    digest : sum of the digests of its messages.
    """

    offset: int
    start_unix_ns: int
    stamps_ns: array[int] = field(default_factory=lambda: array("q"))
    places: array[int] = field(default_factory=lambda: array("Q"))
    content_bytes: int = 0
    digest: int = 0
    nbytes: int = 0

    def images(self) -> Iterator[tuple[int, int, bool]]:
        """Of each image the stamp of its tick, its own, and whether it is the last one."""
        count = len(self.stamps_ns)
        for number, (unix_ns, stamp_ns) in enumerate(zip(self.places[::2], self.stamps_ns, strict=True), 1):
            yield unix_ns - self.start_unix_ns, stamp_ns, number == count


class ImageChunks:
    """Finds the chunks with nothing but images while a file is scanned.

    Parameters
    ----------
    source : the file that is scanned.
    found : what has been found so far.
    """

    def __init__(self, source: McapReader, found: Scan) -> None:
        self._source, self._scan = source, found
        self._found: dict[int, ImageChunk] = {}
        self._any = False
        self._usable = True

    def visit(self, offset: int, records: list[Record]) -> None:
        """Take note of one intact chunk; its checksum has been verified, where it has one."""
        encoding = self._declared_encoding() if self._usable else None
        if encoding is None or any(record.channel != _FRAMES for record in records):
            return
        start_unix_ns = self._source.start_unix_ns
        chunk = ImageChunk(offset, start_unix_ns)
        for log_ns, _, sequence, payload in records:
            assert isinstance(payload, memoryview)
            unix_ns = log_ns + start_unix_ns
            stamp_ns = self._stamp_of(encoding, sequence, payload)
            if stamp_ns is None:
                self._usable = False
                return
            chunk.stamps_ns.append(stamp_ns)
            chunk.places.extend((unix_ns, chunk.content_bytes))
            chunk.content_bytes += _MESSAGE_BYTES + len(payload)
            chunk.digest += message_digest(sequence, unix_ns, payload)
        self._found[offset] = chunk

    def _stamp_of(self, encoding: FrameEncoding, sequence: int, payload: memoryview) -> int | None:
        """Stamp of an image; None where it can not be decoded, or this flowrec would store the first one otherwise."""
        start_unix_ns = self._source.start_unix_ns
        try:
            frame = decode(Frame, encoding.codec, payload, sequence, start_unix_ns)
            # Older files lack a field. One image tells, because all are of the same program.
            if not self._any and payload != b"".join(encode_record(frame, encoding.codec, start_unix_ns)[1]):
                return None
        except SessionError:
            return None
        self._any = True
        return None if shape_error(frame) or not -(1 << 63) <= frame.stamp_ns < 1 << 63 else frame.stamp_ns

    def copyable(self, contents: SessionContents, encoding: FrameEncoding) -> list[ImageChunk]:
        """All chunks of images in order of time, where every one can be copied into a new file; else none of them.

        That takes images in `encoding` and a channel as this flowrec declares it, a checksum on every chunk, and no
        damage before the last intact chunk.
        """
        found = self._scan
        if self._source.start_unix_ns != contents.source.start_unix_ns or not _is_declared(contents, encoding):
            return []
        if not self._usable:
            return []
        if found.lost_bytes and found.first_lost < max(each.chunk_start_offset for each in found.summary.chunks):
            return []
        chunks: list[ImageChunk] = []
        last_tick_ns, last_ns = -1, None
        for place in found.summary.chunks:
            if _FRAMES not in place.message_index_offsets:
                continue
            chunk = self._found.get(place.chunk_start_offset)
            if chunk is None or chunk.content_bytes != place.uncompressed_size:
                return []  # there is something else in it
            for tick_ns, stamp_ns, _ in chunk.images():
                if tick_ns <= last_tick_ns or stamp_ns == last_ns:  # the writer leaves out an image that is not new
                    return []
                last_tick_ns, last_ns = tick_ns, stamp_ns
            chunk.nbytes = place.chunk_length
            head = contents.source.read(chunk.offset + RECORD_HEAD.size, CHUNK_HEAD.size)
            crc, name_bytes = CHUNK_HEAD.unpack(head)[3:]
            if not crc or bool(name_bytes) != encoding.compressed_chunks:
                return []
            chunks.append(chunk)
        return chunks

    def _declared_encoding(self) -> FrameEncoding | None:
        """Of the images, as far as it has been declared and loses nothing."""
        channel = self._scan.summary.channels.get(_FRAMES)
        encoding = ENCODINGS.get(channel.metadata.get("encoding", "")) if channel is not None else None
        if channel is None or encoding is None or not encoding.lossless:
            return None
        return encoding.of(bits_from(channel.metadata))


def stored(source: McapReader, chunk: ImageChunk) -> SealedChunk:
    """A copyable chunk as it is in the file.

    Raises
    ------
    SessionError : the file can not be read.
    """
    body = source.body(chunk.offset, chunk.nbytes, Opcode.CHUNK)
    crc, name_bytes = CHUNK_HEAD.unpack_from(body)[3:]
    name_end = CHUNK_HEAD.size + name_bytes
    index = ChannelIndex(_FRAMES, len(chunk.stamps_ns), chunk.digest, index_record(_FRAMES, chunk.places))
    return SealedChunk(
        compression=str(body[CHUNK_HEAD.size : name_end], "utf-8"),
        data=body[name_end + LONG.size :],
        message_start_time=chunk.places[0],
        message_end_time=chunk.places[-2],
        uncompressed_crc=crc,
        uncompressed_size=chunk.content_bytes,
        indexes=[index],
    )


def with_images(states: Iterable[Tick], chunks: Iterable[ImageChunk]) -> Iterator[tuple[Tick, ImageChunk | None]]:
    """Ticks without images together with the images of chunks, each of which an empty one of its stamp stands for.

    Parameters
    ----------
    states : the ticks of a file in which anything but an image is new.
    chunks : all images of that file, in order of time.

    Returns
    -------
    In order of time each tick of the file, and the chunk of which it has the last image, if any.
    """
    images = ((*image, chunk) for chunk in chunks for image in chunk.images())
    waiting = next(images, None)
    latest = Tick()
    frame: Frame | None = None
    for state in itertools.chain(states, [None]):
        done = None
        while waiting is not None and (state is None or waiting[0] <= state.stamp_ns):
            tick_ns, stamp_ns, is_last, chunk = waiting
            waiting = next(images, None)
            frame, done = Frame(stamp_ns, 0, _EMPTY), chunk if is_last else None
            if state is None or tick_ns < state.stamp_ns:
                latest = replace(latest, stamp_ns=tick_ns, frame=frame)
                yield latest, done
                done = None
        if state is not None:
            latest = replace(state, frame=frame)
            yield latest, done


def _is_declared(contents: SessionContents, encoding: FrameEncoding) -> bool:
    """Whether the images' channel is the one that a new file has, so that its messages mean the same there."""
    channel = contents.channels.get(_FRAMES)
    if channel is None or contents.fields.get(_FRAMES) != "frame":
        return False
    schema = contents.schemas[channel.schema_id]
    ours = list(declarations(encoding, contents.region))
    there = {record.id: record for record in ours if isinstance(record, type(schema))}
    mine = next(each for each in ours if isinstance(each, type(channel)) and each.id == _FRAMES)
    same = there[mine.schema_id]
    return (
        list(contents.fields.values()).count("frame") == 1
        and (channel.topic, channel.message_encoding, channel.metadata)
        == (mine.topic, mine.message_encoding, mine.metadata)
        and (schema.name, schema.encoding, schema.data) == (same.name, same.encoding, same.data)
    )
