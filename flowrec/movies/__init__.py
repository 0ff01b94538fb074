"""Movies of other programs: which formats are read, what a file tells, and its images one after another."""

from flowrec.movies.movie import MOVIE_READERS as MOVIE_READERS
from flowrec.movies.movie import Movie as Movie
from flowrec.movies.movie import MovieFacts as MovieFacts
from flowrec.movies.movie import MovieFrame as MovieFrame
from flowrec.movies.movie import ReadOptions as ReadOptions
from flowrec.movies.opening import open_movie as open_movie
