"""Times of the images of a movie: as its file tells them, from a table, or from a rate that somebody states."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from flowrec.core import DATES, NS_PER_S, TIME_UNITS, Ints, MovieError, Table, read_table
from flowrec.movies.movie import MovieFacts, whole_ns

_MOST_IMAGES = 1 << 40  # a larger number of an image is no number of an image, and may not fit an integer


@dataclass(frozen=True, slots=True, eq=False)
class FrameTimes:
    """Times of the images of one movie, on the clock of the log if that is known."""

    text: str  # where the times come from
    times_ns: Ints | None = None  # (n,) of the images in order; None: by the rate, or by each image itself
    # (n,) the camera's numbers of the images, by which gaps are losses; None: they are counted
    numbers: Ints | None = None
    rate_hz: float | None = None  # None: not by a rate
    exact: bool = False  # `times_ns` has exactly as many rows as there are images

    def of(self, place: int, time_ns: int | None, where: Path) -> tuple[int, int]:
        """Time and number of the image at a place, to which the file gives `time_ns`; MovieError if there is none."""
        if self.rate_hz is not None:
            return round(place * NS_PER_S / self.rate_hz), place
        if self.exact and self.times_ns is not None:
            if place >= len(self.times_ns):
                raise MovieError(f"{where}: has more images than the {len(self.times_ns)} rows of {self.text}")
            return int(self.times_ns[place]), int(self.numbers[place]) if self.numbers is not None else place
        if time_ns is None:
            raise MovieError(f"{where}: image {place} has no time; give them with --times FRAMES.csv or --fps F")
        return time_ns, place


def frame_times(path: Path, facts: MovieFacts, table: str = "", rate_hz: float | None = None) -> FrameTimes:
    """The times of a movie.

    Raises MovieError: in one line: no times at all, both kinds of them, times that go back, more or fewer rows than
    images.

    Parameters
    ----------
    table : CSV or Excel file with a column time_s (other units, dates: see `Table.times_s`) and a row
        for each image in order; '': none. A column frame holds the camera's own numbers, so that a gap is a loss.
    rate_hz : images per second, instead.
    """
    if table and rate_hz is not None:
        raise MovieError(f"{path}: times are given by {table} and by a rate; give one of --times and --fps")
    if rate_hz is not None:
        return FrameTimes(f"the rate that was given, {rate_hz:g} Hz", rate_hz=rate_hz)
    if table:
        times = _from_table(read_table(Path(table)))
    elif facts.times_ns is not None:
        times = FrameTimes(facts.times, facts.times_ns)
    else:
        raise MovieError(
            f"{path}: does not tell when its images were taken; give the times with --times FRAMES.csv (frame,time_s) "
            "or the rate with --fps F"
        )
    stamps = times.times_ns
    assert stamps is not None
    back = np.flatnonzero(np.diff(stamps) <= 0)
    if len(back):
        place = int(back[0])
        now_s, before_s = 1e-9 * stamps[place + 1], 1e-9 * stamps[place]
        raise MovieError(
            f"{table or path}: the time of image {place + 1} is {now_s:.6f} s, not after that of the one before, "
            f"{before_s:.6f} s; correct it with --times FRAMES.csv or --fps F"
        )
    if table and facts.counted and len(stamps) != facts.frames:
        raise MovieError(f"{table}: has {len(stamps)} rows, and {path} {facts.frames} images; give each image its row")
    return times


def _from_table(table: Table) -> FrameTimes:
    found = table.times_s()
    if found is None:
        units = ", ".join(list(TIME_UNITS)[1:])
        raise MovieError(
            f"{table.where}: no column time_s (or {units}; or {DATES}, with dates); the header is frame,time_s"
        )
    if not table.rows:
        raise MovieError(f"{table.where}: has no rows below its header")
    name, times_ns = found[0], whole_ns(found[1])
    numbers = None
    if table.index("frame") is not None:
        given = table.numbers("frame")
        back = np.flatnonzero(np.diff(given) <= 0.0)
        if len(back) or given[0] < 0.0 or given[-1] > _MOST_IMAGES or (given != np.rint(given)).any():
            line = table.lines[int(back[0]) + 1] if len(back) else table.lines[0]
            raise MovieError(f"{table.where}: line {line}: frame numbers are whole, and increase; correct that line")
        numbers = given.astype(np.int64)
    return FrameTimes(f"{Path(table.where).name}, column {name}", times_ns, numbers, exact=True)
