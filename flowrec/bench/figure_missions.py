"""The figure of `flowrec bench missions`: arrival over optimum per policy, trips joined, failures marked."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from flowrec.bench.figure_flow import INK, QUIET

_COLOURS = {"down": "#2f6f8f", "up": "#b5532a"}
_TOP = 3.0  # what is beyond is drawn on the edge
_GOOD = ("reached", "unreachable", "refused")


def draw(path: Path, figures: dict[str, Any]) -> None:
    """Write a PNG from the figures of the bench: one panel per map (surveyed, assumed)."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    rows, policies = figures["rows"], list(figures["summary"])
    maps = list(dict.fromkeys(row["map"] for row in rows))
    figure = Figure(figsize=(1.5 + 1.35 * len(policies) * len(maps), 4.4), layout="constrained", dpi=160)
    FigureCanvasAgg(figure)
    axes = figure.subplots(1, len(maps), sharey=True, squeeze=False)[0]
    for ax, how in zip(axes, maps, strict=True):
        for way, colour in _COLOURS.items():
            some = [row for row in rows if row["map"] == how and row["way"] == way]
            shift = -0.16 if way == "down" else 0.16
            for seed in sorted({row["seed"] for row in some}):
                trip = {row["policy"]: row for row in some if row["seed"] == seed}
                ratios = [trip[name]["ratio"] if name in trip else None for name in policies]
                places = [at + shift for at, ratio in enumerate(ratios) if ratio is not None]
                shown = [min(ratio, _TOP) for ratio in ratios if ratio is not None]
                ax.plot(places, shown, color=colour, alpha=0.15, lw=0.7)
                ax.scatter(places, shown, s=9, color=colour, alpha=0.6, linewidths=0.0)
            for at, name in enumerate(policies):
                mine = [row for row in some if row["policy"] == name]
                ratios = [row["ratio"] for row in mine if row["ratio"] is not None]
                if ratios:
                    middle = min(float(np.median(np.array(ratios))), _TOP)
                    label = {"down": "with the flow", "up": "against it"}[way] if at == 0 else None
                    ax.plot([at + shift - 0.12, at + shift + 0.12], [middle] * 2, color=colour, lw=2.2, label=label)
                failed = sum(row["outcome"] not in _GOOD for row in mine)
                touched = sum(row["contacts"] > 0 for row in mine)
                if failed or touched:
                    note = " ".join([f"{failed}×" if failed else "", f"{touched}▮" if touched else ""]).strip()
                    ax.annotate(note, (at + shift, _TOP), ha="center", va="top", fontsize=8, color=colour)
        ax.axhline(1.0, color=INK, lw=0.8)
        ax.axhline(1.1, color=QUIET, lw=0.8, ls=":")
        ax.set_xticks(range(len(policies)), policies, fontsize=9, color=INK)
        ax.set_xlim(-0.5, len(policies) - 0.5)
        ax.set_ylim(0.9, _TOP)
        ax.set_title(f"on the {how} map", fontsize=10, color=INK)
        ax.tick_params(labelsize=8, color=INK, labelcolor=INK)
        for side in ("top", "right"):
            ax.spines[side].set_visible(False)
    axes[0].set_ylabel("arrival time / optimum in the true flow", fontsize=9, color=INK)
    axes[0].legend(fontsize=8, frameon=False, loc="upper left")
    figure.suptitle(
        f"{figures['seeds']} worlds, inlet flows {100 * figures['world']['flow_error']:g} % off; bars are medians, "
        "lines join the same trip; × failed, ▮ touched a wall",
        fontsize=8.5,
        color=INK,
        x=0.01,
        ha="left",
    )
    figure.savefig(path)
