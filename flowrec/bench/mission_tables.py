"""Tables of `flowrec bench missions`: outcomes by policy, and times of two policies on the same trips."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from flowrec.bench.harness import Results, paired_ratio, print_rows, wilson
from flowrec.core import say

_AS_PREDICTED = ("reached", "unreachable", "refused")  # outcomes that are no failure


@dataclass(frozen=True, slots=True)
class Row:
    """One mission. None or NaN if it was refused, or if there is no such value."""

    world: str
    seed: int
    chip: str
    way: str  # down, up
    map: str  # surveyed, assumed
    policy: str
    outcome: str  # reached, unreachable or refused (both before the start), or the failure
    note: str
    survey_contacts: int = 0
    contacts: int = 0  # while navigating, planning again included
    seconds: float | None = None  # from the adoption of the route to the goal
    optimum_s: float | None = None  # the least time for the same in the true flow
    ratio: float | None = None
    planned_s: float | None = None
    rms_um: float | None = None  # distance to the reference while navigating
    replans: int = 0
    beyond: int = 0  # commands to the coils that a lab's amplifier would have changed or refused
    latency_ms: float = math.nan
    radius_um: float = math.nan
    speed_limit_um_s: float = math.nan


def summary(rows: Sequence[Row]) -> dict[str, Any]:
    """Proportions with their Wilson 95 % intervals, and the arrival times over the least times."""
    ratios = np.array([row.ratio for row in rows if row.ratio is not None])
    errors = [row.rms_um / row.radius_um for row in rows if row.rms_um is not None]
    failed = [row for row in rows if row.outcome not in _AS_PREDICTED]
    counts = {
        "reached": sum(row.outcome == "reached" for row in rows),
        "unreachable": sum(row.outcome in ("unreachable", "refused") for row in rows),
        "without_contact": sum(row.contacts == 0 for row in rows),
        "survey_without_contact": sum(row.survey_contacts == 0 for row in rows),
        "honest": len(rows) - len(failed),
    }
    fast = int((ratios <= 1.1).sum())
    return {
        "missions": len(rows),
        **{name: _proportion(k, len(rows)) | {"count": k} for name, k in counts.items()},
        "failed": [f"{row.chip} {row.seed} {row.way} {row.map}: {row.outcome}" for row in failed],
        "ratio": {
            "median": float(np.median(ratios)),
            "mean": float(ratios.mean()),
            "worst": float(ratios.max()),
            "within_10_percent": _proportion(fast, len(ratios)),
        }
        if len(ratios)
        else None,
        "rms_radii": float(np.mean(errors)) if errors else None,
        "replans": sum(row.replans for row in rows),
    }


def _proportion(successes: int, count: int) -> dict[str, Any]:
    return {"share": successes / count, "wilson_95": wilson(successes, count)}


def compare_times(rows: Sequence[Row], a: str, b: str) -> dict[str, Any]:
    """Times of `a` over those of `b` on the trips on which both arrived."""
    times = {(row.policy, (row.seed, row.way, row.map)): row.seconds for row in rows if row.seconds}
    trips = sorted({trip for _, trip in times})
    both = [trip for trip in trips if (a, trip) in times and (b, trip) in times]
    return paired_ratio(np.array([times[a, trip] / times[b, trip] for trip in both]))


def show(results: Results) -> None:
    """Print the summary by world and policy, and the comparisons."""
    counts = {"reached": "reached", "refused": "unreachable", "either": "honest"}
    counts |= {"no contact": "without_contact", "survey": "survey_without_contact"}
    ratios = {name: f"{{ratio[{name}]:.2f}}" for name in ("median", "mean", "worst")}
    print_rows(
        f"Missions with {results['seeds']} seeds, coils {results['coils']}; Wilson 95 % intervals in brackets; "
        "refused: in advance; time over the least time",
        [
            {"world": world if index == 0 else "", "policy": name, **line}
            for world, lines in results["summary"].items()
            for index, (name, line) in enumerate(lines.items())
        ],
        {
            **{"world": "{world}", "policy": "{policy}", "n": "{missions}"},
            **{
                head: f"{{{key}[count]}} ({{{key}[wilson_95][0]:.0%}}-{{{key}[wilson_95][1]:.0%}})"
                for head, key in counts.items()
            },
            **ratios,
            "< 1.1": "{ratio[within_10_percent][share]:.0%}",
        },
    )
    for world, lines in results["summary"].items():
        for name, line in lines.items():
            for failure in line["failed"]:
                say(f"{world}, {name}: {failure}")
    if results["fault_count"]:
        say(f"{results['fault_count']} commands were beyond the limits of the coils")
    pairs = [
        {"world": world, "policies": name, **pair}
        for world, found in results["pairs"].items()
        for name, pair in found.items()
        if pair["count"]
    ]
    if pairs:
        print_rows(
            "Time of one over time of the other on the same trips",
            pairs,
            {
                **{"world": "{world}", "policies": "{policies}", "n": "{count}", "faster": "{less} of {count}"},
                "mean ratio (95 %)": "{mean:.3f} ({interval_95[0]:.3f} to {interval_95[1]:.3f})",
                **{"sign test p": "{sign_p:.1g}", "Wilcoxon p": "{wilcoxon_p:.1g}"},
            },
        )
