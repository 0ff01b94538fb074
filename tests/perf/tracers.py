"""`python -m tests.perf.tracers`: tracks of tracers beside trackpy's, and displacements beside OpenPIV's.

Drawn images have a known truth: Gaussian spots of two sizes in a shear flow, by no renderer of flowrec. Both trackers
see the same images, and both are told the size of a spot and how far one can go in a frame. trackpy and OpenPIV are no
dependency: what is not installed is left out. With --movies, images of a folder are followed, too, and compared with
the positions and links that trackpy gave.
"""

from __future__ import annotations

import importlib.util
import itertools
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import cv2
import numpy as np
import typer
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from flowrec.bench.harness import Results, print_rows, run
from flowrec.core import Frame, Tracers, nanoseconds
from flowrec.physics import Calibration, Chip, Robot
from flowrec.stages.vision.tracers import TracerTracker

COUNTS = (1, 10, 100, 400)
SIZE_PX = (640, 512)
_RATE_HZ = 30.0
_SPOT_PX = 1.6  # standard deviation of a drawn spot
_FASTEST_PX = 4.0  # in a frame
_LEAST_MASS = 100.0  # of trackpy: the drawn spots have 180 and more, the noise between them has 40 at most
# Of the movies of trackpy's examples: radius in px, um per px, look. Others are told by the options.
_MOVIES = {"bulk_water": (3.0, 1.0 / 2.85, "dark"), "brightfield": (8.0, 0.2, "bright")}
_NEAR_PX = 2.0  # farther from the truth, a place is that of no body
Rows = NDArray[np.float64]  # (n, 3): number of a track, column, row in px


def drawn(count: int, frames: int, seed: int) -> tuple[list[NDArray[np.uint8]], list[Rows]]:
    """Images of spots in a parabolic flow, with shot noise, and where they are; a spot that leaves comes in again."""
    rng = np.random.default_rng(seed)
    width, height = SIZE_PX
    place = rng.uniform((8, 8), (width - 8, height - 8), (count, 2))
    number, next_number = np.arange(count), count
    size = _SPOT_PX * rng.choice((0.8, 1.2), count)
    y, x = np.mgrid[-8:9, -8:9]
    images, truth = [], []
    for _ in range(frames):
        light = np.full((height + 32, width + 32), 170.0)
        for (column, row), std in zip(place, size, strict=True):
            c, r = int(column), int(row)
            spot = np.exp(-((x - column + c) ** 2 + (y - row + r) ** 2) / (2.0 * std**2))
            light[r + 8 : r + 25, c + 8 : c + 25] -= 60.0 * spot
        light = light[16:-16, 16:-16]
        images.append(np.clip(light + 2.0 * rng.standard_normal(light.shape), 0, 255).astype(np.uint8))
        truth.append(np.column_stack([number, place]).astype(np.float64))
        speed = _FASTEST_PX * (1.0 - (2.0 * place[:, 1] / height - 1.0) ** 2)
        place = place + np.column_stack([speed, 0.1 * rng.standard_normal(count)])
        place[:, 1] = np.clip(place[:, 1], 6, height - 6)
        left = place[:, 0] > width - 6
        place[left, 0] = 6.0
        number[left] = next_number + np.arange(left.sum())
        next_number += int(left.sum())
    return images, truth


def by_flowrec(
    images: Sequence[NDArray[np.uint8]],
    radius_px: float,
    fastest_px: float,
    look: Any = "dark",
    um_per_px: float = 10.0,
) -> tuple[list[Rows], float]:
    """The tracks in each image of an open field, and seconds a frame."""
    shape = images[0].shape
    chip = Chip("open", np.ones(shape, bool), um_per_px, (), 1.0, 1000.0)
    fastest_um_s = fastest_px * um_per_px * _RATE_HZ
    robot = Robot(radius_um=10.0, um_per_rev=60.0, step_out_hz=20.0, max_speed_um_s=fastest_um_s)
    tracker, last, found = TracerTracker(radius_px * um_per_px, look), None, []
    began_s = 0.0
    for index, image in enumerate(images):
        began_s = time.process_time() if index == 1 else began_s  # the first one loads what it needs
        frame = Frame(nanoseconds(index / _RATE_HZ), index, image)
        last = tracker.follow(last, None, frame, chip, Calibration(um_per_px), robot)
        found.append(_seen(last, um_per_px))
    return found, (time.process_time() - began_s) / max(len(images) - 1, 1)


def _seen(tracers: Tracers, um_per_px: float) -> Rows:
    return np.column_stack([tracers.id, tracers.position_um / um_per_px])[tracers.lost_frames == 0]


def by_trackpy(images: Sequence[NDArray[np.uint8]], radius_px: float, fastest_px: float) -> tuple[list[Rows], float]:
    """As `by_flowrec`, with the settings that trackpy's introduction gives for dark spots."""
    import trackpy

    trackpy.quiet()
    began_s = time.process_time()
    diameter = 2 * round(2.0 * radius_px) + 1
    places = [trackpy.locate(255 - each, diameter, minmass=_LEAST_MASS)[["x", "y"]].to_numpy() for each in images]
    numbers = [each for _, each in trackpy.link_iter(places, search_range=1.5 * fastest_px, memory=3)]
    took_s = (time.process_time() - began_s) / len(images)
    return [np.column_stack(pair) for pair in zip(numbers, places, strict=True)], took_s


