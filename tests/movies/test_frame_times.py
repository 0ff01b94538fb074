"""Times of images: one for each image, in order, or an error that names the first that is wrong."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from flowrec.core import MovieError
from flowrec.movies import MovieFacts
from flowrec.movies.frame_times import frame_times

MOVIE = Path("a.tif")


def facts(frames: int, times_s: list[float] | None = None, *, counted: bool = True) -> MovieFacts:
    times_ns = None if times_s is None else np.rint(1e9 * np.array(times_s)).astype(np.int64)
    return MovieFacts("tiff", "tifffile", "", False, 8, 8, 8, frames, counted, times_ns, "" if times_s is None else "x")


@pytest.mark.parametrize("second_s", [0.1, 0.05])
def test_two_images_at_one_time_and_a_time_that_goes_back_are_refused(second_s: float) -> None:
    with pytest.raises(MovieError, match=r"image 2 .*0\.\d+ s.* 0\.1"):
        frame_times(MOVIE, facts(3, [0.0, 0.1, second_s]))


@pytest.mark.parametrize("frames", [2, 4])
def test_a_table_has_a_row_for_each_image_and_none_more(frames: int, tmp_path: Path) -> None:
    table = tmp_path / "times.csv"
    table.write_text("frame,time_s\n0,0.0\n1,0.1\n2,0.2\n")
    with pytest.raises(MovieError, match=rf" 3 rows.*a\.tif {frames} images"):
        frame_times(MOVIE, facts(frames), str(table))
    assert frame_times(MOVIE, facts(3), str(table)).of(2, None, MOVIE) == (200_000_000, 2)
    assert frame_times(MOVIE, facts(frames, counted=False), str(table)).exact, "an estimated number refuses nothing"


@pytest.mark.parametrize("numbers", ["-1 1 2", "0 1 1", "0 2 1", "0 1.5 2", "0 1 1e15"])
def test_frame_numbers_are_whole_not_negative_and_increase(numbers: str, tmp_path: Path) -> None:
    table = tmp_path / "times.csv"
    rows = [f"{number},{0.1 * row}" for row, number in enumerate(numbers.split())]
    table.write_text("\n".join(["frame,time_s", *rows]))
    with pytest.raises(MovieError, match=r"line [234]: "):
        frame_times(MOVIE, facts(3), str(table))
