"""`python -m tests.perf.grid DIR`: fit the constants of refine/discretisation_error.py, after a change of the solver.

Cases whose truth comes from a fine grid are solved with their true parameters on the grid in use and on one twice as
coarse. The remaining error is modelled as a fraction of the difference of the two, plus a local error.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from flowrec.bench.harness import Results, print_rows, run, vessel_cases
from flowrec.bench.vessel_truth import read_true_chip, read_true_velocity
from flowrec.core import UsageError
from flowrec.physics import FlowSolver, read_vessel_case
from flowrec.stages.refine.discretisation_error import local_rms

WITHIN_TWO = 0.9545  # of a Gaussian


def measure(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="Vessel cases (*.npz) with a truth on a fine grid.")],
    k: Annotated[int, typer.Option("-k", help="Subcells of the solver per pixel side: 2 or 4.")] = 2,
) -> Results:
    """Per case the error with and without the share, and the settings of ModelError that fit all cases."""
    if k < 2:
        raise UsageError("grid: -k 1 has no coarser grid; choose 2 or 4")
    rows: list[dict[str, Any]] = []
    local = []
    for case in vessel_cases(folder):
        believed = read_vessel_case(case)
        chip, truth = read_true_chip(case, believed), read_true_velocity(case)[believed.mask]
        fine, coarse = (
            replace(FlowSolver(), k=cells).solve(chip).velocity_um_s[chip.mask].astype(np.float64)
            for cells in (k, k // 2)
        )
        beyond, difference = truth - fine, fine - coarse
        share = float((beyond * difference).sum() / (difference**2).sum())
        size = float(np.linalg.norm(truth))
        left = beyond - share * difference
        scale = np.repeat(local_rms(chip.mask, difference), 2)
        moving = scale > 1e-6 * scale.max()  # stagnant corners have no error to speak of
        local.append(np.abs(left).ravel()[moving] / scale[moving])
        rows.append(
            {
                "case": case.stem,
                "share": share,
                "error": float(np.linalg.norm(beyond)) / size,
                "left": float(np.linalg.norm(left)) / size,
            }
        )
    shares = np.array([row["share"] for row in rows])
    return {
        "k": k,
        "rows": rows,
        "share": float(shares.mean()),
        "share_std": float(shares.std()),
        "left_share": float(np.quantile(np.concatenate(local), WITHIN_TWO)) / 2.0,
    }


def show(figures: dict[str, Any]) -> None:
    """Print the cases and the settings."""
    settings = ", ".join(f"{name} = {figures[name]:.3f}" for name in ("share", "share_std", "left_share"))
    columns = {"case": "{case}", "share": "{share:.2f}", "error": "{error:.4f}", "left": "{left:.4f}"}
    print_rows(f"Error of the grid at k = {figures['k']}: {settings}", figures["rows"], columns)


if __name__ == "__main__":
    run(measure, show)
