"""`python -m tests.perf.movie_faults DIR`: one run as movies with a fault each: what import says, and its error.

The images of the run are shaken, drift in brightness, lack some or show a second robot; its log is that of another run,
slow or absent; the scale is wrong or the image mirrored. Of each: the flow error of the refined map against the
simulator's truth, the distance of the track from it, the exit status, and what was said.
"""

from __future__ import annotations

import csv
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import cv2
import numpy as np
import typer
from numpy.typing import NDArray

import flowrec
from flowrec.bench.harness import Results, print_rows, run
from flowrec.core import FlowrecError, Track
from flowrec.physics import relative_rmse
from flowrec.stages import load_config, with_sets
from flowrec.store import Session
from flowrec.verbs.record import record
from tests.movies import makers
from tests.perf.movies import laboratory, write_table

Images = list[NDArray[Any]]
SHAKE_HZ = 3.0
RUN = ("simulated.seed=1", "simulated.world=kind", "survey.method=downstream", "refine.assimilate.doubt_depth=false")
_PATCH_PX = 9  # half width of the copy of the robot
_SECOND_UM = (-250.0, 0.0)  # place of the copy from the right end of the image, on the middle line


def shaken(images: Images, times_s: NDArray[np.float64], amplitude_px: float) -> Images:
    """The images on a stage that shakes by an amplitude, on an ellipse at 3 Hz: cubic interpolation between pixels."""
    moved = []
    for image, time_s in zip(images, times_s, strict=True):
        phase = 2.0 * np.pi * SHAKE_HZ * time_s
        shift = amplitude_px * np.array([np.sin(phase + 0.7), 0.7 * np.cos(phase + 1.0)])
        moved.append(shifted(image, shift))
    return moved


def shifted(image: NDArray[Any], shift_px: NDArray[np.float64]) -> NDArray[Any]:
    """The image shifted by (columns, rows)."""
    to = np.array([[1.0, 0.0, shift_px[0]], [0.0, 1.0, shift_px[1]]])
    size = image.shape[1], image.shape[0]
    return np.asarray(cv2.warpAffine(image, to, size, flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE))


def with_second(images: Images, first_px: NDArray[np.float64], at_px: tuple[int, int]) -> Images:
    """The images with a copy of the robot as it looks in the first one, at rest at a place (column, row)."""
    x, y = (round(each) for each in first_px.tolist())
    half = _PATCH_PX
    patch = images[0][y - half : y + half + 1, x - half : x + half + 1]
    made = []
    for image in images:
        copy = image.copy()
        copy[at_px[1] - half : at_px[1] + half + 1, at_px[0] - half : at_px[0] + half + 1] = patch
        made.append(copy)
    return made


class Fault(NamedTuple):
    """A movie, its log ('': none), its times (their numbers if images lack), and settings besides."""

    images: Images
    log: Path | None
    sets: tuple[str, ...] = ()
    robot: str = ""
    lacking: tuple[int, ...] = ()  # numbers of images that are not there, and of which nobody tells