def judged(found: Sequence[Rows], truth: Sequence[Rows]) -> dict[str, float]:
    """Shares found and false, error and changes of number by body that is seen, from the third image on."""
    wanted = hits = false = switches = 0
    errors: list[float] = []
    known: dict[float, float] = {}
    for ours, theirs in itertools.islice(zip(found, truth, strict=True), 2, None):
        wanted += len(theirs)
        if not len(ours) or not len(theirs):
            false += len(ours)
            continue
        distance, number = cKDTree(ours[:, 1:]).query(theirs[:, 1:], distance_upper_bound=_NEAR_PX)
        hit = np.isfinite(distance)
        hits += int(hit.sum())
        errors += list(distance[hit] ** 2)
        false += len(ours) - len(set(number[hit]))
        for body, track in zip(theirs[hit, 0], ours[number[hit], 0], strict=True):
            switches += known.get(body, track) != track
            known[body] = track
    return {
        "found": hits / max(wanted, 1),
        "false": false / max(wanted, 1),
        "rms_px": float(np.sqrt(np.mean(errors))) if errors else float("nan"),
        "switches_per_1000": 1000.0 * switches / max(hits, 1),
    }


def _image(file: Path) -> NDArray[np.uint8]:
    return np.asarray(cv2.imread(str(file), cv2.IMREAD_GRAYSCALE), np.uint8)


def displacements(first: Path, second: Path) -> dict[str, float]:
    """Of OpenPIV's pair of images: displacement of our tracks beside its correlation, on its windows."""
    import openpiv.pyprocess as piv  # type: ignore[import-not-found]

    pair = [_image(each) for each in (first, second)]
    u, v, _ = piv.extended_search_area_piv(*(each.astype(np.int32) for each in pair), 32, 16, search_area_size=32)
    columns, rows = piv.get_coordinates(pair[0].shape, 32, 16)
    u, v = u.ravel(), v.ravel()
    fastest = float(np.nanmax(np.hypot(u, v)))
    tracks, _ = by_flowrec(pair, 1.5, 2.0 * float(np.nanmedian(np.hypot(u, v))), "bright")
    before = {each[0]: each[1:] for each in tracks[0]}
    both = np.array([[*before[each[0]], *(each[1:] - before[each[0]])] for each in tracks[1] if each[0] in before])
    tree = cKDTree(both[:, :2])
    near = tree.query_ball_point(np.column_stack([columns.ravel(), rows.ravel()]), 16.0)
    ours = np.array([np.median(both[each, 2:], axis=0) if len(each) >= 3 else (np.nan, np.nan) for each in near])
    off = np.hypot(ours[:, 0] - u, ours[:, 1] - v)
    return {
        "windows": float(np.isfinite(off).sum()),
        "tracks": float(len(both)),
        "median_px": float(np.nanmedian(np.hypot(u, v))),
        "fastest_px": fastest,
        "median_off_px": float(np.nanmedian(off)),
        "within_1_px": float(np.mean(off[np.isfinite(off)] < 1.0)),
    }


def measure(
    frames: Annotated[int, typer.Option(min=5, help="Drawn images of each number of bodies.")] = 60,
    movies: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Folders of images, each beside a table NAME.csv of trackpy.")
    ] = None,
    radius_px: Annotated[float, typer.Option(help="Of the dark spots of the movies.")] = 3.0,
) -> Results:
    """Tracks of drawn spots, of movies, and displacements of OpenPIV's images."""
    installed = {name: importlib.util.find_spec(name) is not None for name in ("trackpy", "openpiv")}
    methods: dict[str, Any] = {"flowrec": by_flowrec} | ({"trackpy": by_trackpy} if installed["trackpy"] else {})
    rows = []
    for count in COUNTS:
        images, truth = drawn(count, frames, seed=count)
        for name, follow in methods.items():
            found, took_s = follow(images, _SPOT_PX, _FASTEST_PX)
            rows.append({"images": f"{count} drawn", "method": name, "ms": 1e3 * took_s, **judged(found, truth)})
    for file in sorted(movies.glob("*.csv")) if movies is not None else ():
        images = [_image(each) for each in sorted(file.with_suffix("").iterdir())]
        listed = np.genfromtxt(file, delimiter=",", names=True)
        table_rows = np.column_stack([listed[name] for name in ("particle", "x_px", "y_px")])
        truth = [table_rows[listed["frame"] == index] for index in range(len(images))]
        radius, um_per_px, look = _MOVIES.get(file.stem, (radius_px, 1.0, "dark"))
        found, took_s = by_flowrec(images, radius, _FASTEST_PX, look, um_per_px)
        rows.append({"images": file.stem, "method": "flowrec", "ms": 1e3 * took_s, **judged(found, truth)})
    piv: dict[str, float] = {}
    if installed["openpiv"]:
        import openpiv

        folder = Path(openpiv.__path__[0]) / "data" / "test1"
        piv = displacements(folder / "exp1_001_a.bmp", folder / "exp1_001_b.bmp")
    return {"rows": rows, "openpiv": piv}


def show(found: dict[str, Any]) -> None:
    """Print the figures."""
    print_rows(
        "Tracks of tracers",
        found["rows"],
        {
            "images": "{images}",
            "method": "{method}",
            "found": "{found:.1%}",
            "false": "{false:.1%}",
            "error": "{rms_px:.2f} px",
            "switches per 1000": "{switches_per_1000:.1f}",
            "CPU a frame": "{ms:.1f} ms",
        },
    )
    rows = [{"what": key, "value": value} for key, value in found["openpiv"].items()]
    if rows:
        print_rows("Beside OpenPIV", rows, {"": "{what}", "value": "{value:.3g}"})


if __name__ == "__main__":
    run(measure, show)
