"""`flowrec bench solver`: the flow solver beside exact and published solutions, its speed and its memory."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np

from flowrec.bench.cavity import cavity_case
from flowrec.bench.channel import bend_case, oblique_case, straight_case
from flowrec.bench.cylinder import cylinder_case
from flowrec.bench.harness import Quick, Results
from flowrec.bench.speed import speed_case
from flowrec.terminal import table

# Title, and what is printed of a row under which head; the JSON has all of it.
_TABLES: dict[str, tuple[str, dict[str, str]]] = {
    "channel": (
        "Plane Poiseuille flow along the pixels",
        {"width_px": "px", "k": "k", "profile_error_percent": "profile %", "resistance_error_percent": "resistance %"},
    ),
    "oblique": (
        "Plane Poiseuille flow at an angle to the pixels, drawn as a mask",
        {
            "walls": "walls",
            "width_px": "px",
            "k": "k",
            "mean_resistance_error_percent": "resistance %, mean",
            "largest_resistance_error_percent": "largest",
            "mean_undecided_percent": "open by the mask %, mean",
            "largest_undecided_percent": "largest",
        },
    ),
    "bend": (
        "Flow around a bend between two circles",
        {"width_px": "px", "k": "k", "resistance_error_percent": "resistance %"},
    ),
    "cavity": (
        "Lid-driven cavity: off the table of Ghia, Ghia and Shin, speed of the lid = 1",
        {
            "reynolds": "Re",
            "cells": "cells",
            "u_largest": "u largest",
            "u_rms": "u rms",
            "v_largest": "v largest",
            "v_rms": "v rms",
        },
    ),
    "cylinder": (
        "Cylinder in a channel, Re 20 (Schaefer-Turek 2D-1), drawn as a mask",
        {
            "px_per_diameter": "px",
            "k": "k",
            "unknowns": "unknowns",
            "drag_error_percent": "drag %",
            "lift_error_percent": "lift %",
            "pressure_difference_pa_error_percent": "pressure %",
        },
    ),
    "speed": (
        "Speed and memory",
        {
            "pattern": "mask",
            "side_px": "px",
            "k": "k",
            "unknowns": "unknowns",
            "cold_s": "cold s",
            "warm_s": "warm s",
            "peak_memory_mb": "MB",
        },
    ),
}


def measure(quick: Quick = False) -> Results:
    """All figures; `quick` leaves out what takes more than a second."""
    rows: list[dict[str, Any]] = []

    def add(case: str, found: Iterable[dict[str, Any]]) -> None:
        rows.extend({"case": case, **row} for row in found)

    widths, cuts = ((4, 8), (1, 2)) if quick else ((4, 8, 16), (1, 2, 4))
    angles = (15.0, 30.0) if quick else (5.0, 12.0, 20.0, 30.0, 37.0, 45.0)
    add("channel", (straight_case(width, k) for width in widths for k in cuts))
    oblique = ((width, k, walls) for walls in ("smooth", "pixel") for width in (4, 8) for k in cuts)
    add("oblique", (oblique_case(width, k, walls, angles) for width, k, walls in oblique))  # type: ignore[arg-type]
    add("bend", (bend_case(k) for k in cuts))
    numbers, sizes = ((100,), (16, 32)) if quick else ((100, 400, 1000), (32, 64, 128))
    add("cavity", (cavity_case(cells, reynolds) for reynolds in numbers for cells in sizes))
    shapes = ((10, 1),) if quick else ((10, 1), (10, 2), (20, 1), (20, 2))
    add("cylinder", (cylinder_case(px, k, "smooth") for px, k in shapes))
    jobs = [("vessels", 128, 1)]
    if not quick:
        jobs += [("vessels", 128, 2), ("vessels", 128, 4), ("vessels", 512, 1), ("vessels", 1024, 1)]
        jobs += [("posts", 512, 1), ("posts", 1024, 1)]
    add("speed", (speed_case(pattern, side, k) for pattern, side, k in jobs))  # type: ignore[arg-type]
    return {
        "rows": rows,
        "summary": _summary(rows),
    }


def _summary(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Observed orders of convergence, and the extremes."""

    def of(case: str) -> list[dict[str, Any]]:
        return [row for row in rows if row["case"] == case]

    def order(coarse: float, fine: float) -> float:
        return float(np.log2(abs(coarse) / abs(fine)))

    bends = [row["resistance_error_percent"] for row in of("bend")]
    summary: dict[str, Any] = {
        "channel_largest_error_percent": max(abs(row["resistance_error_percent"]) for row in of("channel")),
        "bend_order": order(bends[0], bends[-1]) / (len(bends) - 1),
        "cylinder_finest_drag_error_percent": of("cylinder")[-1]["drag_error_percent"],
        "mass_lost_in_a_cell": max(row["mass_lost_in_a_cell"] for row in of("speed")),
    }
    for walls in ("smooth", "pixel"):
        errors = [row["mean_resistance_error_percent"] for row in of("oblique") if row["walls"] == walls]
        summary[f"oblique_{walls}_mean_error_percent"] = float(np.mean(errors))
    for reynolds in sorted({row["reynolds"] for row in of("cavity")}):
        found = [row for row in of("cavity") if row["reynolds"] == reynolds]
        summary[f"cavity_re_{reynolds}_finest_u_largest"] = found[-1]["u_largest"]
        if len(found) > 2:
            # Against itself: the table is no more accurate than a few thousandths.
            grids = np.array([row["u_at_quarters"] for row in found[-3:]])
            coarse, fine = np.linalg.norm(np.diff(grids, axis=0), axis=1)
            summary[f"cavity_re_{reynolds}_order"] = order(float(coarse), float(fine))
    return summary


def show(figures: dict[str, Any]) -> None:
    """Print the figures as tables."""
    for case, (title, columns) in _TABLES.items():
        rows = [row for row in figures["rows"] if row["case"] == case]
        table(title, tuple(columns.values()), [tuple(_text(row[key]) for key in columns) for row in rows])
    table(
        "Summary", ("", "value"), [(key.replace("_", " "), _text(value)) for key, value in figures["summary"].items()]
    )


def _text(value: Any) -> str:
    return f"{value:.3g}" if isinstance(value, float) else str(value)
