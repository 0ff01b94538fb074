"""`flowrec.solve` and `flowrec.refine`: the flow on a chip, and the flow that a person's measurements ask for."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any, TypedDict, Unpack

import numpy as np
from numpy.typing import ArrayLike

from flowrec.core import Bools, Floats, FlowField, Observations, UsageError, cells_at, check_ranges, nearest_pixels
from flowrec.physics import (
    SIDES,
    Chip,
    ChipSettings,
    FlowSolver,
    border,
    fluid_runs,
    load_chip,
    opening_names,
    sample,
    without_pockets,
)
from flowrec.stages import Refiner, ratios_along
from flowrec.store import observations_of

_OTHER_WAY_UP = 0.8  # of the measured speed in fluid if y is counted upwards, and less than half of it as given
_TIMES = 10.0  # faster or slower than assumed: the unit is doubted
_SURE, _MAD = 3.0, 1.48  # standard errors; a standard deviation over the median of the deviations
_BEHIND = 1.2  # times as fast as the map: it does not follow what was measured


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
    """The steady flow on a chip for its boundary values, by finite volumes; its note names the openings.

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
    UsageError : an option outside of its range. ChipError : no flow can be computed on such a chip. FlowError : the
        solver has no answer.
    """
    solver = solver or FlowSolver()
    chosen = _chip(chip, options)
    field = solver.solve(chosen)
    note = f"{field.note}; {_openings_text(chosen)}"
    return replace(field, note=note, error_share=Refiner().prior_error_share(chosen, solver))


def refine(
    chip: Chip | Path | str | ArrayLike,
    observations: Any,
    *,
    method: str = "assimilate",
    radius_um: float | None = None,
    window_um: float | None = None,
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
    window_um : side of the interrogation windows of a particle image velocimetry, over which each velocity is a mean;
        None: each is that at its place.
    refiner : settings of the methods; `method` goes before its own.

    Raises
    ------
    UsageError : no such method; an option outside of its range; measurements that are no such table or hold NaN, that
        lie outside of the chip, all in solid, or in fluid only if y is turned over, or that are many times as fast as
        the map that the method finds.
    ChipError, FlowError : as of `solve`.
    """
    solver = solver or FlowSolver()
    chosen = _chip(chip, options)
    measured = observations_of(observations, radius_um, window_um)
    _check_places(measured, chosen)
    assumed = solver.solve(chosen)
    refined = replace(refiner or Refiner(), method=method).refine(assumed, measured, chosen, solver)
    doubt = _doubt(measured, assumed, refined, chosen)
    return replace(refined, note=f"{refined.note}; {doubt}") if doubt else refined


def _chip(chip: Chip | Path | str | ArrayLike, options: ChipOptions) -> Chip:
    if isinstance(chip, Chip):
        if options:
            raise UsageError(f"{next(iter(options))}: a Chip has its values; give them with a mask, a name or a file")
        return chip
    settings = _settings(options)
    if isinstance(chip, Path) or (isinstance(chip, str) and Path(chip).suffix):
        return load_chip(replace(settings, path=str(chip)))
    if isinstance(chip, str):
        return load_chip(replace(settings, name=chip))
    mask = np.asarray(chip)
    if mask.ndim != 2 or mask.dtype != np.bool_:
        raise UsageError(
            f"mask: has the shape {mask.shape} and holds {mask.dtype}; it must be (h, w) of truth values, True in fluid"
        )
    return load_chip(settings, mask)


def _settings(options: ChipOptions) -> ChipSettings:
    """The section [chip] of the options; UsageError for what the section could not hold."""
    given: dict[str, Any] = dict(options)
    for name, value in given.items():
        if name == "inlets":
            given[name] = (value,) if isinstance(value, str) else tuple(value)
        elif value is not None and name in ChipOptions.__annotations__:
            try:
                given[name] = float(value)
            except (TypeError, ValueError) as error:
                raise UsageError(f"{name} = {value!r}: must be a number") from error
    settings = ChipSettings(**given)
    check_ranges(settings, "chip")
    return settings


