"""Every way in which a frame may travel: the same bytes come back, other programs read it, nothing explodes."""

import contextlib
import os
import shutil
import struct
import subprocess
import sys
import zlib
from dataclasses import replace
from pathlib import Path
from typing import get_args, get_type_hints

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from mcap.reader import make_reader

from flowrec.core import PIXEL_BITS, Frame, RigError, SessionError, UsageError, pixel_type
from flowrec.stages import load_config
from flowrec.stages.config import Recording
from flowrec.store import SessionReader, codec, frames_of, recover
from flowrec.store.frame_encodings import ENCODINGS, decode_image, encoding_for, row_differences
from flowrec.store.schema import foxglove_schema
from tests.conftest import HANG_S
from tests.store.made_up import ticks_of, write_session

TICKS = list(ticks_of(30, shape=(47, 63)))
LOSSLESS = [name for name, encoding in ENCODINGS.items() if encoding.lossless]


def there_and_back(frame, encoding):
    encoding = encoding.of(frame.bits)
    _, sequence, parts = codec.encode_record(frame, encoding.codec)
    return codec.decode(Frame, encoding.codec, b"".join(parts), sequence)


def record(path, frames, ticks=TICKS, **options):
    return write_session(path, ticks, frames=frames, **options)


def deeper(tick, bits):
    """A tick with grey levels that use all of a depth."""
    wide = tick.frame.image.astype(np.uint16) << (bits - 8)
    return replace(tick, frame=replace(tick.frame, image=wide | tick.frame.image >> (16 - bits), bits=bits))


@pytest.mark.parametrize("name", LOSSLESS)
def test_images_of_any_shape_and_content_come_back_bit_for_bit(name):
    @settings(max_examples=80)
    @given(st.sampled_from(PIXEL_BITS), st.data())
    def round_trip(bits, data):
        shapes = hnp.array_shapes(min_dims=2, max_dims=2, max_side=40)
        image = data.draw(hnp.arrays(pixel_type(bits), shapes, elements=st.integers(0, 2**bits - 1)))
        frame = Frame(5, 7, image, bits)
        assert there_and_back(frame, ENCODINGS[name]).same_as(frame)

    round_trip()
    rng = np.random.default_rng(0)
    for shape in ((1, 70_000), (70_000, 1), (513, 641)):  # deflate's stored blocks end at 65535 bytes
        for bits in (8, 12):
            frame = Frame(5, 7, rng.integers(0, 2**bits, shape, dtype=pixel_type(bits)), bits)
            assert there_and_back(frame, ENCODINGS[name]).same_as(frame)


@pytest.mark.parametrize(("name", "bits"), [*((name, 8) for name in LOSSLESS), ("delta", 12), ("raw", 16)])
def test_a_session_in_any_lossless_encoding_reads_and_recovers_to_the_same_images(name, bits, tmp_path):
    ticks = TICKS if bits == 8 else [deeper(tick, bits) for tick in TICKS]
    path = record(tmp_path / "s.mcap", name, ticks, bits=bits)
    (tmp_path / "cut.mcap.partial").write_bytes(path.read_bytes()[:-300])
    for found in (path, recover(tmp_path / "cut.mcap.partial").path):
        with SessionReader(found) as reader:
            assert reader.frame_bits == bits
            assert all(a.frame.same_as(b.frame) for a, b in zip(ticks, reader.ticks(), strict=True))


@pytest.mark.parametrize("name", LOSSLESS)
def test_other_programs_see_all_bits_of_a_deep_image_and_learn_its_depth(name, tmp_path):
    """By mcap, protobuf and OpenCV alone; and by Rerun's reader of MCAP."""
    ticks = [deeper(tick, 12) for tick in TICKS[:3]]
    path = record(tmp_path / "s.mcap", name, ticks, bits=12)
    with path.open("rb") as stream:
        for tick, (schema, channel, message) in zip(
            ticks, make_reader(stream).iter_messages(["/camera/frame"]), strict=True
        ):
            assert channel.metadata["bits"] == "12"
            found = foxglove_schema(schema.name.removeprefix("foxglove.")).wire.FromString(message.data)
            if schema.name == "foxglove.RawImage":
                assert (found.encoding, found.step) == ("mono16", 2 * found.width)
                image = np.frombuffer(found.data, "<u2").reshape(found.height, found.width)
            else:
                image = cv2.imdecode(np.frombuffer(found.data, np.uint8), cv2.IMREAD_UNCHANGED)
            assert np.array_equal(image, tick.frame.image)
    rerun_reads(path, tmp_path)


