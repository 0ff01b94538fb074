"""The [chip] section of a config: which chip, and what is to be said differently about it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from flowrec.chip.chip import Walls
from flowrec.ranges import Range, Seed


@dataclass(frozen=True, slots=True)
class ChipSettings:
    """A built-in chip by name or a chip of one's own by path; None keeps what the chip itself says."""

    name: str = "bifurcation"  # bifurcation, straight, vessels
    path: str = ""  # instead of the name: *.png (*.toml beside it), *.toml (*.png beside it) or *.npz vessel case
    seed: Seed = 0  # of the vessels
    um_per_px: Annotated[float, Range(1e-3, 1e3)] | None = None  # wanted for a PNG that has no TOML
    walls: Walls | None = None
    # channel depth, for the depth-averaged friction; 0: two-dimensional
    depth_um: Annotated[float, Range(0.0, 1e5)] | None = None
    viscosity_mpa_s: Annotated[float, Range(1e-3, 1e5)] | None = None
    density_kg_m3: Annotated[float, Range(1.0, 3e4)] | None = None
    # mean speed of the fastest inlet; the others keep their ratio to it
    inlet_speed_um_s: Annotated[float, Range(0.0, 1e7)] | None = None
    # Openings that are inlets, all others outlets at 0 Pa: "left:0" is the first on the left from the top,
    # "top:1" the second on the top from the left, "left" every one on the left.
    inlets: tuple[str, ...] = ()
