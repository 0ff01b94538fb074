"""`flowrec.solve` and `flowrec.refine`: the flow on a chip, and the flow that a person's measurements ask for."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any, TypedDict, Unpack

import numpy as np
from numpy.typing import ArrayLike

from flowrec.core import FlowField, Observations, UsageError, nearest_pixels
from flowrec.physics import Chip, ChipSettings, FlowSolver, load_chip
from flowrec.stages import Refiner
from flowrec.store import observations_of


class ChipOptions(TypedDict, total=False):
    """Values of a chip that go before those of its file; see chip.ChipSettings."""

    um_per_px: float
    inlets: tuple[str, ...]
    inlet_speed_um_s: float
    depth_um: float
    viscosity_mpa_s: float
    density_kg_m3: float


def solve(
    chip: Chip | Path | str | ArrayLike, *, solver: FlowSolver | None = None, **options: Unpack[ChipOptions]
) -> FlowField:
    """The steady flow on a chip for its boundary values, by finite volumes.

    >>> flow = flowrec.solve(mask, um_per_px=2.0, inlets=("left",), inlet_speed_um_s=200.0)
    >>> flow.plot()

    Parameters
    ----------
    chip : a Chip; the name of a built-in one; a file (PNG with a TOML beside it, or vessel case .npz); or a mask (h, w)
        of truth values, True in fluid, for which `um_per_px` is needed.
    solver : settings of the solver.
    options : um_per_px, inlets, inlet_speed_um_s, depth_um, viscosity_mpa_s, density_kg_m3, as in section [chip].

    Raises
    ------
    ChipError : no flow can be computed on such a chip. FlowError : the solver has no answer.
    """
    solver = solver or FlowSolver()
    chosen = _chip(chip, options)
    return replace(solver.solve(chosen), error_share=Refiner().prior_error_share(chosen, solver))


def refine(
    chip: Chip | Path | str | ArrayLike,
    observations: Any,
    *,
    method: str = "assimilate",
    radius_um: float | None = None,
    refiner: Refiner | None = None,
    solver: FlowSolver | None = None,
    **options: Unpack[ChipOptions],
) -> FlowField:
    """The flow on a chip that explains measurements of it best; its note says what was found.

    >>> flow = flowrec.refine("chip.png", "measured.csv")
    >>> flow.plot(show="error")

    Parameters
    ----------
    chip, options : as of `solve`; the boundary values are what is assumed before the measurements.
    observations : a CSV or Excel file, a DataFrame, columns by name, or an array (n, 4 to 9), with the columns x_um,
        y_um, u_um_s, v_um_s and, where known, std_um_s, own_u_um_s, own_v_um_s, time_s, tracer: that of each bead of
        a particle tracking, over stretches of equal length. Places are in the chip frame: x right and y down from the
        centre of the mask's first pixel.
    method : name of a row of refine.REFINERS.
    radius_um : of the robot or particle whose motion was measured; None: the flow itself was.
    refiner : settings of the methods; `method` goes before its own.

    Raises
    ------
    UsageError : measurements that are no such table, hold NaN, lie outside of the chip or all in solid; no such method.
    ChipError, FlowError : as of `solve`.
    """
    solver = solver or FlowSolver()
    chosen = _chip(chip, options)
    measured = observations_of(observations, radius_um)
    _check_places(measured, chosen)
    assumed = solver.solve(chosen)
    return replace(refiner or Refiner(), method=method).refine(assumed, measured, chosen, solver)


def _chip(chip: Chip | Path | str | ArrayLike, options: ChipOptions) -> Chip:
    if isinstance(chip, Chip):
        if options:
            raise UsageError(f"{next(iter(options))}: a Chip has its values; give them with a mask, a name or a file")
        return chip
    if isinstance(chip, Path) or (isinstance(chip, str) and Path(chip).suffix):
        return load_chip(ChipSettings(path=str(chip), **options))
    if isinstance(chip, str):
        return load_chip(ChipSettings(name=chip, **options))
    mask = np.asarray(chip)
    if mask.ndim != 2 or mask.dtype != np.bool_:
        raise UsageError(
            f"mask: has the shape {mask.shape} and holds {mask.dtype}; it must be (h, w) of truth values, True in fluid"
        )
    return load_chip(ChipSettings(**options), mask)


def _check_places(measured: Observations, chip: Chip) -> None:
    px = chip.um_per_px
    h, w = chip.mask.shape
    places = measured.position_um / px
    outside = np.flatnonzero(~((places >= -0.5) & (places <= (w - 0.5, h - 0.5))).all(axis=1))
    bounds = f"x from {-0.5 * px:g} to {(w - 0.5) * px:g} um and y from {-0.5 * px:g} to {(h - 0.5) * px:g} um"
    if len(outside):
        x_um, y_um = measured.position_um[outside[0]]
        raise UsageError(
            f"observations: {len(outside)} of {len(places)} places are outside of chip '{chip.name}', "
            f"which has {bounds}; the first is row {outside[0]}, ({x_um:g}, {y_um:g}) um"
        )
    if not chip.mask[nearest_pixels(places, chip.mask.shape)].any():
        raise UsageError(
            f"observations: all {len(places)} places are in solid on chip '{chip.name}'; is y counted downwards, in um?"
        )