def test_an_image_of_another_depth_than_the_session_is_refused_in_one_line(tmp_path):
    for encoding, options, told in (("zstd", {}, "12 bit .* 8 bit"), ("jpeg", {"bits": 12}, "'jpeg' .*8 bit.* 12")):
        with pytest.raises((SessionError, UsageError), match=told):
            record(tmp_path / f"{encoding}.mcap", encoding, [deeper(TICKS[0], 12)], **options)
    with pytest.raises(UsageError, match=r"'jpeg' .*camera\.bits = 12"):
        load_config(None, ["camera.bits=12", "recording.frames=jpeg"])
    for bits, level in ((12, 4096), (10, 1024), (14, 65_535)):
        with pytest.raises(RigError, match=f"a grey level of {level} in an image of {bits} bit"):
            Frame(5, 7, np.full((2, 2), level, np.uint16), bits)
    for image, bits in ((np.zeros((2, 2), np.uint16), 8), (np.zeros((2, 2), np.uint8), 12), (np.zeros((2, 2)), 16)):
        with pytest.raises(RigError, match="it can not be kept exactly"):
            Frame(5, 7, image, bits)
    with pytest.raises(RigError, match=r"9 bit.* 8, 10, 12, 14, 16"):
        Frame(5, 7, np.zeros((2, 2), np.uint16), 9)


@pytest.mark.parametrize("name", ["raw", "png"])
def test_after_damage_the_next_chunk_that_is_not_compressed_is_found(name, tmp_path):
    path = record(tmp_path / "s.mcap", name, flush_s=0.0)
    content = bytearray(path.read_bytes())
    with SessionReader(path) as reader:
        frames = [c for c in reader.file(0).chunks if c.compression == ""]
    content[frames[1].chunk_start_offset + 5] ^= 0xFF  # its length makes no sense
    path.write_bytes(content)
    with SessionReader(recover(path).path) as reader:
        assert 0 < len(TICKS) - reader.counts["frame"] < 3 * len(TICKS) / len(frames)


def test_a_jpeg_session_says_that_it_is_not_lossless_and_recovery_adds_no_loss(tmp_path):
    path = record(tmp_path / "s.mcap", "jpeg")
    (tmp_path / "cut.mcap.partial").write_bytes(path.read_bytes()[:-300])
    first, second = SessionReader(path), SessionReader(recover(tmp_path / "cut.mcap.partial").path)
    assert "not lossless" in first.outcome["frames_encoding"]
    for tick, one, two in zip(TICKS, first.messages("frame"), second.messages("frame"), strict=True):
        assert one.same_as(two) and not one.same_as(tick.frame)
        assert np.abs(one.image.astype(int) - tick.frame.image).max() < 20


@pytest.mark.parametrize(("name", "kind"), [("delta", "png"), ("png", "png"), ("jpeg", "jpeg")])
def test_other_programs_see_an_ordinary_image_file(name, kind, tmp_path):
    path = record(tmp_path / "s.mcap", name)
    with path.open("rb") as stream:
        _, _, message = next(make_reader(stream).iter_messages(["/camera/frame"]))
    image = foxglove_schema("CompressedImage").wire.FromString(message.data)
    assert image.format == kind
    assert cv2.imdecode(np.frombuffer(image.data, np.uint8), cv2.IMREAD_GRAYSCALE).shape == (47, 63)
    if name == "delta":
        rerun_reads(path, tmp_path)


