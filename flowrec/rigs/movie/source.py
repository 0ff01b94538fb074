"""A movie with the times of its images and the log of its coils, on one clock, whose zero is the first image."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np

from flowrec.core import NS_PER_S, Closing, Frame, Ints, MovieError, UsageError, nanoseconds, seconds
from flowrec.movies import Movie, MovieFacts, ReadOptions, frame_times, open_movie
from flowrec.stages import Coils, FieldLog, MovieSettings, is_of_session, read_coil_log

_PAUSE = 1.5  # median intervals; some formats round times to ms, so the mean says more than the median
_LEAST_OVERLAP = 0.98  # of the movie; with less a remark says so


def open_source(settings: MovieSettings) -> Movie:
    """The movie of settings, open."""
    options = ReadOptions(settings.channel, settings.bits, settings.partial)
    return open_movie(Path(settings.path), settings.reader, options)


class MovieSource(Closing):
    """The images of a movie with session stamps, and what the coils were told on the same clock.

    A session stamp is clock_rate times the time since the first image, by the movie's clock. The log shows at that
    instant the time of the first image, plus clock_offset_s, plus the stamp.

    Parameters
    ----------
    settings : section [movie].
    coils : section [coils], for logs of currents or fields.

    Attributes
    ----------
    facts : what the movie tells.
    first_ns : time of the first image on the movie's clock.
    stamps_ns : (n,) expected stamps of the images; of a few movies the images themselves tell better.
    log : what the coils did; None: there is no log.
    log_delayed : the log tells what reached the robot, as the tables of a session do: the latency is in it already.
    remarks : what was assumed, and what is unusual.

    Raises
    ------
    MovieError, UsageError : in one line: what can not be read, and what does not fit together.
    """

    def __init__(self, settings: MovieSettings, coils: Coils) -> None:
        if not settings.path:
            raise UsageError(
                "movie.path not given: name the movie that the rig plays, as in --set movie.path=MOVIE.avi"
            )
        self.path = Path(settings.path)
        self._settings = settings
        self._movie = open_source(settings)
        try:
            self.facts: MovieFacts = self._movie.facts
            self._times = frame_times(self.path, self.facts, settings.times, settings.rate_hz)
            times = self._times.times_ns
            if times is None:
                times = np.array([self._times.of(n, None, self.path)[0] for n in range(self.facts.frames)], np.int64)
            first = None if self.facts.times_ns is None else int(self.facts.times_ns[0])
            self.first_ns, _ = self._times.of(0, first, self.path)
            self.stamps_ns = self._stamps(times)
            self._log_remarks: list[str] = []
            self.log_delayed = bool(settings.coils) and is_of_session(Path(settings.coils))
            self.log = self._read_log(coils)
        except BaseException:
            self._movie.close()
            raise

    @property
    def remarks(self) -> list[str]:
        """Assumptions and unusual findings; more may come while images are read."""
        return [*self._movie.remarks, *self._log_remarks]

    @property
    def rate_hz(self) -> float | None:
        """Images per second of the session's clock, without pauses; None: one image alone."""
        if len(self.stamps_ns) < 2:
            return None
        intervals = np.diff(self.stamps_ns)
        return NS_PER_S / float(intervals[intervals < _PAUSE * np.median(intervals)].mean())

    def frames(self) -> Iterator[Frame]:
        """The images with their stamps and numbers, in order.

        Raises MovieError: in one line: an image that can not be decoded, or a time that is not after the one before.
        """
        before, count = -1, 0
        for image in self._movie.frames():
            time_ns, number = self._times.of(image.index, image.time_ns, self.path)
            stamp_ns = int(self._stamps(np.array(time_ns)))
            if stamp_ns <= before:
                raise MovieError(
                    f"{self.path}: the time of image {image.index}, {seconds(time_ns):.6f} s, is not after that of the "
                    "one before; give the times with --times FRAMES.csv or the rate with --fps F"
                )
            yield Frame(stamp_ns, number, image.image, self.facts.bits)
            before, count = stamp_ns, count + 1
        given = len(self.stamps_ns)
        if self._times.exact and count < given and not self._settings.partial:
            raise MovieError(
                f"{self._settings.times}: has {given} rows, and {self.path} {count} images; give each its row"
            )

    def provenance(self) -> Mapping[str, str]:
        """Facts for the head of the session; reads all files once, for their hashes."""
        facts, settings = self.facts, self._settings
        stated = {
            "source_file": self.path.name,
            "source_bytes": str(sum(file.stat().st_size for file in files_of(self.path))),
            "source_sha256": sha256_of(self.path),
            "source_reader": f"{facts.reader}, {facts.library}",
            "source_codec": (facts.codec or "uncompressed") + (", lossy" if facts.lossy else ""),
            "source_images": f"{facts.width_px} x {facts.height_px} x {facts.bits} bit",
            "source_times": self._times.text,
            "source_first_image_s": f"{seconds(self.first_ns):.9f}",
        }
        if facts.um_per_px is not None:
            stated["source_um_per_px"] = f"{facts.um_per_px:.6g}"
        if facts.notes is not None:
            stated["source_session"] = facts.notes.session
            stated["source_session_key"] = facts.notes.session_key
            stated["source_started"] = facts.notes.started
        if settings.channel is not None:
            stated["source_channel"] = settings.channel
        for key, file in (("times", settings.times), ("coil_log", settings.coils)):
            if file:
                stated[f"{key}_file"] = Path(file).name
                stated[f"{key}_sha256"] = sha256_of(Path(file))
        if self.log is None:
            drifts = "movie.drifts: the motion is that of the flow"
            stated["coil_log_file"] = f"none: {drifts if settings.drifts else 'the flow is not refined'}"
        if self.remarks:
            stated["source_remarks"] = "; ".join(self.remarks)
        return stated

    def close(self) -> None:
        """Release the files."""
        self._movie.close()

    def _stamps(self, times_ns: Ints) -> Ints:
        """Session stamps of times on the movie's clock."""
        since, rate = times_ns - self.first_ns, self._settings.clock_rate
        return since if rate == 1.0 else np.rint(since * rate).astype(np.int64)

    def _read_log(self, coils: Coils) -> FieldLog | None:
        settings = self._settings
        if not settings.coils:
            return None  # the refinement says why it is refused
        if settings.drifts:
            raise UsageError(
                f"movie.drifts = true says that nothing drove the body, and {settings.coils} is a log of its coils; "
                "leave one of them out"
            )
        name = Path(settings.coils)
        log = read_coil_log(name, settings.columns, coils, settings.heading_offset_deg, settings.heading_mirrored)
        log = log.interpolate() if settings.between_rows == "linear" else log
        log = log.shift_clock(-self.first_ns - nanoseconds(settings.clock_offset_s))
        begin_s, end_s, movie_s = (seconds(int(ns)) for ns in (log.times_ns[0], log.times_ns[-1], self.stamps_ns[-1]))
        if end_s < 0.0 or begin_s > movie_s:
            raise MovieError(
                f"{name}: does not overlap the movie: it runs from {begin_s:.3f} to {end_s:.3f} s of the movie's "
                f"{movie_s:.3f} s; is it another run's? If its clock has another zero, set movie.clock_offset_s"
            )
        if not (log.amplitude_mt > 0.0).any() or not log.frequency_hz.any():
            raise MovieError(
                f"{name}: the field never turns: its frequency or its amplitude is 0 throughout; check columns"
            )
        if begin_s > (1.0 - _LEAST_OVERLAP) * movie_s:
            self._log_remarks.append(f"the log begins {begin_s:.3f} s after the movie; no field is assumed before it")
        if end_s < _LEAST_OVERLAP * movie_s and log.amplitude_mt[-1] > 0.0 and log.frequency_hz[-1] > 0.0:
            self._log_remarks.append(
                f"the log ends {movie_s - end_s:.3f} s before the movie with the field on; it is assumed to stay on"
            )
        return log


def files_of(path: Path) -> list[Path]:
    """The files of a movie, in the order of their names."""
    return sorted(each for each in path.rglob("*") if each.is_file()) if path.is_dir() else [path]


def sha256_of(path: Path) -> str:
    """SHA-256 of a file; of a folder that of the names and hashes of its files."""
    if path.is_dir():
        digest = hashlib.sha256()
        for file in files_of(path):
            digest.update(f"{file.relative_to(path).as_posix()}\0{sha256_of(file)}\n".encode(errors="surrogateescape"))
        return digest.hexdigest()
    try:
        with path.open("rb") as opened:
            return hashlib.file_digest(opened, "sha256").hexdigest()
    except OSError as error:
        raise MovieError(f"{path}: can not be read ({error.strerror})") from error
