"""`python -m tests.perf.movies DIR`: simulated runs as movies of other people's encoders, imported, verified, compared.

Each run is exported as a laboratory would have it: a movie and a table of what the coils were commanded. The session
that `import` makes of them knows nothing of the truth; its refined flow is compared with the simulator's true flow. How
good that can be depends on where the run went and how well the robot rolls: so all observations of the run itself are
refined too, as are the true velocities where they were taken.
"""

from __future__ import annotations

import csv
import shutil
import time
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

import flowrec
from flowrec.bench.harness import Results, print_rows, run
from flowrec.core import progress
from flowrec.physics import chip_files, relative_rmse, sample
from flowrec.stages import Config, load_config
from flowrec.store import Session
from flowrec.verbs.record import record
from tests.movies import makers

KINDS = ("png", "ome-tiff 12 bit", "ffv1", "ome-zarr", "mjpeg", "h264", "xvid")


def commands_of(session: Session) -> list[tuple[str, ...]]:
    """What the coils were commanded: a row for each change."""
    rows, last = [("time_s", "frequency_hz", "heading_deg", "amplitude_mt")], None
    for tick in session.ticks(with_frames=False):
        c = tick.currents
        command = (c.frequency_hz, c.heading_rad, c.amplitude_mt)
        if command != last:
            cells = (tick.stamp_ns / 1e9, c.frequency_hz, np.degrees(c.heading_rad), c.amplitude_mt)
            rows.append(tuple(f"{cell:.4f}" for cell in cells))
            last = command
    return rows


def write_table(path: Path, rows: list[tuple[str, ...]]) -> Path:
    with path.open("w", newline="") as file:
        csv.writer(file).writerows(rows)
    return path


def laboratory(folder: Path, session: Session) -> tuple[Config, Path]:
    """The files of a laboratory: the chip and the log; the settings that it knows, and the log's path."""
    png, toml = chip_files(session.chip)
    (folder / "chip.png").write_bytes(png)
    (folder / "chip.toml").write_text(toml, encoding="utf-8")
    config = session.config
    sets = [f"camera.um_per_px={config.camera.um_per_px}", f"chip.path={folder / 'chip.toml'}"]
    sets += [f"robot.{key}={getattr(config.robot, key)}" for key in ("radius_um", "um_per_rev", "delay_s")]
    return load_config(None, sets), write_table(folder / "commands.csv", commands_of(session))


def movie_of(kind: str, folder: Path, images: list[Any], stamps_ns: list[int]) -> tuple[Path, Path | None]:
    """The movie, and the table of its times where it can not hold them."""
    times_s = np.array(stamps_ns) / 1e9
    rate_hz = (len(stamps_ns) - 1) / (times_s[-1] - times_s[0])
    if kind == "png":
        rows = [("frame", "time_s"), *((str(n), f"{t:.6f}") for n, t in enumerate(times_s))]
        return makers.folder(folder / "png", images), write_table(folder / "frames.csv", rows)
    if kind == "ome-tiff 12 bit":
        return makers.ome_tiff(folder / "stack.ome.tif", images, times_s, bits=12), None
    if kind == "ome-zarr":
        return makers.ome_zarr(folder / "stack.zarr", images, 1.0 / rate_hz), None
    return makers.video(folder / f"{kind}{makers.CODECS[kind][3]}", kind, images, rate_hz), None


def limits(truth: Session) -> tuple[float, float]:
    """Flow error of a refinement by all observations of the run itself, and by the true velocities at their places."""
    taken, true_flow = list(truth.messages("observations"))[-1], truth.fields["true"]
    there = np.array([sample(true_flow, place) for place in taken.position_um])
    config, errors = truth.config, []
    for each in (taken, replace(taken, flow_um_s=there)):
        field = config.refine.refine(truth.fields["assumed"], each, truth.chip, config.flow)
        errors.append(float(relative_rmse(field, true_flow, truth.chip.mask).v))
    return errors[0], errors[1]


