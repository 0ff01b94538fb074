"""Movies of other people's encoders: grey levels, times and depth come out as they went in, or the movie is refused."""

import json
import struct
import sys
import zlib
from dataclasses import fields, replace

import av
import cv2
import numpy as np
import pytest
import tifffile
import zstandard

from flowrec.core import MovieError
from flowrec.movies import MovieNotes, ReadOptions, ome, open_movie
from flowrec.movies.notes import notes_in
from flowrec.rigs import MovieRig, MovieSource, fitted_to_movie
from flowrec.stages import Coils, load_config
from flowrec.stages.config import MovieSettings
from tests.extras import needs
from tests.movies import makers

COUNT, HEIGHT, WIDTH = 12, 48, 64
TIMES_MS = [0, 30, 65, 100, 101, 150, 200, 230, 260, 300, 333, 400]


def pictures(bits=8, count=COUNT):
    """Noise on a slope, over the whole range of levels."""
    rng, top = np.random.default_rng(3), 2**bits - 1
    slope = np.linspace(0, top, WIDTH)[None, :] * np.ones((HEIGHT, 1))
    dtype = np.uint8 if bits == 8 else np.uint16
    return [np.clip(slope + rng.normal(0, top / 20, slope.shape), 0, top).astype(dtype) for _ in range(count)]


def read(path, **options):
    with open_movie(path, options=ReadOptions(**options)) as movie:
        frames = list(movie.frames())
        return movie.facts, frames, movie.remarks


LOSSLESS = {
    "png folder": (8, lambda d, images: makers.folder(d / "pngs", images)),
    "16-bit tif folder": (16, lambda d, images: makers.folder(d / "tifs", images, "a{}.tif")),
    "12-bit ome-tiff": (12, lambda d, images: makers.ome_tiff(d / "a.ome.tif", images, bits=12)),
    "big-endian tiff": (
        16,
        lambda d, images: tifffile.imwrite(d / "b.tif", np.stack(images), byteorder=">") or d / "b.tif",
    ),
    "imagej": (16, lambda d, images: tifffile.imwrite(d / "i.tif", np.stack(images), imagej=True) or d / "i.tif"),
    "lzw pages": (
        8,
        lambda d, images: tifffile.imwrite(d / "l.tif", np.stack(images), compression="lzw") or d / "l.tif",
    ),
    "ffv1": (8, lambda d, images: makers.video(d / "a.mkv", "ffv1", images)),
    "12-bit ffv1": (12, lambda d, images: makers.video(d / "a12.mkv", "ffv1_12", images)),
    "raw avi": (8, lambda d, images: makers.video(d / "a.avi", "raw", images)),
    "luma of h264": (8, lambda d, images: makers.video(d / "a.mp4", "h264_lossless", images)),
    "nd2": (12, lambda d, images: makers.nd2(d / "a.nd2", images, np.arange(COUNT) / 30)),
    "ome-zarr 0.5": (16, lambda d, images: makers.ome_zarr(d / "a.zarr", images, 0.05)),
    "ome-zarr 0.4": (8, lambda d, images: makers.ome_zarr(d / "b.zarr", images, 0.05, "0.4", "tyx", 5)),
}


def with_nd2(kinds):
    """Parameters of a test; that of ND2 needs its package."""
    return [pytest.param(kind, marks=needs("nd2")) if kind == "nd2" else kind for kind in kinds]


@pytest.mark.parametrize("kind", with_nd2(LOSSLESS))
def test_grey_levels_come_out_as_they_went_in(kind, tmp_path):
    bits, make = LOSSLESS[kind]
    images = pictures(bits)
    facts, frames, _ = read(make(tmp_path, images))
    assert (facts.width_px, facts.height_px, facts.bits) == (WIDTH, HEIGHT, bits)
    assert facts.frames == len(frames) == COUNT
    for frame, image in zip(frames, images, strict=True):
        np.testing.assert_array_equal(frame.image, image)
        assert frame.image.dtype == image.dtype
    with open_movie(make_again := tmp_path / next(tmp_path.iterdir())) as movie:  # one image alone, in any order
        for index in (7, 0, 11):
            np.testing.assert_array_equal(movie.image(index), images[index], err_msg=str(make_again))
        assert movie.median_image().shape == (HEIGHT, WIDTH)


