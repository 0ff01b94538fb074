"""`flowrec bench track`: the paper's tracking study. How well each law keeps a robot on a lemniscate in a vortex.

The true Observer and Controller stages on a plant that is solved exactly (lemniscate.py). `policy` is not among them:
it follows no reference.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from typing import Annotated, Any

import numpy as np
import typer
from scipy.spatial import KDTree

from flowrec.bench.figure_track import draw
from flowrec.bench.harness import FigureFile, Results
from flowrec.bench.lemniscate import CENTRE_UM, PERIOD_S, Flight, World, fly, lemniscate
from flowrec.control import Controller
from flowrec.estimation import Observer
from flowrec.estimation.kalman import Kalman
from flowrec.terminal import progress, table

V_MAX_UM_S = 1000.0
NO_LIMIT_UM_S = 1e6
CONVERGED_UM = 50.0
IDEAL = World()
ALL = World(delay_s=0.04, noise_um=10.0, map_error=0.1)
WORLDS = {"ideal": IDEAL, "all": ALL}
STEP_OUTS_UM_S = (600.0, 500.0)


@dataclass(frozen=True, slots=True)
class Law:
    """A controller with its observer."""

    method: str
    observer: str
    v_max_um_s: float = V_MAX_UM_S


# Luenberger hands the measured position on as it is, as in the paper.
LAWS = {
    "paper, with compensation": Law("ff_fb", "luenberger"),
    "paper, without": Law("ff_fb_no_flow", "luenberger"),
    "paper, with observer": Law("ff_fb_observer", "luenberger"),
    "paper as printed": Law("ff_fb_literal", "luenberger"),
    "paper as printed, no limit": Law("ff_fb_literal", "luenberger", NO_LIMIT_UM_S),
    "paper's law, kalman_map": Law("ff_fb", "kalman_map"),
    "vector, luenberger": Law("vector", "luenberger"),
    "vector, kalman": Law("vector", "kalman"),
    "vector, kalman_map": Law("vector", "kalman_map"),
}
FIRST = ("paper, with compensation", "paper, without", "paper, with observer")
OURS = ("paper, with compensation", "vector, kalman", "vector, kalman_map")

# The paper's reference does not wait; ours goes no faster than the robot can, and by default also waits for it.
_FIXED = Controller(lag_free_radii=1e9, lag_full_radii=2e9, pace_share=1e9)
PACES = {
    "as planned": _FIXED,
    "no faster than can be": replace(_FIXED, pace_share=Controller().pace_share),
    "and waits": Controller(),
}


@dataclass(frozen=True, slots=True)
class Score:
    """Means over the seeds; errors are distances to the reference in um."""

    law: str
    world: str
    rmse_um: float
    steady_um: float  # the same over the second turn
    off_curve_um: float  # distance to the curve, over the second half of the time
    converged_s: float | None  # from then on within 50 um in every run; None: never
    observer_um_s: float  # RMS of what the observer misses of the flow, over the second half
    progress: float  # share of the two turns that the reference went
    demand_um_s: float  # the largest


def measure(
    seeds: Annotated[int, typer.Option(min=1, help="Runs with noise per law.")] = 5, figure: FigureFile = None
) -> Results:
    """Every law in both worlds, and the laws where step-out binds, with and without retiming."""
    flown: dict[tuple[str, str], list[Flight]] = {}
    total = len(LAWS) * len(WORLDS) + 2 * len(STEP_OUTS_UM_S) * len(PACES)
    bound: list[Score] = []
    with progress("tracking", total) as done:
        for world_name, world in WORLDS.items():
            for name, law in LAWS.items():
                flown[name, world_name] = flights(law, _FIXED, world, seeds)
                done(len(flown))
        for top_um_s in STEP_OUTS_UM_S:
            world = replace(ALL, step_out_um_s=top_um_s)
            for name in ("paper, with compensation", "vector, kalman_map"):
                for pace, controller in PACES.items():
                    made = flights(LAWS[name], controller, world, seeds)
                    bound.append(score(f"{name}; {pace}", f"step-out at {top_um_s:g} um/s", made))
                    done(len(flown) + len(bound))
    if figure is not None:
        first = {name: flown[name, "ideal"][0] for name in FIRST}
        ours = {name: flown[name, "all"][0] for name in OURS}
        draw(figure, lemniscate(1).waypoints_um - CENTRE_UM, first, ours)
    return {
        "seeds": seeds,
        "v_max_um_s": V_MAX_UM_S,
        "worlds": {name: asdict(world) for name, world in WORLDS.items()},
        "rows": [asdict(score(name, world, made)) for (name, world), made in flown.items()],
        "step_out": [asdict(score) for score in bound],
    }


def flights(law: Law, pace: Controller, world: World, seeds: int) -> list[Flight]:
    """One run per seed; without noise all are the same."""
    # What a parked robot's track would say of the camera.
    kalman = Kalman(position_noise_um=world.noise_um if world.noise_um > 0.0 else None)
    observer = Observer(method=law.observer, kalman=kalman)
    controller, robot = replace(pace, method=law.method), world.robot(law.v_max_um_s)
    return [fly(controller, observer, robot, world, seed) for seed in range(seeds if world.noise_um > 0.0 else 1)]


def score(name: str, world: str, flown: list[Flight]) -> Score:
    """Means over flights."""
    steady = flown[0].time_s >= PERIOD_S
    curve = KDTree(lemniscate(1).waypoints_um - CENTRE_UM)  # marked every 3 um
    converged = [_converged_s(flight) for flight in flown]
    off = [curve.query(flight.position_um[steady])[0] for flight in flown]
    return Score(
        law=name,
        world=world,
        rmse_um=_mean([_rms(flight.error_um) for flight in flown]),
        steady_um=_mean([_rms(flight.error_um[steady]) for flight in flown]),
        off_curve_um=_mean([_rms(distance) for distance in off]),
        converged_s=None if None in converged else _mean([value for value in converged if value is not None]),
        observer_um_s=_mean([_rms(flight.flow_miss_um_s[steady]) for flight in flown]),
        progress=_mean([flight.progress_s[-1] / flight.time_s[-1] for flight in flown]),
        demand_um_s=max(float(np.hypot(*flight.demand_um_s.T).max()) for flight in flown),
    )


def _converged_s(flight: Flight) -> float | None:
    """When the error came within 50 um to stay there; None if it never did."""
    out = np.flatnonzero(flight.error_um > CONVERGED_UM)
    if not len(out):
        return 0.0
    return float(flight.time_s[out[-1] + 1]) if out[-1] + 1 < len(flight.time_s) - 30 else None


def _rms(values: np.ndarray[Any, np.dtype[np.float64]]) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def _mean(values: list[float]) -> float:
    return float(np.mean(values))


def show(figures: dict[str, Any]) -> None:
    """Print both tables."""
    rows: list[tuple[str, ...]] = []
    for name in LAWS:
        cells: list[str] = []
        for world in WORLDS:
            row = next(row for row in figures["rows"] if row["law"] == name and row["world"] == world)
            settled = row["converged_s"]
            cells += [
                f"{row['rmse_um']:.0f}",
                f"{row['steady_um']:.1f}",
                "never" if settled is None else f"{settled:.1f}",
            ]
        rows.append((name, *cells))
    table(
        "Lemniscate, distance to the reference in um; all: 40 ms latency, 10 um noise, flow map 10 % too strong",
        ("law", "ideal RMSE", "steady", "< 50 um, s", "all RMSE", "steady", "< 50 um, s"),
        rows,
    )
    table(
        "Where step-out binds (all)",
        ("law; pace of the reference", "step-out", "RMSE", "steady", "off the curve", "went, %"),
        [
            (
                row["law"],
                row["world"].removeprefix("step-out at "),
                f"{row['rmse_um']:.0f}",
                f"{row['steady_um']:.1f}",
                f"{row['off_curve_um']:.1f}",
                f"{100 * row['progress']:.1f}",
            )
            for row in figures["step_out"]
        ],
    )