def faults(truth: Session, log: Path, folder: Path) -> dict[str, Callable[[], Fault]]:
    """The faults by name; the images of each are made when it is called."""
    ticks = list(truth.ticks())
    images = [tick.frame.image for tick in ticks]
    times_s = np.array([tick.stamp_ns for tick in ticks]) / 1e9
    first_px = truth.calibration.to_px(next(tick.truth.position_um for tick in ticks if tick.truth is not None))
    height, width = images[0].shape
    at_px = round(width + _SECOND_UM[0] / truth.config.camera.um_per_px), round(float(first_px[1]))
    rows = list(csv.reader(log.read_text().splitlines()))
    rng = np.random.default_rng(1)
    wrong = [tuple(rows[0]), *((t, f, f"{rng.uniform(-180.0, 180.0):.1f}", a) for t, f, _, a in rows[1:])]
    bright = np.linspace(0.7, 1.3, len(images))
    lacking = tuple(range(len(images) // 3, len(images) // 3 + 8))
    scale = truth.config.camera.um_per_px
    slow = [tuple(rows[0])]
    for row in rows[1:]:
        if float(row[0]) - float(slow[-1][0] if len(slow) > 1 else -1.0) >= 0.1:
            slow.append(tuple(row))
    return {
        "none": lambda: Fault(images, log),
        **{
            f"shake {px:g} px": lambda px=px: Fault(shaken(images, times_s, px), log)  # type: ignore[misc]
            for px in (1.0, 2.0, 4.0)
        },
        "shake 2 px, stabilise.on = false": lambda: Fault(shaken(images, times_s, 2.0), log, ("stabilise.on=false",)),
        "two robots alike": lambda: Fault(with_second(images, first_px, at_px), log),
        "two alike, the wrong one": lambda: Fault(
            with_second(images, first_px, at_px), log, robot=f"{at_px[0]},{at_px[1]}px"
        ),
        "two alike, the right one": lambda: Fault(
            with_second(images, first_px, at_px), log, robot=f"{first_px[0]:.0f},{first_px[1]:.0f}px"
        ),
        "no log": lambda: Fault(images, None),
        "log of another run": lambda: Fault(images, write_table(folder / "wrong.csv", wrong)),
        "log at 10 Hz": lambda: Fault(images, write_table(folder / "slow.csv", slow)),
        "brightness drifts by 60 %": lambda: Fault(
            [np.clip(each * gain, 0, 255).astype(np.uint8) for each, gain in zip(images, bright, strict=True)], log
        ),
        "16 bit": lambda: Fault([(each.astype(np.uint16) << 8) for each in images], log),
        "8 images lack, unsaid": lambda: Fault(images, log, lacking=lacking),
        "scale 5 % too large": lambda: Fault(images, log, (f"camera.um_per_px={1.05 * scale}",)),
        "scale 5 % too small": lambda: Fault(images, log, (f"camera.um_per_px={0.95 * scale}",)),
        "mirrored": lambda: Fault([np.ascontiguousarray(each[:, ::-1]) for each in images], log),
    }


def imported(folder: Path, truth: Session, fault: Fault) -> dict[str, Any]:
    """What import makes of a movie."""
    config, _ = laboratory(folder, truth)
    stamps = [tick.stamp_ns for tick in truth.ticks(with_frames=False)]
    kept = [number for number in range(len(stamps)) if number not in fault.lacking]
    movie = folder / "movie"
    if movie.exists():
        shutil.rmtree(movie)
    makers.folder(movie, [fault.images[number] for number in kept])
    # An image that lacks is not told: those after it have the times of a camera that lost none.
    rows = [("frame", "time_s"), *((str(n), f"{stamps[n] / 1e9:.6f}") for n in range(len(kept)))]
    times = write_table(folder / "frames.csv", rows)
    asked = with_sets(config, ["refine.assimilate.doubt_depth=false", *fault.sets])
    out = folder / "imported.mcap"
    try:
        done = flowrec.import_movie(movie, out, asked, coils=fault.log, times=times, overwrite=True, robot=fault.robot)
    except FlowrecError as error:
        return {"status": error.exit_status, "said": str(error).replace(f"{folder}/", "")}
    with flowrec.open(out) as session:
        error = {
            name: float(relative_rmse(field, truth.fields["true"], truth.chip.mask).v)
            for name, field in session.fields.items()
        }
        return {
            "status": done.exit_status,
            "unrefined": error.get("assumed"),
            "refined": error.get("refined"),
            "track_um": off_um(list(session.messages("track")), truth),
            "said": "; ".join([*done.doubts, session.fields["refined"].note if "refined" in session.fields else ""]),
            "shake": str(flowrec.info(session).get("source_shake", "")),
        }


def off_um(tracks: list[Track], truth: Session) -> float:
    """Root mean square distance of a track from the truth."""
    known = {tick.stamp_ns: tick.truth.position_um for tick in truth.ticks(with_frames=False) if tick.truth is not None}
    stamps = np.array(sorted(known))
    off = [t.position_um - known[int(stamps[np.abs(stamps - t.stamp_ns).argmin()])] for t in tracks if t.seen]
    return float(np.sqrt(np.mean(np.sum(np.square(off), axis=1)))) if off else float("nan")


def measure(
    folder: Annotated[Path, typer.Argument(help="Folder for the files; about 100 MB.")],
    only: Annotated[str, typer.Option(help="Only the faults whose names hold this.")] = "",
    sets: Annotated[str, typer.Option(help="More settings of the run, comma-separated.")] = "",
) -> Results:
    """What import says of one run with each fault, and how far its map is off."""
    folder.mkdir(parents=True, exist_ok=True)
    run_sets = [*RUN, *(each for each in sets.split(",") if each)]
    if not (folder / "truth.mcap").exists():
        record(load_config(None, run_sets), folder / "truth.mcap")
    rows = []
    with flowrec.open(folder / "truth.mcap") as truth:
        _, log = laboratory(folder, truth)
        for name, make in faults(truth, log, folder).items():
            if only in name:
                rows.append({"fault": name, **imported(folder, truth, make())})
    return {"rows": rows}


def report(results: Results) -> None:
    """One line for each fault."""
    rows = [{"unrefined": None, "refined": None, "track_um": None} | row for row in results["rows"]]
    columns = {
        "fault": "{fault}",
        "status": "{status}",
        "flow error": "{unrefined:.1%} -> {refined:.2%}",
        "track um": "{track_um:.2f}",
        "said": "{said}",
    }
    print_rows("Imports of one run", rows, columns, text="said")


if __name__ == "__main__":
    run(measure, report)
