"""Corrupts a session, with wrong or with right checksums; the same seed corrupts it the same way."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import zstandard

from tests.store.drafts import (
    ATTACHMENT,
    ATTACHMENT_INDEX,
    CHANNEL,
    CHUNK_INDEX,
    MAGIC,
    METADATA,
    METADATA_INDEX,
    SCHEMA,
    STATISTICS,
    Draft,
    Piece,
    Sent,
    text,
    with_sound_index,
)

Rng = np.random.Generator
Part = tuple[int, bytes]

NUMBERS = (0, 1, 2, 9, 255, 2**16 - 1, 2**31 - 1, 2**31, 2**32 - 1, 2**40, 2**62, 2**63 - 1, 2**63, 2**64 - 1)
NAMES = (
    "../../x", "/etc/passwd", "C:\\x", "a\0b", "\x1b[2J\x1b]0;owned\x07", "<script>alert(1)</script>", "\u202eevil",
    "x" * 70_000, "", "config.toml", "chip.png", "weights/../../x", "flowrec.session", "/robot/track", "line\nline",
)  # fmt: skip
TEXTS = (
    b"\xff\xfe", b"a = [" + b"[" * 3000, b"x = " + b"9" * 5000, b'rig = "os.system"', b'[control]\nlaw = "os.system"',
    b"[mission]\nphases = 3", b'[camera]\nwidth_px = "__import__"', b"\x89PNG\r\n\x1a\n", b"", b"um_per_px = nan",
    b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR\0\0\xff\xff\0\0\xff\xff\x08\0\0\0\0\0\0\0\0",
    b"um_per_px = 1e300\n[[opening]]\nside = 'left'\nfirst = -5\nlast = 99999999999\nkind = 'inlet'\nspeed_um_s = 1.0",
)  # fmt: skip
_FLOATS = (float("nan"), float("inf"), -float("inf"), 1e308, -0.0)


def corrupt(draft: Draft, whole: bytes, seed: int) -> tuple[str, bytes]:
    """The kind of corruption and the corrupted file."""
    rng = np.random.default_rng(seed)
    kind = list(_KINDS)[int(rng.integers(len(_KINDS)))]
    return kind, _KINDS[kind](draft, whole, rng)


def blind(kind: str) -> bool:
    """Whether checksums are wrong, so that a reader must not pass an incomplete file for a complete one."""
    return kind in ("bits", "cut", "splice")


def _bits(_draft: Draft, whole: bytes, rng: Rng) -> bytes:
    """Change a few bytes, half of them in the index, where the sizes and offsets are."""
    data = bytearray(whole)
    for _ in range(rng.integers(1, 8)):
        low = len(data) - 6000 if rng.random() < 0.5 else 0
        data[int(rng.integers(low, len(data)))] = int(rng.integers(256))
    return bytes(data)


def _cut(_draft: Draft, whole: bytes, rng: Rng) -> bytes:
    """Cut off or replace the end."""
    data = whole[: int(rng.integers(len(whole)))]
    choice = rng.random()
    if choice < 0.3:
        return data + bytes(int(rng.integers(20_000)))
    return data + whole[-int(rng.integers(1, 200)) :] if choice < 0.5 else data


def _splice(_draft: Draft, whole: bytes, rng: Rng) -> bytes:
    """Remove, duplicate or overwrite a block."""
    a, b, c = (int(number) for number in rng.integers(0, len(whole), 3))
    block = whole[a : a + int(rng.integers(1, 5000))]
    choice = rng.random()
    if choice < 0.3:
        return whole[:b] + block + whole[b:]
    if choice < 0.6:
        return whole[: min(b, c)] + whole[max(b, c) :]
    return whole[:b] + block + whole[b + len(block) :]


def _lengths(_draft: Draft, whole: bytes, rng: Rng) -> bytes:
    """Change lengths of records; the checksum of the index is right."""
    data = bytearray(whole)
    heads = _heads(whole)
    for _ in range(rng.integers(1, 3)):
        at = heads[int(rng.integers(len(heads)))]
        if rng.random() < 0.7:
            struct.pack_into("<Q", data, at + 1, _number(rng, len(whole)))
        else:
            data[at] = int(rng.integers(20))
    return with_sound_index(bytes(data))


def _index(draft: Draft, _whole: bytes, rng: Rng) -> bytes:
    """Change the index so that it contradicts the file; its checksum is right."""

    def change(parts: list[Part]) -> list[Part]:
        for _ in range(rng.integers(1, 4)):
            number = int(rng.integers(len(parts)))
            opcode, body = parts[number]
            choice = rng.random()
            if choice < 0.15:
                del parts[number]
            elif choice < 0.3:
                parts.insert(int(rng.integers(len(parts))), parts[number])
            elif opcode in (CHUNK_INDEX, STATISTICS, ATTACHMENT_INDEX, METADATA_INDEX):
                spot = int(rng.integers(0, max(1, len(body) - 8)))
                spot -= spot % 8 if rng.random() < 0.6 else 0
                parts[number] = opcode, _overwritten(body, spot, _number(rng, 100_000), rng)
            else:
                parts[number] = opcode, _noise(body, rng)
        return parts

    return replace(draft, change_index=change).build()


def _inside(draft: Draft, _whole: bytes, rng: Rng) -> bytes:
    """Change messages inside chunks; all checksums are right."""
    pieces = list(draft.pieces)
    for _ in range(rng.integers(1, 4)):
        at = int(rng.integers(len(pieces)))
        messages = list(pieces[at].messages)
        if not messages:  # the only one has been taken out before
            continue
        number = int(rng.integers(len(messages)))
        messages[number : number + 1] = _changed(messages[number], messages, rng)
        pieces[at] = replace(pieces[at], messages=tuple(messages))
    if rng.random() < 0.1:
        rng.shuffle(pieces)
    return replace(draft, pieces=tuple(pieces)).build()


def _changed(sent: Sent, others: Sequence[Sent], rng: Rng) -> list[Sent]:
    choice = int(rng.integers(9))
    if choice == 0:
        return []
    if choice == 1:
        return [sent, sent]
    if choice == 2:
        return [replace(sent, log_ns=_number(rng, sent.log_ns))]
    if choice == 3:
        return [replace(sent, channel=int(rng.integers(30)))]
    if choice == 4:
        return [replace(sent, sequence=_number(rng, 100) % 2**32)]
    if choice == 5:
        return [replace(sent, payload=others[int(rng.integers(len(others)))].payload)]
    if choice == 6:
        number = struct.pack("<d", _FLOATS[int(rng.integers(len(_FLOATS)))])
        at = int(rng.integers(max(1, len(sent.payload) - 8)))
        return [replace(sent, payload=sent.payload[:at] + number + sent.payload[at + 8 :])]
    if choice == 7:
        return [replace(sent, payload=sent.payload[: int(rng.integers(len(sent.payload) + 1))])]
    return [replace(sent, payload=_noise(sent.payload, rng))]


def _chunks(draft: Draft, _whole: bytes, rng: Rng) -> bytes:
    """Change the headers of chunks: decompression bombs, sizes, times, checksums, compressions."""
    pieces = list(draft.pieces)
    at = int(rng.integers(len(pieces)))
    pieces[at] = _told(pieces[at], int(rng.integers(8)), rng)
    return replace(draft, pieces=tuple(pieces)).build()


def _told(piece: Piece, choice: int, rng: Rng) -> Piece:
    if choice == 0:
        return replace(piece, told_size=_number(rng, 10_000))
    if choice == 1:
        return replace(piece, told_crc=int(rng.integers(2**32)))
    if choice == 2:
        return replace(piece, told_times=(_number(rng, 1), _number(rng, 1)))
    if choice == 3:
        name = ("lz4", "", "zstd", "bz2", "x" * 300)[int(rng.integers(5))]
        return replace(piece, compression=name, packed=zstandard.compress(bytes(100)))
    if choice == 4:  # a bomb that is told as one, with the right checksum and without
        size = (1 << 24) + 100, 1 << 26, (1 << 28) + 1
        content = bytes(size[int(rng.integers(3))])
        crc = (zlib.crc32(content), 0, 1)[int(rng.integers(3))]
        return replace(piece, packed=zstandard.compress(content), told_size=len(content), told_crc=crc)
    if choice == 5:  # many tiny messages
        tiny = replace(piece.messages[0], payload=b"")
        return replace(piece, messages=(tiny,) * int(rng.integers(1, 3000)))
    if choice == 6:
        return replace(piece, messages=(), compression="")
    return replace(piece, compression="")


def _heads_of_session(draft: Draft, _whole: bytes, rng: Rng) -> bytes:
    """Change the metadata of the session: names, texts, images, declarations."""
    head = list(draft.head)
    for _ in range(rng.integers(1, 4)):
        number = int(rng.integers(len(head)))
        opcode, body = head[number]
        choice = int(rng.integers(5))
        name = NAMES[int(rng.integers(len(NAMES)))]
        if choice == 0:
            del head[number]
        elif choice == 1:
            head.insert(int(rng.integers(len(head))), head[number])
        elif opcode == ATTACHMENT or choice == 2:
            words = TEXTS[int(rng.integers(len(TEXTS)))]
            own = ("config.toml", "chip.png", "chip.toml", name)[int(rng.integers(4))]
            attached = struct.pack("<QQ", 0, 0) + text(own) + text(name) + struct.pack("<Q", len(words)) + words
            changed = ATTACHMENT, attached + struct.pack("<I", zlib.crc32(attached))
            head[number if opcode == ATTACHMENT else len(head) - 1] = changed
        elif opcode in (METADATA, CHANNEL, SCHEMA) and choice == 3:
            head[number] = opcode, _renamed(opcode, body, name)
        else:
            head[number] = opcode, _noise(body, rng)
    return _built(replace(draft, head=tuple(head)))


def _renamed(opcode: int, body: bytes, name: str) -> bytes:
    if opcode == METADATA:
        pairs = text(name) + text(name)
        return text("flowrec.session" if len(name) % 2 else name) + struct.pack("<I", len(pairs)) + pairs
    start = 4 if opcode == CHANNEL else 2  # numbers of channel and schema, then the name
    (size,) = struct.unpack_from("<I", body, start)
    return body[:start] + text(name) + body[start + 4 + size :]


def _built(draft: Draft) -> bytes:
    try:
        return draft.build()
    except (struct.error, IndexError, ValueError):  # too corrupt for an index: without that part
        sound = tuple(part for part in draft.head if part[0] not in (METADATA, ATTACHMENT))
        return replace(draft, head=sound).build()


def _overwritten(body: bytes, at: int, number: int, rng: Rng) -> bytes:
    form = "<Q" if rng.random() < 0.7 and len(body) - at >= 8 else "<I" if len(body) - at >= 4 else "<B"
    size = struct.calcsize(form)
    return body[:at] + struct.pack(form, number % 2 ** (8 * size)) + body[at + size :]


def _noise(body: bytes, rng: Rng) -> bytes:
    data = bytearray(body or b"\0")
    for _ in range(rng.integers(1, 6)):
        data[int(rng.integers(len(data)))] = int(rng.integers(256))
    return bytes(data)


def _number(rng: Rng, near: int) -> int:
    choice = rng.random()
    if choice < 0.6:
        return NUMBERS[int(rng.integers(len(NUMBERS)))]
    return (
        max(0, near + int(rng.integers(-20, 21)))
        if choice < 0.8
        else int(rng.integers(0, 2**63)) >> int(rng.integers(0, 60))
    )


def _heads(whole: bytes) -> list[int]:
    """Offsets of the records."""
    found, at = [], len(MAGIC)
    while at + 9 <= len(whole) - len(MAGIC):
        found.append(at)
        at += 9 + struct.unpack_from("<Q", whole, at + 1)[0]
    return found


_KINDS: dict[str, Callable[[Draft, bytes, Rng], bytes]] = {
    "bits": _bits,
    "cut": _cut,
    "splice": _splice,
    "lengths": _lengths,
    "index": _index,
    "inside": _inside,
    "chunks": _chunks,
    "head": _heads_of_session,
}
