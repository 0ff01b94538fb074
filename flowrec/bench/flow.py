"""`flowrec bench flow`: the paper's Table I. How far each refinement brings an assumed flow towards the true one.

A case is read without its truth; the truth is read when the results are there to be scored. Each method runs in a
process of its own, so that its peak memory is its own.
"""

from __future__ import annotations

import multiprocessing
import os
import platform
import tempfile
import time
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import ExitStack
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from flowrec.bench.figure_flow import Picture, draw, median_case, need_matplotlib
from flowrec.bench.memory import peak_mb
from flowrec.chip.chip import Chip
from flowrec.chip.vessel_case import read_observations, read_true_velocity, read_vessel_case
from flowrec.errors import FlowError, FlowrecError, UsageError
from flowrec.estimation import Trimmed
from flowrec.flow import FlowSolver
from flowrec.flow.linear_solver import clear_cache
from flowrec.flow.sampling import relative_rmse
from flowrec.messages import FlowField, Observations
from flowrec.refine import PiUnet, Refiner
from flowrec.refine.training.vessels import draw_mask, make_case, with_mask_error
from flowrec.terminal import progress, say, table

MADE_UP = 10  # cases, where none are given

# Name in the table: the refiner that does it. `pi_unet` starts from the solver's prediction, as the paper's does;
# `pi_unet:printed` also with random weights and nothing but the network's descent.
METHODS = {
    "fvm": Refiner("fvm"),
    "ni": Refiner("ni"),
    "pinn": Refiner("pinn"),
    "unet": Refiner("unet"),
    "pi_unet:printed": Refiner("pi_unet", pi_unet=PiUnet(start="fvm", weights="none", finish="none")),
    "assimilate": Refiner("assimilate"),
    "pi_unet": Refiner("pi_unet", pi_unet=PiUnet(start="fvm")),
    "pi_unet:assimilate": Refiner("pi_unet", pi_unet=PiUnet(start="assimilate")),
}


@dataclass(frozen=True, slots=True)
class Trouble:
    """What is wrong with a case besides its parameters."""

    outliers: float = 0.0  # share of the observations that are replaced by nonsense of the flow's size
    mask: str = "right"  # grown, shrunk: walls one pixel off everywhere; shifted: one pixel to the right
    observations: str = "raw"  # trimmed: treated as in the paper before they are used


@dataclass(frozen=True, slots=True)
class Row:
    """One case by one method. Errors are relative RMSE over the true mask's fluid pixels."""

    case: str
    method: str
    rmse_vx: float
    rmse_vy: float
    rmse_v: float
    seconds: float  # from nothing: the initial solve and the refinement
    cpu_seconds: float  # the same without what other programs took
    seconds_update: float  # the same case again with other observations, all caches filled
    within_2_std: float | None  # share of the components that lie within two of the stated standard deviations
    stated_rmse_v: float | None  # what the error bars expect rmse_v to be
    peak_mb: float  # of the method's process up to then, above what it needs before it starts
    note: str