TIMED = {
    "mkv": lambda d, images: makers.video(d / "v.mkv", "ffv1", images, times_ms=TIMES_MS),
    "mp4": lambda d, images: makers.video(d / "v.mp4", "h264", images, times_ms=TIMES_MS),
    "ome.tif": lambda d, images: makers.ome_tiff(d / "v.ome.tif", images, np.array(TIMES_MS) / 1e3),
    "nd2": lambda d, images: makers.nd2(d / "v.nd2", images, np.array(TIMES_MS) / 1e3, 8),
}


@pytest.mark.parametrize("kind", with_nd2(TIMED))
def test_times_are_those_of_the_file_where_it_has_them(kind, tmp_path):
    times_ns = np.array(TIMES_MS) * 1_000_000
    facts, frames, _ = read(TIMED[kind](tmp_path, pictures()))
    assert [frame.time_ns for frame in frames] == times_ns.tolist() == facts.times_ns.tolist()
    assert "nominal" not in facts.times


def test_a_rate_that_no_clock_has_measured_is_called_nominal(tmp_path):
    images = pictures()
    rates = {
        makers.video(tmp_path / "r.avi", "xvid", images, 25.0): 40.0,
        makers.ome_zarr(tmp_path / "r.zarr", images, 0.05): 50.0,
    }
    tifffile.imwrite(tmp_path / "r.tif", np.stack(images), imagej=True, metadata={"axes": "TYX", "finterval": 0.025})
    for path, step_ms in (rates | {tmp_path / "r.tif": 25.0}).items():
        facts, frames, _ = read(path)
        assert "nominal" in facts.times
        np.testing.assert_allclose(np.diff([frame.time_ns for frame in frames]) / 1e6, step_ms, rtol=1e-6)
    for path in (makers.folder(tmp_path / "pngs", images), makers.ome_zarr(tmp_path / "n.zarr", images, None)):
        facts, frames, _ = read(path)
        assert facts.times == "" and frames[3].time_ns is None


def cut(path, share):
    data = path.read_bytes()
    short = path.with_name("cut_" + path.name)
    head = 6144 if path.suffix == ".avi" else 0
    short.write_bytes(data[: head + int(share * (len(data) - head))])
    return short


def test_a_movie_that_breaks_off_is_refused_and_its_whole_images_can_be_asked_for(tmp_path):
    images = pictures()
    stack = tifffile.TiffWriter(tmp_path / "t.tif", imagej=True)
    stack.write(np.stack(images), contiguous=True)
    stack.close()
    for path in (
        makers.video(tmp_path / "a.avi", "mjpeg", images),
        makers.video(tmp_path / "x.avi", "xvid", images),
        makers.video(tmp_path / "a.mkv", "ffv1", images),
    ):
        whole = [frame.image for frame in read(path)[1]]
        with pytest.raises(MovieError, match=r" 12 images, \d .*--partial"):
            read(cut(path, 0.6))
        _, frames, remarks = read(cut(path, 0.6), partial=True)
        assert 1 <= len(frames) <= 8 and f"only the first {len(frames)} images" in remarks[-1]
        for frame, image in zip(frames, whole, strict=False):
            np.testing.assert_array_equal(frame.image, image)
    for path in (makers.video(tmp_path / "a.mp4", "h264", images), tmp_path / "t.tif"):  # their index is at the end
        with pytest.raises(MovieError, match=str(tmp_path)):
            read(cut(path, 0.6))