def _openings_text(chip: Chip) -> str:
    """Inlets and outlets by name, fluid at the border without an opening, and fluid that stands still."""
    names = opening_names(chip.openings)
    kinds = [
        f"{kind}s {', '.join(name for name, each in zip(names, chip.openings, strict=True) if each.kind == kind)}"
        for kind in ("inlet", "outlet")
    ]
    closed = [
        f"{side} {first}-{last}"
        for side in SIDES
        for first, last in fluid_runs(border(chip.mask, side))
        if last > first and not any(o.side == side and o.first <= last and first <= o.last for o in chip.openings)
    ]
    reached = without_pockets(replace(chip, openings=tuple(o for o in chip.openings if o.kind == "inlet")))
    still = np.count_nonzero(chip.mask & ~reached.mask)
    return "; ".join(
        kinds
        + ([f"closed where fluid meets the border at {', '.join(closed)}"] if closed else [])
        + ([f"{still} px of fluid are reached by no inlet and stand still"] if still else [])
    )


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
    if not _in_fluid(measured, chip).any():
        raise UsageError(
            f"observations: all {len(places)} places are in solid on chip '{chip.name}'; is y counted downwards, in um?"
        )
    upwards = np.column_stack([places[:, 0], h - 1.0 - places[:, 1]])
    share, other_share = (_moving_share(measured, at, chip.mask) for at in (places, upwards))
    if other_share > _OTHER_WAY_UP and share < 0.5 * other_share:
        raise UsageError(
            f"observations: {100.0 * share:.0f} % of what moves is in fluid on chip '{chip.name}', and "
            f"{100.0 * other_share:.0f} % with y counted from its lower edge: count y downwards, and turn the sign of v"
        )


def _moving_share(measured: Observations, places: Floats, mask: Bools) -> float:
    """Share of the measured speed that is in fluid if its places are these (n, 2), in px; a wild row counts once."""
    speed = np.linalg.norm(measured.flow_um_s, axis=1)
    speed = np.minimum(speed, np.median(speed[speed > 0.0])) if (speed > 0.0).any() else np.ones(len(speed))
    inside = cells_at(places, mask.shape).inside
    inside[inside] = mask[nearest_pixels(places[inside], mask.shape)]
    return float(speed[inside].sum() / speed.sum())


def _doubt(measured: Observations, assumed: FlowField, refined: FlowField, chip: Chip) -> str:
    """A doubt about the unit, the sign or the direction of all measured speeds, in words; '': none.

    Raises UsageError where they are so fast that the map does not follow.
    """
    times = _times(measured, assumed, chip)
    if times is None:
        return ""
    if 1.0 / _TIMES <= abs(times) <= _TIMES:
        return "the measured flow runs against the assumed one" if times < 0.0 else ""
    if abs(times) < 1.0 / _TIMES and _speeds(measured, assumed, chip) > 1.0 / _TIMES:
        return "the measured flow runs across the assumed one: are u and v exchanged?"
    behind = _times(measured, refined, chip)
    text = f"the measured flow is {float(f'{times:.2g}'):g} times the assumed one: is it in um/s?"
    if abs(times) > _TIMES and behind is not None and abs(behind) > _BEHIND:
        speed = abs(times) * max(abs(o.value) for o in chip.openings if o.kind == "inlet")
        raise UsageError(
            f"observations: {text} The method {refined.method} finds no flow that is as fast; "
            f"if the unit is right, give inlet_speed_um_s near {float(f'{speed:.2g}'):g}"
        )
    return text


def _speeds(measured: Observations, field: FlowField, chip: Chip) -> float:
    """The median measured speed over that of a field at the same places, whatever the directions."""
    inside = _in_fluid(measured, chip)
    here, there = measured.flow_um_s[inside], sample(field, measured.position_um[inside])
    return float(np.median(np.linalg.norm(here, axis=1)) / np.median(np.linalg.norm(there, axis=1)))


def _in_fluid(measured: Observations, chip: Chip) -> Bools:
    """(n,) True for rows in fluid."""
    return np.asarray(chip.mask[nearest_pixels(measured.position_um / chip.um_per_px, chip.mask.shape)])


def _times(measured: Observations, field: FlowField, chip: Chip) -> float | None:
    """The measured flow over that of a field at the same places, a median; None: noise hides it, or nothing flows."""
    inside = _in_fluid(measured, chip)
    flow, std = measured.flow_um_s[inside], measured.std_um_s[inside]
    there = sample(field, measured.position_um[inside])
    ratio, fast = ratios_along(flow, there)
    if not len(ratio):
        return None
    times = float(np.median(ratio))
    stated, seen = np.median(std[fast] / np.hypot(*there[fast].T)), _MAD * np.median(np.abs(ratio - times))
    error = float(max(stated, seen)) / np.sqrt(len(ratio))
    return times if _SURE * error < max(abs(times), 1.0 / _TIMES) else None