def measure(
    folder: Path | None = None,
    methods: Sequence[str] | None = None,
    noise: str = "05",
    share: str = "10",
    k: int = 2,
    trouble: Trouble = Trouble(),
    fields: Path | None = None,
    figure: Path | None = None,
    case: str | None = None,
) -> dict[str, Any]:
    """Rows per case and method, and their summary; `fields` keeps every field as CASE.METHOD.npz.

    A case that some method can not do is left out for all, and why is said in `left_out`.

    Without a folder of cases some are made up. `figure` is a PNG to draw, of the case that is named or else of the
    one whose error before any refinement is the median.

    Raises
    ------
    UsageError
        If there are no cases, or no such method or case, or a figure is wanted and matplotlib is not installed.
    """
    if figure is not None:
        need_matplotlib()
    methods = tuple(METHODS if methods is None else dict.fromkeys(methods))
    unknown = [name for name in methods if name not in METHODS]
    if unknown:
        raise UsageError(f"bench flow: no method {', '.join(map(repr, unknown))}; there are {', '.join(METHODS)}")
    rows: list[Row] = []
    left_out: dict[str, str] = {}
    with ExitStack() as stack:
        if fields is None and figure is not None:
            fields = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        if fields is not None:
            fields.mkdir(parents=True, exist_ok=True)
        if folder is None:
            folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
            make_up(folder, MADE_UP)
        cases = sorted(folder.glob("*.npz"))
        if not cases:
            raise UsageError(f"{folder}: no vessel case (*.npz) in it")
        if case is not None and case not in {path.stem for path in cases}:
            raise UsageError(f"bench flow: no case {case!r}; there are {', '.join(path.stem for path in cases)}")
        done = stack.enter_context(progress("refining", len(cases) * len(methods)))
        for method in methods:
            with ProcessPoolExecutor(1, multiprocessing.get_context("spawn"), _start) as worker:
                for number, path in enumerate(cases, len(cases) * methods.index(method) + 1):
                    try:
                        rows.append(worker.submit(_one, path, method, noise, share, k, trouble, fields).result())
                    except FlowrecError as error:  # walls a pixel off can close a channel
                        left_out[path.stem] = f"{method}: {error}"
                    done(number)
        rows = [row for row in rows if row.case not in left_out]
        if not rows:
            raise FlowError(f"{folder}: no case could be refined; {next(iter(left_out.values()))}")
        if figure is not None:
            assert fields is not None
            figures = [asdict(row) for row in rows]
            chosen = folder / f"{case or median_case(figures)}.npz"
            draw(figure, _picture(chosen, methods, noise, share, trouble, fields), figures)
    return {
        "machine": {"cores": os.cpu_count(), "platform": platform.platform(), "python": platform.python_version()},
        "noise": noise,
        "share": share,
        "k": k,
        "trouble": asdict(trouble),
        "rows": [asdict(row) for row in rows],
        "left_out": left_out,
        "summary": {method: _summary([row for row in rows if row.method == method]) for method in methods},
    }


def _summary(rows: list[Row]) -> dict[str, float | None]:
    """Mean, std and median over cases; `mean` and `std` are those of rmse_v."""
    made: dict[str, float | None] = {}
    for name in ("rmse_vx", "rmse_vy", "rmse_v"):
        values = [getattr(row, name) for row in rows]
        made |= {f"{name}_mean": float(np.mean(values)), f"{name}_std": float(np.std(values))}
    covered = [row.within_2_std for row in rows if row.within_2_std is not None]
    return made | {
        "mean": made["rmse_v_mean"],
        "std": made["rmse_v_std"],
        "worst": max(row.rmse_v for row in rows),
        "median_seconds": float(np.median([row.seconds for row in rows])),
        "median_cpu_seconds": float(np.median([row.cpu_seconds for row in rows])),
        "median_seconds_update": float(np.median([row.seconds_update for row in rows])),
        "peak_mb": max(row.peak_mb for row in rows),
        "within_2_std": float(np.mean(covered)) if covered else None,
    }


_floor_mb = 0.0


def _start() -> None:
    """Pay for imports before anything is measured."""
    global _floor_mb  # noqa: PLW0603 - one number per worker process
    import torch

    torch.set_num_threads(1)
    _floor_mb = peak_mb()


def _one(case: Path, method: str, noise: str, share: str, k: int, trouble: Trouble, fields: Path | None) -> Row:
    """Refine one case, then look at its truth."""
    chip = read_vessel_case(case)
    observations = _observations(case, noise, share, trouble)
    believed = with_mask_error(chip, trouble.mask)
    solver, refiner = FlowSolver(k), METHODS[method]
    clear_cache()
    began, began_cpu = time.perf_counter(), time.process_time()
    assumed = solver.solve(believed)
    field = refiner.refine(assumed, observations, believed, solver)
    seconds, cpu_seconds = time.perf_counter() - began, time.process_time() - began_cpu
    again = replace(observations, flow_um_s=observations.flow_um_s * 1.01)
    began = time.perf_counter()
    if method in ("fvm", "assimilate"):  # the others begin anew with every observation
        refiner.refine(assumed, again, believed, solver)
        seconds_update = time.perf_counter() - began
    else:
        seconds_update = seconds
    return _scored(case, method, chip, field, (seconds, cpu_seconds, seconds_update), fields)


