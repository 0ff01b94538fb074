"""Made-up masks and vessel cases: refused before they fill the memory."""

import struct
import tracemalloc
import zipfile

import cv2
import numpy as np
import pytest

from flowrec.core import ChipError
from flowrec.physics import chip_from_files, read_vessel_case
from flowrec.physics.chip.io import KEYS as CASE_KEYS


def test_a_mask_that_promises_more_than_it_has_is_refused():
    for width, height in ((65535, 65535), (32767, 32767), (2**31, 1)):
        head = b"\x89PNG\r\n\x1a\n" + struct.pack(">I4sIIBBBBB", 13, b"IHDR", width, height, 8, 0, 0, 0, 0)
        with pytest.raises(ChipError, match="at most"):
            chip_from_files(head + bytes(10), "um_per_px = 1.0")
    for data in (b"BM" + bytes(100), b"\xff\xd8\xff" + bytes(100), b"II*\0" + bytes(100)):
        with pytest.raises(ChipError, match="PNG"):
            chip_from_files(data, "um_per_px = 1.0")


def png(image):
    """An image as PNG: of a channel between walls."""
    return cv2.imencode(".png", image)[1].tobytes()


@pytest.mark.parametrize("fluid", ["bright", "dark"])
def test_a_mask_of_zeros_and_ones_is_refused_with_the_brightness_that_fluid_has(fluid):
    mask = np.zeros((30, 40), np.uint8)
    mask[10:20] = 1
    with pytest.raises(ChipError, match=r"the brightest is 1 of 255, and fluid is 128 or more; save it"):
        chip_from_files(png(mask), f'um_per_px = 1.0\nfluid = "{fluid}"')
    assert chip_from_files(png(255 * mask), "um_per_px = 1.0").mask.sum() == mask.sum()


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_a_mask_with_transparent_pixels_is_refused_as_the_colour_under_them_is_not_seen(dtype):
    grey = np.zeros((30, 40), dtype)
    grey[10:20] = full = np.iinfo(dtype).max
    seen = np.full_like(grey, full)
    assert chip_from_files(png(np.dstack([grey, grey, grey, seen])), "um_per_px = 1.0").mask.sum() == 400
    seen[12:18, 20:30] = 0
    with pytest.raises(ChipError, match=r"60 pixels of the mask are transparent: fluid or wall\?"):
        chip_from_files(png(np.dstack([grey, grey, grey, seen])), "um_per_px = 1.0")


def vessel_case(path, mask_header, zeros):
    """A case whose mask announces itself like this and has so many MB of zeros."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as case:
        for key in CASE_KEYS:
            with case.open(f"{key}.npy", "w") as file:
                if key == "mask":
                    np.lib.format.write_array_header_1_0(file, mask_header)
                    for _ in range(zeros):
                        file.write(bytes(1 << 20))
                else:
                    np.lib.format.write_array(file, np.zeros(3))
    return path


@pytest.mark.parametrize(
    ("shape", "zeros", "said"),
    [((270, 1 << 20), 270, "arrays of 2831.* bytes, more than"), ((10**6, 10**6), 0, "announces an array of shape")],
)
def test_a_vessel_case_that_would_fill_the_memory_is_refused_before_it_is_unpacked(tmp_path, shape, zeros, said):
    header = {"descr": "|u1", "fortran_order": False, "shape": shape}
    path = vessel_case(tmp_path / "case.npz", header, zeros)
    tracemalloc.start()
    try:
        with pytest.raises(ChipError, match=said):
            read_vessel_case(path)
        assert tracemalloc.get_traced_memory()[1] < 8 << 20
    finally:
        tracemalloc.stop()