def test_a_damaged_slice_of_ffv1_is_refused_and_the_images_before_it_are_whole(tmp_path):
    """Its decoder puts the image before in the place of the damaged one."""
    images = pictures()
    path = makers.video(tmp_path / "film.mkv", "ffv1", images)
    data = bytearray(path.read_bytes())
    data[len(data) * 2 // 3] ^= 0xFF
    path.write_bytes(data)
    with pytest.raises(MovieError, match=r"image \d+ .*--partial .* \d+ images"):
        read(path)
    _, frames, remarks = read(path, partial=True)
    assert 4 <= len(frames) < COUNT and len(remarks) == 1
    np.testing.assert_array_equal([frame.image for frame in frames], images[: len(frames)])


def test_colour_is_refused_unless_it_is_said_what_to_take_of_it(tmp_path):
    colours = np.random.default_rng(1).integers(0, 255, (3, HEIGHT, WIDTH, 3)).astype(np.uint8)
    tifffile.imwrite(tmp_path / "c.tif", colours, photometric="rgb")
    makers.folder(tmp_path / "c", [image[..., ::-1] for image in colours])
    with av.open(str(tmp_path / "c.mov"), "w") as container:
        stream = container.add_stream("qtrle", rate=30)
        stream.height, stream.width, stream.pix_fmt = HEIGHT, WIDTH, "rgb24"
        for image in colours:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="rgb24")))
        container.mux(stream.encode(None))
    for name in ("c.tif", "c", "c.mov"):
        with pytest.raises(MovieError, match=r"--set movie\.channel=grey"):
            read(tmp_path / name)
        for channel, expected in (("green", colours[..., 1]), ("blue", colours[..., 2])):
            frames = read(tmp_path / name, channel=channel)[1]
            np.testing.assert_array_equal([frame.image for frame in frames], expected)
        luma = read(tmp_path / name, channel="grey")[1][0].image
        np.testing.assert_array_equal(luma, cv2.cvtColor(colours[0], cv2.COLOR_RGB2GRAY))
    tifffile.imwrite(tmp_path / "g.tif", np.repeat(colours[..., :1], 3, -1), photometric="rgb")
    np.testing.assert_array_equal(read(tmp_path / "g.tif")[1][1].image, colours[1, ..., 0])  # grey in all channels


