from .frame_times import frame_times as frame_times
from .movie import (
    MOVIE_READERS as MOVIE_READERS, Movie as Movie, MovieFacts as MovieFacts, ReadOptions as ReadOptions,
    median_of as median_of,
)
from .notes import MovieNotes as MovieNotes
from .ome import NAMESPACE as NAMESPACE
from .opening import open_movie as open_movie
