"""A movie of any format: the table of readers, the facts that a file tells, and the interface of a reader.

Nothing is converted silently: grey levels are those of the file, and what had to be assumed is a remark.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flowrec.core import NS_PER_S, PIXEL_BITS, Closing, Floats, Image, Ints, Method, Methods, MovieError, pixel_type
from flowrec.movies.grey import grey_image
from flowrec.movies.notes import MovieNotes

# A row's class is made with (path, options) and is a Movie.
MOVIE_READERS = Methods(
    "movie.reader",
    Method("video", "flowrec.movies.video:VideoMovie", "AVI, MP4, MKV, MOV (PyAV)", extra="movies"),
    Method(
        "tiff", "flowrec.movies.tiff:TiffMovie", "TIFF stacks: plain, OME, ImageJ, BigTIFF (tifffile)", extra="movies"
    ),
    Method("nd2", "flowrec.movies.nikon:NikonMovie", "Nikon ND2 (nd2)", extra="movies"),
    Method("ome_zarr", "flowrec.movies.ome_zarr:ZarrMovie", "OME-Zarr (zarr)", extra="movies"),
    Method(
        "folder", "flowrec.movies.folder:FolderMovie", "a folder of images, in natural order of their names (OpenCV)"
    ),
)
LARGEST_PX, SMALLEST_PX = 16_384, 8  # as of camera.width_px and height_px
MOST_PIXELS = 150_000_000
MOST_IMAGES = 20_000_000  # nine hours at 600 Hz; a file that declares more is damaged
_MEDIAN_IMAGES = 31  # that a median is taken of, at most
_MEDIAN_BYTES = 400_000_000  # of those images, at most


@dataclass(frozen=True, slots=True, eq=False)
class MovieFrame:
    """One image of a movie."""

    index: int
    image: Image  # (h, w) uint8 or uint16
    time_ns: int | None  # on the clock of the file; None: the file does not tell


@dataclass(frozen=True, slots=True)
class ReadOptions:
    """Options for reading a movie."""

    # red, green, blue or grey (luma) of a movie in colour; None: a movie in colour is refused
    channel: str | None = None
    # depth of the pixels, where the file does not tell it; None: that of the file, or of its type
    bits: int | None = None
    # a movie that breaks off, or can not be decoded from some image on, ends there instead of being refused
    partial: bool = False


@dataclass(frozen=True, slots=True, eq=False)
class MovieFacts:
    """Metadata of a movie file.

    Attributes
    ----------
    reader, library : the row of MOVIE_READERS, and the package that decodes, with its version.
    codec : name of the compression, '' for none.
    lossy : whether it changes grey levels; None: not known.
    bits : depth of the pixels.
    frames : number of images; an estimate if `counted` is False.
    times_ns : (n,) time of each image on the clock of the file; None: the file tells no times.
    times : where these times come from, for people; '' without times.
    um_per_px : as the file states it. It is used only where flowrec has written the file, else shown.
    notes : what flowrec wrote into the file that it exported; None: another program wrote it.
    """

    reader: str
    library: str
    codec: str
    lossy: bool | None
    width_px: int
    height_px: int
    bits: int
    frames: int
    counted: bool = True
    times_ns: Ints | None = None
    times: str = ""
    um_per_px: float | None = None
    notes: MovieNotes | None = None

    def describe(self) -> str:
        """One line for people."""
        known = "" if self.counted else "about "
        return (
            f"{self.width_px} x {self.height_px} pixels of {self.bits} bit, {known}{self.frames} images, "
            f"{self.codec or 'uncompressed'}{' (lossy)' if self.lossy else ''}, times: {self.times or 'none'}"
        )


class Movie(Closing):
    """An open movie. Memory does not grow with its length.

    Attributes
    ----------
    path : as given.
    facts : what the file tells.
    """

    def __init__(self, path: Path, options: ReadOptions) -> None:
        self.path = path
        self.options = options
        self._assumed: list[str] = []  # and what is unusual, in sentences
        self._cut: list[str] = []  # sentence on an early end
        self._opened = ExitStack()  # what is closed with the movie
        try:
            self.facts = self._open()
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Release the file."""
        self._opened.close()

    @property
    def remarks(self) -> list[str]:
        """Assumptions, what is unusual, and what was noticed while reading."""
        return [*self._assumed, *self._cut]

    @abstractmethod
    def _open(self) -> MovieFacts:
        """Open the file; MovieError if it is no movie that can be read."""

    @abstractmethod
    def image(self, index: int) -> Image:
        """One image; MovieError if it can not be read."""

    def frames(self) -> Iterator[MovieFrame]:
        """All images in order.

        Raises MovieError: an image can not be read, and `options.partial` is not set; the text says how many could.
        """
        times = self.facts.times_ns
        for index in range(self.facts.frames):
            try:
                image = self.image(index)
            except MovieError as error:
                self.broken_off(index, str(error).removeprefix(f"{self.path}: "), error)
                return
            yield MovieFrame(index, image, None if times is None else int(times[index]))

    def broken_off(self, read: int, why: str, error: Exception | None = None) -> None:
        """Note that the movie ends early, after `read` images; or refuse it."""
        if not self.options.partial or not read:
            advice = f"; --partial takes the {read} images before it" if read else ""
            raise MovieError(f"{self.path}: {why}{advice}") from error
        self._cut = [f"only the first {read} images were taken: {why}"]

    def median_image(self) -> Image:
        """Median of images spread over the movie: what does not move, such as the chip."""
        return median_of(self.image(index) for index in self.median_indices())

    def median_indices(self) -> list[int]:
        """The images that `median_image` takes."""
        facts = self.facts
        affordable = _MEDIAN_BYTES // (facts.width_px * facts.height_px * pixel_type(facts.bits).itemsize)
        count = max(min(_MEDIAN_IMAGES, facts.frames, affordable), 1)
        return np.unique(np.linspace(0, facts.frames - 1, count).round().astype(int)).tolist()

    def _grey(self, array: NDArray[Any], index: int) -> Image:
        """Grey levels (h, w) of an image, see `grey_image`."""
        return grey_image(array, self.options.channel, self.facts.bits, self.path, index)

    def _depth(self, kept: int, stated: int | None = None, who: str = "the file does not say how many of its") -> int:
        """The depth of PIXEL_BITS of pixels that are kept in so many bits; the one that was asked for, if any.

        `stated`: number of significant bits by the file. Raises MovieError: more bits than an image can have.
        """
        if self.options.bits is not None:
            return self.options.bits
        bits = next((bits for bits in PIXEL_BITS if bits >= (stated or kept)), None)
        if bits is None:
            raise MovieError(
                f"{self.path}: its samples have {stated or kept} bits, and images of at most {PIXEL_BITS[-1]} are "
                "recorded; convert it, for example with ffmpeg -pix_fmt gray16le"
            )
        if bits == 16 and stated is None:
            self._assumed.append(f"{who} 16 bits the camera used; 16 are assumed (movie.bits)")
        return bits


