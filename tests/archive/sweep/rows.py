"""Rows of a sweep that nobody has made."""

from __future__ import annotations

from typing import Any

from flowrec.archive.sweep.replay_process import failed_row
from flowrec.archive.sweep.tasks import Task


def row_of(content: str, error: float | None = None, **settings: str) -> dict[str, Any]:
    row = failed_row(Task(f"{content}.mcap", content, tuple(settings.items())), "")
    figures = {
        "refined_flow_error": [0.3, error],
        "assumed_flow_error": [0.5, 0.5],
        "residual_um_s": [5.0, 4.0],
        "map": ["fvm", "gain"],
    }
    return row | {
        "figures": figures,
        "verdict": "good",
        "findings": ["odd"],
        "refinement": [],
        "cpu_s": 1.0,
        "error": None,
    }
