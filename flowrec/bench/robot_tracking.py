"""The tracker on movies of robots that are no dark discs, beside a threshold (the null model) and trackpy."""

from __future__ import annotations

import csv
import importlib.util
import math
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from flowrec.bench.harness import print_rows
from flowrec.bench.robot_movies import RobotMovie, judges
from flowrec.core import Appearance, Floats, Frame, Image, Track, UsageError
from flowrec.physics import Calibration, Chip, Robot
from flowrec.stages import Tracker

_RATE_HZ = 25.0
_MOST_RADII = 3.0  # that a robot moves between two frames: its greatest speed, which all methods are told
_SWITCHED_RADII = 1.5  # an error beyond this is that of another object

Found = tuple[Floats, Floats]  # positions (n, 2) in px, NaN where not seen; ms (n,) of CPU
Method = Callable[[RobotMovie], Found]


def by_flowrec(movie: RobotMovie) -> Found:
    """The tracker from a click, or from a box where the movie needs one."""
    x, y = movie.centres_px[0].tolist()
    marked: dict[str, Any] = {"box_px": movie.box_px} if movie.box else {"click_px": (x, y)}
    tracker = Tracker(polarity="auto", **marked)
    shape = movie.images[0].shape
    chip = Chip("open", np.ones(shape, bool), 1.0, (), 1.0, 1000.0)
    speed = _MOST_RADII * movie.radius_px * _RATE_HZ / tracker.reach_speed
    robot = Robot(radius_um=movie.radius_px, max_speed_um_s=speed, step_out_hz=1e4)
    track: Track | None = None
    appearance: Appearance | None = None
    places, ms = [], []
    for index, image in enumerate(movie.images):
        frame = Frame(round(index / _RATE_HZ * 1e9), index, image, movie.bits)
        start = time.thread_time()
        track, appearance = tracker.follow(track, appearance, frame, chip, Calibration(1.0), robot)
        ms.append(1e3 * (time.thread_time() - start))
        places.append(track.position_um if track.seen else np.full(2, np.nan))
    return np.array(places), np.array(ms)


def by_threshold(movie: RobotMovie) -> Found:
    """The object nearest to the last place, of all that differ from the median by half of what the robot did."""
    x, y = movie.centres_px[0].tolist()
    last, places, ms = np.array([x, y]), [], []
    first = movie.images[0].astype(np.float64)
    half = math.ceil(0.5 * movie.radius_px)
    around = first[max(round(y) - half, 0) : round(y) + half + 1, max(round(x) - half, 0) : round(x) + half + 1]
    contrast = float(np.abs(around - np.median(first)).max())
    for image in movie.images:
        start = time.thread_time()
        differs = (np.abs(image - np.median(image)) > 0.5 * contrast).astype(np.uint8)
        _, _, _, centres = cv2.connectedComponentsWithStats(differs)
        distance = np.hypot(*(centres[1:] - last).T)
        ms.append(1e3 * (time.thread_time() - start))
        near = len(distance) and distance.min() < (_MOST_RADII + 2.0) * movie.radius_px
        last = centres[1 + int(distance.argmin())] if near else last
        places.append(last if near else np.full(2, np.nan))
    return np.array(places), np.array(ms)


def by_trackpy(movie: RobotMovie) -> Found:
    """`locate` and `link` of trackpy, with the diameter, the polarity and the brightness that the click gives."""
    import pandas
    import trackpy

    trackpy.quiet()
    x, y = movie.centres_px[0].tolist()
    diameter = max(2 * int(movie.radius_px) + 1, 3)
    first = movie.images[0].astype(np.float64)
    inverted = float(
        first[max(round(y) - 1, 0) : round(y) + 2, max(round(x) - 1, 0) : round(x) + 2].mean()
    ) < np.median(first)
    top = 2.0**movie.bits - 1.0
    tables, ms, least = [], [], 0.0
    for index, image in enumerate(movie.images):
        start = time.thread_time()
        shown = top - image if inverted else image.astype(np.float64)
        table = trackpy.locate(shown, diameter, minmass=least)
        ms.append(1e3 * (time.thread_time() - start))
        if index == 0 and len(table):
            least = 0.3 * float(table.mass.iloc[int(np.hypot(table.x - x, table.y - y).argmin())])
            table = table[table.mass >= least]
        table["frame"] = index
        tables.append(table)
    frames = pandas.concat(tables)
    places = np.full((len(movie.images), 2), np.nan)
    try:
        linked = trackpy.link(
            frames, (_MOST_RADII + 2.0) * movie.radius_px, memory=3, adaptive_stop=1.0, adaptive_step=0.9
        )
    except trackpy.SubnetOversizeException:
        return places, np.array(ms)
    begin = linked[linked.frame == 0]
    if len(begin):
        which = begin.particle.iloc[int(np.hypot(begin.x - x, begin.y - y).argmin())]
        for row in linked[linked.particle == which].itertuples():
            places[row.frame] = row.x, row.y
    return places, np.array(ms)


