"""`flowrec bench solver`: the flow solver compared with exact and published solutions; its time and memory."""

from __future__ import annotations

import time
from collections.abc import Iterable
from typing import Any, Literal

import numpy as np

from flowrec.bench.complex_fluids import LAWS, law_bend_case, law_channel_case, law_oblique_case, law_speed_case
from flowrec.bench.exact_flows import bend_case, oblique_case, straight_case
from flowrec.bench.harness import Quick, Results, print_rows
from flowrec.bench.published_flows import cavity_case, cylinder_case
from flowrec.core import Bools, peak_mb, pool, progress
from flowrec.physics import (
    Chip,
    FlowSolver,
    Walls,
    bifurcation,
    find_openings,
    guess_inlets,
    straight,
    system,
    vessels,
    without_pockets,
)

Pattern = Literal["vessels", "posts"]
_PITCH_PX, _RADIUS_PX = 32, 13  # of the posts

# Title, and the keys of a row that are printed; the JSON has all keys.
_TABLES = {
    "channel": (
        "Plane Poiseuille flow along the pixels",
        ("width_px", "k", "profile_error_percent", "sampled_error_percent", "resistance_error_percent"),
    ),
    "oblique": (
        "Plane Poiseuille flow at an angle to the pixels, drawn as a mask; undecided: by the mask",
        (
            *("walls", "width_px", "k", "mean_resistance_error_percent", "largest_resistance_error_percent"),
            *("mean_undecided_percent", "largest_undecided_percent"),
        ),
    ),
    "bend": ("Flow around a bend between two circles", ("width_px", "k", "resistance_error_percent")),
    "cavity": (
        "Lid-driven cavity: deviation from Ghia, Ghia and Shin, in units of the lid speed",
        ("reynolds", "cells", "u_largest", "u_rms", "v_largest", "v_rms"),
    ),
    "cylinder": (
        "Cylinder in a channel, Re 20 (Schaefer-Turek 2D-1), drawn as a mask",
        (
            *("px_per_diameter", "k", "unknowns", "drag_error_percent", "lift_error_percent"),
            "pressure_difference_pa_error_percent",
        ),
    ),
    "law channel": (
        "Channel along the pixels of a fluid whose viscosity depends on the shear rate, beside a fine quadrature",
        ("law", "width_px", "k", "profile_error_percent", "resistance_error_percent"),
    ),
    "law oblique": (
        "The same at an angle to the pixels, with exact walls",
        ("law", "width_px", "k", "mean_profile_error_percent", "largest_profile_error_percent"),
    ),
    "law bend": ("The same around a bend between two circles", ("law", "k", "resistance_error_percent")),
    "law speed": (
        "CPU time of such a flow over that of a Newtonian one, nothing in the cache",
        ("pattern", "law", "k", "cpu_s", "newtonian_cpu_s", "over_newtonian"),
    ),
    "speed": ("Time and memory", ("pattern", "side_px", "k", "unknowns", "cold_s", "warm_s", "peak_memory_mb")),
}


def measure(quick: Quick = False) -> Results:
    """Rows by case, and a summary. `quick` leaves out cases that take more than a second."""
    widths, cuts = ((4, 8), (1, 2)) if quick else ((4, 8, 16), (1, 2, 4))
    angles = (15.0, 30.0) if quick else (5.0, 12.0, 20.0, 30.0, 37.0, 45.0)
    numbers, cells = ((100,), (16, 32)) if quick else ((100, 400, 1000), (32, 64, 128))
    shapes = ((10, 1),) if quick else ((10, 1), (10, 2), (20, 1), (20, 2))
    masks: list[tuple[Pattern, int, int]] = [("vessels", 128, 1)]
    if not quick:
        masks += [("vessels", 128, 2), ("vessels", 128, 4), ("vessels", 512, 1), ("vessels", 1024, 1)]
        masks += [("posts", 512, 1), ("posts", 1024, 1)]
    laws = ("power law 0.5",) if quick else tuple(LAWS)
    channels = ((12, 1),) if quick else ((6, 1), (12, 1), (12, 2), (24, 1))
    chips = (straight(),) if quick else (bifurcation(), vessels(1))
    walls: tuple[Walls, ...] = ("smooth", "pixel")
    cases: dict[str, Iterable[dict[str, Any]]] = {
        "channel": (straight_case(width, k) for width in widths for k in cuts),
        "oblique": (oblique_case(width, k, wall, angles) for wall in walls for width in (4, 8) for k in cuts),
        "bend": (bend_case(k) for k in cuts),
        "cavity": (cavity_case(size, reynolds) for reynolds in numbers for size in cells),
        "cylinder": (cylinder_case(px, k, "smooth") for px, k in shapes),
        "law channel": (law_channel_case(law, width, k) for law in laws for width, k in channels),
        "law oblique": (law_oblique_case(law, 12.0, k, angles) for law in laws for k in cuts[:2]),
        "law bend": (law_bend_case(law, k) for law in laws for k in cuts),
        "law speed": (row for chip in chips for row in law_speed_case(chip.name, chip, 1, 1 if quick else 5)),
        "speed": (speed_case(*mask) for mask in masks),
    }
    rows: list[dict[str, Any]] = []
    with progress("solving", len(cases), "kinds of cases") as done:
        for number, (case, found) in enumerate(cases.items(), 1):
            rows += ({"case": case, **row} for row in found)
            done(number)
    return {"rows": rows, "summary": _summary(rows)}


