"""A movie that is read in a child process: of formats whose data can unpack to more than they declare."""

from __future__ import annotations

from pathlib import Path

from flowrec.core import BoundedProcess, Image, MovieError
from flowrec.movies.movie import MOVIE_READERS, Movie, MovieFacts, ReadOptions

_CPU_S = 60.0  # to open it, and for each image; a chunk of a gigabyte takes some 5 s
_open: list[Movie] = []  # of the child: the movie that it reads


class BoundedMovie(Movie):
    """A movie of any reader; MovieError where an image takes more time or memory than it can need."""

    def __init__(self, path: Path, reader: str, options: ReadOptions) -> None:
        super().__init__(path, options)
        self._process = BoundedProcess(str(path), _CPU_S, error=MovieError)
        try:
            self.facts = self._process.call(_open_movie, path, reader, options)
        except BaseException:
            self._process.close()
            raise

    def image(self, index: int) -> Image:
        return self._process.call(_image, index)

    def close(self) -> None:
        self._process.close()


def _open_movie(path: Path, reader: str, options: ReadOptions) -> MovieFacts:
    movie: Movie = MOVIE_READERS[reader].load()(path, options)
    _open.append(movie)
    return movie.facts


def _image(index: int) -> Image:
    return _open[0].image(index)
