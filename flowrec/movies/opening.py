"""A movie is opened by the reader of its content, whatever its name is; in a child process, if it may cost much."""

from __future__ import annotations

from pathlib import Path

from flowrec.core import BoundedProcess, Image, MovieError, refuse_irregular
from flowrec.movies.movie import MOVIE_READERS, Movie, MovieFacts, ReadOptions

_BEGINNINGS = {
    b"II*\0": "tiff",
    b"MM\0*": "tiff",
    b"II+\0": "tiff",
    b"MM\0+": "tiff",
    b"\xda\xce\xbe\x0a": "nd2",
    b"\x89PNG": "folder",
    b"\xff\xd8\xff": "folder",
    b"BM": "folder",
    b"P5": "folder",
    b"P6": "folder",
}
_ZARR_FILES = (".zgroup", ".zattrs", ".zarray", "zarr.json")
# Readers whose libraries unpack whatever a file holds; those of the others stop at the size of the image.
_UNPACKING = ("ome_zarr", "nd2")
_CPU_S = 60.0  # to open one of those, and for each image; a chunk of a gigabyte takes some 5 s
_of_child: list[Movie] = []  # the movie that the child reads


def open_movie(path: Path | str, reader: str | None = None, options: ReadOptions | None = None) -> Movie:
    """Open a movie for reading.

    Parameters
    ----------
    path : a file, or a folder of images or of OME-Zarr.
    reader : a name of MOVIE_READERS; None: by the content of the file, whatever its name is.

    Raises
    ------
    MovieError : one line: there is no such file, or it is no movie that can be read.
    UsageError : a package is not installed; the text has the command.
    """
    path = Path(path)
    if not path.exists():
        raise MovieError(f"{path}: no such movie; it is a file of this machine, or a folder of images")
    name = reader or _reader_by_content(path)
    options = options or ReadOptions()
    return BoundedMovie(path, name, options) if name in _UNPACKING else _load(path, name, options)


class BoundedMovie(Movie):
    """A movie of any reader in a child process; MovieError where an image takes more time or memory than it can need.

    It is for formats whose data can unpack to more than they declare.
    """

    def __init__(self, path: Path, reader: str, options: ReadOptions) -> None:
        self._reader = reader
        self._process = BoundedProcess(str(path), _CPU_S, error=MovieError)
        super().__init__(path, options)

    def _open(self) -> MovieFacts:
        self._opened.enter_context(self._process)
        facts, self._assumed = self._process.call(_open_in_child, self.path, self._reader, self.options)
        return facts

    def image(self, index: int) -> Image:
        return self._process.call(_image, index)


def _load(path: Path, reader: str, options: ReadOptions) -> Movie:
    return MOVIE_READERS[reader].load()(path, options)


def _open_in_child(path: Path, reader: str, options: ReadOptions) -> tuple[MovieFacts, list[str]]:
    movie = _load(path, reader, options)
    _of_child.append(movie)
    return movie.facts, movie.remarks


def _image(index: int) -> Image:
    return _of_child[0].image(index)


def _reader_by_content(path: Path) -> str:
    if path.is_dir():
        return "ome_zarr" if any((path / name).exists() for name in _ZARR_FILES) else "folder"
    refuse_irregular(path, MovieError)
    try:
        with path.open("rb") as file:
            begin = file.read(8)
    except OSError as error:
        raise MovieError(f"{path}: can not be read ({error.strerror}); check its permissions") from error
    if not begin:
        raise MovieError(f"{path}: is empty; the recording or the copy has failed")
    return next((name for magic, name in _BEGINNINGS.items() if begin.startswith(magic)), "video")