def speed_case(pattern: Pattern, side_px: int, k: int) -> dict[str, Any]:
    """Cold and warm seconds, unknowns and peak memory of a solve, measured in a process of its own."""
    with pool(1) as worker:
        return worker.submit(_speed, pattern, side_px, k).result()


def _speed(pattern: Pattern, side_px: int, k: int) -> dict[str, Any]:
    FlowSolver(1).solve(straight())  # imports and compiles
    mask = _mask(pattern, side_px)
    chip = without_pockets(Chip(pattern, mask, 10.0, guess_inlets(find_openings(mask)), 1.0, 1000.0))
    before_mb = peak_mb()
    began = time.perf_counter()
    FlowSolver(k).solve(chip)
    cold_s, after_mb = time.perf_counter() - began, peak_mb()
    other = chip.with_boundary(0.8 * chip.boundary_values, viscosity_mpa_s=1.2)
    began = time.perf_counter()
    FlowSolver(k).solve(other)
    warm_s = time.perf_counter() - began
    equations = system(chip, k)
    # Imbalance of mass in a cell, relative to the fastest velocity of a face.
    moving = equations.linear(np.array([[float(o.kind == "inlet")] for o in chip.openings]))[:, 0]
    padded = np.append(moving, 0.0)
    u, v = padded[equations.grid.u.number], padded[equations.grid.v.number]
    lost = np.abs(np.diff(u, axis=1) + np.diff(v, axis=0)).max() / np.abs(moving).max()
    return {
        "pattern": pattern,
        "side_px": side_px,
        "k": k,
        "fluid_px": int(chip.mask.sum()),
        "unknowns": int(equations.stream.curl.shape[1]),
        "cold_s": cold_s,
        "warm_s": warm_s,
        "peak_memory_mb": after_mb - before_mb,
        "mass_lost_in_a_cell": float(lost),
    }


def _mask(pattern: Pattern, side: int) -> Bools:
    if pattern == "vessels":
        drawn = vessels(1).mask[:, :256]
        at = np.arange(side) * 256 // side
        return drawn[at][:, at]
    y, x = np.mgrid[:side, :side] + 0.5
    x = x + (y // _PITCH_PX) % 2 * _PITCH_PX / 2
    mask = np.hypot(x % _PITCH_PX - _PITCH_PX / 2, y % _PITCH_PX - _PITCH_PX / 2) > _RADIUS_PX
    mask[:3] = mask[-3:] = False
    return mask


def _summary(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Observed orders of convergence, and extremes."""

    def of(case: str) -> list[dict[str, Any]]:
        return [row for row in rows if row["case"] == case]

    def order(coarse: float, fine: float) -> float:
        return float(np.log2(abs(coarse) / abs(fine)))

    bends = [row["resistance_error_percent"] for row in of("bend")]
    summary: dict[str, Any] = {
        "channel_largest_error_percent": max(abs(row["resistance_error_percent"]) for row in of("channel")),
        "bend_order": order(bends[0], bends[-1]) / (len(bends) - 1),
        "cylinder_finest_drag_error_percent": of("cylinder")[-1]["drag_error_percent"],
        "law_channel_largest_error_percent_at_12_px": max(
            row["profile_error_percent"] for row in of("law channel") if (row["width_px"], row["k"]) == (12, 1)
        ),
        "law_largest_time_over_newtonian": max(row["over_newtonian"] for row in of("law speed")),
        "mass_lost_in_a_cell": max(row["mass_lost_in_a_cell"] for row in of("speed")),
    }
    for walls in ("smooth", "pixel"):
        errors = [row["mean_resistance_error_percent"] for row in of("oblique") if row["walls"] == walls]
        summary[f"oblique_{walls}_mean_error_percent"] = float(np.mean(errors))
    for reynolds in sorted({row["reynolds"] for row in of("cavity")}):
        found = [row for row in of("cavity") if row["reynolds"] == reynolds]
        summary[f"cavity_re_{reynolds}_finest_u_largest"] = found[-1]["u_largest"]
        if len(found) > 2:
            # From the solutions alone: the table is accurate to a few thousandths.
            grids = np.array([row["u_at_quarters"] for row in found[-3:]])
            coarse, fine = np.linalg.norm(np.diff(grids, axis=0), axis=1)
            summary[f"cavity_re_{reynolds}_order"] = order(float(coarse), float(fine))
    return summary


def show(results: Results) -> None:
    """Print the results as tables."""

    def heading(key: str) -> str:
        return key.replace("_percent", " %").replace("_", " ")

    for case, (title, keys) in _TABLES.items():
        rows = [row for row in results["rows"] if row["case"] == case]
        numbers = {key for key in keys if isinstance(rows[0][key], float)}
        print_rows(title, rows, {heading(key): f"{{{key}{':.3g}' if key in numbers else '}'}" for key in keys})
    summary = [{"name": heading(key), "value": value} for key, value in results["summary"].items()]
    print_rows("Summary", summary, {"": "{name}", "value": "{value:.3g}"})
