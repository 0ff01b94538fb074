"""`flowrec bench grid`: the numbers of refine/model_error.py anew, for when the solver's walls have changed.

Cases whose truth comes from a fine grid are solved with their true parameters on the grid in use and on one twice as
coarse. What the fine grid still adds is a share of the difference between the two; what is left is the local error.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from flowrec.chip.vessel_case import read_true_chip, read_true_velocity, read_vessel_case
from flowrec.errors import UsageError
from flowrec.flow import FlowSolver
from flowrec.refine.discretisation_error import around
from flowrec.terminal import table

WITHIN_TWO = 0.9545  # of a Gaussian


def measure(folder: Path, k: int = 2) -> dict[str, Any]:
    """Per case the error with and without the share, and the settings of ModelError that fit all cases."""
    if k < 2:
        raise UsageError("bench grid: -k 1 has no coarser grid; choose 2 or 4")
    cases = sorted(folder.glob("*.npz"))
    if not cases:
        raise UsageError(f"{folder}: no vessel case (*.npz) in it")
    rows: list[dict[str, Any]] = []
    local = []
    for case in cases:
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
        scale = np.repeat(around(chip.mask, difference), 2)
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
    rows = [
        (row["case"], f"{row['share']:.2f}", f"{row['error']:.4f}", f"{row['left']:.4f}") for row in figures["rows"]
    ]
    settings = ", ".join(f"{name} = {figures[name]:.3f}" for name in ("share", "share_std", "left_share"))
    table(f"Error of the grid at k = {figures['k']}: {settings}", ("case", "share", "error", "left"), rows)