def rerun_reads(path, tmp_path):
    """Whether Rerun, where it is installed, converts a session without an error."""
    rerun = Path(sys.executable).with_name("rerun")
    if rerun.exists() or shutil.which("rerun"):
        convert = [rerun if rerun.exists() else "rerun", "mcap", "convert", path, "-o", tmp_path / "s.rrd"]
        home = os.environ | {"HOME": str(tmp_path)}  # where Rerun notes that it was started
        done = subprocess.run(convert, capture_output=True, text=True, check=False, timeout=HANG_S, env=home)
        assert done.returncode == 0 and "ERROR" not in done.stderr, done.stderr


def test_an_unpacked_png_is_a_png_by_the_book():
    """Read by a few lines that follow the standard: chunk checksums, deflate with its checksum, filter 2."""
    image = np.random.default_rng(1).integers(0, 256, (300, 301), dtype=np.uint8)
    data, at, parts = b"".join(row_differences(image)), 8, {}
    while at < len(data):
        (length,) = struct.unpack_from(">I", data, at)
        kind, body = data[at + 4 : at + 8], data[at + 8 : at + 8 + length]
        assert struct.unpack_from(">I", data, at + 8 + length)[0] == zlib.crc32(kind + body)
        parts[kind] = body
        at += 12 + length
    assert list(parts) == [b"IHDR", b"IDAT", b"IEND"]
    rows = np.frombuffer(zlib.decompress(parts[b"IDAT"]), np.uint8).reshape(300, 302)
    assert (rows[:, 0] == 2).all()
    assert np.array_equal(np.cumsum(rows[:, 1:], axis=0, dtype=np.uint8), image)


def test_an_image_file_that_claims_more_pixels_than_it_can_hold_is_refused_unread():
    png = bytearray(b"".join(row_differences(np.zeros((4, 4), np.uint8))))
    png[16:24] = struct.pack(">II", 65_535, 65_535)
    jpeg = bytearray(cv2.imencode(".jpg", np.zeros((16, 16), np.uint8))[1].tobytes())
    at = jpeg.index(b"\xff\xc0")
    jpeg[at + 5 : at + 9] = struct.pack(">HH", 65_535, 65_535)
    colour = cv2.imencode(".png", np.zeros((8, 8, 3), np.uint8))[1].tobytes()
    for data in (png, jpeg, colour, b"", b"\xff\xd8\xff", b"GIF89a", bytes(png[:20])):
        with pytest.raises(ValueError, match=r"image|PNG"):
            decode_image(bytes(data))


@settings(max_examples=60)
@given(st.data())
def test_a_damaged_image_file_is_a_session_error_or_an_image(data):
    name, bits = data.draw(st.sampled_from([("delta", 8), ("png", 8), ("jpeg", 8), ("delta", 12), ("png", 12)]))
    frames = ENCODINGS[name].of(bits).codec
    parts = codec.encode_record(Frame(5, 7, np.full((20, 30), 90, pixel_type(bits)), bits), frames).payload
    payload = bytearray(b"".join(parts))
    for _ in range(data.draw(st.integers(1, 3))):
        payload[data.draw(st.integers(0, len(payload) - 1))] = data.draw(st.integers(0, 255))
    with contextlib.suppress(SessionError):
        assert codec.decode(Frame, frames, payload, 7).image.dtype == pixel_type(bits)


def test_an_empty_image_is_refused_by_the_encodings_that_can_not_hold_it():
    with pytest.raises(SessionError, match=r"recording\.frames = zstd"):
        there_and_back(Frame(5, 7, np.zeros((0, 3), np.uint8)), ENCODINGS["delta"])


def test_the_default_is_the_smallest_that_the_rate_allows():
    assert encoding_for(640, 512, 100.0) == "delta"
    assert encoding_for(2448, 2048, 60.0) == "zstd"
    assert encoding_for(2448, 2048, 200.0) == encoding_for(2448, 2048, 60.0, bits=12) == "raw"
    config = load_config(None, ["camera.rate_hz=60.0", "camera.width_px=2448", "camera.height_px=2048"])
    assert frames_of(config) == "zstd"
    assert frames_of(replace(config, recording=replace(config.recording, frames="jpeg"))) == "jpeg"


def test_the_setting_accepts_the_names_of_the_table_and_auto():
    assert set(get_args(get_type_hints(Recording)["frames"])) == {"auto", *ENCODINGS}