def measured(folder: Path, kinds: tuple[str, ...], sets: list[str]) -> list[dict[str, Any]]:
    """Rows of one world."""
    rows: list[dict[str, Any]] = []
    for bits in (12, 8):
        wanted = [kind for kind in kinds if ("12" in kind) == (bits == 12)]
        if not wanted:
            continue
        record(load_config(None, [*sets, f"camera.bits={bits}"]), folder / "truth.mcap", overwrite=True)
        with flowrec.open(folder / "truth.mcap") as truth:
            ticks = list(truth.ticks())
            images, stamps = [tick.frame.image for tick in ticks], [tick.stamp_ns for tick in ticks]
            true_um = {tick.stamp_ns: tick.truth.position_um for tick in ticks if tick.truth is not None}
            true_flow, mask = truth.fields["true"], truth.chip.mask
            config, log = laboratory(folder, truth)
            own, exact = limits(truth)
            for kind in wanted:
                movie, times = movie_of(kind, folder, images, stamps)
                out, began_s = folder / "imported.mcap", time.perf_counter()
                flowrec.import_movie(movie, out, config, coils=log, times=times, overwrite=True)
                took_s = time.perf_counter() - began_s
                replayed = flowrec.replay(out, verify=True)
                with flowrec.open(out) as session:
                    tracks = [track for track in session.messages("track") if track.seen]
                    known = np.array(sorted(true_um))
                    errors = [
                        track.position_um - true_um[int(known[np.abs(known - track.stamp_ns).argmin()])]
                        for track in tracks
                    ]
                    error = {name: relative_rmse(field, true_flow, mask).v for name, field in session.fields.items()}
                    rows.append(
                        {
                            "kind": kind,
                            "images": len(images),
                            "seen": len(tracks),
                            "track_um": float(np.sqrt(np.mean(np.sum(np.square(errors), axis=1)))),
                            "unrefined": float(error["assumed"]),
                            "refined": float(error.get("refined", np.nan)),
                            "own": own,
                            "exact": exact,
                            "verified": replayed.same,
                            "good": flowrec.check(out).word == "good",
                            "mb": sum(f.stat().st_size for f in ([movie] if movie.is_file() else movie.rglob("*")))
                            / 1e6,
                            "import_s": took_s,
                        }
                    )
                shutil.rmtree(movie) if movie.is_dir() else movie.unlink()
    return rows


def measure(
    folder: Annotated[Path, typer.Argument(help="Folder for the files; about 1 GB.")],
    seeds: Annotated[int, typer.Option(min=1, help="Worlds.")] = 5,
    kinds: Annotated[str, typer.Option(help="Comma-separated names of kinds.")] = ",".join(KINDS),
    chip: Annotated[str, typer.Option(help="Built-in chip.")] = "bifurcation",
) -> Results:
    """Errors of flow and track by kind of movie and seed."""
    folder.mkdir(parents=True, exist_ok=True)
    names = tuple(name.strip() for name in kinds.split(","))
    rows = []
    with progress("movies", seeds) as done:
        for seed in range(1, seeds + 1):
            sets = [f"simulated.seed={seed}", f"chip.name={chip}", f"chip.seed={seed}"]
            rows += [{"seed": seed, **row} for row in measured(folder, names, sets)]
            done(seed)
    return {"rows": rows}


def report(results: Results) -> None:
    """One line for each movie."""
    print_rows(
        "Imported movies",
        results["rows"],
        {
            "seed": "{seed}",
            "kind": "{kind}",
            "seen": "{seen}/{images}",
            "track um": "{track_um:.2f}",
            "flow error": "{unrefined:.1%} -> {refined:.2%}",
            "own, exact": "{own:.2%}, {exact:.2%}",
            "verified": "{verified}",
            "GOOD": "{good}",
            "MB": "{mb:.2f}",
            "s": "{import_s:.1f}",
        },
    )


if __name__ == "__main__":
    run(measure, report)