def median_of(images: Iterable[Image]) -> Image:
    """Median of images of one size."""
    stack = np.stack(list(images))
    return np.median(stack, axis=0, overwrite_input=True).round().astype(stack.dtype)


def checked_size(path: Path, width_px: int, height_px: int) -> tuple[int, int]:
    """Width and height, before anything of that size is decoded; MovieError if they are no image's."""
    sides = min(width_px, height_px) >= SMALLEST_PX and max(width_px, height_px) <= LARGEST_PX
    if not sides or width_px * height_px > MOST_PIXELS:
        raise MovieError(
            f"{path}: images of {width_px} x {height_px} pixels; from {SMALLEST_PX} to {LARGEST_PX} on each side can "
            f"be read, and {MOST_PIXELS / 1e6:g} million in all; crop or bin them"
        )
    return width_px, height_px


def checked_count(path: Path, count: int) -> int:
    """The number of images that a header declares, before a list of that length is made; MovieError if it is absurd."""
    if not 0 < count <= MOST_IMAGES:
        raise MovieError(f"{path}: declares {count} images; from 1 to {MOST_IMAGES / 1e6:g} million can be read")
    return count


def refuse_missing(image: Image, path: Path, index: int) -> Image:
    """The image, of a format that returns zeros where its data is missing; MovieError if it is nothing else."""
    if not image.any():
        raise MovieError(
            f"{path}: image {index} holds nothing but 0: its data is missing, or it is black; export the movie again "
            "without it"
        )
    return image


@contextmanager
def refusing(what: str, after: str = "") -> Iterator[None]:
    """Turn what a library raises, of many kinds, into a MovieError, with the reason between two texts."""
    try:
        yield
    except MovieError:
        raise
    except Exception as error:
        raise MovieError(f"{what} ({str(error) or type(error).__name__}){after}") from error


def refuse_series(path: Path, lengths: Iterable[tuple[str, int]]) -> MovieError:
    """The error for a file with more than one series of images, by the lengths of its axes."""
    named = ", ".join(f"{axis} {length}" for axis, length in lengths)
    return MovieError(f"{path}: has more than one series of images ({named}); export one channel and one plane")


def colours_last(array: NDArray[Any], counts: tuple[int, ...]) -> NDArray[Any]:
    """An image (h, w, colours) of one that may have its colours, of one of these counts, first."""
    first = array.ndim == 3 and array.shape[0] in counts and array.shape[2] not in counts
    return np.moveaxis(array, 0, 2) if first else array


def whole_ns(times_s: Floats) -> Ints:
    """Times in s as ns."""
    return np.rint(np.asarray(times_s, np.float64) * NS_PER_S).astype(np.int64)


def nominal_times(count: int, interval_s: float, source: str) -> tuple[Ints, str]:
    """Times of images at equal intervals, and where they come from."""
    times_ns = whole_ns(np.arange(count, dtype=np.float64) * interval_s)
    return times_ns, f"{source}, every {1e3 * interval_s:.4g} ms; nominal"
