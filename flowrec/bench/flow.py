"""`flowrec bench flow`: Table I of the paper, the error of the flow after each refinement.

A case is read without its truth, which is read when there is a result to score. Each method runs in a process of its
own, so that peak memory is that of the method.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import typer
from numpy.typing import NDArray

from flowrec.bench.figure_flow import FlowPanels, draw, median_case
from flowrec.bench.harness import (
    Cases,
    FigureFile,
    Names,
    Results,
    choose_names,
    flow_scores,
    print_rows,
    stated_over_true,
    vessel_cases,
)
from flowrec.bench.null_models import NULL_MODELS, NullModel
from flowrec.bench.vessel_truth import Noise, ObservedShare, read_observations, read_true_pressure, read_true_velocity
from flowrec.bench.vessels import draw_mask, make_case, with_mask_error
from flowrec.core import (
    FlowError,
    FlowrecError,
    Observations,
    peak_mb,
    pool,
    progress,
    remove_leftovers,
    replacing,
    say,
)
from flowrec.physics import FlowSolver, clear_cache, read_vessel_case, relative_rmse
from flowrec.stages import REFINERS, Device, PiUnet, Refiner, Trimmed, with_row

RANDOM_CASES = 10  # vessels that are made up where no folder of cases is given

# The rows of REFINERS and of null_models.py; fvm, which refines nothing, and gain are null models, too. As in the
# paper, pi_unet starts from the solver's field. `:printed` has random weights and no other optimiser than the paper's.
METHODS: dict[str, Refiner | NullModel] = {
    **{name: with_row(Refiner(pi_unet=PiUnet(start="fvm")), REFINERS, name) for name in REFINERS.usable()},
    "pi_unet:printed": Refiner("pi_unet", pi_unet=PiUnet(start="fvm", weights="none", finish="none")),
    "pi_unet:assimilate": Refiner("pi_unet", pi_unet=PiUnet(start="assimilate")),
    **{name: NullModel(name) for name in NULL_MODELS},
}
_INCREMENTAL = ("fvm", "assimilate")  # an update reuses earlier results; the others start again


@dataclass(frozen=True, slots=True)
class Scenario:
    """Observations of a case, and its deviations from the assumptions besides the assumed parameters."""

    noise: str = "05"  # % of the root mean square speed along the route
    share: str = "10"  # part of the skeleton that is observed, %
    k: int = 2
    outliers: float = 0.0  # fraction of the observations
    # grown, shrunk: walls one pixel off everywhere; shifted: one pixel to the right; otsu, adaptive: from a picture
    mask: str = "right"
    observations: str = "raw"  # trimmed: outliers removed as in the paper
    device: Device = "cpu"  # of the methods that have a network

    def observe(self, case: Path) -> Observations:
        """The observations of a case. Outliers differ between cases and are the same for every method."""
        seed = int.from_bytes(case.stem.encode()[-4:], "little")
        observations = with_outliers(read_observations(case, self.noise, self.share), self.outliers, seed)
        return Trimmed().treat(observations) if self.observations == "trimmed" else observations


def _check_subcells(k: int) -> int:
    if k not in (1, 2, 4):
        raise typer.BadParameter(f"{k}: choose 1, 2 or 4 subcells per pixel side")
    return k


def measure(
    cases: Cases = None,
    methods: Names = None,
    noise: Noise = "05",
    share: ObservedShare = "10",
    k: Annotated[int, typer.Option("-k", callback=_check_subcells, help="Subcells per pixel side: 1, 2 or 4.")] = 2,
    outliers: Annotated[float, typer.Option(min=0, max=1, help="Share of the observations that are outliers.")] = 0.0,
    mask: Annotated[
        Literal["right", "grown", "shrunk", "shifted", "otsu", "adaptive"],
        typer.Option(help="Error of the assumed walls: of one pixel, or those of a picture by a threshold."),
    ] = "right",
    observations: Annotated[
        Literal["raw", "trimmed"], typer.Option(help="trimmed: outliers are removed as in the paper.")
    ] = "raw",
    device: Annotated[Device, typer.Option(help="Where the networks are fitted.")] = "cpu",
    fields: Annotated[Path | None, typer.Option(metavar="DIR", help="Write every field into this folder.")] = None,
    figure: FigureFile = None,
    case: Annotated[
        str | None, typer.Option(metavar="NAME", help="Case of the figure; by default that of median error.")
    ] = None,
) -> Results:
    """Rows by case and method, and a summary by method; `fields` gets every field as CASE.METHOD.npz.

    A case that one method can not do is left out for all methods; `left_out` has the reason.

    Raises
    ------
    UsageError
        If there is no case, no such method or no such case of the figure.
    FlowError
        If no case can be refined.
    """
    names = choose_names("bench flow: no method", methods, METHODS)
    scenario = Scenario(noise, share, k, outliers, mask, observations, device)
    rows: list[dict[str, Any]] = []
    left_out: dict[str, str] = {}
    with ExitStack() as stack:
        if fields is None and figure is not None:
            fields = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        if fields is not None:
            fields.mkdir(parents=True, exist_ok=True)
            stack.callback(remove_leftovers, fields)  # of the process below, if it was stopped
        if cases is None:
            cases = Path(stack.enter_context(tempfile.TemporaryDirectory()))
            make_up(cases, RANDOM_CASES)
        paths = vessel_cases(cases)
        if case is not None:
            choose_names("bench flow: no case", case, [path.stem for path in paths])
        done = stack.enter_context(progress("refining", len(paths) * len(names), "refinements"))
        for first, method in zip(range(0, len(paths) * len(names), len(paths)), names, strict=True):
            with pool(1) as worker:
                before_mb = worker.submit(_prepare).result()
                for number, path in enumerate(paths, first + 1):
                    try:
                        row = worker.submit(refine_case, path, method, scenario, fields).result()
                        rows.append(row | {"peak_mb": row["peak_mb"] - before_mb})
                    except FlowrecError as error:  # a wall that is one pixel off can close a channel
                        left_out[path.stem] = f"{method}: {error}"
                    done(number)
        rows = [row for row in rows if row["case"] not in left_out]
        if not rows:
            raise FlowError(f"{cases}: no case could be refined; {next(iter(left_out.values()))}")
        if figure is not None:
            assert fields is not None
            draw(figure, _picture(cases / f"{case or median_case(rows)}.npz", names, scenario, fields), rows)
    return {
        **asdict(scenario),
        "rows": rows,
        "left_out": left_out,
        "summary": {method: summary([row for row in rows if row["method"] == method]) for method in names},
    }


def _prepare() -> float:
    """Import torch before anything is measured; returns the peak memory of the process so far, MB."""
    import torch

    torch.set_num_threads(1)
    return peak_mb()


def refine_case(
    case: Path, method: str, scenario: Scenario, fields: Path | None = None, refiner: Refiner | NullModel | None = None
) -> dict[str, Any]:
    """Refine one case by a row of METHODS or by `refiner`, then read its truth and score the result.

    `rmse_*` are relative RMSE over the fluid pixels of the true mask; that of the pressure, None where the case does
    not have it, is of the pressure less its mean. `seconds` and `cpu_seconds` include the first
    solution of the flow; `seconds_update` is the time for other observations of the same case, with filled caches.
    `within_2_std`, `stated_over_true` and `crps` are those of `flow_scores`; `peak_mb` and `gpu_mb` are the peak memory
    of this process and of what it has on a GPU.
    """
    chip = read_vessel_case(case)
    observations = scenario.observe(case)
    assumed_chip = with_mask_error(chip, scenario.mask)
    solver, refiner = FlowSolver(scenario.k), _on_device(refiner or METHODS[method], scenario.device)
    clear_cache()
    began, began_cpu = time.perf_counter(), time.process_time()
    assumed = solver.solve(assumed_chip)
    field = refiner.refine(assumed, observations, assumed_chip, solver)
    seconds, cpu_seconds = time.perf_counter() - began, time.process_time() - began_cpu
    seconds_update = seconds
    if method in _INCREMENTAL:
        other = replace(observations, flow_um_s=observations.flow_um_s * 1.01)
        began = time.perf_counter()
        refiner.refine(assumed, other, assumed_chip, solver)
        seconds_update = time.perf_counter() - began
    if fields is not None:
        with replacing(_field_path(fields, case, method)) as file:
            np.savez_compressed(file, velocity_um_s=field.velocity_um_s, mask=chip.mask)
    true = read_true_velocity(case)
    error = relative_rmse(field, replace(field, velocity_um_s=true.astype(np.float32)), chip.mask)
    scores = flow_scores(field, true, chip.mask)
    speed, true_speed = (np.linalg.norm(each[chip.mask], axis=-1) for each in (field.velocity_um_s, true))
    true_pa = read_true_pressure(case)
    return {
        **{"case": case.stem, "method": method},
        **{"rmse_vx": error.vx, "rmse_vy": error.vy, "rmse_v": error.v, "rmse_speed": _relative(speed, true_speed)},
        "rmse_p": None
        if true_pa is None
        else _relative(*(_less_mean(p[chip.mask]) for p in (field.pressure_pa, true_pa))),
        "seconds": seconds,
        "cpu_seconds": cpu_seconds,
        "seconds_update": seconds_update,
        "within_2_std": scores["within_2_sigma"],
        "stated_over_true": scores["stated_over_true"],
        "crps": scores["crps"],
        "peak_mb": peak_mb(),
        "gpu_mb": _gpu_mb(scenario.device),
        "note": field.note,
    }


def _relative(found: NDArray[np.floating], true: NDArray[np.floating]) -> float:
    return float(np.linalg.norm(found - true) / max(float(np.linalg.norm(true)), 1e-300))


def _less_mean(pressure: NDArray[np.floating]) -> NDArray[np.floating]:
    return pressure - pressure.mean()


def _on_device(method: Refiner | NullModel, device: Device) -> Refiner | NullModel:
    """The method with its network on a device; one without network is the same."""
    if isinstance(method, NullModel) or device == "cpu":
        return method
    fitted = {name: getattr(method, name) for name in ("pi_unet", "ni", "pinn", "unet")}
    return replace(method, **{name: replace(settings, device=device) for name, settings in fitted.items()})


def _gpu_mb(device: Device) -> float:
    """Peak memory of the GPU that this process has allocated, MB; 0 without a GPU."""
    if device == "cpu":
        return 0.0
    import torch

    return torch.cuda.max_memory_allocated() / 1e6


def summary(rows: Sequence[dict[str, Any]]) -> dict[str, float | None]:
    """Mean, standard deviation and median over cases; `mean` and `std` are those of rmse_v."""
    of = {key: [row[key] for row in rows] for key in rows[0]}
    moments: dict[str, float | None] = {}
    for name in ("rmse_vx", "rmse_vy", "rmse_v"):
        moments |= {f"{name}_mean": float(np.mean(of[name])), f"{name}_std": float(np.std(of[name]))}
    covered = [value for value in of["within_2_std"] if value is not None]
    return moments | {
        "mean": moments["rmse_v_mean"],
        "std": moments["rmse_v_std"],
        "worst": max(of["rmse_v"]),
        **{f"median_{name}": float(np.median(of[name])) for name in ("seconds", "cpu_seconds", "seconds_update")},
        "peak_mb": max(of["peak_mb"]),
        "within_2_std": float(np.mean(covered)) if covered else None,
        "stated_over_true": stated_over_true(zip(of["rmse_v"], of["stated_over_true"], strict=True)),
        "crps": float(np.mean(of["crps"])),
    }


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


def with_outliers(observations: Observations, fraction: float, seed: int) -> Observations:
    """Replace a fraction of the flows by draws of three times their root mean square; the stated std stays."""
    rng = np.random.default_rng([seed, 17])
    count = round(fraction * len(observations.std_um_s))
    wrong = rng.choice(len(observations.std_um_s), count, replace=False)
    flow = observations.flow_um_s.copy()
    flow[wrong] = 3.0 * np.sqrt((flow**2).sum(axis=1).mean()) * rng.standard_normal((count, 2))
    return replace(observations, flow_um_s=flow)


def _picture(case: Path, methods: Sequence[str], scenario: Scenario, fields: Path) -> FlowPanels:
    """Panels of the figure for a case that is scored."""
    chip, observations = read_vessel_case(case), scenario.observe(case)
    found = {}
    for method in methods:
        with np.load(_field_path(fields, case, method)) as field:
            found[method] = field["velocity_um_s"]
    observed = observations.position_um, observations.flow_um_s
    return FlowPanels(case.stem, chip.mask, chip.um_per_px, read_true_velocity(case), found, *observed)


def _field_path(fields: Path, case: Path, method: str) -> Path:
    return fields / f"{case.stem}.{method.replace(':', '_')}.npz"


def show(results: Results) -> None:
    """Print Table I; the seconds of an update and the single cases are in the JSON."""
    cases = {row["case"] for row in results["rows"]}
    components = {name: f"{{rmse_{name}_mean:.3f}}" for name in ("vx", "vy")}
    components["v"] = "{rmse_v_mean:.3f}±{rmse_v_std:.3f}"
    print_rows(
        f"Relative RMSE over {len(cases)} cases, noise {results['noise']} %, {results['share']} % of the route seen; "
        "2 std: share of the components; stated: over the true error",
        [{"method": method, **line} for method, line in results["summary"].items()],
        {
            **{"method": "{method}", **components, "worst": "{worst:.3f}", "CRPS": "{crps:.4f}"},
            **{"2 std": "{within_2_std:.0%}", "stated": "{stated_over_true:.2f}"},
            **{"s": "{median_seconds:.3g}", "MB": "{peak_mb:.0f}"},
        },
    )
    for case, reason in results["left_out"].items():
        say(f"{case} left out, {reason}")