def _scored(
    case: Path, method: str, chip: Chip, field: FlowField, seconds: tuple[float, float, float], fields: Path | None
) -> Row:
    """Read the truth, for the first time, and compare."""
    true = read_true_velocity(case)
    truth = replace(field, velocity_um_s=true.astype(np.float32))
    error = relative_rmse(field, truth, chip.mask)
    covered = stated = None
    if field.std_um_s is not None:
        miss = np.abs(field.velocity_um_s - true)[chip.mask]
        covered = float((miss <= 2.0 * field.std_um_s[chip.mask]).mean())
        stated = float(
            np.sqrt((field.std_um_s[chip.mask].astype(np.float64) ** 2).sum() / (true[chip.mask] ** 2).sum())
        )
    if fields is not None:
        np.savez_compressed(
            _field_path(fields, case, method),
            velocity_um_s=field.velocity_um_s,
            mask=chip.mask,
        )
    return Row(
        case.stem, method, error.vx, error.vy, error.v, *seconds, covered, stated, peak_mb() - _floor_mb, field.note
    )


def make_up(folder: Path, count: int, seed: int = 0) -> None:
    """Write `count` random vessel cases as made_up_NN.npz."""
    made = 0
    while made < count:
        rng = np.random.default_rng([seed, 0xCA5E])
        case = make_case(draw_mask(rng), rng)
        seed += 1
        if case is not None:
            np.savez_compressed(folder / f"made_up_{made:02d}.npz", allow_pickle=False, **case)
            made += 1


def _observations(case: Path, noise: str, share: str, trouble: Trouble) -> Observations:
    """What the robot says it felt; nonsense differs from case to case and is the same for every method."""
    seed = int.from_bytes(case.stem.encode()[-4:], "little")
    observations = with_outliers(read_observations(case, noise, share), trouble.outliers, seed)
    return Trimmed().treat(observations) if trouble.observations == "trimmed" else observations


def _picture(case: Path, methods: Sequence[str], noise: str, share: str, trouble: Trouble, fields: Path) -> Picture:
    """What the figure shows of a case that is scored."""
    chip = read_vessel_case(case)
    observations = _observations(case, noise, share, trouble)
    found = {}
    for method in methods:
        with np.load(_field_path(fields, case, method)) as field:
            found[method] = field["velocity_um_s"]
    truth = read_true_velocity(case)
    seen, felt = observations.position_um, observations.flow_um_s
    return Picture(case.stem, chip.mask, chip.um_per_px, truth, found, seen, felt)


def _field_path(fields: Path, case: Path, method: str) -> Path:
    return fields / f"{case.stem}.{method.replace(':', '_')}.npz"


def with_outliers(observations: Observations, share: float, seed: int) -> Observations:
    """Some observations replaced by draws of three times the flow's root mean square, their stated std unchanged."""
    rng = np.random.default_rng([seed, 17])
    count = round(share * len(observations.std_um_s))
    wrong = rng.choice(len(observations.std_um_s), count, replace=False)
    flow = observations.flow_um_s.copy()
    size = 3.0 * np.sqrt((flow**2).sum(axis=1).mean())
    flow[wrong] = size * rng.standard_normal((count, 2))
    return replace(observations, flow_um_s=flow)


def show(figures: dict[str, Any]) -> None:
    """Print Table I; seconds of an update and all single cases are in the JSON."""
    rows = []
    for method, line in figures["summary"].items():
        covered = line["within_2_std"]
        rows.append(
            (
                method,
                *(f"{line[f'{name}_mean']:.3f}±{line[f'{name}_std']:.3f}" for name in ("rmse_vx", "rmse_vy", "rmse_v")),
                f"{line['worst']:.3f}",
                "" if covered is None else f"{100 * covered:.0f} %",
                f"{line['median_seconds']:.2f}" if line["median_seconds"] < 10.0 else f"{line['median_seconds']:.0f}",
                f"{line['peak_mb']:.0f}",
            )
        )
    count = len({row["case"] for row in figures["rows"]})
    table(
        f"Relative RMSE over {count} cases, noise {figures['noise']} %, {figures['share']} % of the skeleton seen",
        ("method", "vx", "vy", "v", "worst v", "2 std", "s", "MB"),
        rows,
    )
    for case, why in figures["left_out"].items():
        say(f"{case} left out, {why}")