METHODS: dict[str, Method] = {"flowrec": by_flowrec, "threshold": by_threshold}
if importlib.util.find_spec("trackpy") is not None:
    METHODS["trackpy"] = by_trackpy


def show_rows(rows: list[dict[str, Any]]) -> None:
    """Print a table of the synthetic movies, and one line for each recorded movie."""
    columns = {
        **{"movie": "{movie}", "method": "{method}", "seen": "{seen:.0%}", "RMSE px": "{rmse_px:.3f}"},
        **{"worst": "{worst_px:.2f}", "elsewhere": "{elsewhere:.0%}", "ms p50": "{p50_ms:.2f}", "p95": "{p95_ms:.2f}"},
    }
    print_rows("Robots that are no dark discs, from one click or box", rows, columns)


def row(name: str, method: str, movie: RobotMovie, found: Found) -> dict[str, Any]:
    """Share of frames seen, errors in px (bias: the mean in x and y), frames on another object, CPU time in ms."""
    places, ms = found
    miss = places - movie.centres_px
    seen = np.isfinite(miss[:, 0])
    distance = np.hypot(*miss[seen].T)
    return {
        "movie": name,
        "method": method,
        "seen": float(seen.mean()),
        "rmse_px": float(np.sqrt(np.mean(distance**2))) if seen.any() else math.nan,
        "bias_px": miss[seen].mean(axis=0).tolist() if seen.any() else [math.nan, math.nan],
        "worst_px": float(distance.max()) if seen.any() else math.nan,
        "elsewhere": float((distance > _SWITCHED_RADII * movie.radius_px).mean()) if seen.any() else math.nan,
        # Once locked: not the first frame.
        "p50_ms": float(np.median(ms[1:])),
        "p95_ms": float(np.percentile(ms[1:], 95)),
    }


def tracking_rows(movies: Path | None) -> Iterator[dict[str, Any]]:
    """A row for each synthetic movie and method, and for each object of the recorded movies of a folder."""
    for name, make in judges().items():
        movie = make()
        for method, find in METHODS.items():
            yield row(name, method, movie, find(movie))
    recorded: dict[str, list[dict[str, Any]]] = {}
    for name, movie in recorded_movies(movies) if movies is not None else ():
        recorded.setdefault(name.split()[0], []).append(row(name, "flowrec", movie, by_flowrec(movie)))
    for name, each in recorded.items():
        yield together(name, each)


def together(name: str, rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Medians over the objects of a movie; the share seen is the least one, the worst error the greatest."""
    middle = {key: float(np.median([each[key] for each in rows])) for key in ("rmse_px", "p50_ms", "p95_ms")}
    return {
        "movie": f"{name}, {len(rows)} objects",
        "method": "flowrec",
        "seen": min(each["seen"] for each in rows),
        "bias_px": np.mean([each["bias_px"] for each in rows], axis=0).tolist(),
        "worst_px": max(each["worst_px"] for each in rows),
        "elsewhere": float(np.mean([each["elsewhere"] for each in rows])),
        "within_0_3_px": sum(each["seen"] == 1.0 and each["rmse_px"] <= 0.3 for each in rows),
        "objects": len(rows),
        **middle,
    }


def recorded_movies(folder: Path) -> Iterator[tuple[str, RobotMovie]]:
    """Each object that NAME.csv (frame, x_px, y_px, particle) follows through all images of NAME/*.png.

    The radius is a quarter of the least distance of two objects, but at most 8 px. Raises UsageError: no such files.
    """
    tables = sorted(folder.glob("*.csv"))
    if not tables:
        raise UsageError(f"{folder}: holds no NAME.csv with frame, x_px, y_px, particle beside a folder NAME of images")
    for table in tables:
        files = sorted((folder / table.stem).glob("*.png"))
        images: list[Image] = [np.asarray(cv2.imread(str(file), cv2.IMREAD_GRAYSCALE), np.uint8) for file in files]
        paths: dict[str, dict[int, tuple[float, float]]] = {}
        with table.open(newline="", encoding="utf-8") as lines:
            for line in csv.DictReader(lines):
                place = float(line["x_px"]), float(line["y_px"])
                paths.setdefault(line["particle"], {})[int(float(line["frame"]))] = place
        starts = np.array([path[0] for path in paths.values() if 0 in path])
        apart = np.hypot(*(starts[:, None] - starts[None]).transpose(2, 0, 1)) + 1e9 * np.eye(len(starts))
        for particle, path in paths.items():
            if set(path) == set(range(len(images))):
                centres = np.array([path[frame] for frame in range(len(images))])
                yield f"{table.stem} {particle}", RobotMovie(images, centres, min(0.25 * float(apart.min()), 8.0))
