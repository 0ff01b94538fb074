"""A movie is opened by the reader of its content, whatever its name is."""

from __future__ import annotations

from pathlib import Path

from flowrec.core import MovieError, refuse_irregular
from flowrec.movies.bounded import BoundedMovie
from flowrec.movies.movie import MOVIE_READERS, Movie, ReadOptions

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
        raise MovieError(f"{path}: no such movie; it is a file, or a folder of images")
    name = reader or _reader_by_content(path)
    options = options or ReadOptions()
    bounded = name in _UNPACKING
    movie: Movie = BoundedMovie(path, name, options) if bounded else MOVIE_READERS[name].load()(path, options)
    movie.remarks[:0] = movie.facts.remarks
    return movie


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
