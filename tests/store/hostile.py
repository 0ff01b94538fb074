"""What the tests of made-up files share: a small session put together wrongly, with every checksum right."""

import struct
import zlib
from dataclasses import replace

import pytest

from flowrec.core import SessionError, printable
from flowrec.store import SLOTS, SessionReader, recover
from flowrec.store.session_path import session_path
from tests.store.drafts import small_draft, text
from tests.store.range_server import served

_CHUNK_OPCODE = 6


STATE = SLOTS["/robot/estimate"].channel
FRAMES = SLOTS["/camera/frame"].channel


def file_of(tmp_path, draft):
    path = tmp_path / "hostile.mcap"
    path.write_bytes(draft.build())
    return path


def refused(path, match):
    """Reading says so in one line, of the file and of the file at a URL, of which no more is asked for than it has."""
    with served(path.parent) as server:
        for place in (path, session_path(f"{server.url}/{path.name}")):
            _refused(place, match)
        assert sum(nbytes for _, nbytes in server.requests) <= 3 * path.stat().st_size


def _refused(path, match):
    def read():
        with SessionReader(path) as reader:
            _ = reader.header
            for _tick in reader.ticks():
                pass

    with pytest.raises(SessionError, match=match) as error:
        read()
    assert str(error.value) == printable(str(error.value)) and str(path) in str(error.value)


def with_piece(holding, change):
    """The draft with its first chunk of a channel changed."""
    pieces = list(small_draft().pieces)
    number = next(i for i, piece in enumerate(pieces) if any(sent.channel == holding for sent in piece.messages))
    pieces[number] = change(pieces[number])
    return replace(small_draft(), pieces=tuple(pieces))


def with_message(holding, change):
    """The draft with the first message of a channel changed, and packed again."""

    def changed(piece):
        first = next(sent for sent in piece.messages if sent.channel == holding)
        return replace(piece, messages=tuple(change(sent) if sent is first else sent for sent in piece.messages))

    return with_piece(holding, changed)


def with_head(opcode, body):
    """The draft with one more record in its head, before the first of its kind."""
    head = list(small_draft().head)
    head.insert(next(i for i, part in enumerate(head) if part[0] == opcode), (opcode, body))
    return replace(small_draft(), head=tuple(head))


def with_index(change):
    return replace(small_draft(), change_index=change)


def attached(name, data):
    body = struct.pack("<QQ", 0, 0) + text(name) + text("text/plain") + struct.pack("<Q", len(data)) + data
    return body + struct.pack("<I", zlib.crc32(body))


def saved(path, tmp_path):
    out = tmp_path / "saved.mcap"
    out.unlink(missing_ok=True)
    return recover(path, out)