def test_a_colour_movie_of_a_lossy_codec_is_refused_and_a_grey_one_is_not(tmp_path):
    planes = np.full((HEIGHT * 3 // 2, WIDTH), 90, np.uint8)
    for name, chroma in (("grey.mp4", 128), ("tinted.mp4", 150)):
        planes[HEIGHT:] = chroma
        with av.open(str(tmp_path / name), "w") as container:
            stream = container.add_stream("libx264", rate=30)
            stream.height, stream.width, stream.pix_fmt = HEIGHT, WIDTH, "yuv420p"
            for _ in range(3):
                container.mux(stream.encode(av.VideoFrame.from_ndarray(planes, format="yuv420p")))
            container.mux(stream.encode(None))
    assert len(read(tmp_path / "grey.mp4")[1]) == 3
    with pytest.raises(MovieError, match="in colour"):
        read(tmp_path / "tinted.mp4")
    assert abs(int(read(tmp_path / "tinted.mp4", channel="grey")[1][0].image[5, 5]) - 90) <= 1


def png_head(width, height):
    """A PNG that declares a size and holds a few bytes."""
    chunks = [(b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0)), (b"IDAT", zlib.compress(bytes(9)))]
    data = b"".join(struct.pack(">I", len(d)) + k + d + struct.pack(">I", zlib.crc32(k + d)) for k, d in chunks)
    return b"\x89PNG\r\n\x1a\n" + data


def test_sizes_are_refused_from_the_header_before_anything_is_decoded(tmp_path, monkeypatch):
    (tmp_path / "bomb").mkdir()
    (tmp_path / "bomb" / "a.png").write_bytes(png_head(60_000, 60_000))
    tifffile.imwrite(tmp_path / "bomb.tif", np.zeros((2, HEIGHT, WIDTH), np.uint8), compression="zlib")
    with tifffile.TiffFile(tmp_path / "bomb.tif", mode="r+b") as file:
        for page in file.pages:
            page.tags["ImageWidth"].overwrite(100_000)
            page.tags["ImageLength"].overwrite(100_000)
    makers.folder(tmp_path / "tiny", [np.zeros((1, 1), np.uint8)])
    monkeypatch.setattr(cv2, "imdecode", lambda *_: pytest.fail("decoded"))
    monkeypatch.setattr(tifffile.TiffPage, "asarray", lambda *_: pytest.fail("decoded"))
    for name in ("bomb", "bomb.tif", "tiny"):
        with pytest.raises(MovieError, match=r"8 to 16384|150 million"):
            open_movie(tmp_path / name)


def test_images_of_one_movie_have_one_size(tmp_path):
    images = [*pictures(count=3), np.zeros((HEIGHT + 2, WIDTH), np.uint8)]
    makers.folder(tmp_path / "mixed", images)
    with tifffile.TiffWriter(tmp_path / "mixed.tif") as stack:
        for image in images:
            stack.write(image, contiguous=False, metadata=None)
    for name, told in (("mixed", r"img_3\.png: .*64 x 50.* 64 x 48"), ("mixed.tif", r"mixed\.tif")):
        with pytest.raises(MovieError, match=told):
            read(tmp_path / name)


def test_a_file_is_what_it_holds_whatever_it_is_called(tmp_path):
    images = pictures()
    makers.ome_tiff(tmp_path / "a.ome.tif", images).rename(tmp_path / "stack.avi")
    makers.video(tmp_path / "b.mkv", "ffv1", images).rename(tmp_path / "film.tif")
    (tmp_path / "text.avi").write_text("frame,time_s\n" * 50)
    (tmp_path / "nothing.tif").touch()
    for name, reader in (("stack.avi", "tiff"), ("film.tif", "video")):
        facts, frames, _ = read(tmp_path / name)
        assert facts.reader == reader and len(frames) == COUNT
    for name, why in (("text.avi", "no movie"), ("nothing.tif", "is empty"), ("absent.avi", "no such movie")):
        with pytest.raises(MovieError, match=why):
            read(tmp_path / name)


def test_a_folder_is_read_in_natural_order_also_with_odd_names(tmp_path):
    odd = tmp_path / "Fläschchen 測定 №1"
    makers.folder(odd, pictures(count=12), "Bild µ{}.png")
    (odd / "notes.txt").write_text("not an image")
    (odd / ".hidden.png").write_text("nor this")
    huge = odd / f"Bild µ{10**25}.png"
    (odd / "Bild µ3.png").rename(huge)
    with open_movie(odd) as movie:
        order = [*pictures()[:3], *pictures()[4:], pictures()[3]]
        for frame, image in zip(movie.frames(), order, strict=True):
            np.testing.assert_array_equal(frame.image, image)
        assert len(movie.remarks) == 1 and movie.remarks[0].startswith("2 ")
    (tmp_path / "empty").mkdir()
    with pytest.raises(MovieError, match="empty"):
        open_movie(tmp_path / "empty")


@pytest.mark.slow("reads hostile files in processes with limits")
def test_what_a_header_declares_is_not_believed(tmp_path):
    """A billion images cost no memory, and data that is missing is not taken for black images."""
    images = pictures()
    xml = tifffile.TiffFile(makers.ome_tiff(tmp_path / "a.ome.tif", images))
    text = xml.ome_metadata.replace('SizeT="12"', 'SizeT="1000000000"').replace(
        'PlaneCount="12"', 'PlaneCount="1000000000"'
    )
    xml.close()
    tifffile.imwrite(tmp_path / "declared.tif", np.stack(images), description=text.encode(), metadata=None)
    makers.ome_zarr(tmp_path / "declared.zarr", images, 0.1, axes="tyx", chunk=1)
    meta = tmp_path / "declared.zarr" / "0" / "zarr.json"
    meta.write_text(meta.read_text().replace(f"{COUNT},", f"{10**9},", 1))
    makers.ome_zarr(tmp_path / "part.zarr", images, 0.1, axes="tyx", chunk=1)
    (tmp_path / "part.zarr" / "0" / "c" / "5" / "0" / "0").unlink()
    for name in ("declared.tif", "declared.zarr"):
        with pytest.raises(MovieError, match="1000000000"):
            read(tmp_path / name)
    with pytest.raises(MovieError, match=r"image 5 .*--partial"):
        read(tmp_path / "part.zarr")
    assert len(read(tmp_path / "part.zarr", partial=True)[1]) == 5


def test_the_early_end_of_a_movie_is_what_its_rig_noticed_while_it_played(tmp_path):
    folder = makers.folder(tmp_path / "pngs", pictures())
    broken = folder / "img_5.png"
    broken.write_bytes(broken.read_bytes()[:60])
    source = MovieSource(MovieSettings(path=str(folder), rate_hz=10.0, partial=True), Coils())
    source._log_remarks.append("what the log said when it was read")
    with MovieRig(source, 0.0) as rig:
        assert len(list(rig.inputs())) == 5
        assert len(rig.noticed) == 1 and "first 5 images" in rig.noticed[0]


def test_of_a_movie_that_is_played_for_a_time_the_image_at_its_end_is_the_last(tmp_path):
    folder = makers.folder(tmp_path / "pngs", pictures(count=4))
    for duration_s, count in ((None, 4), (0.2, 3), (0.19, 2), (0.0, 1)):
        source = MovieSource(MovieSettings(path=str(folder), rate_hz=10.0), Coils())
        with MovieRig(source, 0.0, duration_s) as rig:
            assert len(list(rig.inputs())) == rig.taken == rig.images == count


def test_the_top_speed_of_a_robot_in_a_movie_is_that_of_the_fastest_rotation_that_had_a_field(tmp_path):
    makers.folder(tmp_path / "pngs", pictures(count=4))
    rows = ["time_s,frequency_hz,heading_deg,amplitude_mt", "0,50,0,0", "0.1,4,0,3", "0.2,3,0,3", "0.3,50,0,0"]
    (tmp_path / "log.csv").write_text("\n".join(rows))
    sets = [
        "camera.um_per_px=2",
        "robot.radius_um=25",
        "robot.um_per_rev=30",
        "chip.path=sessions/chips/y_junction.png",
    ]
    files = [f"movie.path={tmp_path / 'pngs'}", f"movie.coils={tmp_path / 'log.csv'}", "movie.rate_hz=10"]
    fitted, _, _ = fitted_to_movie(load_config(None, [*sets, *files]))
    assert fitted.robot.max_speed_um_s == pytest.approx(1.2 * 4.0 * 30.0)


def test_samples_of_more_bits_than_an_image_can_have_are_refused(tmp_path):
    path = makers.folder(tmp_path / "pngs", pictures())
    with open_movie(path) as movie, pytest.raises(MovieError, match=r"32 bits.*ffm"):
        movie._depth(32, 32)


HOUR = {"s": 3600, "ms": 3.6e6, "\u00b5s": 3.6e9, "\u03bcs": 3.6e9, "us": 3.6e9, "ns": 3.6e12, "min": 60, "h": 1}
HOUR |= {"second": 3600, "millisecond": 3.6e6, "microsecond": 3.6e9, "nanosecond": 3.6e12, "minute": 60, "hour": 1}
METRE = {"\u00b5m": 1e6, "\u03bcm": 1e6, "um": 1e6, "micron": 1e6, "nm": 1e9, "mm": 1e3, "cm": 100, "m": 1}
METRE |= {"micrometer": 1e6, "nanometer": 1e9, "millimeter": 1e3, "centimeter": 100, "meter": 1}


def test_every_unit_that_ome_states_has_its_length():
    assert set(ome._S_PER) == set(HOUR) and set(ome._UM_PER) == set(METRE)
    assert {unit: ome.seconds_per(unit) * length for unit, length in HOUR.items()} == pytest.approx(
        dict.fromkeys(HOUR, 3600.0)
    )
    assert {unit: ome.um_per(unit) * length for unit, length in METRE.items()} == pytest.approx(
        dict.fromkeys(METRE, 1e6)
    )


def test_a_series_of_several_ome_files_is_one_movie(tmp_path):
    images = pictures(12)
    uuids = [f"urn:uuid:00000000-0000-0000-0000-00000000000{n}" for n in range(3)]
    planes = "".join(
        f'<TiffData FirstT="{t}" IFD="{t % 4}" PlaneCount="1">'
        f'<UUID FileName="part{t // 4}.ome.tif">{uuids[t // 4]}</UUID></TiffData>'
        f'<Plane TheC="0" TheZ="0" TheT="{t}" DeltaT="{0.05 * t}"/>'
        for t in range(12)
    )
    for n in range(3):
        xml = (
            f'<?xml version="1.0"?><OME xmlns="http://www.openmicroscopy.org/Schemas/OME/2016-06" UUID="{uuids[n]}">'
            '<Image ID="Image:0"><Pixels ID="Pixels:0" DimensionOrder="XYCZT" Type="uint8" SizeX="64" SizeY="48" '
            f'SizeC="1" SizeZ="1" SizeT="12"><Channel ID="Channel:0:0" SamplesPerPixel="1"/>{planes}</Pixels></Image>'
            "</OME>"
        )
        part = np.stack(images[4 * n : 4 * n + 4]).astype(np.uint8)
        tifffile.imwrite(
            tmp_path / f"part{n}.ome.tif", part, description=xml.encode(), metadata=None, photometric="minisblack"
        )
    facts, frames, _ = read(tmp_path / "part0.ome.tif")
    assert facts.frames == len(frames) == 12 and "DeltaT" in facts.times
    np.testing.assert_array_equal([frame.image for frame in frames], [image.astype(np.uint8) for image in images])
    (tmp_path / "part2.ome.tif").unlink()
    with pytest.raises(MovieError, match=str(tmp_path)):
        read(tmp_path / "part0.ome.tif")
    facts, frames, _ = read(tmp_path / "part0.ome.tif", partial=True)
    assert facts.frames == len(facts.times_ns) == len(frames) == 8


def test_what_can_not_be_kept_exactly_is_refused(tmp_path):
    tifffile.imwrite(tmp_path / "f.tif", np.zeros((2, HEIGHT, WIDTH), np.float32))
    tifffile.imwrite(
        tmp_path / "two.tif", np.zeros((4, 2, HEIGHT, WIDTH), np.uint8), imagej=True, metadata={"axes": "TCYX"}
    )
    tifffile.imwrite(tmp_path / "deep.tif", np.full((2, HEIGHT, WIDTH), 4096, np.uint16))
    for name, why in (("f.tif", "float32 pixels"), ("two.tif", r"\(T 4, C 2\); export one channel")):
        with pytest.raises(MovieError, match=why):
            read(tmp_path / name)
    with pytest.raises(MovieError, match=r"4096.* 12 bit"):
        read(tmp_path / "deep.tif", bits=12)
    facts, _, remarks = read(tmp_path / "deep.tif")
    assert facts.bits == 16 and "16 are assumed" in remarks[0]


@pytest.mark.slow("packs and unpacks eight gigabytes of zeros")
def test_a_zarr_whose_chunks_hold_nothing_or_unpack_without_measure_is_refused(tmp_path):
    none = makers.ome_zarr(tmp_path / "none.zarr", pictures(), 0.05) / "0" / "zarr.json"
    head = json.loads(none.read_text())
    head["chunk_grid"]["configuration"]["chunk_shape"][0] = 0
    none.write_text(json.dumps(head))
    with pytest.raises(MovieError, match=r"chunks of shape \(0, "):
        read(tmp_path / "none.zarr")
    if sys.platform != "linux":
        return  # the system limits no memory
    bomb = makers.ome_zarr(tmp_path / "bomb.zarr", pictures(), 0.05)
    nothing, packer = bytes(1 << 24), zstandard.ZstdCompressor().compressobj(size=1 << 33)
    packed = b"".join([packer.compress(nothing) for _ in range(1 << 9)] + [packer.flush()])
    for chunk in (each for each in (bomb / "0" / "c").rglob("*") if each.is_file()):
        chunk.write_bytes(packed)
    with pytest.raises(MovieError, match=r"bomb\.zarr: .*3\.2 GB"):
        read(bomb)


@needs("nd2")
@pytest.mark.parametrize(("compression", "lossy"), [(0, False), (1, True), (2, False)])  # as ND2 numbers them
def test_a_nikon_file_says_whether_its_levels_were_changed(compression, lossy, tmp_path):
    path = makers.nd2(tmp_path / "a.nd2", pictures(12), np.arange(COUNT) / 30, compression=compression)
    with open_movie(path) as movie:
        assert movie.facts.lossy is lossy


def test_the_time_of_an_image_of_several_planes_is_that_of_the_first():
    times_s = [[0.0, 0.3, 0.5], [1.0, 1.3, 1.5]]
    planes = "".join(
        f'<Plane TheC="{c}" TheZ="0" TheT="{t}" DeltaT="{time_s}"/>'
        for t, of_image in enumerate(times_s)
        for c, time_s in enumerate(of_image)
    )
    facts = ome.ome_facts(ome.parse_ome(f"<OME><Pixels>{planes}</Pixels></OME>"), 2)
    assert facts.times_s.tolist() == [0.0, 1.0]


@pytest.mark.parametrize("um_per_px", [0, -2.0, float("nan"), float("inf"), 1e9, None, "2"])
def test_a_scale_that_no_pixel_can_have_is_damage_of_the_notes(um_per_px):
    given = dict.fromkeys((each.name for each in fields(MovieNotes) if each.type == "str"), "")
    given |= {each.name: 8 for each in fields(MovieNotes) if each.type == "int"} | {"drawn": False}
    notes = MovieNotes(**given, um_per_px=2.0)
    assert notes_in(notes.text(), makers.Path("a.mp4")) == notes
    with pytest.raises(MovieError, match="um_per_px is"):
        notes_in(replace(notes, um_per_px=um_per_px).text(), makers.Path("a.mp4"))
